//! Tasks: the pieces that a job is cut into.

use serde::{Deserialize, Serialize};

/// What a task does. Snapshots are counted from 0 within the measurement, tiles within the tile plan.
///
/// The order of work is prepare, then previews, the pilot of an adaptive schedule, and all tiles; a
/// snapshot is assembled when its tiles are done, and the manifest is written when all snapshots
/// are assembled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TaskKind {
    /// Estimate the scene's scale, once a job, so that no two tiles differ in it.
    Prepare,
    /// Reconstruct one snapshot coarsely, to be looked at until its tiles are done.
    Preview {
        /// The snapshot's index.
        snapshot: u32,
    },
    /// Find out how many iterations of an adaptive schedule pay. Tiles wait for it.
    Pilot,
    /// Reconstruct one tile of one snapshot.
    Tile {
        /// The snapshot's index.
        snapshot: u32,
        /// The tile's index in the plan.
        tile: u32,
    },
    /// Blend the tiles of one snapshot and write its frames.
    Assemble {
        /// The snapshot's index.
        snapshot: u32,
    },
    /// Write the manifest of the job.
    Manifest,
}

impl TaskKind {
    /// The kind's name in the database, in metrics and in logs.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Prepare => "prepare",
            Self::Preview { .. } => "preview",
            Self::Pilot => "pilot",
            Self::Tile { .. } => "tile",
            Self::Assemble { .. } => "assemble",
            Self::Manifest => "manifest",
        }
    }

    /// The snapshot that the task belongs to, if it belongs to one.
    #[must_use]
    pub fn snapshot(self) -> Option<u32> {
        match self {
            Self::Preview { snapshot }
            | Self::Tile { snapshot, .. }
            | Self::Assemble { snapshot } => Some(snapshot),
            Self::Prepare | Self::Pilot | Self::Manifest => None,
        }
    }

    /// The tile's index, for a tile.
    #[must_use]
    pub fn tile(self) -> Option<u32> {
        match self {
            Self::Tile { tile, .. } => Some(tile),
            _ => None,
        }
    }

    /// The kind with this name and these indices: the inverse of the three functions above.
    #[must_use]
    pub fn from_parts(name: &str, snapshot: Option<u32>, tile: Option<u32>) -> Option<Self> {
        match (name, snapshot, tile) {
            ("prepare", None, None) => Some(Self::Prepare),
            ("preview", Some(snapshot), None) => Some(Self::Preview { snapshot }),
            ("pilot", None, None) => Some(Self::Pilot),
            ("tile", Some(snapshot), Some(tile)) => Some(Self::Tile { snapshot, tile }),
            ("assemble", Some(snapshot), None) => Some(Self::Assemble { snapshot }),
            ("manifest", None, None) => Some(Self::Manifest),
            _ => None,
        }
    }
}

/// Where a task stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// Waits for other tasks of its job.
    Blocked,
    /// Can be claimed.
    Ready,
    /// Claimed by a worker, whose lease may have run out.
    Running,
    /// Its result is stored.
    Done,
    /// Given up; the job has failed with it.
    Failed,
    /// The job was cancelled or failed before this task was done.
    Cancelled,
}

/// The part of its work that a task is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskStage {
    /// Reading inputs.
    Reading,
    /// Iterations with total variation as the prior.
    Tv,
    /// Iterations with a learned denoiser.
    Deep,
    /// Iterations with the nonlocal prior.
    Nonlocal,
    /// Blending and writing.
    Writing,
}

impl TaskStage {
    /// The stage's name in JSON and in the database.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Reading => "reading",
            Self::Tv => "tv",
            Self::Deep => "deep",
            Self::Nonlocal => "nonlocal",
            Self::Writing => "writing",
        }
    }
}

/// How far a running task is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TaskProgress {
    /// What it is doing now.
    pub stage: TaskStage,
    /// Solver iterations done so far.
    pub iterations: u32,
    /// Passes of the deep denoiser done so far.
    pub passes: u32,
    /// The share of the planned work that is done, on [0, 1], by cost and not by count: one deep
    /// pass costs as much as thousands of TV iterations ([`super::Schedule::share_done`]).
    pub fraction: f64,
}

impl TaskProgress {
    /// Nothing is done yet.
    pub const START: Self =
        Self { stage: TaskStage::Reading, iterations: 0, passes: 0, fraction: 0.0 };
}
