//! Tasks, the units of work of workers. A job has many tasks, a calibration has one.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray, VariantNames};

use super::registration::RegistrationRequest;
use super::request::JobSpec;
use super::shape::SceneShape;
use super::text::Sha256;
use reconstruction::{ReconError, crop, joints, preview};

/// CPU seconds per voxel that is read (measured).
const READ_S: f64 = 12e-9;
/// CPU seconds per frame of the registration of masks on pieces of fixed size. Median of `make eval-registration` with rotation and growth.
const REGISTRATION_S: f64 = 0.16;
/// CPU seconds per voxel that is blended and written in all formats (measured).
const WRITE_S: f64 = 110e-9;
/// CPU seconds per voxel of a preview by blocks (measured).
const PREVIEW_BLOCKS_S: f64 = 10e-9;
/// CPU seconds per voxel of a preview at full resolution (measured).
const PREVIEW_WHOLE_S: f64 = 120e-9;
/// CPU seconds per sample of a movie (measured; noise takes twice as long).
const MOVIE_S: f64 = 700e-9;
/// Largest planned CPU seconds of a task that the light worker takes, checks excepted: an upload may wait that long.
const LIGHT_S: f64 = 1.0;
/// CPU seconds per sample of a GIF of noise in colours (measured; smooth ones take 40e-9, grey ones up to 30e-9).
const GIF_S: f64 = 107e-9;
/// Longest side of a movie in pixels.
pub const MOVIE_SIDE: usize = 1920;
/// Shortest side of a movie in pixels; the AV1 encoder accepts no smaller ones.
pub const MIN_MOVIE_SIDE: usize = 16;

/// The kind of a task. Snapshots are counted from 0 within the measurement, tiles from 0 within the tile plan.
///
/// A job starts with prepare. Previews, the pilot (for an adaptive schedule or a sequence) and the tiles of all runs
/// follow. When all tiles are done, the white level of the frames is determined, and the snapshots are assembled. The
/// manifest comes last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr, VariantNames)]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum TaskKind {
    /// Estimates the scale of the solver once per job, so that all tiles use the same one.
    Prepare,
    /// Reconstructs one snapshot coarsely, for display until its tiles are done.
    Preview { snapshot: u32 },
    /// Decides the iterations of an adaptive schedule, and which neighbouring snapshots are reconstructed together.
    /// Tiles wait for it.
    Pilot,
    /// Reconstructs one tile of a run of snapshots.
    Tile {
        /// First snapshot of the run.
        snapshot: u32,
        /// Number of snapshots in the run.
        snapshots: u32,
        tile: u32,
    },
    /// Determines the white level of all frames, by which they are displayed and their errors are judged.
    White,
    /// Blends the tiles of one snapshot and writes its frames.
    Assemble { snapshot: u32 },
    /// Writes the manifest of the job.
    Manifest,
    /// Checks the uploads of a calibration, measurement or model, and prepares them.
    Check,
    /// Computes the masks of a calibration from its captures, and the report.
    Calibration,
    /// Encodes a requested movie of one snapshot, or of all snapshots of a job.
    Movie { snapshot: Option<u32> },
    /// Writes such a movie as a GIF.
    Gif { snapshot: Option<u32> },
}

/// The format of a movie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
#[derive(schemars::JsonSchema)]
pub enum MovieFormat {
    /// AV1 in MP4, which browsers and video players play.
    Mp4,
    /// GIF, which presentation programs play. Grey levels are exact.
    Gif,
}

impl MovieFormat {
    /// The task that writes the movie of a snapshot, or of all snapshots for `None`.
    pub fn task(self, snapshot: Option<u32>) -> TaskKind {
        match self {
            Self::Mp4 => TaskKind::Movie { snapshot },
            Self::Gif => TaskKind::Gif { snapshot },
        }
    }
}

impl TaskKind {
    /// The snapshot of the task, or the first of its run; `None` for tasks of the whole job.
    pub fn snapshot(self) -> Option<u32> {
        match self {
            Self::Preview { snapshot }
            | Self::Tile { snapshot, .. }
            | Self::Assemble { snapshot } => Some(snapshot),
            Self::Movie { snapshot } | Self::Gif { snapshot } => snapshot,
            Self::Prepare
            | Self::Pilot
            | Self::White
            | Self::Manifest
            | Self::Check
            | Self::Calibration => None,
        }
    }

    /// Number of snapshots that the task processes together.
    pub fn snapshots(self) -> u32 {
        match self {
            Self::Tile { snapshots, .. } => snapshots,
            _ => 1,
        }
    }

