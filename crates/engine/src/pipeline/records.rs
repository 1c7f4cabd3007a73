//! Records of a job's tasks, for later tasks and for the manifests.

use serde::{Deserialize, Serialize};

use super::assessment::TileAssessment;
use crate::job::{Assessment, ResultFile, Timestamp};
use reconstruction::assessment::Evidence;
use reconstruction::pilot::Decision;
use reconstruction::prior::Prior;
use reconstruction::schedule::Schedule;
use reconstruction::solver::Outcome;

/// The record of the task that prepares a job.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct PreparedRecord {
    /// White level of the scene, for all snapshots and tiles of the job.
    pub white: f32,
}

/// The pilot's decisions for a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PilotRecord {
    pub snapshot: usize,
    pub row: usize,
    pub column: usize,
    pub height: usize,
    pub width: usize,
    /// The stages of the requested schedule. Empty for a fixed schedule.
    pub stages: Vec<StageRecord>,
    /// The decisions on the joints between consecutive snapshots.
    #[serde(default)]
    pub joints: Vec<JointRecord>,
    /// Evidence on the error of an adaptive schedule's frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Evidence>,
}

impl PilotRecord {
    pub fn decide(&self, schedule: &Schedule) -> Schedule {
        if self.stages.is_empty() {
            return schedule.clone();
        }
        let decision = |stage: &StageRecord| Decision {
            iterations: stage.iterations,
            temporal_weight: stage.temporal_weight,
            temporal_shrinkage: stage.temporal_shrinkage,
            rest_shrinkage: stage.rest_shrinkage,
            rest_everywhere: stage.rest_everywhere,
            static_variance: stage.static_variance,
            gamma: stage.gamma,
        };
        schedule.decided(&self.stages.iter().map(decision).collect::<Vec<_>>())
    }

    /// The snapshots after which the sequence is cut.
    pub fn cuts(&self) -> Vec<usize> {
        let cut = self.joints.iter().filter(|joint| !joint.together);
        cut.map(|joint| joint.after).collect()
    }
}

/// The pilot's decision on the joint between two snapshots.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
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

/// The pilot's decision on a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    pub prior: &'static dyn Prior,
    /// Largest number of iterations in the requested schedule.
    pub planned: usize,
    /// Chosen number of iterations.
    pub iterations: usize,
    /// Requested weight of the temporal total variation; 0 for none.
    #[serde(default)]
    pub planned_temporal_weight: f32,
    /// Chosen weight of the temporal total variation: the requested one, or 0.
    #[serde(default)]
    pub temporal_weight: f32,
    /// Requested temporal shrinkage; 0 for none.
    #[serde(default)]
    pub planned_temporal_shrinkage: f32,
    /// Chosen temporal shrinkage; 0 for none.
    #[serde(default)]
    pub temporal_shrinkage: f32,
    /// Chosen temporal shrinkage of static regions, at least four times the requested one. `None` if it does not help.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rest_shrinkage: Option<f32>,
    /// True if the whole scene is treated as static.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rest_everywhere: bool,
    /// Requested static variance of the projection.
    #[serde(default)]
    pub planned_static_variance: Option<f32>,
    /// Chosen static variance of the projection.
    #[serde(default)]
    pub static_variance: Option<f32>,
    /// Chosen noise term of the projection. `None` if it is that of the schedule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gamma: Option<f32>,
    /// Reason of the end: `fixed`, `max-iterations`, `converged` or `diverged`.
    pub end: String,
    /// Hold-out error before the stage, relative to the measurement.
    pub error_before: f64,
    /// Hold-out error after the stage, relative to the measurement.
    pub error_after: f64,
}

impl StageRecord {
    /// Describes the decisions on temporal total variation, temporal shrinkage, static variance and noise term.
    pub fn fates(&self) -> Vec<String> {
        let kept = if self.temporal_weight > 0.0 { "kept" } else { "left out" };
        let along_time = (self.planned_temporal_weight > 0.0)
            .then(|| format!("total variation along time {kept}"));
        let changes =
            (self.planned_temporal_shrinkage > 0.0).then(|| match self.temporal_shrinkage {
                0.0 => "shrinkage along time left out".into(),
                shrinkage => format!("shrinkage along time {shrinkage}"),
            });
        let rest = self.rest_shrinkage.map(|level| match self.rest_everywhere {
            true => format!("shrinkage {level}, as the scene is static"),
            false => format!("shrinkage in static regions {level}"),
        });
        let variance = self.planned_static_variance.map(|_| match self.static_variance {
            Some(variance) => format!("static variance {variance}"),
            None => "static variance left out".into(),
        });
        let noise = self.gamma.map(|gamma| format!("noise term {gamma}"));
        along_time.into_iter().chain(changes).chain(rest).chain(variance).chain(noise).collect()
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TileRecord {
    /// Iterations whose prior had a total-variation part.
    pub tv_iterations: usize,
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the tile's frames.
    pub residual: f32,
    /// `converged` or `max-iterations`.
    pub stop_reason: String,
}

impl From<&Outcome> for TileRecord {
    fn from(outcome: &Outcome) -> Self {
        Self {
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
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CostRecord {
    /// Execution provider of the network. `None` without a network.
    pub provider: Option<String>,
    /// Version of ONNX Runtime. `None` without a network.
    pub onnxruntime: Option<String>,
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
            cpu_seconds: sum.cpu_seconds + part.cpu_seconds,
            peak_rss_bytes: sum.peak_rss_bytes.max(part.peak_rss_bytes),
        })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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

/// Summary of a snapshot's tiles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Largest value of the tiles.
    pub tv_iterations: usize,
    /// Largest value of the tiles.
    pub denoiser_passes: usize,
    /// Largest value of the tiles.
    pub residual: f32,
    /// `converged` if all tiles converged, else `max-iterations`.
    pub stop_reason: String,
}

impl Summary {
    pub fn of(tiles: &[TileRecord]) -> Self {
        let converged = tiles.iter().all(|tile| tile.stop_reason == "converged");
        Self {
            tv_iterations: tiles.iter().map(|tile| tile.tv_iterations).max().unwrap_or(0),
            denoiser_passes: tiles.iter().map(|tile| tile.denoiser_passes).max().unwrap_or(0),
            residual: tiles.iter().map(|tile| tile.residual).fold(0.0, f32::max),
            stop_reason: if converged { "converged" } else { "max-iterations" }.into(),
        }
    }
}

/// The record of a snapshot's assembly.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SnapshotRecord {
    pub summary: Summary,
    #[serde(default)]
    pub assessment: Option<Assessment>,
    pub run: RunRecord,
    /// All files, the manifest last.
    pub files: Vec<ResultFile>,
}

#[cfg(test)]
mod tests {
    use super::{Summary, TileRecord};

    fn record(residual: f32, stop_reason: &str, passes: usize) -> TileRecord {
        let stop_reason = stop_reason.to_owned();
        TileRecord { tv_iterations: 40, denoiser_passes: passes, residual, stop_reason }
    }

    #[test]
    fn a_summary_has_the_largest_values_of_the_tiles() {
        let tiles = [record(0.01, "converged", 20), record(0.03, "max-iterations", 24)];
        let summary = Summary::of(&tiles);
        assert_eq!((summary.denoiser_passes, summary.residual), (24, 0.03));
        assert_eq!(summary.stop_reason, "max-iterations");
        assert_eq!(Summary::of(&tiles[..1]).stop_reason, "converged");
    }
}
