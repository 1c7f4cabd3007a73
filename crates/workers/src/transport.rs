//! The interface through which a worker reaches the queue and the files. `local.rs` implements it with the store of
//! the same machine, `nats/remote.rs` for tiles on other machines.

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
    JobId, JobSpec, ModelRecord, Mosaic, RegistrationRequest, SceneShape, Schedule, Sha256,
    SnapshotRange, TaskProgress, WrittenFile,
};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::Arrays;
use engine::pipeline::blend::StoredTile;
use engine::pipeline::manifest::{JobTasks, Recipe};
use engine::pipeline::movie::MovieTask;
use engine::pipeline::networks::ModelFile;
use engine::pipeline::tile::TileInput;
use formats::{DiskTrouble, FormatError};
use reconstruction::ReconError;
use reconstruction::assessment::Evidence;
use reconstruction::registration::Correction;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::Tile;
use store::{
    BlobWriter, CalibrationDone, CheckTask, Checked, Heartbeat, Lease, StagedDir, StagedPath,
    Store, StoreError,
};

/// The queue or the files can't be reached.
pub type TransportError = Box<dyn Error + Send + Sync>;

/// Time after which a task without a heartbeat is offered to another worker. It is longer than pauses of the disk
/// and shorter than a lab would wait.
pub(super) const LEASE: Duration = Duration::from_secs(20);

/// Access to the queue and the files.
#[allow(async_fn_in_trait)] // a worker does not move between threads
pub trait Transport: Clone + Send + 'static {
    async fn started(&self) -> Result<(), TransportError>;

    /// Reports that an idle worker is alive.
    async fn report_alive(&self) -> Result<(), TransportError>;

    async fn claim(&self) -> Result<Option<Claim>, TransportError>;

    /// Waits until there may be a task, at most for `time`.
    async fn idle(&self, time: Duration) {
        tokio::time::sleep(time).await;
    }

    /// Number of workers that share the cores of this machine now; none if that is unknown. The worker then uses one core.
    async fn busy_workers(&self) -> Result<Option<usize>, TransportError> {
        Ok(None)
    }

    /// Renews a lease, and records the progress and the solver's history (JSON). The answer says whether to continue.
    async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat, TransportError>;

    /// Waits until a task is cancelled or its lease is lost. Never returns where only heartbeats report that.
    async fn called_off(&self, _lease: &Lease) -> Heartbeat {
        std::future::pending().await
    }

    /// Stores the result of a task. [`Heartbeat::Lost`] means that another worker has the task; after an error, this
    /// worker still has it.
    async fn complete(&self, lease: &Lease, done: Done) -> Result<Heartbeat, TransportError>;

    /// Reports a failure, and whether another attempt may succeed.
    async fn fail(&self, lease: &Lease, reason: &str, retry: bool) -> Result<(), TransportError>;

    /// Returns a task to the queue with a pause, because the disk can't be written.
    async fn postpone(&self, lease: &Lease, reason: &str) -> Result<(), TransportError> {
        self.fail(lease, reason, true).await
    }

    /// Returns a task without counting a failure: the worker stops, or the job was cancelled.
    async fn give_back(&self, lease: &Lease) -> Result<(), TransportError>;

    /// Returns an assembly and repeats its damaged tiles. A tile is named by the first snapshot of its run and its
    /// index.
    async fn redo(&self, lease: &Lease, tiles: &[(u32, u32)]) -> Result<(), TransportError>;

    /// The input of a tile. Also fetches the file of its network. Blocks.
    fn window(&self, task: &TileTask) -> Result<TileInput, PipelineError>;

    /// The local file of a network, which [`Transport::window`] has fetched.
    fn model(&self, sha256: Sha256) -> ModelFile;
}

#[derive(Debug)]
pub struct Claim {
    /// Names the attempt in every message about the task.
    pub lease: Lease,
    pub span: tracing::Span,
    /// Planned processor time in seconds.
    pub cost: f64,
    /// The work, or the reason why its input can't be read.
    pub input: Result<TaskInput, TaskError>,
}

