//! How a worker reaches the queue and the files: the store of the same machine today. A transport to
//! other machines would offer the same, with tile tasks alone.

use std::error::Error;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use ndarray::Array3;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::runtime::Handle;

use engine::intake::{CaptureFiles, IntakeError};
use engine::job::{
    JobId, JobSpec, Mosaic, ResultFile, SceneShape, Schedule, Sha256, SnapshotRange, TaskProgress,
};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::Arrays;
use engine::pipeline::blend::StoredTile;
use engine::pipeline::manifest::{JobTasks, Recipe};
use engine::pipeline::movie::MovieTask;
use engine::pipeline::networks::ModelFile;
use engine::pipeline::tile::TileInput;
use formats::FormatError;
use reconstruction::assessment::Evidence;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::Tile;
use store::{
    BlobWriter, CalibrationDone, CheckTask, Checked, Heartbeat, Lease, StagedDir, StagedPath,
    Store, StoreError,
};

/// The queue or the files can't be reached.
pub type TransportError = Box<dyn Error + Send + Sync>;

/// How long a task is a worker's without a heartbeat. Long against a pause of the disk, short
/// against a lab's patience.
pub(super) const LEASE: Duration = Duration::from_secs(20);

/// The way to the queue and the files.
#[allow(async_fn_in_trait)] // a worker does not move between threads
pub trait Transport: Clone + Send + 'static {
    async fn started(&self) -> Result<(), TransportError>;

    /// Tells that the worker, which has nothing to do, is alive.
    async fn seen(&self) -> Result<(), TransportError>;

    async fn claim(&self) -> Result<Option<Claim>, TransportError>;

    /// Waits until there may be a task, at most for `time`.
    async fn idle(&self, time: Duration) {
        tokio::time::sleep(time).await;
    }

    /// Renews a lease, notes the progress and how the solver went (JSON), and asks whether to go on.
    async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat, TransportError>;

    /// Waits until a task is known to be wanted no more, or to be someone else's, between heartbeats.
    /// Where nobody tells, for ever.
    async fn called_off(&self, _lease: &Lease) -> Heartbeat {
        std::future::pending().await
    }

    /// Hands over what was made. [`Heartbeat::Lost`] says that the task is someone else's by now; an
    /// error that it is still the worker's.
    async fn complete(&self, lease: &Lease, done: Done) -> Result<Heartbeat, TransportError>;

    /// Tells why a task could not be done, and whether another attempt may succeed.
    async fn fail(&self, lease: &Lease, reason: &str, retry: bool) -> Result<(), TransportError>;

    /// Gives a task back for a while, as the disk is full.
    async fn postpone(&self, lease: &Lease, reason: &str) -> Result<(), TransportError> {
        self.fail(lease, reason, true).await
    }

    /// Gives a task back unharmed: the worker is to end, or the job was cancelled.
    async fn give_back(&self, lease: &Lease) -> Result<(), TransportError>;

    /// Has tiles done again that an assembly, which is given back, found damaged: each is given by the first
    /// snapshot of its run, and its index.
    async fn redo(&self, lease: &Lease, tiles: &[(u32, u32)]) -> Result<(), TransportError>;

    /// What a tile is made of. Brings the file of its network here, too. Blocks.
    fn window(&self, task: &TileTask) -> Result<TileInput, PipelineError>;

    /// The file of the network of a tile whose window was asked for, on this machine.
    fn model(&self, sha256: Sha256) -> ModelFile;
}

#[derive(Debug)]
pub struct Claim {
    /// The right to it, to be shown with every message about it.
    pub lease: Lease,
    pub span: tracing::Span,
    /// Its planned processor time in seconds.
    pub cost: f64,
    /// What is to be done, or why that can't be told.
    pub input: Result<TaskInput, TaskError>,
}

