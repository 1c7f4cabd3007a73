//! The pilot of a job: which of its planned iterations pay, decided once for all its tiles.

use ndarray::Axis;

use super::records::{PilotRecord, StageRecord};
use super::tile::TileInput;
use crate::recon::ReconError;
use crate::recon::pilot::{self, StageFinding};
use crate::recon::prior::Networks;
use crate::recon::schedule::{Schedule, Stage};
use crate::recon::solver::Observer;

/// Runs the pilot of an adaptive schedule on a piece of a snapshot; none for a schedule that is
/// fixed, or a piece that no light reaches.
pub fn decide(
    input: TileInput,
    (snapshot, row, column): (usize, usize, usize),
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Option<PilotRecord>, ReconError> {
    if !schedule.adaptive {
        return Ok(None);
    }
    let (height, width) = input.y.index_axis(Axis(0), 0).dim();
    let Some((op, y)) = input.on_unit_scale()? else { return Ok(None) };
    let op = op.with_gamma(schedule.gamma)?;
    let findings = pilot::run(op, y.view(), schedule, networks, observer)?;
    let record = |(stage, finding): (&Stage, StageFinding)| StageRecord {
        prior: stage.prior,
        planned: stage.iterations,
        iterations: finding.iterations,
        planned_temporal_weight: stage.temporal_weight.unwrap_or(0.0),
        temporal_weight: finding.temporal_weight,
        end: finding.end.to_string(),
        error_before: finding.before,
        error_after: finding.after,
    };
    let stages = schedule.stages.iter().zip(findings).map(record).collect();
    Ok(Some(PilotRecord { snapshot, row, column, height, width, stages }))
}

/// A schedule as the tiles run it: with all defaults filled in, and ended where the pilot found that
/// it should.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule)).filled()
}
