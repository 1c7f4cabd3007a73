//! The loop of a worker process.
//!
//! 1. Claim a task.
//! 2. Perform it on a separate thread.
//! 3. While it runs, renew the lease, report progress and listen for a cancellation.
//! 4. Store the result, or the reason of a failure.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::model_process::{ModelCommand, ModelProcesses};
use super::perform::{Engines, perform};
use super::transport::{Claim, Done, TaskError, TaskInput, Transport, TransportError};
use engine::intake::IntakeError;
use engine::job::without_paths;
use engine::pipeline::networks::WarmNetworks;
use engine::pipeline::progress::Monitor;
use engine::pipeline::{NetworkSource, PipelineError};
use reconstruction::cores::Cores;
use store::{Heartbeat, Lease};

/// Time between heartbeats, which is the longest time until the worker learns of a cancellation.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Heartbeats for which more cores must be free before a task takes them, because each change loads its networks again.
const BEATS_WITH_MORE: u32 = 5;
/// Longest time between attempts to claim a task.
const POLL: Duration = Duration::from_millis(200);
/// Time between two signs of life of an idle worker.
const SIGN: Duration = Duration::from_secs(5);
/// Pause after a failure of the database.
const RETRY_PAUSE: Duration = Duration::from_secs(2);
/// Time that a task has to finish its iteration when the worker is asked to stop. A network pass may take longer.
/// The worker then abandons it and returns the task.
const STOP_GRACE: Duration = Duration::from_secs(5);
/// Time that a stalled task has to end the processes that it started.
const STALL_GRACE: Duration = Duration::from_secs(1);
/// Factor from planned processor time to the longest time without progress, for machines that are busy with other
/// work.
const SLOWNESS: f64 = 4.0;

#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The worker could not register itself.
    #[error(transparent)]
    Transport(#[from] TransportError),
    #[error("the computing thread panicked")]
    Panicked,
    /// A task hangs, probably in native code. Only the end of the process can end it.
    #[error("the task made no progress for {} seconds", .0.as_secs())]
    Stalled(Duration),
    /// The server of this worker counts the task as lost, and another process tries it.
    #[error("{0}")]
    DeviceLost(String),
    #[error("the task was given back in the middle of an iteration")]
    Unfinished,
}

/// A worker: takes tasks from the queue, one at a time.
pub struct Worker<T> {
    transport: T,
    /// `None` while the computing thread has them.
    engines: Option<Engines>,
    source: NetworkSource,
    model: ModelCommand,
    machine_cores: usize,
    /// This worker's share of them.
    cores: Cores,
    /// See [`Worker::new`].
    stall: Duration,
    stop: CancellationToken,
}

/// Engines and outcome, as the computing thread returns them.
type Computed = (Engines, Result<Done, TaskError>);

/// StopReason for which a task is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StopReason {
    Cancelled,
    Lost,
    Shutdown,
}

impl<T: Transport> Worker<T> {
    /// A worker that runs until `stop` is cancelled, and then returns its task. The program's networks come from
    /// `source`; `model` runs those of users. All workers of this machine share its `cores`. A task counts as stalled after `stall` plus four times its planned
    /// time without progress.
    pub fn new(
        transport: T,
        source: NetworkSource,
        model: ModelCommand,
        cores: usize,
        stall: Duration,
        stop: CancellationToken,
    ) -> Self {
        let (machine_cores, cores) = (cores, Cores::default());
        Self { transport, engines: None, source, model, machine_cores, cores, stall, stop }
    }

    /// Works until `stop` is cancelled.
    /// Errors: see [`WorkerError`]. The worker survives a failed task and a temporary failure of the database.
    /// After [`WorkerError::DeviceLost`], [`WorkerError::Stalled`] and [`WorkerError::Unfinished`] the computing thread still runs, so the
    /// process must end.
    pub async fn run(mut self) -> Result<(), WorkerError> {
        self.transport.started().await?;
        tracing::info!("waiting for tasks");
        let mut last_sign = Instant::now();
        while !self.stop.is_cancelled() {
            match self.transport.claim().await {
                Ok(Some(claim)) => self.work(claim).await?,
                Ok(None) => {
                    if last_sign.elapsed() >= SIGN {
                        last_sign = Instant::now();
                        if let Err(error) = self.transport.report_alive().await {
                            tracing::warn!(%error, "the worker's sign of life is not recorded");
                        }
                    }
                    tokio::select! {
                        () = self.transport.idle(POLL) => {}
                        () = self.stop.cancelled() => {}
                    }
                }
                Err(error) => {
                    tracing::error!(%error, "no task can be claimed");
                    self.pause(RETRY_PAUSE).await;
                }
            }
        }
        Ok(())
    }

