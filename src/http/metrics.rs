//! Metrics for Prometheus. Requests are counted in this process; figures of labs and tasks come from the database.

use std::sync::OnceLock;
use std::time::Duration;

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, histogram};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use strum::VariantArray;

use engine::job::JobState;
use store::{LabFigures, TaskTotals};

const REQUEST_SECONDS: &str = "sci_recon_http_request_duration_seconds";
const BUCKETS: [f64; 10] = [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0, 30.0];

/// The metrics of this process.
#[derive(Debug, Clone)]
pub struct Metrics(PrometheusHandle);

impl Metrics {
    /// Installs the recorder of this process. A second call returns the same metrics.
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

    /// Merges new observations into the histograms. Call this every few seconds.
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
    describe_gauge!("sci_recon_jobs", "Jobs in the database, by state.");
    describe_gauge!("sci_recon_tasks", "Tasks in the database, by kind and state.");
    describe_counter!("sci_recon_tasks_done_total", "Tasks done, by kind.");
    describe_counter!("sci_recon_solver_iterations_total", "Solver iterations done.");
    describe_counter!("sci_recon_denoiser_passes_total", "Passes of the deep denoiser done.");
    describe_gauge!(
        "sci_recon_disk_promised_bytes",
        Unit::Bytes,
        "Bytes promised to jobs and uploads."
    );
    describe_gauge!("sci_recon_workers", "Worker processes alive.");
    describe_gauge!(
        "sci_recon_tile_workers",
        "Workers alive that take tiles, on this machine and others."
    );
    describe_gauge!("sci_recon_blobs", "Files in the content-addressed store.");
    describe_gauge!("sci_recon_blob_bytes", Unit::Bytes, "Bytes of files in that store.");
    describe_gauge!("sci_recon_damaged_files", "Stored files known to be damaged or missing.");
    describe_gauge!("sci_recon_disk_free_bytes", Unit::Bytes, "Bytes free on the disk.");
    describe_gauge!("sci_recon_disk_size_bytes", Unit::Bytes, "Bytes of the disk.");
}

/// Number of labs with separate figures. The figures of all other labs are added up as `lab="_others"`, which is not a
/// valid name of a lab.
const MAX_LABS: usize = 100;

/// Figures that are read from the database for each answer. They depend on the access of the request.
#[derive(Debug, Default)]
pub(super) struct Figures(String);

impl Figures {
    /// Writes the header of a figure. Its kind is `counter` or `gauge`.
    fn describe(&mut self, name: &str, kind: &str, help: &str) {
        self.0 += &format!("# HELP {name} {help}\n# TYPE {name} {kind}\n");
    }

    /// Writes a value. Values of labels are names from the service, which need no escaping.
    fn add(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        let labels: Vec<_> =
            labels.iter().map(|(key, value)| format!("{key}=\"{value}\"")).collect();
        self.0 += &format!("{name}{{{}}} {value}\n", labels.join(","));
    }

    /// Adds the duration of finished tasks, by kind.
    pub(super) fn add_tasks(&mut self, totals: &[TaskTotals]) {
        let name = "sci_recon_task_seconds_total";
        self.describe(name, "counter", "Seconds of tasks done.");
        for done in totals {
            self.add(name, &[("kind", &done.kind)], done.seconds);
        }
    }

    #[allow(clippy::cast_precision_loss)] // counts and bytes far below 2^53
    pub(super) fn add_labs(&mut self, labs: &[LabFigures]) {
        let name = |lab: usize| {
            labs.get(lab)
                .filter(|_| lab < MAX_LABS)
                .map_or("_others", |figures| figures.lab.as_str())
        };
        let jobs = |lab: &LabFigures, state| lab.jobs.get(&state).copied().unwrap_or_default();
        let figure = "sci_recon_lab_jobs";
        self.describe(figure, "gauge", "Jobs of a lab in the database, by state.");
        for &state in JobState::VARIANTS {
            for (lab, value) in with_others_added_up(labs, |lab| jobs(lab, state) as f64) {
                self.add(figure, &[("lab", name(lab)), ("state", state.into_str())], value);
            }
        }
        type Value = fn(&LabFigures) -> f64;
        let figures: [(&str, &str, &str, Value); 5] = [
            (
                "sci_recon_lab_jobs_begun_total",
                "counter",
                "Jobs of a lab that have started.",
                |lab| lab.jobs_begun as f64,
            ),
            (
                "sci_recon_lab_wait_seconds_total",
                "counter",
                "Seconds that started jobs of a lab waited for their first task.",
                |lab| lab.wait_seconds,
            ),
            (
                "sci_recon_lab_cpu_seconds_total",
                "counter",
                "CPU seconds of finished tasks of a lab.",
                |lab| lab.cpu_seconds,
            ),
            (
                "sci_recon_lab_result_bytes",
                "gauge",
                "Bytes of the results of a lab's jobs.",
                |lab| lab.result_bytes as f64,
            ),
            (
                "sci_recon_lab_longest_wait_seconds",
                "gauge",
                "Waiting time of the oldest job of a lab that has not started; _others is a sum.",
                |lab| lab.longest_wait,
            ),
        ];
        for (figure, kind, help, value) in figures {
            self.describe(figure, kind, help);
            for (lab, value) in with_others_added_up(labs, value) {
                self.add(figure, &[("lab", name(lab))], value);
            }
        }
    }

    pub(super) fn into_text(self) -> String {
        self.0
    }
}

/// The value of each of the first labs, with its index. The last item is the sum of all other labs.
fn with_others_added_up(
    labs: &[LabFigures],
    value: impl Fn(&LabFigures) -> f64,
) -> Vec<(usize, f64)> {
    let (named, others) = labs.split_at(labs.len().min(MAX_LABS));
    let mut values: Vec<_> = named.iter().map(&value).enumerate().collect();
    if !others.is_empty() {
        values.push((MAX_LABS, others.iter().map(value).sum()));
    }
    values
}

/// Counts a request. `route` is the pattern and not the path, which limits the number of time series.
pub(super) fn observe(method: &str, route: &str, status: u16, took: Duration) {
    let (method, route) = (method.to_owned(), route.to_owned());
    counter!("sci_recon_http_requests_total", "method" => method.clone(), "route" => route.clone(),
        "status" => status.to_string())
    .increment(1);
    histogram!(REQUEST_SECONDS, "method" => method, "route" => route).record(took.as_secs_f64());
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::{Figures, MAX_LABS};
    use engine::job::JobState;
    use store::LabFigures;

    #[test]
    fn many_labs_are_added_up() {
        let lab = |number: usize| LabFigures {
            lab: format!("lab-{number:03}").parse().unwrap(),
            jobs: HashMap::from([(JobState::Queued, 1)]),
            jobs_begun: 2,
            wait_seconds: 0.5,
            longest_wait: 1.5,
            cpu_seconds: 0.25,
            result_bytes: 7,
        };
        let labs: Vec<_> = (0..MAX_LABS + 4).map(lab).collect();
        let mut figures = Figures::default();
        figures.add_labs(&labs);
        let text = figures.into_text();
        assert!(text.contains("sci_recon_lab_cpu_seconds_total{lab=\"lab-099\"} 0.25\n"), "{text}");
        assert!(text.contains("sci_recon_lab_cpu_seconds_total{lab=\"_others\"} 1\n"), "{text}");
        assert!(
            text.contains("sci_recon_lab_jobs{lab=\"_others\",state=\"queued\"} 4\n"),
            "{text}"
        );
        assert!(!text.contains("lab-100"), "{text}");
    }
}
