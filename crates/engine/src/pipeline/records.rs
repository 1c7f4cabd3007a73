//! What the tasks of a job leave for those that follow, and for the manifests.

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

/// What the pilot of a job found out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PilotRecord {
    pub snapshot: usize,
    pub row: usize,
    pub column: usize,
    pub height: usize,
    pub width: usize,
    /// The stages of the schedule that was asked for; none if it is fixed.
    pub stages: Vec<StageRecord>,
    /// Whether snapshots that follow one another belong together, joint by joint.
    #[serde(default)]
    pub joints: Vec<JointRecord>,
    /// What it tells of the error of an adaptive schedule's frames.
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

    /// The joints that are taken apart, each given by the snapshot before it.
    pub fn cuts(&self) -> Vec<usize> {
        let apart = self.joints.iter().filter(|joint| !joint.together);
        apart.map(|joint| joint.after).collect()
    }
}

/// What the pilot found out about a joint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct JointRecord {
    /// The index of the snapshot before it; that behind it is the next.
    pub after: usize,
    /// Whether both snapshots are reconstructed together.
    pub together: bool,
    /// Error at the held-out pixels of both snapshots, each alone, relative to the measurement; null where
    /// the solver diverged.
    pub error_alone: Option<f64>,
    /// The same of both together.
    pub error_together: Option<f64>,
}

/// What the pilot found out about a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
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
    /// Shrinkage of changes along time that was asked for; 0 for none.
    #[serde(default)]
    pub planned_temporal_shrinkage: f32,
    /// The one that pays; 0 if none does.
    #[serde(default)]
    pub temporal_shrinkage: f32,
    /// The same where nothing moves, if four times as much or more pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rest_shrinkage: Option<f32>,
    /// Whether all is taken to be at rest then.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rest_everywhere: bool,
    /// Static variance of the projection that was asked for; none if it was not.
    #[serde(default)]
    pub planned_static_variance: Option<f32>,
    /// The one that pays, if one does.
    #[serde(default)]
    pub static_variance: Option<f32>,
    /// Noise term of the projection, where it is not the schedule's: asked for, or one that pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gamma: Option<f32>,
    /// Why no more: `fixed`, `max-iterations`, `converged` or `diverged`.
    pub end: String,
    /// Error at the held-out pixels before the stage, relative to the measurement.
    pub error_before: f64,
    /// The same after its iterations.
    pub error_after: f64,
}

impl StageRecord {
    /// What became of the total variation along time, of the shrinkage of changes, of the static variance and
    /// of the noise term, as far as there are any.
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
            true => format!("shrinkage {level}, as all is at rest"),
            false => format!("shrinkage where nothing moves {level}"),
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
    /// The snapshots that have frames here, by their place in the run; the others are left to another run.
    pub solved: Vec<usize>,
    /// `None` if nothing can be estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assessment: Option<TileAssessment>,
    /// From reading its window to its frames.
    #[serde(flatten)]
    pub cost: CostRecord,
}

/// What computing took, and on what.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CostRecord {
    /// Execution provider of the network; none without a network.
    pub provider: Option<String>,
    /// Build of ONNX Runtime; none without a network.
    pub onnxruntime: Option<String>,
    pub cpu_seconds: f64,
    /// Largest resident memory of a process that computed.
    pub peak_rss_bytes: u64,
}

impl CostRecord {
    /// Of several parts taken together.
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
    /// The job; none on the command line.
    pub job: Option<String>,
    /// Of all tiles together.
    #[serde(flatten)]
    pub cost: CostRecord,
    /// Wall time of computing; none for a job, whose workers share their time with others'.
    pub seconds: Option<f64>,
    /// When it ended, RFC 3339 in UTC.
    pub finished_at: String,
}

impl RunRecord {
    /// Of a run that ends now.
    pub fn ended(job: Option<String>, cost: CostRecord, seconds: Option<f64>) -> Self {
        Self { job, cost, seconds, finished_at: Timestamp::now().to_string() }
    }
}

/// The tiles of a snapshot taken together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Most of any tile.
    pub tv_iterations: usize,
    /// Most of any tile.
    pub denoiser_passes: usize,
    /// Largest of any tile.
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
    fn a_summary_tells_the_worst_of_the_tiles() {
        let tiles = [record(0.01, "converged", 20), record(0.03, "max-iterations", 24)];
        let summary = Summary::of(&tiles);
        assert_eq!((summary.denoiser_passes, summary.residual), (24, 0.03));
        assert_eq!(summary.stop_reason, "max-iterations");
        assert_eq!(Summary::of(&tiles[..1]).stop_reason, "converged");
    }
}
