//! The pilot of a job: which of its planned iterations pay, and which of its snapshots belong together,
//! decided once for all its tiles.

use ndarray::{ArrayView2, s};

use super::records::{JointRecord, PilotRecord, StageRecord};
use super::tile::TileInput;
use optics::Mosaic;
use reconstruction::ReconError;
use reconstruction::joints::{self, JointFinding};
use reconstruction::pilot::{self, StageFinding};
use reconstruction::prior::Networks;
use reconstruction::schedule::{Schedule, Stage};
use reconstruction::sequence::SequencePlan;
use reconstruction::solver::Observer;
use reconstruction::tile::Window;

/// What is to be found out, and on which piece of the snapshots.
#[derive(Debug, Clone, Copy)]
pub struct Pilot<'a> {
    /// The index of the first snapshot in the measurement.
    pub first: usize,
    /// The piece's place in the picture.
    pub place: &'a Window,
    pub schedule: &'a Schedule,
    pub runs: &'a SequencePlan,
}

/// Where in a snapshot \[H,W\] the pilot is run: in the picture, or in the first green sub-image of a mosaic.
/// `light` is the sum \[H,W\] of all masks.
pub fn place(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>, mosaic: Option<Mosaic>) -> Window {
    let Some(mosaic) = mosaic else {
        let (rows, columns) = pilot::piece(light, y);
        return Window { rows, columns, step: 1 };
    };
    let first = mosaic.green();
    let plane = s![first.0..;2, first.1..;2];
    let (rows, columns) = pilot::piece(light.slice(plane), y.slice(plane));
    Window::of_plane(rows, columns, first)
}

/// Runs the pilot on a piece of all snapshots: how long the stages of an adaptive schedule should be, on the
/// first of them, and then, by the schedule so decided, whether those that runs hold together are better
/// apart. None where there is nothing to be decided, or no light reaches the piece.
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
        let (findings, evidence) = pilot::run(&op, y, schedule, networks, observer)?;
        record.evidence = evidence;
        record.stages = schedule.stages.iter().zip(findings).map(stage).collect();
    }
    let decided = record.decide(schedule);
    let found = joints::compare(&op, (first, y.view()), &candidates, &decided, networks, observer)?;
    record.joints = found.into_iter().map(joint).collect();
    Ok(Some(record))
}

fn stage((stage, finding): (&Stage, StageFinding)) -> StageRecord {
    StageRecord {
        prior: stage.prior,
        planned: stage.iterations,
        iterations: finding.iterations,
        planned_temporal_weight: stage.temporal_weight.unwrap_or(0.0),
        temporal_weight: finding.temporal_weight,
        planned_temporal_shrinkage: stage.temporal_shrinkage.unwrap_or(0.0),
        temporal_shrinkage: finding.temporal_shrinkage,
        rest_shrinkage: finding.rest_shrinkage,
        rest_everywhere: finding.rest_everywhere,
        planned_static_variance: stage.static_variance,
        static_variance: finding.static_variance,
        gamma: finding.gamma,
        end: finding.end.to_string(),
        error_before: finding.before,
        error_after: finding.after,
    }
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

/// A schedule as the tiles run it: with all defaults filled in, and ended where the pilot found that
/// it should.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule)).filled()
}
