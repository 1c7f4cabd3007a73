//! The loop of a worker process.
//!
//! 1. Claim a task.
//! 2. Do it on a thread of its own.
//! 3. Meanwhile, renew the lease, tell the progress and listen for a cancel.
//! 4. Store what it made, or why it failed.

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
use store::{Heartbeat, Lease};

/// Time between heartbeats, and so the longest time until a cancel is heard of.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// The longest time between looks for a task, such as one whose lease has expired.
const POLL: Duration = Duration::from_millis(200);
/// Time between two signs of life of a worker without a task.
const SIGN: Duration = Duration::from_secs(5);
/// Pause after the database has failed.
const TROUBLE: Duration = Duration::from_secs(2);
/// How long a task may take to come to the end of an iteration when the worker is to end. A deep
/// pass may take longer: it is given up then, and its task given back.
const GRACE: Duration = Duration::from_secs(5);
/// How long a task that hangs may take to end the processes that it started.
const LAST_CHANCE: Duration = Duration::from_secs(1);
/// A task may be silent for so many times its planned processor time: a machine that does much else
/// is slow, but not for ever.
const SLOWNESS: f64 = 4.0;

#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// Not even that the worker is there can be told.
    #[error(transparent)]
    Transport(#[from] TransportError),
    #[error("the computing thread panicked")]
    Panicked,
    /// A task hangs, as native code may, and nothing but the end of the process ends it.
    #[error("the task made no progress for {} seconds", .0.as_secs())]
    Stalled(Duration),
    #[error("the task was given back in the middle of an iteration")]
    Unfinished,
}

/// A worker: takes tasks from the queue, one at a time.
pub struct Worker<T> {
    transport: T,
    /// On their way between the loop and the computing thread.
    engines: Option<Engines>,
    source: NetworkSource,
    model: ModelCommand,
    /// See [`Worker::new`].
    stall: Duration,
    stop: CancellationToken,
}