    /// Index of the tile; `None` for other tasks.
    pub fn tile(self) -> Option<u32> {
        match self {
            Self::Tile { tile, .. } => Some(tile),
            _ => None,
        }
    }

    /// True if the light worker of a server takes a task of this kind with these planned CPU seconds. It takes every
    /// check, since an upload must not wait behind tiles, and no other long task.
    pub fn is_light(self, cost: f64) -> bool {
        match self {
            Self::Check => true,
            Self::Prepare
            | Self::Preview { .. }
            | Self::White
            | Self::Assemble { .. }
            | Self::Manifest
            | Self::Movie { .. }
            | Self::Gif { .. } => cost <= LIGHT_S,
            Self::Pilot | Self::Tile { .. } | Self::Calibration => false,
        }
    }

    /// The kind with this name and these indices. It is the inverse of the accessors and of `into_str`.
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
            ("white", None, None) => Some(Self::White),
            ("assemble", Some(snapshot), None) => Some(Self::Assemble { snapshot }),
            ("manifest", None, None) => Some(Self::Manifest),
            ("check", None, None) => Some(Self::Check),
            ("calibration", None, None) => Some(Self::Calibration),
            ("movie", snapshot, None) => Some(Self::Movie { snapshot }),
            ("gif", snapshot, None) => Some(Self::Gif { snapshot }),
            _ => None,
        }
    }
}

impl JobSpec {
    /// The tasks of the job with their planned CPU seconds, in the order in which workers claim them.
    ///
    /// Errors: none for a spec from [`JobRequest::resolve`](super::JobRequest::resolve).
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn tasks(&self) -> Result<Vec<(TaskKind, f64)>, ReconError> {
        let (tiles, runs) = (self.tile_plan()?, self.sequence_plan()?);
        let pixels = (self.shape.height * self.shape.width) as f64;
        let frames = self.shape.frames as f64;
        let per_voxel = self.planned_ns_per_voxel() * 1e-9;
        let registration = match (self.registration, self.shape.mosaic) {
            (RegistrationRequest::Auto, None) => frames * REGISTRATION_S,
            _ => 0.0,
        };
        let prepare = pixels * (frames + 1.0) * READ_S + registration;
        let mut tasks = vec![(TaskKind::Prepare, prepare)];
        let (height, width) = self.shape.solved();
        let full_resolution = preview::block(self.shape.frames, height, width) == 1;
        let write_s = WRITE_S * self.shape.channels().count() as f64;
        let preview =
            pixels * frames * if full_resolution { PREVIEW_WHOLE_S } else { PREVIEW_BLOCKS_S };
        let snapshots = self.snapshots.indices();
        tasks.extend(snapshots.map(|snapshot| (TaskKind::Preview { snapshot }, preview)));
        let joints = runs.joints().len() as f64;
        if self.schedule.adaptive || joints > 0.0 {
            let voxels = pixels.min((crop::SIDE * crop::SIDE) as f64) * frames;
            let schedule_s = if self.schedule.adaptive {
                self.schedule.pilot_ns_per_voxel() * 1e-9
            } else {
                0.0
            };
            // Each joint compares both snapshots together with the second one alone.
            let joints_s = if joints > 0.0 {
                (3.0 * joints + 1.0) / joints::ITERATION_DIVISOR as f64
            } else {
                0.0
            };
            // The pilot follows the preview of the first snapshot; the other previews can wait.
            tasks.insert(2, (TaskKind::Pilot, voxels * (schedule_s + per_voxel * joints_s)));
        }
        for run in runs.runs() {
            let (snapshot, snapshots) = (run.start as u32, run.len() as u32);
            let mut areas: Vec<_> = (0..).zip(tiles.tiles()).collect();
            areas.sort_by(|(a, _), (b, _)| work_order(*a).total_cmp(&work_order(*b)));
            for (tile, area) in areas {
                let voxels = (area.height * area.width * run.len()) as f64 * frames;
                tasks.push((TaskKind::Tile { snapshot, snapshots, tile }, voxels * per_voxel));
            }
        }
        let voxels = pixels * frames * f64::from(self.snapshots.count);
        tasks.push((TaskKind::White, voxels * READ_S));
        let assemble = |snapshot| (TaskKind::Assemble { snapshot }, pixels * frames * write_s);
        tasks.extend(self.snapshots.indices().map(assemble));
        tasks.push((TaskKind::Manifest, 0.01));
        Ok(tasks)
    }

