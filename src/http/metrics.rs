//! The figures of this process for Prometheus. Requests are counted as they go by.

use std::sync::OnceLock;
use std::time::Duration;

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, histogram};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};

const REQUEST_SECONDS: &str = "sci_recon_http_request_duration_seconds";
const BUCKETS: [f64; 10] = [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0, 30.0];

/// The figures of this process.
#[derive(Debug, Clone)]
pub struct Metrics(PrometheusHandle);

impl Metrics {
    /// Begins to count, for the whole process; a second call gives the same figures.
    pub fn install() -> Result<Self, BuildError> {
        static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
        if let Some(handle) = HANDLE.get() {
            return Ok(Self(handle.clone()));
        }
        let handle = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Full(REQUEST_SECONDS.into()), &BUCKETS)?
            .install_recorder()?;
        describe();
        Ok(Self(HANDLE.get_or_init(|| handle).clone()))
    }

    /// Folds what was observed into the histograms; to be called every few seconds.
    pub fn upkeep(&self) {
        self.0.run_upkeep();
    }

    pub(super) fn render(&self) -> String {
        self.0.render()
    }
}

fn describe() {
    describe_counter!("sci_recon_http_requests_total", "Requests answered.");
    describe_histogram!(REQUEST_SECONDS, Unit::Seconds, "Time from a request to its answer.");
    describe_counter!("sci_recon_upload_bytes_total", Unit::Bytes, "Bytes of uploads received.");
    describe_counter!("sci_recon_worker_exits_total", "Worker processes that ended, by reason.");
    describe_gauge!("sci_recon_jobs", "Jobs on record, by state.");
    describe_gauge!("sci_recon_tasks", "Tasks on record, by kind and state.");
    describe_counter!("sci_recon_tasks_done_total", "Tasks done, by kind.");
    describe_counter!("sci_recon_task_seconds_total", Unit::Seconds, "Seconds of tasks done.");
    describe_counter!("sci_recon_solver_iterations_total", "Solver iterations done.");
    describe_counter!("sci_recon_denoiser_passes_total", "Passes of the deep denoiser done.");
    describe_gauge!(
        "sci_recon_disk_promised_bytes",
        Unit::Bytes,
        "Bytes promised to jobs and uploads."
    );
    describe_gauge!("sci_recon_workers", "Worker processes alive.");
    describe_gauge!("sci_recon_blobs", "Files in the content-addressed store.");
    describe_gauge!("sci_recon_blob_bytes", Unit::Bytes, "Bytes of files in that store.");
    describe_gauge!("sci_recon_damaged_files", "Stored files known to be damaged or missing.");
    describe_gauge!("sci_recon_disk_free_bytes", Unit::Bytes, "Bytes free on the disk.");
    describe_gauge!("sci_recon_disk_size_bytes", Unit::Bytes, "Bytes of the disk.");
}

/// Counts a request. `route` is the pattern and not the path: there are few patterns.
pub(super) fn observe(method: &str, route: &str, status: u16, took: Duration) {
    let (method, route) = (method.to_owned(), route.to_owned());
    counter!("sci_recon_http_requests_total", "method" => method.clone(), "route" => route.clone(),
        "status" => status.to_string())
    .increment(1);
    histogram!(REQUEST_SECONDS, "method" => method, "route" => route).record(took.as_secs_f64());
}