/// What the computing thread hands back.
type Computed = (Engines, Result<Done, TaskError>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reason {
    Cancelled,
    Lost,
    Shutdown,
}

impl<T: Transport> Worker<T> {
    /// A worker that ends, and gives its task back, when `stop` is called. The program's networks come from
    /// `source`, those of users run as `model` says. A task without progress for `stall` on top of four
    /// times its planned time is held to hang.
    pub fn new(
        transport: T,
        source: NetworkSource,
        model: ModelCommand,
        stall: Duration,
        stop: CancellationToken,
    ) -> Self {
        Self { transport, engines: None, source, model, stall, stop }
    }

    /// Works until it is told to stop.
    /// Errors: see [`WorkerError`]. A failure of a task or a passing one of the database is none.
    /// After [`WorkerError::Stalled`] and [`WorkerError::Unfinished`] the computing thread still
    /// runs: the process must end.
    pub async fn run(mut self) -> Result<(), WorkerError> {
        self.transport.started().await?;
        tracing::info!("waiting for tasks");
        let mut seen = Instant::now();
        while !self.stop.is_cancelled() {
            match self.transport.claim().await {
                Ok(Some(claim)) => self.work(claim).await?,
                Ok(None) => {
                    if seen.elapsed() >= SIGN {
                        seen = Instant::now();
                        if let Err(error) = self.transport.seen().await {
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
                    self.pause(TROUBLE).await;
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

    /// Does one task and tells how it ended.
    async fn work(&mut self, claim: Claim) -> Result<(), WorkerError> {
        let Claim { lease, span, cost, input } = claim;
        let monitor = Arc::new(Monitor::default());
        let patience = self.stall + Duration::from_secs_f64(SLOWNESS * cost);
        let computing = self.start(input, &monitor, span.clone());
        let watched = async {
            match self.watch(computing, &lease, &monitor, patience).await {
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

    /// Parts with a task whose thread does not come back.
    async fn abandon(&self, lease: &Lease, error: &WorkerError) {
        match error {
            WorkerError::Stalled(_) => {
                said(self.transport.fail(lease, &error.to_string(), true).await);
            }
            WorkerError::Unfinished => said(self.transport.give_back(lease).await),
            // Who started this process learns how it ended.
            WorkerError::Panicked | WorkerError::Transport(_) => {}
        }
    }

    /// Tells how a task ended.
    async fn end(
        &self,
        lease: &Lease,
        outcome: Result<Done, TaskError>,
        reason: Option<Reason>,
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
                said(self.transport.redo(lease, tiles).await);
            }
            _ => self.failed(lease, &error).await,
        }
    }

    /// Tells that a task has stopped as it was asked to.
    async fn stopped(&self, lease: &Lease, reason: Option<Reason>) {
        match reason {
            Some(Reason::Lost) => {
                return tracing::warn!("the task is another worker's now, or nobody's");
            }
            Some(Reason::Cancelled) => tracing::info!("cancelled"),
            Some(Reason::Shutdown) | None => tracing::info!("given back"),
        }
        said(self.transport.give_back(lease).await);
    }

    fn start(
        &mut self,
        input: Result<TaskInput, TaskError>,
        monitor: &Arc<Monitor>,
        span: tracing::Span,
    ) -> JoinHandle<Computed> {
        let mut engines = self.engines.take().unwrap_or_else(|| Engines {
            networks: WarmNetworks::new(self.source.clone()),
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

    /// Waits for the computing thread, with heartbeats; says why it was stopped, if it was.
    async fn watch(
        &self,
        mut computing: JoinHandle<Computed>,
        lease: &Lease,
        monitor: &Monitor,
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
        let called_off = self.transport.called_off(lease);
        tokio::pin!(too_late, called_off);
        loop {
            let silence = monitor.silence();
            if silence > patience {
                // The task may wait for the process of a network, which must not outlive it.
                monitor.stop();
                let _ = tokio::time::timeout(LAST_CHANCE, &mut computing).await;
                return Err(WorkerError::Stalled(silence));
            }
            tokio::select! {
                computed = &mut computing => {
                    return Ok((computed.map_err(|_| WorkerError::Panicked)?, reason));
                }
                () = self.stop.cancelled(), if reason.is_none() => reason = Some(Reason::Shutdown),
                () = &mut too_late => return Err(WorkerError::Unfinished),
                answer = &mut called_off, if reason.is_none() => reason = stop_for(answer),
                _ = tick.tick() => match self.beat(lease, monitor).await {
                    Ok(answer) => reason = reason.or(stop_for(answer)),
                    // If this goes on, the lease runs out, and the store will say so.
                    Err(error) => tracing::error!(%error, "a heartbeat is not recorded"),
                },
            }
            if reason.is_some() {
                monitor.stop();
            }
        }
    }

    /// A heartbeat with all that there is to tell.
    async fn beat(&self, lease: &Lease, monitor: &Monitor) -> Result<Heartbeat, TransportError> {
        let news = monitor.news();
        self.transport.heartbeat(lease, monitor.progress(), news.as_deref()).await
    }

    async fn complete(&self, lease: &Lease, done: Done, monitor: &Monitor) {
        // What the solver did after the last heartbeat.
        said(self.beat(lease, monitor).await.map(|_| ()));
        let completed = tokio::select! {
            completed = self.transport.complete(lease, done) => completed,
            // Bringing a large result to its place may take longer than a lease.
            never = self.keep(lease, monitor) => match never {},
        };
        match completed {
            Ok(Heartbeat::Lost) => tracing::warn!("done, but too late: the lease had run out"),
            Ok(_) => tracing::info!("done"),
            Err(error) => self.failed(lease, &TaskError::Transport(error)).await,
        }
    }

    /// Renews the lease for as long as this is awaited.
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
            tracing::warn!(%error, "the task waits until the disk takes its results");
            let reason = without_paths(&error.to_string());
            return said(self.transport.postpone(lease, &reason).await);
        }
        tracing::error!(%error, "the task failed");
        // The user reads the reason, and has no business with the folders of this machine.
        let reason = without_paths(&error.to_string());
        said(self.transport.fail(lease, &reason, error.is_retryable()).await);
    }
}

/// Why an answer ends a task, if it does.
fn stop_for(answer: Heartbeat) -> Option<Reason> {
    match answer {
        Heartbeat::Continue => None,
        Heartbeat::Cancelled => Some(Reason::Cancelled),
        Heartbeat::Lost => Some(Reason::Lost),
    }
}

/// Logs that the end of a task could not be told; the lease runs out then.
fn said(told: Result<(), TransportError>) {
    if let Err(error) = told {
        tracing::error!(%error, "the end of the task is not recorded");
    }
}
