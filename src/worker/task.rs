//! One task, whatever its kind: what it shares with the heartbeat, and how it can end.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::{assemble, calibration_task, finish, pilot, prepare, preview, tile};
use crate::formats::FormatError;
use crate::intake::IntakeError;
use crate::job::{Sha256, TaskProgress};
use crate::pipeline::history::History;
use crate::pipeline::{NetworkError, ResultError, WarmNetworks};
use crate::recon::ReconError;
use crate::recon::solver::Progress;
use crate::store::{ClaimedTask, Completion, Step, Store, StoreError, Work};

/// What the computing thread and the heartbeat tell each other.
#[derive(Debug)]
pub(super) struct Shared {
    /// Where the task stands, and its last sign of life.
    progress: Mutex<(TaskProgress, Instant)>,
    /// How the solver went, and whether there is more of it than was last told.
    history: Mutex<(History, bool)>,
    stop: AtomicBool,
}

impl Shared {
    pub(super) fn new() -> Self {
        let progress = Mutex::new((TaskProgress::START, Instant::now()));
        Self { progress, history: Mutex::default(), stop: AtomicBool::new(false) }
    }

    fn lock(&self) -> MutexGuard<'_, (TaskProgress, Instant)> {
        // Whole values are stored: a poisoned lock holds a good one.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Where the task stands.
    pub(super) fn progress(&self) -> TaskProgress {
        self.lock().0
    }

    /// How long ago the computing thread gave its last sign of life.
    pub(super) fn silence(&self) -> Duration {
        self.lock().1.elapsed()
    }

    pub(super) fn set_progress(&self, progress: TaskProgress) {
        *self.lock() = (progress, Instant::now());
    }

    /// Takes note of an iteration of the solver.
    pub(super) fn note(&self, progress: &Progress) {
        let mut history = self.history.lock().unwrap_or_else(PoisonError::into_inner);
        history.0.note(progress);
        history.1 = true;
    }

    /// How the solver went, as JSON; none if that was told before and nothing came after.
    pub(super) fn news(&self) -> Option<String> {
        let mut history = self.history.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut history.1).then(|| history.0.to_json())
    }

    /// Asks the computing thread to stop at the next opportunity.
    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    pub(super) fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// A sign of life; an error once [`Shared::stop`] was called.
    pub(super) fn check(&self) -> Result<(), TaskError> {
        self.lock().1 = Instant::now();
        if self.stopped() { Err(TaskError::Stopped) } else { Ok(()) }
    }
}

/// How a task can end without a result.
#[derive(Debug, thiserror::Error)]
pub(super) enum TaskError {
    /// It was asked to stop.
    #[error("stopped")]
    Stopped,
    /// The solver refused or failed.
    #[error(transparent)]
    Recon(ReconError),
    /// There is no denoiser.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A prepared array or a tile can't be read, or a result not be written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// A result can't be written.
    #[error(transparent)]
    Result(#[from] ResultError),
    /// Captures or masks that can't be used.
    #[error(transparent)]
    Intake(IntakeError),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Stored tiles are not what was stored.
    #[error("the stored results of tiles {0:?} are damaged")]
    Damaged(Vec<u32>),
    /// A prepared array is not what was stored.
    #[error(
        "the stored {what} (blob {sha256}) are damaged: send the files again, and make the \
         calibration and the measurement anew"
    )]
    Corrupt {
        /// Masks or snapshots.
        what: &'static str,
        /// The hash that it should have.
        sha256: Sha256,
    },
    /// A snapshot without light.
    #[error("snapshot {snapshot}: {source}")]
    Snapshot {
        /// Its index.
        snapshot: u32,
        /// What is wrong with it.
        source: ReconError,
    },
    /// A record in the database is not what this program writes.
    #[error("the record of the {what} can't be used: {problem}")]
    Record {
        /// Whose record.
        what: &'static str,
        /// What is wrong with it.
        problem: String,
    },
}

impl TaskError {
    /// Whether another attempt may succeed: the machine failed, not the data.
    pub(super) fn is_retryable(&self) -> bool {
        match self {
            Self::Recon(error) => matches!(error, ReconError::Runtime(_)),
            Self::Format(error) => !error.is_callers_fault(),
            Self::Intake(error) => error.is_retryable(),
            Self::Snapshot { .. } | Self::Record { .. } | Self::Corrupt { .. } => false,
            _ => true,
        }
    }
}

impl From<ReconError> for TaskError {
    fn from(error: ReconError) -> Self {
        match error {
            ReconError::Cancelled => Self::Stopped,
            other => Self::Recon(other),
        }
    }
}

impl From<IntakeError> for TaskError {
    fn from(error: IntakeError) -> Self {
        match error {
            IntakeError::Stopped => Self::Stopped,
            other => Self::Intake(other),
        }
    }
}

/// Does a task. Blocks for as long as it takes.
pub(super) fn perform(
    store: &Store,
    task: &ClaimedTask,
    engine: &mut WarmNetworks,
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let job = match &task.work {
        Work::Calibration(calibration) => return calibration_task::run(store, calibration, shared),
        Work::Job(job) => job,
    };
    match &job.step {
        Step::Prepare => prepare::run(job, shared),
        Step::Preview { snapshot } => preview::run(store, job, *snapshot, shared),
        Step::Pilot => pilot::run(job, engine, shared),
        Step::Tile { snapshot, tile } => tile::run(store, job, (*snapshot, *tile), engine, shared),
        Step::Assemble { snapshot, tiles } => assemble::run(store, job, *snapshot, tiles, shared),
        Step::Manifest { records } => finish::run(store, job, task.lease.attempt, records),
    }
}
