//! Records of a job's tasks, for later tasks and for the manifests.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::assessment::TileAssessment;
use crate::job::{Assessment, Registered, ResultFile, Timestamp};
use reconstruction::assessment::Evidence;
use reconstruction::pilot::Decided;
use reconstruction::schedule::Schedule;
use reconstruction::solver::Outcome;

/// The record of the task that prepares a job.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PreparedRecord {
    /// The solver's scale, for all snapshots and tiles of the job.
    pub white: f32,
    /// The registration of the masks, unless it is off.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration: Option<Registered>,
}

/// The record of the task that determines the white level of a job.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct WhiteRecord {
    /// The 99.9th percentile of all frames, without dim pixels.
    pub white_level: f32,
}

/// The decisions of a job's pilot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PilotRecord {
    pub snapshot: usize,
    pub row: usize,
    pub column: usize,
    pub height: usize,
    pub width: usize,
    /// The decided stages. Empty for a fixed schedule.
    pub stages: Vec<Decided>,
    /// The decisions on the joints between consecutive snapshots.
    #[serde(default)]
    pub joints: Vec<JointRecord>,
    /// Hold-out evidence of the error of an adaptive schedule's frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Evidence>,
}

impl PilotRecord {
    /// The schedule that the pilot has decided. Returns a fixed schedule unchanged.
    pub fn decide(&self, schedule: &Schedule) -> Schedule {
        if self.stages.is_empty() { schedule.clone() } else { schedule.decided(&self.stages) }
    }

    /// Hold-out error of the decided schedule's frames, relative to that of the mean of the neighbours.
    pub fn hold_out_ratio(&self) -> Option<f64> {
        let prediction = self.evidence.as_ref()?.prediction?;
        let is_known = prediction.by_neighbours > 0.0;
        is_known.then(|| (prediction.by_frames / prediction.by_neighbours).sqrt())
    }

    /// The snapshots after which the sequence is cut.
    pub fn cuts(&self) -> Vec<usize> {
        let cut = self.joints.iter().filter(|joint| !joint.together);
        cut.map(|joint| joint.after).collect()
    }
}

/// The pilot's decision on the joint between two snapshots.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct JointRecord {
    /// Index of the snapshot before the joint.
    pub after: usize,
    /// True if both snapshots are reconstructed together.
    pub together: bool,
    /// Hold-out error of both snapshots when each is solved alone, relative to the measurement. `None` if the solver
    /// diverged.
    pub error_alone: Option<f64>,
    /// Hold-out error of both snapshots when they are solved together, relative to the measurement.
    pub error_together: Option<f64>,
}

/// Lists the settings that a pilot has changed. Each has a leading comma, such as `, gamma 1`.
pub fn changes(decided: &Decided) -> String {
    let fields = |stage| match serde_json::to_value(stage) {
        Ok(Value::Object(fields)) => fields,
        _ => Map::new(),
    };
    let (planned, stage) = (fields(&decided.planned), fields(&decided.stage));
    let changed = stage.iter().filter(|(name, value)| {
        !["iterations", "sigma"].contains(&name.as_str()) && planned.get(*name) != Some(*value)
    });
    let text = |(name, value): (&String, &Value)| {
        let name = name.replace('_', " ");
        match value {
            Value::Null => format!(", {name} left out"),
            Value::Number(number) if number.as_f64() == Some(0.0) => format!(", {name} left out"),
            Value::Number(number) => {
                format!(", {name} {}", number.as_f64().unwrap_or_default() as f32)
            }
            value => format!(", {name} {value}"),
        }
    };
    changed.map(text).collect()
}

/// The iterations of a tile, or the largest values and the common reason of several tiles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TileRecord {
    /// Iterations of all stages.
    pub iterations: usize,
    /// Iterations with total variation.
    pub tv_iterations: usize,
    /// Iterations with a network.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the tile's frames.
    pub residual: f32,
    /// `converged` or `max-iterations`.
    pub stop_reason: String,
}

impl TileRecord {
    /// Summary of tiles: the largest values, and `converged` if all tiles converged.
    pub fn summary(tiles: &[Self]) -> Self {
        let converged = tiles.iter().all(|tile| tile.stop_reason == "converged");
        let most = |count: fn(&Self) -> usize| tiles.iter().map(count).max().unwrap_or(0);
        Self {
            iterations: most(|tile| tile.iterations),
            tv_iterations: most(|tile| tile.tv_iterations),
            denoiser_passes: most(|tile| tile.denoiser_passes),
            residual: tiles.iter().map(|tile| tile.residual).fold(0.0, f32::max),
            stop_reason: if converged { "converged" } else { "max-iterations" }.into(),
        }
    }
}