    async fn pause(&self, length: Duration) {
        tokio::select! {
            () = tokio::time::sleep(length) => {}
            () = self.stop.cancelled() => {}
        }
    }

    /// Performs one task and reports its end.
    async fn work(&mut self, claim: Claim) -> Result<(), WorkerError> {
        let Claim { lease, span, cost, input } = claim;
        let monitor = Arc::new(Monitor::default());
        self.cores.set(self.share().await);
        let patience = self.stall + Duration::from_secs_f64(SLOWNESS * cost);
        let computing = self.start(input, &monitor, span.clone());
        let watched = async {
            match self.watch(computing, &lease, &monitor, patience).await {
                Ok(((_, Err(error)), _)) if error.is_device_loss() => {
                    Err(WorkerError::DeviceLost(error.to_string()))
                }
                Ok(((engines, outcome), reason)) => {
                    self.engines = Some(engines);
                    self.end(&lease, outcome, reason, &monitor).await;
                    Ok(())
                }
                Err(error) => {
                    self.abandon(&lease, &error).await;
                    Err(error)
                }
            }
        };
        watched.instrument(span).await
    }

    /// Gives up a task when its thread does not return.
    async fn abandon(&self, lease: &Lease, error: &WorkerError) {
        match error {
            WorkerError::Stalled(_) => {
                log_failure(self.transport.fail(lease, &error.to_string(), true).await);
            }
            WorkerError::Unfinished => log_failure(self.transport.give_back(lease).await),
            // The supervisor reports the exit status of this process.
            WorkerError::Panicked | WorkerError::Transport(_) | WorkerError::DeviceLost(_) => {}
        }
    }

    /// Reports the end of a task.
    async fn end(
        &self,
        lease: &Lease,
        outcome: Result<Done, TaskError>,
        reason: Option<StopReason>,
        monitor: &Monitor,
    ) {
        let error = match outcome {
            Ok(done) => return self.complete(lease, done, monitor).await,
            Err(error) => error,
        };
        match (&error, reason) {
            (
                TaskError::Pipeline(PipelineError::Stopped)
                | TaskError::Intake(IntakeError::Stopped),
                reason,
            ) => self.stopped(lease, reason).await,
            (TaskError::Pipeline(PipelineError::Damaged(tiles)), _) => {
                tracing::error!(?tiles, "stored tiles are damaged and will be done again");
                log_failure(self.transport.redo(lease, tiles).await);
            }
            _ => self.failed(lease, &error).await,
        }
    }

    /// Returns a task that was stopped, unless its lease was lost.
    async fn stopped(&self, lease: &Lease, reason: Option<StopReason>) {
        match reason {
            Some(StopReason::Lost) => {
                return tracing::warn!("the lease was lost; the result is dropped");
            }
            Some(StopReason::Cancelled) => tracing::info!("cancelled"),
            Some(StopReason::Shutdown) | None => tracing::info!("given back"),
        }
        log_failure(self.transport.give_back(lease).await);
    }

    fn start(
        &mut self,
        input: Result<TaskInput, TaskError>,
        monitor: &Arc<Monitor>,
        span: tracing::Span,
    ) -> JoinHandle<Computed> {
        let mut engines = self.engines.take().unwrap_or_else(|| Engines {
            networks: WarmNetworks::new(self.source.clone()).with_cores(self.cores.clone()),
            models: ModelProcesses::new(self.model.clone()),
        });
        let (transport, monitor) = (self.transport.clone(), monitor.clone());
        tokio::task::spawn_blocking(move || {
            let _entered = span.enter();
            let outcome =
                input.and_then(|input| perform(&transport, input, &mut engines, &monitor));
            (engines, outcome)
        })
    }

