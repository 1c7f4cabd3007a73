//! The loop of a worker process.
//!
//! 1. Claim a task.
//! 2. Do it on a thread of its own.
//! 3. Meanwhile, renew the lease, tell the progress and listen for a cancel.
//! 4. Store what it made, or why it failed.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::task::{Shared, TaskError, perform};
use crate::job::{TaskProgress, WorkerId, without_paths};
use crate::pipeline::{NetworkSource, WarmNetworks};
use crate::store::{
    CalibrationTask, ClaimedTask, Completion, Heartbeat, Lease, Store, StoreError, Work,
};

/// How long a task is a worker's without a heartbeat. Long against a pause of the disk, short
/// against a lab's patience.
const LEASE: Duration = Duration::from_secs(20);
/// Time between heartbeats, and so the longest time until a cancel is heard of.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Time between looks for a task.
const POLL: Duration = Duration::from_millis(200);
/// Looks without a task between two signs of life.
const LOOKS_PER_SIGN: u32 = 25;
/// Pause after the database has failed.
const TROUBLE: Duration = Duration::from_secs(2);
/// How long a task may take to come to the end of an iteration when the worker is to end. A deep
/// pass may take longer: it is given up then, and its task given back.
const GRACE: Duration = Duration::from_secs(5);
/// A task may be silent for so many times its planned processor time: a machine that does much else
/// is slow, but not for ever.
const SLOWNESS: f64 = 4.0;

/// Why a worker had to end.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The database can't even be told that the worker is there.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A task took the computing thread down.
    #[error("the computing thread panicked")]
    Panicked,
    /// A task hangs, as native code may, and nothing but the end of the process ends it.
    #[error("the task made no progress for {} seconds", .0.as_secs())]
    Stalled(Duration),
    /// The worker was to end, and its task did not come to the end of an iteration in time.
    #[error("the task was given back in the middle of an iteration")]
    Unfinished,
}

/// A worker: takes tasks from the queue, one at a time.
pub struct Worker {
    store: Store,
    id: WorkerId,
    /// On its way between the loop and the computing thread.
    engine: Option<WarmNetworks>,
    network: NetworkSource,
    /// See [`Worker::new`].
    stall: Duration,
    stop: CancellationToken,
}

/// What the computing thread hands back.
type Computed = (WarmNetworks, Result<Completion, TaskError>);

/// Why a task was stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reason {
    Cancelled,
    Lost,
    Shutdown,
}

impl Worker {
    /// A worker under the name `id` that ends, and gives its task back, when `stop` is called. A task
    /// without progress for `stall` on top of four times its planned time is held to hang.
    pub fn new(
        store: Store,
        id: WorkerId,
        network: NetworkSource,
        stall: Duration,
        stop: CancellationToken,
    ) -> Self {
        Self { store, id, engine: None, network, stall, stop }
    }

    /// Works until it is told to stop.
    ///
    /// # Errors
    /// See [`WorkerError`]. A failure of a task or a passing one of the database is none. After
    /// [`WorkerError::Stalled`] and [`WorkerError::Unfinished`] the computing thread still runs: the
    /// process must end.
    pub async fn run(mut self) -> Result<(), WorkerError> {
        self.store.worker_started(self.id, std::process::id()).await?;
        tracing::info!(worker = %self.id, "waiting for tasks");
        let mut looks = 0;
        while !self.stop.is_cancelled() {
            match self.store.claim(self.id, LEASE).await {
                Ok(Some(task)) => {
                    self.work(task).await?;
                    continue;
                }
                Ok(None) => {
                    looks += 1;
                    if looks % LOOKS_PER_SIGN == 0 {
                        self.sign_of_life().await;
                    }
                    self.pause(POLL).await;
                }
                Err(error) => {
                    tracing::error!(%error, "no task can be claimed");
                    self.pause(TROUBLE).await;
                }
            }
        }
        Ok(())
    }

    async fn sign_of_life(&self) {
        if let Err(error) = self.store.worker_seen(self.id).await {
            tracing::warn!(%error, "the worker's sign of life is not recorded");
        }
    }

    async fn pause(&self, length: Duration) {
        tokio::select! {
            () = tokio::time::sleep(length) => {}
            () = self.stop.cancelled() => {}
        }
    }

    /// Does one task and tells the store how it ended.
    async fn work(&mut self, task: ClaimedTask) -> Result<(), WorkerError> {
        let lease = task.lease;
        let (kind, id) = (task.kind.name(), lease.task);
        let span = match &task.work {
            Work::Job(job) => tracing::info_span!("task", job = %job.job, kind, task = %id),
            Work::Calibration(CalibrationTask { calibration, .. }) => {
                tracing::info_span!("task", %calibration, kind, task = %id)
            }
        };
        let shared = Arc::new(Shared::new());
        let patience = self.stall + Duration::from_secs_f64(SLOWNESS * task.cost);
        let computing = self.start(task, &shared, span.clone());
        let watching = self.watch(computing, &lease, &shared, patience).instrument(span.clone());
        match watching.await {
            Ok(((engine, outcome), reason)) => {
                self.engine = Some(engine);
                if outcome.is_ok() && reason.is_none() {
                    self.last_news(&lease, &shared).instrument(span.clone()).await;
                }
                self.end(&lease, outcome, reason).instrument(span).await;
                Ok(())
            }
            Err(error) => {
                self.abandon(&lease, &error).instrument(span).await;
                Err(error)
            }
        }
    }

