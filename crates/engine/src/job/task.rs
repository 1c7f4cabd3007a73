//! Tasks: what workers do. A job is cut into many; a calibration is one.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray, VariantNames};

use super::request::JobSpec;
use super::shape::SceneShape;
use super::text::Sha256;
use reconstruction::{ReconError, crop, joints, preview};

/// CPU-seconds for each voxel that is read, or blended and written in all formats (measured).
const READ_S: f64 = 12e-9;
const WRITE_S: f64 = 110e-9;
/// The same of a preview by blocks, and of one that is done whole (measured).
const PREVIEW_BLOCKS_S: f64 = 10e-9;
const PREVIEW_WHOLE_S: f64 = 120e-9;
/// The same for each sample of a movie (measured; of noise it is twice as much).
const MOVIE_S: f64 = 700e-9;
/// No side of a movie is longer, or shorter: AV1's encoder takes no smaller ones.
pub const MOVIE_SIDE: usize = 1920;
pub const LEAST_MOVIE_SIDE: usize = 16;

/// What a task does. Snapshots are counted from 0 within the measurement, tiles within the tile plan.
///
/// The order of work is prepare, then previews, the pilot of an adaptive schedule or a sequence, and all
/// tiles, run by run; a snapshot is assembled when the tiles of the runs that hold it are done, and the
/// manifest is written when all snapshots are assembled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr, VariantNames)]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum TaskKind {
    /// Estimate the scene's scale, once a job, so that no two tiles differ in it.
    Prepare,
    /// Reconstruct one snapshot coarsely, to be looked at until its tiles are done.
    Preview {
        snapshot: u32,
    },
    /// Find out how many iterations of an adaptive schedule pay, and which snapshots belong together. Tiles
    /// wait for it.
    Pilot,
    /// Reconstruct one tile of a run of snapshots.
    Tile {
        /// The run's first snapshot.
        snapshot: u32,
        /// How many there are in the run.
        snapshots: u32,
        tile: u32,
    },
    /// Blend the tiles of one snapshot and write its frames.
    Assemble {
        snapshot: u32,
    },
    Manifest,
    /// Make the masks of a calibration from its captures, and the report on them.
    Calibration,
    /// Make a movie of the frames of a snapshot, or of all of a job, which somebody has asked for.
    Movie {
        snapshot: Option<u32>,
    },
}

impl TaskKind {
    /// The snapshot that the task belongs to, or the first of its run, if it belongs to one.
    pub fn snapshot(self) -> Option<u32> {
        match self {
            Self::Preview { snapshot }
            | Self::Tile { snapshot, .. }
            | Self::Assemble { snapshot } => Some(snapshot),
            Self::Movie { snapshot } => snapshot,
            Self::Prepare | Self::Pilot | Self::Manifest | Self::Calibration => None,
        }
    }

    /// How many snapshots the task does at once.
    pub fn snapshots(self) -> u32 {
        match self {
            Self::Tile { snapshots, .. } => snapshots,
            _ => 1,
        }
    }

    /// The tile's index, for a tile.
    pub fn tile(self) -> Option<u32> {
        match self {
            Self::Tile { tile, .. } => Some(tile),
            _ => None,
        }
    }

    /// The kind with this name and these indices: the inverse of the functions above and `into_str`.
    pub fn from_parts(
        name: &str,
        (snapshot, snapshots): (Option<u32>, u32),
        tile: Option<u32>,
    ) -> Option<Self> {
        match (name, snapshot, tile) {
            ("prepare", None, None) => Some(Self::Prepare),
            ("preview", Some(snapshot), None) => Some(Self::Preview { snapshot }),
            ("pilot", None, None) => Some(Self::Pilot),
            ("tile", Some(snapshot), Some(tile)) => Some(Self::Tile { snapshot, snapshots, tile }),
            ("assemble", Some(snapshot), None) => Some(Self::Assemble { snapshot }),
            ("manifest", None, None) => Some(Self::Manifest),
            ("calibration", None, None) => Some(Self::Calibration),
            ("movie", snapshot, None) => Some(Self::Movie { snapshot }),
            _ => None,
        }
    }
}