impl From<&Outcome> for TileRecord {
    fn from(outcome: &Outcome) -> Self {
        Self {
            iterations: outcome.iterations,
            tv_iterations: outcome.tv_iterations,
            denoiser_passes: outcome.denoiser_passes,
            residual: outcome.residual,
            stop_reason: outcome.stop_reason.to_string(),
        }
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TileTaskRecord {
    #[serde(flatten)]
    pub tile: TileRecord,
    /// The solved snapshots, as indices in the run. Another run solves the others.
    pub solved: Vec<usize>,
    /// `None` if nothing can be estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assessment: Option<TileAssessment>,
    /// Cost of the tile, from reading its window to its frames.
    #[serde(flatten)]
    pub cost: CostRecord,
}

/// Cost of a computation, and the runtime that performed it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CostRecord {
    /// Execution provider of the network. `None` without a network.
    pub provider: Option<String>,
    /// Version of ONNX Runtime. `None` without a network.
    pub onnxruntime: Option<String>,
    /// Name and driver of the GPU that ran the solver. `None` if the CPU did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gpu: Option<String>,
    pub cpu_seconds: f64,
    /// Largest resident memory of a computing process.
    pub peak_rss_bytes: u64,
}

impl CostRecord {
    /// The total cost of several parts.
    pub fn sum<'a>(parts: impl Iterator<Item = &'a Self>) -> Self {
        parts.fold(Self::default(), |sum, part| Self {
            provider: sum.provider.or_else(|| part.provider.clone()),
            onnxruntime: sum.onnxruntime.or_else(|| part.onnxruntime.clone()),
            gpu: sum.gpu.or_else(|| part.gpu.clone()),
            cpu_seconds: sum.cpu_seconds + part.cpu_seconds,
            peak_rss_bytes: sum.peak_rss_bytes.max(part.peak_rss_bytes),
        })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunRecord {
    /// The job. `None` on the command line.
    pub job: Option<String>,
    /// Total cost of all tiles.
    #[serde(flatten)]
    pub cost: CostRecord,
    /// Wall time of the computation. `None` for a job, because its workers also serve other jobs.
    pub seconds: Option<f64>,
    /// End of the run, RFC 3339 in UTC.
    pub finished_at: String,
}

impl RunRecord {
    /// The record of a run that ends now.
    pub fn ended(job: Option<String>, cost: CostRecord, seconds: Option<f64>) -> Self {
        Self { job, cost, seconds, finished_at: Timestamp::now().to_string() }
    }
}

/// The record of a snapshot's assembly.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SnapshotRecord {
    pub summary: TileRecord,
    #[serde(default)]
    pub assessment: Option<Assessment>,
    pub run: RunRecord,
    /// All files, the manifest last.
    pub files: Vec<ResultFile>,
}

#[cfg(test)]
mod tests {
    use super::{Decided, Schedule, TileRecord, changes};
    use reconstruction::pilot::StageEnd;
    use reconstruction::stage::Stage;

    fn record(residual: f32, stop_reason: &str, passes: usize) -> TileRecord {
        let stop_reason = stop_reason.to_owned();
        let iterations = 40 + passes;
        TileRecord { iterations, tv_iterations: 40, denoiser_passes: passes, residual, stop_reason }
    }

    #[test]
    fn changes_of_a_pilot_are_named() {
        let planned = Schedule::pnp_nonlocal().stages[1].clone();
        let mut stage = planned.clone();
        stage.iterations = 12;
        let decided = |stage: &Stage| Decided {
            planned: planned.clone(),
            stage: stage.clone(),
            error_before: 0.1,
            error_after: 0.05,
            end: StageEnd::Converged,
        };
        assert_eq!(changes(&decided(&stage)), "");
        stage.prior.nonlocal_mut().unwrap().static_shrinkage = Some(1.4);
        (stage.projection.static_variance, stage.projection.gamma) = (None, Some(0.3));
        assert_eq!(
            changes(&decided(&stage)),
            ", gamma 0.3, static shrinkage 1.4, static variance left out"
        );
    }

    #[test]
    fn a_summary_has_the_largest_values_of_the_tiles() {
        let tiles = [record(0.01, "converged", 20), record(0.03, "max-iterations", 24)];
        let summary = TileRecord::summary(&tiles);
        assert_eq!((summary.denoiser_passes, summary.residual), (24, 0.03));
        assert_eq!(summary.iterations, 64);
        assert_eq!(summary.stop_reason, "max-iterations");
        assert_eq!(TileRecord::summary(&tiles[..1]).stop_reason, "converged");
    }
}