    /// Parts with a task whose thread does not come back.
    async fn abandon(&self, lease: &Lease, error: &WorkerError) {
        match error {
            WorkerError::Stalled(_) => said(self.store.fail(lease, &error.to_string(), true).await),
            WorkerError::Unfinished => said(self.store.release_task(lease).await),
            // Who started this process learns how it ended.
            WorkerError::Panicked | WorkerError::Store(_) => {}
        }
    }

    /// Tells the store how a task ended.
    async fn end(
        &self,
        lease: &Lease,
        outcome: Result<Completion, TaskError>,
        reason: Option<Reason>,
    ) {
        match (outcome, reason) {
            (Ok(completion), _) => self.complete(lease, completion).await,
            (Err(TaskError::Stopped), Some(Reason::Cancelled)) => {
                tracing::info!("cancelled");
                said(self.store.cancelled(lease).await);
            }
            (Err(TaskError::Stopped), Some(Reason::Shutdown) | None) => {
                tracing::info!("given back");
                said(self.store.release_task(lease).await);
            }
            (Err(TaskError::Stopped), Some(Reason::Lost)) => {
                tracing::warn!("the task is another worker's now, or nobody's");
            }
            (Err(TaskError::Damaged(tiles)), _) => {
                tracing::error!(?tiles, "stored tiles are damaged and will be done again");
                said(self.store.redo_tiles(lease, &tiles).await);
            }
            (Err(error), _) => self.failed(lease, &error).await,
        }
    }

    fn start(
        &mut self,
        task: ClaimedTask,
        shared: &Arc<Shared>,
        span: tracing::Span,
    ) -> JoinHandle<Computed> {
        let mut engine =
            self.engine.take().unwrap_or_else(|| WarmNetworks::new(self.network.clone()));
        let (store, shared) = (self.store.clone(), shared.clone());
        tokio::task::spawn_blocking(move || {
            let _entered = span.enter();
            let outcome = perform(&store, &task, &mut engine, &shared);
            (engine, outcome)
        })
    }

    /// Waits for the computing thread, with heartbeats; says why it was stopped, if it was.
    async fn watch(
        &self,
        mut computing: JoinHandle<Computed>,
        lease: &Lease,
        shared: &Shared,
        patience: Duration,
    ) -> Result<(Computed, Option<Reason>), WorkerError> {
        let mut tick = tokio::time::interval(HEARTBEAT);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        // The claim was the first sign of life.
        tick.tick().await;
        let mut reason = None;
        let too_late = async {
            self.stop.cancelled().await;
            tokio::time::sleep(GRACE).await;
        };
        tokio::pin!(too_late);
        loop {
            let silence = shared.silence();
            if silence > patience {
                return Err(WorkerError::Stalled(silence));
            }
            tokio::select! {
                computed = &mut computing => {
                    return Ok((computed.map_err(|_| WorkerError::Panicked)?, reason));
                }
                () = self.stop.cancelled(), if reason.is_none() => reason = Some(Reason::Shutdown),
                () = &mut too_late => return Err(WorkerError::Unfinished),
                _ = tick.tick() => match self.beat(lease, shared).await {
                    Ok(Heartbeat::Continue) => {}
                    Ok(Heartbeat::Cancelled) => reason = Some(Reason::Cancelled),
                    Ok(Heartbeat::Lost) => reason = Some(Reason::Lost),
                    // If this goes on, the lease runs out, and the store will say so.
                    Err(error) => tracing::error!(%error, "a heartbeat is not recorded"),
                },
            }
            if reason.is_some() {
                shared.stop();
            }
        }
    }

    /// A heartbeat with all that there is to tell.
    async fn beat(&self, lease: &Lease, shared: &Shared) -> Result<Heartbeat, StoreError> {
        let news = shared.news();
        self.store.heartbeat_with(lease, shared.progress(), news.as_deref()).await
    }

    /// Tells what the solver did after the last heartbeat.
    async fn last_news(&self, lease: &Lease, shared: &Shared) {
        if let Some(news) = shared.news() {
            let told = self.store.heartbeat_with(lease, shared.progress(), Some(&news)).await;
            said(told.map(|_| ()));
        }
    }

    async fn complete(&self, lease: &Lease, completion: Completion) {
        let progress = completion.progress;
        let completed = tokio::select! {
            completed = self.store.complete(lease, completion) => completed,
            // Bringing a large result to the disk may take longer than a lease.
            never = self.keep(lease, progress) => match never {},
        };
        match completed {
            Ok(Heartbeat::Lost) => tracing::warn!("done, but too late: the lease had run out"),
            Ok(_) => tracing::info!("done"),
            Err(error) => self.failed(lease, &error.into()).await,
        }
    }

    /// Renews the lease for as long as this is awaited.
    async fn keep(&self, lease: &Lease, progress: TaskProgress) -> Infallible {
        loop {
            tokio::time::sleep(HEARTBEAT).await;
            if let Err(error) = self.store.heartbeat(lease, progress).await {
                tracing::error!(%error, "a heartbeat is not recorded");
            }
        }
    }

    async fn failed(&self, lease: &Lease, error: &TaskError) {
        tracing::error!(%error, "the task failed");
        // The user reads the reason, and has no business with the folders of this machine.
        let reason = without_paths(&error.to_string());
        said(self.store.fail(lease, &reason, error.is_retryable()).await);
    }
}

/// Logs that the store could not be told; the lease runs out then.
fn said(told: Result<(), StoreError>) {
    if let Err(error) = told {
        tracing::error!(%error, "the end of the task is not recorded");
    }
}
