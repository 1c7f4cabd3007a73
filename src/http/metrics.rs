//! The figures of this process for Prometheus. Requests are counted as they go by.

use std::sync::OnceLock;
use std::time::Duration;

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, histogram};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use strum::VariantArray;

use engine::job::JobState;
use store::{LabFigures, TaskTotals};

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
        "Workers alive that take tiles, here and on other machines."
    );
    describe_gauge!("sci_recon_blobs", "Files in the content-addressed store.");
    describe_gauge!("sci_recon_blob_bytes", Unit::Bytes, "Bytes of files in that store.");
    describe_gauge!("sci_recon_damaged_files", "Stored files known to be damaged or missing.");
    describe_gauge!("sci_recon_disk_free_bytes", Unit::Bytes, "Bytes free on the disk.");
    describe_gauge!("sci_recon_disk_size_bytes", Unit::Bytes, "Bytes of the disk.");
}

/// Labs with figures of their own; those of the others are added up as `lab="_others"`, which is no lab's name.
const MOST_LABS: usize = 100;

/// Figures that are read of the database for each answer, and may differ by who asks.
#[derive(Debug, Default)]
pub(super) struct Figures(String);

impl Figures {
    /// Begins a figure with its kind (`counter` or `gauge`) and what it is.
    fn describe(&mut self, name: &str, kind: &str, about: &str) {
        self.0 += &format!("# HELP {name} {about}\n# TYPE {name} {kind}\n");
    }

    /// The labels' values are names of ours, which need no escapes.
    fn add(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        let labels: Vec<_> = labels.iter().map(|(key, of)| format!("{key}=\"{of}\"")).collect();
        self.0 += &format!("{name}{{{}}} {value}\n", labels.join(","));
    }

    /// Seconds of tasks done, by kind.
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
            labs.get(lab).filter(|_| lab < MOST_LABS).map_or("_others", |of| of.lab.as_str())
        };
        let own = |lab: &LabFigures, state| lab.jobs.get(&state).copied().unwrap_or_default();
        let figure = "sci_recon_lab_jobs";
        self.describe(figure, "gauge", "Jobs of a lab on record, by state.");
        for &state in JobState::VARIANTS {
            for (lab, value) in folded(labs, |lab| own(lab, state) as f64) {
                self.add(figure, &[("lab", name(lab)), ("state", state.into_str())], value);
            }
        }
        type Value = fn(&LabFigures) -> f64;
        let figures: [(&str, &str, &str, Value); 5] = [
            (
                "sci_recon_lab_jobs_begun_total",
                "counter",
                "Jobs of a lab that have begun.",
                |lab| lab.jobs_begun as f64,
            ),
            (
                "sci_recon_lab_wait_seconds_total",
                "counter",
                "Seconds that those jobs waited for their first task.",
                |lab| lab.wait_seconds,
            ),
            (
                "sci_recon_lab_cpu_seconds_total",
                "counter",
                "Processor seconds of a lab's tasks that are done.",
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
                "For how long a lab's oldest job waits that has not begun; of _others in sum.",
                |lab| lab.longest_wait,
            ),
        ];
        for (figure, kind, about, value) in figures {
            self.describe(figure, kind, about);
            for (lab, value) in folded(labs, value) {
                self.add(figure, &[("lab", name(lab))], value);
            }
        }
    }

    pub(super) fn into_text(self) -> String {
        self.0
    }
}

/// A value for each of the first labs, and the sum of the others' in the place after them.
fn folded(labs: &[LabFigures], value: impl Fn(&LabFigures) -> f64) -> Vec<(usize, f64)> {
    let (named, others) = labs.split_at(labs.len().min(MOST_LABS));
    let mut values: Vec<_> = named.iter().map(&value).enumerate().collect();
    if !others.is_empty() {
        values.push((MOST_LABS, others.iter().map(value).sum()));
    }
    values
}

/// Counts a request. `route` is the pattern and not the path: there are few patterns.
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

    use super::{Figures, MOST_LABS};
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
        let labs: Vec<_> = (0..MOST_LABS + 4).map(lab).collect();
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
