//! The queue: how tasks get to workers and come back, and what that means for their jobs.

pub(super) mod calibrating;
pub(super) mod claim;
pub(super) mod complete;
mod forecast;
pub(super) mod graph;
pub(super) mod lease;
mod marks;
mod progress;

pub use calibrating::{CalibrationDone, CalibrationLease, CalibrationWork, ClaimedCalibration};
pub use claim::{ClaimedTask, Completion, Heartbeat, Lease, Product};
pub use graph::{TaskRecord, TileResult};
pub use lease::{MAX_FAILURES, MAX_LOSSES};
pub use marks::JobMark;
pub use progress::{JobProgress, ProgressStage, TaskCounts, TaskTotals};
