//! The pilot of a job. It decides once for all tiles how many of the planned iterations are useful, and which snapshots
//! are reconstructed together.

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

/// The task of a pilot.
#[derive(Debug, Clone, Copy)]
pub struct Pilot<'a> {
    /// Index of the first snapshot in the measurement.
    pub first: usize,
    /// The part of the picture that the pilot solves.
    pub window: &'a Window,
    pub schedule: &'a Schedule,
    pub runs: &'a SequencePlan,
}

/// Chooses the window of the pilot in a snapshot \[H,W\], or in the first green sub-image of a mosaic. `light` is the sum
/// \[H,W\] of all masks.
pub fn window(
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    mosaic: Option<Mosaic>,
) -> Window {
    let Some(mosaic) = mosaic else {
        let (rows, columns) = pilot::piece(light, y);
        return Window { rows, columns, step: 1 };
    };
    let first = mosaic.green();
    let plane = s![first.0..;2, first.1..;2];
    let (rows, columns) = pilot::piece(light.slice(plane), y.slice(plane));
    Window::of_plane(rows, columns, first)
}

/// Runs the pilot on a window of all snapshots. It first decides the lengths of the stages of an adaptive schedule on the
/// first snapshot. With that schedule it then decides whether consecutive snapshots of a run should be cut. Returns `None`
/// if there is nothing to decide, or if no light reaches the window.
pub fn decide(
    input: TileInput,
    task: &Pilot<'_>,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Option<PilotRecord>, ReconError> {
    let &Pilot { first, window, schedule, runs } = task;
    let candidates = runs.joints();
    if !schedule.adaptive && candidates.is_empty() {
        return Ok(None);
    }
    let (row, column) = (window.rows.start, window.columns.start);
    let (_, height, width) = input.y.dim();
    let (height, width) = (height * window.step, width * window.step);
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
    let findings =
        joints::compare(&op, (first, y.view()), &candidates, &decided, networks, observer)?;
    record.joints = findings.into_iter().map(joint).collect();
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

/// The schedule that the tiles run, with the pilot's decisions and all defaults.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule)).filled()
}