/// What is to be done, with all that is needed.
#[derive(Debug)]
pub enum TaskInput {
    /// Estimate the solver's scale of a job.
    Prepare {
        arrays: Arrays,
        snapshots: SnapshotRange,
    },
    Preview {
        arrays: Arrays,
        shape: SceneShape,
        snapshot: u32,
        white: f32,
    },
    /// Find out how many iterations of an adaptive schedule pay, and which snapshots belong together.
    Pilot {
        arrays: Arrays,
        snapshots: SnapshotRange,
        white: f32,
        schedule: Schedule,
        runs: SequencePlan,
        mosaic: Option<Mosaic>,
    },
    Tile(Box<TileTask>),
    /// Determine the white level of all frames of a job from all its tiles.
    White {
        recipe: Box<Recipe>,
        snapshots: SnapshotRange,
        tiles: Vec<StoredTile>,
    },
    /// Blend all tiles of the runs that hold a snapshot, and write its frames to the folder.
    Assemble {
        job: JobId,
        recipe: Box<Recipe>,
        snapshot: u32,
        tiles: Vec<StoredTile>,
        folder: StagedDir,
    },
    Manifest {
        job: JobId,
        spec: Box<JobSpec>,
        recipe: Box<Recipe>,
        tasks: JobTasks,
        folder: StagedDir,
    },
    /// Check the uploads of a request.
    Check(Box<Check>),
    /// Make masks of captures, and a report on them; they lie in `scratch` until their scale is known.
    Captures {
        files: CaptureFiles,
        /// A map of bad pixels.
        bad_pixels: Option<PathBuf>,
        scratch: StagedPath,
        masks: Box<BlobWriter>,
    },
    /// Make a report on masks, a prepared array at this place.
    Report(PathBuf),
    /// Make a movie, which is written to the file.
    Movie(Box<MovieTask>, StagedPath),
}

/// A check that a worker of this machine has claimed.
#[derive(Debug)]
pub struct Check {
    pub task: CheckTask,
    pub store: Store,
    pub lease: Lease,
    pub runtime: Handle,
}

/// A tile to be reconstructed. Arrays and models are named by their hashes, so that this can go to
/// another machine as it is.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TileTask {
    pub masks: Sha256,
    pub measurement: Sha256,
    /// The run of snapshots that it belongs to, by their indices in the measurement.
    pub snapshots: Range<u32>,
    /// Those of them that are solved together, by their place in the run.
    pub pieces: Vec<Range<usize>>,
    pub tile: Tile,
    pub white: f32,
    /// The schedule, after the pilot; without stages if there is a model.
    pub schedule: Schedule,
    pub model: Option<Sha256>,
    /// What the pilot tells of the error of the frames.
    #[serde(default)]
    pub evidence: Option<Evidence>,
}

#[derive(Debug)]
pub struct Done {
    /// Where the task stood when it ended: `fraction` is below 1 if the solver converged early.
    pub progress: TaskProgress,
    /// What is to be remembered of it, for the manifest.
    pub record: Value,
    pub output: Output,
}

#[derive(Debug)]
pub enum Output {
    Record,
    /// The share of their planned cost that the tiles still have, on \[0,1\].
    TileCost(f64),
    /// The frames \[S B,h,w\] of a tile, or \[B,h,w\] of a preview.
    Stack(Array3<f32>),
    /// A movie.
    File(StagedPath),
    /// Files of a result, which are on the disk, and their folder.
    Files(StagedDir, Vec<ResultFile>),
    Checked(Box<Checked>),
    /// The report on a calibration, and its masks if they were made of captures.
    Calibration(Box<CalibrationDone>),
}

#[derive(Debug, thiserror::Error)]
pub enum TaskError {
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    #[error(transparent)]
    Intake(#[from] IntakeError),
    #[error(transparent)]
    Transport(#[from] TransportError),
}

impl TaskError {
    /// Whether there was no room on the disk: the task is not to blame, and goes on when there is.
    pub(super) fn is_disk_full(&self) -> bool {
        match self {
            Self::Pipeline(error) => error.is_disk_full(),
            Self::Intake(IntakeError::Format { source, .. }) => source.is_disk_full(),
            Self::Intake(_) => false,
            Self::Transport(error) => {
                let store =
                    error.downcast_ref::<StoreError>().is_some_and(StoreError::is_disk_full);
                let format = error.downcast_ref::<FormatError>();
                store || format.is_some_and(FormatError::is_disk_full)
            }
        }
    }

    pub(super) fn is_retryable(&self) -> bool {
        match self {
            Self::Pipeline(error) => error.is_retryable(),
            Self::Intake(error) => error.is_retryable(),
            Self::Transport(_) => true,
        }
    }
}
