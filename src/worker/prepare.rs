//! The first task of a job: the white level that all its tiles share.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::task::{Shared, TaskError};
use crate::formats::planar::Reader;
use crate::formats::{FormatError, Limits};
use crate::job::{JobSpec, Schedule, Sha256, TaskProgress, TaskStage};
use crate::pipeline::manifest::full_schedule;
use crate::pipeline::pilot::PilotRecord;
use crate::pipeline::typical_white;
use crate::recon::scale::ScaleEstimator;
use crate::store::{Completion, JobTask, Product, hash_file};

/// What the other tasks of the job learn from this one, and from the pilot.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Prepared {
    /// White level of the scene: the median over the snapshots of the job (see
    /// [`typical_white`]).
    pub(super) white: f32,
    /// How far the stages of an adaptive schedule go.
    #[serde(skip)]
    pub(super) pilot: Option<PilotRecord>,
}

impl Prepared {
    /// The records of the job's first tasks.
    pub(super) fn of(task: &JobTask) -> Result<Self, TaskError> {
        let record = |problem: String| TaskError::Record { what: "prepare task", problem };
        let prepared = task.prepared.clone().ok_or_else(|| record("there is none".into()))?;
        let mut prepared: Self =
            serde_json::from_value(prepared).map_err(|error| record(error.to_string()))?;
        prepared.pilot = super::pilot::pilot_of(task)?;
        Ok(prepared)
    }

    /// The schedule of the job's tiles.
    pub(super) fn schedule(&self, spec: &JobSpec) -> Schedule {
        full_schedule(&spec.schedule, self.pilot.as_ref())
    }
}

/// Estimates the white level; memory holds a few planes, whatever the number of frames.
pub(super) fn run(task: &JobTask, shared: &Shared) -> Result<Completion, TaskError> {
    check("masks", &task.masks, task.calibration.prepared)?;
    check("snapshots", &task.snapshots, task.measurement.prepared)?;
    shared.check()?;
    let limits = Limits::default();
    let masks = Reader::open(&task.masks, &limits)?;
    let snapshots = Reader::open(&task.snapshots, &limits)?;
    let (height, width) = (masks.info().height, masks.info().width);
    let mut estimator = ScaleEstimator::new(height, width);
    for frame in 0..masks.info().frames {
        shared.check()?;
        estimator.add_mask(plane(&masks, frame)?.view())?;
    }
    let mut whites = Vec::with_capacity(task.spec.snapshots.count as usize);
    for snapshot in task.spec.snapshots.indices() {
        shared.check()?;
        let y = plane(&snapshots, snapshot as usize)?;
        let white = estimator.white(y.view());
        whites.push(white.map_err(|source| TaskError::Snapshot { snapshot, source })?);
    }
    let none = || TaskError::Record { what: "job", problem: "it names no snapshots".into() };
    let white = typical_white(whites).ok_or_else(none)?;
    let prepared = Prepared { white, pilot: None };
    let progress = TaskProgress { stage: TaskStage::Reading, fraction: 1.0, ..shared.progress() };
    Ok(Completion { progress, record: to_record(&prepared)?, product: Product::Record })
}

/// Refuses an array whose bytes are not those that were stored, once a job.
fn check(what: &'static str, path: &Path, sha256: Sha256) -> Result<(), TaskError> {
    if path.exists() && hash_file(path)? == sha256 {
        return Ok(());
    }
    Err(TaskError::Corrupt { what, sha256 })
}

/// One frame \[H,W\] of a prepared array.
pub(super) fn plane(reader: &Reader, frame: usize) -> Result<ndarray::Array2<f32>, FormatError> {
    let (height, width) = (reader.info().height, reader.info().width);
    let window = reader.read_window(frame..frame + 1, 0..height, 0..width)?;
    Ok(window.index_axis_move(ndarray::Axis(0), 0))
}

/// What is to be remembered of a task.
pub(super) fn to_record(value: &impl Serialize) -> Result<serde_json::Value, TaskError> {
    let record =
        |error: serde_json::Error| TaskError::Record { what: "task", problem: error.to_string() };
    serde_json::to_value(value).map_err(record)
}