    /// Sends heartbeats until the computing thread ends. Also returns the reason if the task was stopped.
    async fn watch(
        &self,
        mut computing: JoinHandle<Computed>,
        lease: &Lease,
        monitor: &Monitor,
        patience: Duration,
    ) -> Result<(Computed, Option<StopReason>), WorkerError> {
        let mut tick = tokio::time::interval(HEARTBEAT);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        // The claim was the first sign of life.
        tick.tick().await;
        let mut reason = None;
        let grace_over = async {
            self.stop.cancelled().await;
            tokio::time::sleep(STOP_GRACE).await;
        };
        let called_off = self.transport.called_off(lease);
        tokio::pin!(grace_over, called_off);
        let mut beats_with_more = 0;
        loop {
            let silence = monitor.silence();
            if silence > patience {
                // The task may wait for a network's process, which must not outlive the worker.
                monitor.stop();
                let _ = tokio::time::timeout(STALL_GRACE, &mut computing).await;
                return Err(WorkerError::Stalled(silence));
            }
            tokio::select! {
                computed = &mut computing => {
                    return Ok((computed.map_err(|_| WorkerError::Panicked)?, reason));
                }
                () = self.stop.cancelled(), if reason.is_none() => reason = Some(StopReason::Shutdown),
                () = &mut grace_over => return Err(WorkerError::Unfinished),
                answer = &mut called_off, if reason.is_none() => reason = stop_reason(answer),
                _ = tick.tick() => {
                    match self.beat(lease, monitor).await {
                        Ok(answer) => reason = reason.or(stop_reason(answer)),
                        // If this persists, the lease expires, and the store reports it lost.
                        Err(error) => tracing::error!(%error, "a heartbeat is not recorded"),
                    }
                    let share = self.share().await;
                    beats_with_more = if share > self.cores.count() { beats_with_more + 1 } else { 0 };
                    if share < self.cores.count() || beats_with_more == BEATS_WITH_MORE {
                        self.cores.set(share);
                    }
                }
            }
            if reason.is_some() {
                monitor.stop();
            }
        }
    }

    /// This worker's share of the cores of this machine, which the workers that compute divide. The present one if the others
    /// are unknown.
    async fn share(&self) -> usize {
        match self.transport.busy_workers().await {
            Ok(busy) => busy.map_or(1, |busy| self.machine_cores / busy.max(1)),
            Err(error) => {
                tracing::warn!(%error, "the number of busy workers is unknown");
                self.cores.count()
            }
        }
    }

    /// Sends a heartbeat with the progress and the new part of the solver's history.
    async fn beat(&self, lease: &Lease, monitor: &Monitor) -> Result<Heartbeat, TransportError> {
        let news = monitor.news();
        self.transport.heartbeat(lease, monitor.progress(), news.as_deref()).await
    }

    async fn complete(&self, lease: &Lease, done: Done, monitor: &Monitor) {
        // Sends the history since the last heartbeat.
        log_failure(self.beat(lease, monitor).await.map(|_| ()));
        let completed = tokio::select! {
            completed = self.transport.complete(lease, done) => completed,
            // Storing a large result may take longer than a lease.
            never = self.keep(lease, monitor) => match never {},
        };
        match completed {
            Ok(Heartbeat::Lost) => tracing::warn!("done too late: the lease had expired"),
            Ok(_) => tracing::info!("done"),
            Err(error) => self.failed(lease, &TaskError::Transport(error)).await,
        }
    }

    /// Renews the lease until the future is dropped.
    async fn keep(&self, lease: &Lease, monitor: &Monitor) -> Infallible {
        loop {
            tokio::time::sleep(HEARTBEAT).await;
            if let Err(error) = self.beat(lease, monitor).await {
                tracing::error!(%error, "a heartbeat is not recorded");
            }
        }
    }

    async fn failed(&self, lease: &Lease, error: &TaskError) {
        if error.disk_trouble().is_some() {
            tracing::warn!(%error, "the task waits until its results can be written to the disk");
            let reason = without_paths(&error.to_string());
            return log_failure(self.transport.postpone(lease, &reason).await);
        }
        tracing::error!(%error, "the task failed");
        // Users read the reason; paths of this machine do not concern them.
        let reason = without_paths(&error.to_string());
        log_failure(self.transport.fail(lease, &reason, error.is_retryable()).await);
    }
}

/// Reason for which an answer stops a task, if it does.
fn stop_reason(answer: Heartbeat) -> Option<StopReason> {
    match answer {
        Heartbeat::Continue => None,
        Heartbeat::Cancelled => Some(StopReason::Cancelled),
        Heartbeat::Lost => Some(StopReason::Lost),
    }
}

/// Logs that the end of a task could not be reported. The lease then expires.
fn log_failure(reported: Result<(), TransportError>) {
    if let Err(error) = reported {
        tracing::error!(%error, "the end of the task is not recorded");
    }
}