/// The work of a task, with its complete input.
#[derive(Debug)]
pub enum TaskInput {
    /// Estimate the solver's scale of a job, and register its masks.
    Prepare {
        arrays: Arrays,
        snapshots: SnapshotRange,
        registration: RegistrationRequest,
        is_coloured: bool,
    },
    Preview {
        arrays: Arrays,
        shape: SceneShape,
        snapshot: u32,
        white: f32,
    },
    /// Decide the iterations of an adaptive schedule, and the cuts between snapshots.
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
        arrays: Arrays,
        recipe: Box<Recipe>,
        snapshots: SnapshotRange,
        tiles: Vec<StoredTile>,
    },
    /// Blend all tiles of the runs that contain a snapshot, and write its frames to the folder.
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
    /// Make masks from captures, and a report on them. `scratch` holds the masks until their scale is known.
    Captures {
        files: CaptureFiles,
        /// A map of bad pixels.
        bad_pixels: Option<PathBuf>,
        scratch: StagedPath,
        masks: Box<BlobWriter>,
    },
    /// Make a report on the masks in this prepared array.
    Report {
        masks: PathBuf,
        /// True for the bands of one mask.
        spectral: bool,
    },
    /// Write a movie to the file.
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

/// A tile to be reconstructed. Arrays and models are named by their hashes, so that the task is valid on every
/// machine.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TileTask {
    pub masks: Sha256,
    /// Correction of masks that have moved.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub correction: Option<Correction>,
    pub measurement: Sha256,
    /// The run of snapshots that the tile belongs to, as indices in the measurement.
    pub snapshots: Range<u32>,
    /// Groups of snapshots that are solved together, as indices in the run.
    pub pieces: Vec<Range<usize>>,
    pub tile: Tile,
    pub white: f32,
    /// The schedule after the pilot. It has no stages if there is a model.
    pub schedule: Schedule,
    pub model: Option<Sha256>,
    /// The networks of the schedule at the submission of the job.
    pub networks: Vec<ModelRecord>,
    /// The pilot's evidence on the error of the frames.
    #[serde(default)]
    pub evidence: Option<Evidence>,
}

#[derive(Debug)]
pub struct Done {
    /// The progress at the end: `fraction` is below 1 if the solver converged early.
    pub progress: TaskProgress,
    /// The record of the task, for the manifest.
    pub record: Value,
    pub output: Output,
}

#[derive(Debug)]
pub enum Output {
    Record,
    /// Cost of the tiles after the pilot, as a share of their planned cost, on \[0,1\].
    TileCost(f64),
    /// The frames \[S B,h,w\] of a tile, or \[B,h,w\] of a preview.
    Stack(Array3<f32>),
    /// The file of a movie.
    File(StagedPath),
    /// Files of a result, and their folder.
    Files(StagedDir, Vec<WrittenFile>),
    Checked(Box<Checked>),
    /// The report on a calibration, and its masks if they were made from captures.
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
    /// The condition of the disk that caused the error, if there is one. The task is retried when the condition has ended.
    pub(super) fn disk_trouble(&self) -> Option<DiskTrouble> {
        match self {
            Self::Pipeline(error) => error.disk_trouble(),
            Self::Intake(IntakeError::Format { source, .. }) => source.disk_trouble(),
            Self::Intake(_) => None,
            Self::Transport(error) => {
                let store = error.downcast_ref::<StoreError>().and_then(StoreError::disk_trouble);
                let format = error.downcast_ref::<FormatError>();
                store.or_else(|| format.and_then(FormatError::disk_trouble))
            }
        }
    }

    /// True if the process must be replaced, because it can't use its device again.
    pub(super) fn is_device_loss(&self) -> bool {
        matches!(self, Self::Pipeline(PipelineError::Recon(ReconError::DeviceLost(_))))
    }

    pub(super) fn is_retryable(&self) -> bool {
        match self {
            Self::Pipeline(error) => error.is_retryable(),
            Self::Intake(error) => error.is_retryable(),
            Self::Transport(_) => true,
        }
    }
}
