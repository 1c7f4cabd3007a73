//! The pilot of a job: which of its planned iterations pay, decided once for all its tiles.

use serde::{Deserialize, Serialize};

use super::tile::TileInput;
use crate::recon::ReconError;
use crate::recon::pilot::{self, StageFinding};
use crate::recon::prior::{Networks, Prior};
use crate::recon::schedule::{Schedule, Stage};
use crate::recon::solver::Observer;

/// What the pilot found, as it stands in manifests.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PilotRecord {
    /// The snapshot, from 0.
    pub snapshot: usize,
    /// First row of the piece.
    pub row: usize,
    /// First column.
    pub column: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// The stages of the schedule that was asked for.
    pub stages: Vec<StageRecord>,
}

/// What was found out about a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// Its prior.
    pub prior: &'static dyn Prior,
    /// The most iterations that might have been.
    pub planned: usize,
    /// Those that pay.
    pub iterations: usize,
    /// Weight of the total variation along time that was asked for; 0 for none.
    #[serde(default)]
    pub planned_temporal_weight: f32,
    /// The same if it pays; else 0.
    #[serde(default)]
    pub temporal_weight: f32,
    /// Why no more: `fixed`, `max-iterations`, `converged` or `diverged`.
    pub end: String,
    /// Error at the held-out pixels before the stage, relative to the measurement.
    pub error_before: f64,
    /// The same after its iterations.
    pub error_after: f64,
}

impl StageRecord {
    /// What became of the total variation along time; none if it was not asked for.
    pub fn along_time(&self) -> Option<&'static str> {
        let kept = self.temporal_weight > 0.0;
        (self.planned_temporal_weight > 0.0).then_some(if kept { "kept" } else { "left out" })
    }
}

impl PilotRecord {
    /// The schedule for the tiles.
    pub fn decide(&self, schedule: &Schedule) -> Schedule {
        let found = self.stages.iter().map(|stage| (stage.iterations, stage.temporal_weight));
        schedule.decided(&found.collect::<Vec<_>>())
    }
}

/// Runs the pilot of an adaptive schedule on a piece of a snapshot; none for a schedule that is
/// fixed, or a piece that no light reaches.
///
/// # Errors
/// As [`pilot::run`].
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
    let (height, width) = input.measurement.dim();
    let Some((op, y)) = input.on_unit_scale()? else { return Ok(None) };
    let op = op.with_gamma(schedule.gamma)?;
    let findings = pilot::run(op, y.view(), schedule, networks, observer)?;
    let record = |(stage, finding): (&Stage, StageFinding)| StageRecord {
        prior: stage.prior,
        planned: stage.iterations,
        iterations: finding.iterations,
        planned_temporal_weight: stage.temporal_weight.unwrap_or(0.0),
        temporal_weight: finding.temporal_weight,
        end: finding.end.name().into(),
        error_before: finding.before,
        error_after: finding.after,
    };
    let stages = schedule.stages.iter().zip(findings).map(record).collect();
    Ok(Some(PilotRecord { snapshot, row, column, height, width, stages }))
}