    /// Planned CPU seconds of the movie of one snapshot, or of all snapshots for `None`.
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn movie_cost(&self, format: MovieFormat, snapshot: Option<u32>) -> f64 {
        let SceneShape { frames, height, width, .. } = self.frame_shape();
        let snapshots = if snapshot.is_some() { 1 } else { self.snapshots.count as usize };
        let samples = snapshots * frames * height * width * self.shape.channels().count();
        let written = snapshots as u64 * frames as u64 * self.movie_samples();
        let sample_s = match format {
            MovieFormat::Mp4 => MOVIE_S,
            MovieFormat::Gif => GIF_S,
        };
        samples as f64 * READ_S + written as f64 * sample_s
    }

    /// Upper bound, in bytes, of the movie of one snapshot, or of all snapshots for `None`: one byte per sample of an
    /// MP4. GIF codes a pixel of noise with up to 12 bits.
    pub fn movie_bytes(&self, format: MovieFormat, snapshot: Option<u32>) -> u64 {
        let snapshots = if snapshot.is_some() { 1 } else { u64::from(self.snapshots.count) };
        let samples = snapshots * self.shape.frames as u64 * self.movie_samples();
        match format {
            MovieFormat::Mp4 => samples,
            MovieFormat::Gif => samples.div_ceil(2) * 3 + (1 << 10) * self.shape.frames as u64,
        }
    }

    /// True if the frames are large enough for a movie in this format.
    pub fn has_movie(&self, format: MovieFormat) -> bool {
        let SceneShape { height, width, .. } = self.frame_shape();
        format == MovieFormat::Gif
            || height.min(width).div_ceil(movie_step(height, width)) >= MIN_MOVIE_SIDE
    }

    /// Number of samples in a frame of a movie.
    pub(super) fn movie_samples(&self) -> u64 {
        let SceneShape { height, width, .. } = self.frame_shape();
        let step = movie_step(height, width);
        let side = |length: usize| length.div_ceil(step) as u64;
        side(height) * side(width) * self.shape.channels().count() as u64
    }
}

/// Subsampling factor, a power of two, that fits pictures of this size into [`MOVIE_SIDE`].
pub fn movie_step(height: usize, width: usize) -> usize {
    let fits = |step: &usize| height.max(width).div_ceil(*step) <= MOVIE_SIDE;
    (0..usize::BITS).map(|level| 1 << level).find(fits).unwrap_or(1)
}

/// Sort key of a tile in the order of work. Multiples of the golden ratio spread the first tiles over the picture, so
/// that it becomes sharp everywhere, and the first tiles give a good estimate of the remaining time.
fn work_order(tile: u32) -> f64 {
    (f64::from(tile) * 0.618_033_988_75).fract()
}

/// The state of a task, in the order of its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[derive(Serialize, Deserialize, schemars::JsonSchema)]
#[derive(Display, EnumString, IntoStaticStr, VariantArray)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum TaskState {
    /// Waits for other tasks of the job.
    Blocked,
    /// Can be claimed.
    Ready,
    /// Claimed by a worker. The lease may have expired.
    Running,
    /// The result is stored.
    Done,
    /// Failed after all attempts, and with it the job or calibration.
    Failed,
    /// Not done because the job was cancelled or failed.
    Cancelled,
}

/// The phase of a running task.
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

/// Progress of a running task.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TaskProgress {
    pub stage: TaskStage,
    /// Number of finished solver iterations.
    pub iterations: u32,
    /// Number of finished passes of the deep denoiser.
    pub passes: u32,
    /// Finished share of the planned cost, on \[0,1\]; see [`super::Schedule::share_done`]. One deep pass costs as much
    /// as thousands of TV iterations.
    pub fraction: f64,
}

impl TaskProgress {
    /// The progress at the start of a task.
    pub const START: Self =
        Self { stage: TaskStage::Reading, iterations: 0, passes: 0, fraction: 0.0 };
}

/// A file of a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ResultFile {
    /// Path below the folder of the snapshot or job, such as `frames/frame_0001.exr`.
    pub name: String,
    pub size: u64,
    pub sha256: Sha256,
}

/// A file of a result as the task that makes it reports it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrittenFile {
    pub file: ResultFile,
    /// CRC-32 of the bytes, by which ZIP archives check their members.
    pub crc32: u32,
    /// True for a file that is not on the disk, but derived from the stack of frames when it is read.
    pub is_derived: bool,
}
