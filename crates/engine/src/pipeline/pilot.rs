//! The pilot of a job. It adapts the schedule and decides which snapshots are reconstructed together, once for all tiles.

use ndarray::{ArrayView2, s};

use super::records::{JointRecord, PilotRecord};
use super::tile::TileInput;
use optics::Mosaic;
use reconstruction::joints::{self, JointFinding};
use reconstruction::priors::Networks;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::solver::Observer;
use reconstruction::tile::Window;
use reconstruction::{ReconError, crop, pilot};

/// The task of a pilot, and the crop of the snapshots on which it runs.
#[derive(Debug, Clone, Copy)]
pub struct Pilot<'a> {
    /// Index of the first snapshot in the measurement.
    pub first: usize,
    /// Position of the crop in the picture.
    pub crop: &'a Window,
    pub schedule: &'a Schedule,
    pub runs: &'a SequencePlan,
}

/// Chooses the crop of a snapshot \[H,W\] on which the pilot runs. Behind a mosaic, it is a crop of the first green
/// sub-image. `light` is the sum \[H,W\] of all masks.
pub fn choose_crop(
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    mosaic: Option<Mosaic>,
) -> Window {
    let Some(mosaic) = mosaic else {
        let (rows, columns) = crop::choose(light, y);
        return Window { rows, columns, step: 1 };
    };
    let first = mosaic.green();
    let plane = s![first.0..;2, first.1..;2];
    let (rows, columns) = crop::choose(light.slice(plane), y.slice(plane));
    Window::of_plane(rows, columns, first)
}

/// Runs the pilot on a crop of all snapshots. It adapts the schedule to the first one. With that schedule it then solves
/// neighbouring snapshots together and alone, and compares the results. Returns `None` if there is nothing to decide, or
/// if no light reaches the crop.
///
/// # Errors
/// As [`pilot::decide`] and [`joints::compare`].
pub fn decide(
    input: TileInput,
    task: &Pilot<'_>,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Option<PilotRecord>, ReconError> {
    let &Pilot { first, crop, schedule, runs } = task;
    let candidates = runs.joints();
    if !schedule.adaptive && candidates.is_empty() {
        return Ok(None);
    }
    let (row, column) = (crop.rows.start, crop.columns.start);
    let (_, height, width) = input.y.dim();
    let (height, width) = (height * crop.step, width * crop.step);
    let Some((op, y)) = input.on_unit_scale()? else { return Ok(None) };
    let mut record = PilotRecord {
        snapshot: first,
        row,
        column,
        height,
        width,
        stages: vec![],
        joints: vec![],
        evidence: None,
    };
    if schedule.adaptive {
        let y = y.slice(s![..1, .., ..]);
        let decisions = pilot::decide(&op, y, schedule, networks, observer)?;
        (record.stages, record.evidence) = (decisions.stages, decisions.evidence);
    }
    let decided = record.decide(schedule);
    let findings =
        joints::compare(&op, first, y.view(), &candidates, &decided, networks, observer)?;
    record.joints = findings.into_iter().map(joint).collect();
    Ok(Some(record))
}

fn joint(finding: JointFinding) -> JointRecord {
    let finite = |error: f64| error.is_finite().then_some(error);
    JointRecord {
        after: finding.after,
        together: finding.belong_together(),
        error_alone: finite(finding.alone),
        error_together: finite(finding.together),
    }
}

/// The schedule that the tiles run: that of the pilot, if there was one.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule))
}
