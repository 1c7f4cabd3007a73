//! What passes between the queue and a worker: a task with the right to it, and what came of it.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;

use crate::job::{JobId, JobSpec, TaskId, TaskKind, TaskProgress, WorkerId};
use crate::store::{Calibration, Measurement, StagedBlob, StagedDir};

/// The right to work on a task, until it runs out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// The task.
    pub task: TaskId,
    /// The number of this attempt, from 1.
    pub attempt: u32,
    /// Who holds it.
    pub worker: WorkerId,
    /// For how long each heartbeat renews it.
    pub length: Duration,
}

/// A task with all that a worker needs to do it.
#[derive(Debug, Clone)]
pub struct ClaimedTask {
    /// The right to it, to be shown with every message about it.
    pub lease: Lease,
    /// What is to be done.
    pub kind: TaskKind,
    /// For which job.
    pub job: JobId,
    /// Its planned processor time in seconds.
    pub cost: f64,
    /// The job.
    pub spec: JobSpec,
    /// The calibration's record.
    pub calibration: Calibration,
    /// The prepared masks: planar f32 [B, H, W] on [0, 1].
    pub masks: PathBuf,
    /// The measurement's record.
    pub measurement: Measurement,
    /// The prepared snapshots: planar f32 [S, H, W], full scale divided out.
    pub snapshots: PathBuf,
    /// The ONNX file of the job's model, if it has one.
    pub model: Option<PathBuf>,
    /// What the job's prepare task recorded; none for that task itself.
    pub prepared: Option<Value>,
    /// What its pilot recorded, if it has one that is done.
    pub pilot: Option<Value>,
}

/// The answer to a heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    /// Go on; the lease is renewed.
    Continue,
    /// The job is not wanted any more: stop, and call [`crate::store::Store::cancelled`].
    Cancelled,
    /// The lease ran out and the task is someone else's: stop, and drop everything.
    Lost,
}

/// What a task has made.
#[derive(Debug)]
pub enum Product {
    /// Nothing but its record (prepare).
    Record,
    /// The share of their planned cost that the tiles still have, on \[0,1\] (pilot).
    TileCost(f64),
    /// The reconstructed tile, or preview.
    Tile(StagedBlob),
    /// The files of a snapshot (assemble) or of the job (manifest).
    Files(StagedDir),
}

/// The end of a task.
#[derive(Debug)]
pub struct Completion {
    /// Where the solver stood when it stopped: `fraction` is below 1 if it converged early.
    pub progress: TaskProgress,
    /// What is to be remembered of it, for the manifest.
    pub record: Value,
    /// What it has made.
    pub product: Product,
}