impl JobSpec {
    /// The tasks of the job with their planned CPU-seconds, in the order in which they are handed out.
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn tasks(&self) -> Result<Vec<(TaskKind, f64)>, ReconError> {
        let (tiles, runs) = (self.tile_plan()?, self.sequence_plan()?);
        let pixels = (self.shape.height * self.shape.width) as f64;
        let frames = self.shape.frames as f64;
        let per_voxel = self.planned_ns_per_voxel() * 1e-9;
        let mut tasks = vec![(TaskKind::Prepare, pixels * (frames + 1.0) * READ_S)];
        let (height, width) = self.shape.solved();
        let whole = preview::block(self.shape.frames, height, width) == 1;
        let write_s = WRITE_S * self.shape.channels().count() as f64;
        let preview = pixels * frames * if whole { PREVIEW_WHOLE_S } else { PREVIEW_BLOCKS_S };
        let snapshots = self.snapshots.indices();
        tasks.extend(snapshots.map(|snapshot| (TaskKind::Preview { snapshot }, preview)));
        let joints = runs.joints().len() as f64;
        if self.schedule.adaptive || joints > 0.0 {
            let voxels = pixels.min((crop::SIDE * crop::SIDE) as f64) * frames;
            let decided = if self.schedule.adaptive {
                self.schedule.pilot_ns_per_voxel() * 1e-9
            } else {
                0.0
            };
            // Of each joint both snapshots together, and the second one alone.
            let compared = if joints > 0.0 {
                (3.0 * joints + 1.0) / joints::ITERATION_DIVISOR as f64
            } else {
                0.0
            };
            // The preview of the first snapshot is there at once; the others may wait.
            tasks.insert(2, (TaskKind::Pilot, voxels * (decided + per_voxel * compared)));
        }
        let mut assembled = self.snapshots.first;
        for (index, run) in runs.runs().iter().enumerate() {
            let (snapshot, snapshots) = (run.start as u32, run.len() as u32);
            let mut areas: Vec<_> = (0..).zip(tiles.tiles()).collect();
            areas.sort_by(|(a, _), (b, _)| place(*a).total_cmp(&place(*b)));
            for (tile, area) in areas {
                let voxels = (area.height * area.width * run.len()) as f64 * frames;
                tasks.push((TaskKind::Tile { snapshot, snapshots, tile }, voxels * per_voxel));
            }
            // What no later run holds is complete.
            let complete = runs.runs().get(index + 1).map_or(run.end, |next| next.start) as u32;
            let snapshots = std::mem::replace(&mut assembled, complete)..complete;
            let assemble = |snapshot| (TaskKind::Assemble { snapshot }, pixels * frames * write_s);
            tasks.extend(snapshots.map(assemble));
        }
        tasks.push((TaskKind::Manifest, 0.01));
        Ok(tasks)
    }

    /// Planned CPU-seconds of the movie of a snapshot or, with none, of all of them.
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn movie_cost(&self, snapshot: Option<u32>) -> f64 {
        let SceneShape { frames, height, width, .. } = self.shape;
        let snapshots = if snapshot.is_some() { 1 } else { self.snapshots.count as usize };
        let samples = snapshots * frames * height * width * self.shape.channels().count();
        samples as f64 * READ_S + self.movie_bytes(snapshot) as f64 * MOVIE_S
    }

    /// Samples of the movie of a snapshot or, with none, of all of them: more bytes than it takes.
    pub fn movie_bytes(&self, snapshot: Option<u32>) -> u64 {
        let snapshots = if snapshot.is_some() { 1 } else { u64::from(self.snapshots.count) };
        snapshots * self.shape.frames as u64 * self.movie_samples()
    }

    /// Whether the frames are large enough for a movie.
    pub fn has_movie(&self) -> bool {
        let SceneShape { height, width, .. } = self.shape;
        height.min(width).div_ceil(movie_step(height, width)) >= LEAST_MOVIE_SIDE
    }

    /// Samples of a frame of a movie.
    pub(super) fn movie_samples(&self) -> u64 {
        let step = movie_step(self.shape.height, self.shape.width);
        let side = |length: usize| length.div_ceil(step) as u64;
        side(self.shape.height) * side(self.shape.width) * self.shape.channels().count() as u64
    }
}

/// Every so many rows and columns of pictures of this size are one of their movie: a power of two.
pub fn movie_step(height: usize, width: usize) -> usize {
    let fits = |step: &usize| height.max(width).div_ceil(*step) <= MOVIE_SIDE;
    (0..usize::BITS).map(|level| 1 << level).find(fits).unwrap_or(1)
}

/// The place of a tile in the order of work. Multiples of the golden ratio go all over the picture: it
/// gets sharper everywhere, and the first tiles tell what the others may take.
fn place(tile: u32) -> f64 {
    (f64::from(tile) * 0.618_033_988_75).fract()
}

/// Where a task stands, in the order of its life.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum TaskState {
    /// Waits for other tasks of its job.
    Blocked,
    /// Can be claimed.
    Ready,
    /// Claimed by a worker, whose lease may have run out.
    Running,
    /// Its result is stored.
    Done,
    /// Given up; its job or calibration has failed with it.
    Failed,
    /// The job was cancelled or failed before this task was done.
    Cancelled,
}

/// The part of its work that a task is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Display, EnumString)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum TaskStage {
    Reading,
    /// Iterations with total variation as the prior.
    Tv,
    /// Iterations with a learned denoiser.
    Deep,
    /// Iterations with the nonlocal prior.
    Nonlocal,
    Writing,
}

/// How far a running task is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TaskProgress {
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

/// A file that a task has made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultFile {
    /// Its path below the folder of the snapshot or job, such as `frames/frame_0001.exr`.
    pub name: String,
    pub size: u64,
    pub sha256: Sha256,
}
