//! Metrics for Prometheus.

use metrics::{Unit, counter, describe_counter, describe_gauge, gauge};

use engine::job::Pool;

pub const REDELIVERED: &str = "sci_recon_cluster_redelivered_total";
pub const REFUSED: &str = "sci_recon_cluster_refused_total";
pub const REJECTED: &str = "sci_recon_cluster_rejected_total";
pub const REPLAYED: &str = "sci_recon_cluster_replayed_total";
pub const MISMATCHED: &str = "sci_recon_cluster_mismatched_total";
pub const REPAIRED: &str = "sci_recon_cluster_repaired_total";

/// The counters of events, with their descriptions.
const COUNTERS: [(&str, &str); 6] = [
    (REDELIVERED, "Tiles that another worker took up because the first one fell silent."),
    (REFUSED, "Reports that were refused: late, repeated, from the wrong worker, or unreadable."),
    (
        REJECTED,
        "Results of workers that were rejected: impossible values, a wrong residual, or a result that differs from \
         another worker's.",
    ),
    (REPLAYED, "Tiles that two workers have computed and whose results were compared."),
    (MISMATCHED, "Tiles about which two workers disagree."),
    (REPAIRED, "Tiles that were handed out again because their message or frames were lost."),
];

/// Describes the metrics of the hub.
pub fn describe() {
    describe_gauge!("sci_recon_cluster_workers", "Workers on other machines, by pool.");
    describe_gauge!("sci_recon_cluster_tiles_out", "Tiles that are out with a pool.");
    for (name, description) in COUNTERS {
        describe_counter!(name, description);
        count(name, 0);
    }
    describe_counter!(
        "sci_recon_cluster_blob_bytes_total",
        Unit::Bytes,
        "Bytes of inputs put (out) and of frames fetched (in)."
    );
    describe_gauge!(
        "sci_recon_cluster_lag_seconds",
        Unit::Seconds,
        "Time that the latest report of a worker waited until it was handled."
    );
    bytes("out", 0);
    bytes("in", 0);
    lag(0.0);
}

/// Adds to one of [`COUNTERS`].
pub fn count(counter: &'static str, events: u64) {
    counter!(counter).increment(events);
}

pub fn bytes(direction: &'static str, count: usize) {
    let count = u64::try_from(count).unwrap_or(u64::MAX);
    counter!("sci_recon_cluster_blob_bytes_total", "direction" => direction).increment(count);
}

pub fn lag(seconds: f64) {
    gauge!("sci_recon_cluster_lag_seconds").set(seconds);
}

#[allow(clippy::cast_precision_loss)] // counts far below 2^53
pub fn pool(pool: &Pool, workers: usize, out: usize) {
    let name = || pool.to_string();
    gauge!("sci_recon_cluster_workers", "pool" => name()).set(workers as f64);
    gauge!("sci_recon_cluster_tiles_out", "pool" => name()).set(out as f64);
}
