//! Metrics for Prometheus.

use metrics::{Unit, counter, describe_counter, describe_gauge, gauge};

use engine::job::Pool;

/// Describes the metrics of the hub.
pub fn describe() {
    describe_gauge!("sci_recon_cluster_workers", "Workers on other machines, by pool.");
    describe_gauge!("sci_recon_cluster_tiles_out", "Tiles that are out with a pool.");
    describe_counter!(
        "sci_recon_cluster_redelivered_total",
        "Tiles that another worker took up because the first one fell silent."
    );
    describe_counter!(
        "sci_recon_cluster_refused_total",
        "Reports that were refused: late, repeated, from the wrong worker, or unreadable."
    );
    describe_counter!(
        "sci_recon_cluster_rejected_total",
        "Results of workers that were rejected: impossible values, a wrong residual, or a result that differs from \
         another worker's."
    );
    describe_counter!(
        "sci_recon_cluster_replayed_total",
        "Tiles that two workers have computed and whose results were compared."
    );
    describe_counter!(
        "sci_recon_cluster_mismatched_total",
        "Tiles about which two workers disagree."
    );
    describe_counter!(
        "sci_recon_cluster_repaired_total",
        "Tiles that were handed out again because their message or frames were lost."
    );
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
    redelivered(0);
    refused(0);
    rejected(0);
    replayed(0);
    mismatched(0);
    repaired(0);
    bytes("out", 0);
    bytes("in", 0);
    lag(0.0);
}

pub fn redelivered(count: u64) {
    counter!("sci_recon_cluster_redelivered_total").increment(count);
}

pub fn refused(count: u64) {
    counter!("sci_recon_cluster_refused_total").increment(count);
}

pub fn rejected(count: u64) {
    counter!("sci_recon_cluster_rejected_total").increment(count);
}

pub fn replayed(count: u64) {
    counter!("sci_recon_cluster_replayed_total").increment(count);
}

pub fn mismatched(count: u64) {
    counter!("sci_recon_cluster_mismatched_total").increment(count);
}

pub fn repaired(count: u64) {
    counter!("sci_recon_cluster_repaired_total").increment(count);
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
