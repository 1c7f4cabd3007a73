//! The task of the pilot: which of the planned iterations pay, decided once for all tiles of a job.

use super::prepare::{Prepared, plane, to_record};
use super::task::{Shared, TaskError};
use super::tile::{TaskObserver, window};
use crate::formats::Limits;
use crate::formats::planar::Reader;
use crate::job::TaskProgress;
use crate::pipeline::WarmNetworks;
use crate::pipeline::manifest::full_schedule;
use crate::pipeline::pilot::{PilotRecord, decide};
use crate::recon::pilot;
use crate::store::{Completion, JobTask, Product};

/// The record of the job's pilot; none before it, and for a job without one.
pub(super) fn pilot_of(task: &JobTask) -> Result<Option<PilotRecord>, TaskError> {
    let record =
        |error: serde_json::Error| TaskError::Record { what: "pilot", problem: error.to_string() };
    let pilot = task.pilot.clone().map(serde_json::from_value::<Option<PilotRecord>>);
    Ok(pilot.transpose().map_err(record)?.flatten())
}

/// The task of the pilot, on the first snapshot of the job.
pub(super) fn run(
    task: &JobTask,
    engine: &mut WarmNetworks,
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let snapshot = task.spec.snapshots.first as usize;
    let y = plane(&Reader::open(&task.snapshots, &Limits::default())?, snapshot)?;
    let (rows, columns) = pilot::piece(y.view());
    let place = (snapshot, rows.start, columns.start);
    let input = window(task, snapshot, (rows, columns), Prepared::of(task)?.white)?;
    let schedule = &task.spec.schedule;
    let mut observer = TaskObserver::new(shared, schedule.clone());
    let record = decide(input, place, schedule, engine, &mut observer)?;
    let decided = full_schedule(schedule, record.as_ref());
    let share = decided.planned_ns_per_voxel() / schedule.planned_ns_per_voxel();
    let progress = TaskProgress { fraction: 1.0, ..shared.progress() };
    Ok(Completion { progress, record: to_record(&record)?, product: Product::TileCost(share) })
}
