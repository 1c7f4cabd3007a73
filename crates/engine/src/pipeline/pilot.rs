//! The pilot of a job: it adapts the schedule, and decides which snapshots are reconstructed together, once for all tiles.

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
    /// The index of the first snapshot in the measurement.
    pub first: usize,
    /// The crop's place in the picture.
    pub place: &'a Window,
    pub schedule: &'a Schedule,
    pub runs: &'a SequencePlan,
}

/// The crop of a snapshot \[H,W\] on which the pilot runs: of the picture, or of the first green sub-image of a mosaic.
/// `light` is the sum \[H,W\] of all masks.
pub fn place(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>, mosaic: Option<Mosaic>) -> Window {
    let Some(mosaic) = mosaic else {
        let (rows, columns) = crop::choose(light, y);
        return Window { rows, columns, step: 1 };
    };
    let first = mosaic.green();
    let plane = s![first.0..;2, first.1..;2];
    let (rows, columns) = crop::choose(light.slice(plane), y.slice(plane));
    Window::of_plane(rows, columns, first)
}

/// Runs the pilot on a crop of all snapshots: it adapts the schedule to the first one, and then compares neighbouring
/// snapshots, together and alone, with the decided schedule. Returns `None` if there is nothing to decide, or no light
/// reaches the crop.
///
/// # Errors
/// As [`pilot::decide`] and [`joints::compare`].
pub fn decide(
    input: TileInput,
    task: &Pilot<'_>,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Option<PilotRecord>, ReconError> {
    let &Pilot { first, place, schedule, runs } = task;
    let candidates = runs.joints();
    if !schedule.adaptive && candidates.is_empty() {
        return Ok(None);
    }
    let (row, column) = (place.rows.start, place.columns.start);
    let (_, height, width) = input.y.dim();
    let (height, width) = (height * place.step, width * place.step);
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
    let found = joints::compare(&op, (first, y.view()), &candidates, &decided, networks, observer)?;
    record.joints = found.into_iter().map(joint).collect();
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

/// The schedule that the tiles run: as decided by the pilot, if there was one.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule))
}
