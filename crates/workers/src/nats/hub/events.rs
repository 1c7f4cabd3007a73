//! Handles events, the reports on finished tiles: fetches and checks the frames, and updates the store.
//!
//! Each pool has a separate loop that handles a few events at a time, so that pools do not delay each other.
//! Workers are not trusted: all parts of an event are checked. An event that can't be handled is acknowledged like
//! any other. It costs its tile at most one attempt.

use std::collections::HashMap;
use std::io::Write;
use std::panic::AssertUnwindSafe;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::{AckKind, Message};
use futures_util::{FutureExt, StreamExt};
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;

use super::accept::{Accepted, Report};
use super::core::{Core, lock};
use super::error::HubError;
use super::figures;
use crate::nats::blobs::BlobError;
use crate::nats::connection::ClusterError;
use crate::nats::message::{Begin, BeginAnswer, End, Event, Input};
use crate::nats::names;
use crate::nats::setup::EVENT_WAIT;
use engine::job::Pool;
use store::{Heartbeat, RemoteBeat, RemoteTask, StagedBlob};

/// Time that a request for events waits at the message server.
const PULL: Duration = Duration::from_secs(5);
/// Events of a pool that are handled at a time.
const AT_ONCE: usize = 4;
/// Attempts to fetch a chunk that a replica may not have yet.
const FETCH_ATTEMPTS: u32 = 10;
/// Time between two attempts to fetch a chunk.
const FETCH_PAUSE: Duration = Duration::from_millis(500);
/// Pause after a failure of the message server.
const RETRY_PAUSE: Duration = Duration::from_secs(2);
/// Time between searches for pools without a loop.
const TICK: Duration = Duration::from_secs(1);
/// Deliveries after which an event that the store refuses ends the attempt. They take about three minutes.
const MAX_DELIVERIES: i64 = 100;
/// Longest reason of a failure that is kept, in characters.
const MAX_REASON: usize = 1000;

impl Core {
    /// Handles the events of all pools until the future is dropped.
    pub async fn take_events(self: Arc<Self>) {
        let mut takers: HashMap<Pool, JoinHandle<()>> = HashMap::new();
        loop {
            let mut pools = self.pools().await;
            match self.connection.pools_with_events().await {
                Ok(more) => pools.extend(more),
                Err(error) => tracing::warn!(%error, "the pools with events can't be looked up"),
            }
            for pool in pools {
                if takers.get(&pool).is_none_or(JoinHandle::is_finished) {
                    let taker = tokio::spawn(self.clone().take_events_of(pool.clone()));
                    takers.insert(pool, taker);
                }
            }
            tokio::time::sleep(TICK).await;
        }
    }

    /// The pools that had a worker since the server started, and those that have tiles.
    pub async fn pools(&self) -> Vec<Pool> {
        let mut pools = lock(&self.presence).pools();
        match self.store.remote_counts().await {
            Ok(counts) => {
                let with_tiles = counts.keys().filter_map(|pool| pool.parse::<Pool>().ok());
                pools.extend(with_tiles.map(|pool| (pool, (0, std::time::Instant::now()))));
            }
            Err(error) => tracing::error!(%error, "the pools with tiles can't be looked up"),
        }
        pools.into_keys().collect()
    }

    async fn take_events_of(self: Arc<Self>, pool: Pool) {
        let permits = Arc::new(Semaphore::new(AT_ONCE));
        loop {
            if let Err(error) = self.take_batch(&pool, &permits).await {
                tracing::warn!(%error, %pool, "events can't be fetched");
                tokio::time::sleep(RETRY_PAUSE).await;
            }
        }
    }

    /// Fetches as many events as there are permits, and handles each in a separate task.
    async fn take_batch(
        self: &Arc<Self>,
        pool: &Pool,
        permits: &Arc<Semaphore>,
    ) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("ask for events");
        // The semaphore is never closed.
        let Ok(mut permit) = permits.clone().acquire_owned().await else { return Ok(()) };
        let consumer = self.connection.events(pool).await?;
        let count = 1 + permits.available_permits();
        let batch = consumer.batch().max_messages(count).expires(PULL).messages();
        let batch = batch.await.map_err(failed)?;
        // The server may forget a pull when the stream's leader changes.
        let mut batch = pin!(batch.take_until(tokio::time::sleep(PULL + RETRY_PAUSE)));
        while let Some(message) = batch.next().await {
            match message {
                Ok(message) => {
                    let (hub, pool) = (self.clone(), pool.clone());
                    tokio::spawn(async move {
                        hub.take(&pool, &message).await;
                        drop(permit);
                    });
                    let Ok(next) = permits.clone().acquire_owned().await else { return Ok(()) };
                    permit = next;
                }
                Err(error) => tracing::warn!(%error, "an event can't be fetched"),
            }
        }
        Ok(())
    }

    /// Handles an event, and extends its delivery at NATS while it does.
    async fn take(self: &Arc<Self>, pool: &Pool, message: &Message) {
        let event = serde_json::from_slice::<Event>(&message.payload);
        let mut handling =
            pin!(AssertUnwindSafe(self.try_take(pool, message, event)).catch_unwind());
        let handled = loop {
            tokio::select! {
                handled = &mut handling => break handled,
                () = tokio::time::sleep(EVENT_WAIT / 3) => {
                    if let Err(error) = message.ack_with(AckKind::Progress).await {
                        tracing::debug!(%error, "an event may be delivered again");
                    }
                }
            }
        };
        let kind = match handled {
            Ok(Ok(())) => AckKind::Ack,
            Ok(Err(error)) => {
                tracing::warn!(%error, "an event is postponed");
                AckKind::Nak(Some(RETRY_PAUSE))
            }
            Err(_) => {
                tracing::error!(%pool, "an event caused a panic in the server; it is dropped");
                AckKind::Ack
            }
        };
        if let Err(error) = message.ack_with(kind).await {
            tracing::warn!(%error, "an event can't be acknowledged; it is delivered again");
        }
        if let Ok(info) = message.info() {
            let age = std::time::SystemTime::now().duration_since(info.published.into());
            figures::lag(age.unwrap_or_default().as_secs_f64());
        }
        self.more.notify_one();
    }

    async fn try_take(
        &self,
        pool: &Pool,
        message: &Message,
        event: Result<Event, serde_json::Error>,
    ) -> Result<(), HubError> {
        let event = match event {
            Ok(event) => event,
            Err(error) => {
                tracing::error!(%error, %pool, "an event can't be read; it is dropped");
                figures::count(figures::REFUSED, 1);
                return Ok(());
            }
        };
        let task = event.task;
        let handled = self.handle(pool, event).await;
        let deliveries = message.info().map_or(1, |info| info.delivered);
        match handled {
            Err(error) if error.is_of_event() && deliveries >= MAX_DELIVERIES => {
                tracing::error!(%error, %task, deliveries, "an event can't be handled");
                if let Some(remote) = self.store.remote_task(task).await? {
                    self.store.remote_lost(&remote, "its report can't be handled").await?;
                }
                Ok(())
            }
            handled => handled,
        }
    }

    async fn handle(&self, pool: &Pool, event: Event) -> Result<(), HubError> {
        let Event { task, attempt, worker, .. } = event;
        let prefix = names::output(pool, task, attempt, worker);
        let Some(remote) = self.task_of(pool, &event).await? else {
            tracing::info!(%task, attempt, %worker, "a report is refused: the attempt is not the worker's");
            figures::count(figures::REFUSED, 1);
            self.connection.purge(names::OUTPUTS, format!("{prefix}.>")).await?;
            return Ok(());
        };
        let lease = remote.lease();
        match event.end {
            End::Done { frames, progress, record, history } => {
                let report = Report { frames, progress, record, history };
                match self.accept(&remote, &prefix, report).await? {
                    Accepted::Completion(completion, history) => {
                        let (task, attempt, worker) = (lease.task, lease.attempt, lease.worker);
                        let (pool, progress) = (pool.to_string(), completion.progress);
                        let last = RemoteBeat { task, attempt, worker, pool, progress, history };
                        self.store.remote_beats(&[last], &[]).await?;
                        match self.store.complete(&lease, *completion).await? {
                            Heartbeat::Lost => figures::count(figures::REFUSED, 1),
                            _ => tracing::info!(%task, attempt, %worker, "a tile is done"),
                        }
                    }
                    Accepted::Again => {
                        tracing::info!(%task, attempt, %worker, "another worker verifies a tile");
                    }
                    Accepted::Refused(reason) => {
                        tracing::error!(%task, attempt, %worker, reason, "a worker's result is rejected");
                        figures::count(figures::REJECTED, 1);
                        let reason = format!("the result of worker {worker} is rejected: {reason}");
                        self.store.fail(&lease, &reason, true).await?;
                    }
                    Accepted::Lost(error) => {
                        tracing::warn!(%error, %task, attempt, %worker, "a tile's frames are lost");
                        figures::count(figures::REPAIRED, 1);
                        self.store.remote_lost(&remote, "its frames were lost in transit").await?;
                    }
                }
            }
            End::Failed { reason, retry } => {
                let reason = readable(&reason);
                tracing::warn!(%task, attempt, %worker, reason, "a tile has failed");
                self.store.fail(&lease, &reason, retry).await?;
            }
            End::Died { how, fault } => {
                let how = readable(&how);
                tracing::warn!(%task, attempt, %worker, how, "a worker has died while it computed a tile");
                self.store.remote_died(&remote, &how, fault).await?;
            }
            End::GivenBack => self.store.give_back(&lease).await?,
        }
        self.clear(pool, task).await;
        Ok(())
    }

    /// Finds the tile of an event. Returns `None` if the worker does not own the attempt. If the worker began while the
    /// server was down, its begin is recorded now.
    async fn task_of(&self, pool: &Pool, event: &Event) -> Result<Option<RemoteTask>, HubError> {
        let &Event { task, attempt, worker, seq, delivery, .. } = event;
        let remote = self.store.remote_task(task).await?;
        let Some(remote) = remote.filter(|remote| remote.pool == pool.as_str()) else {
            return Ok(None);
        };
        if (remote.attempt, remote.worker) == (attempt, worker) {
            return Ok(Some(remote));
        }
        let begin = Begin { task, attempt, seq, delivery, worker };
        match self.begin(pool, begin).await? {
            BeginAnswer::Go(_) => Ok(self.store.remote_task(task).await?),
            BeginAnswer::Over | BeginAnswer::Lost | BeginAnswer::Another => Ok(None),
        }
    }

    /// Writes frames to the disk chunk by chunk. Memory holds only a few chunks.
    pub async fn fetch(
        &self,
        prefix: &str,
        frames: Input,
    ) -> Result<Result<StagedBlob, BlobError>, HubError> {
        let store = self.store.clone();
        let mut writer = tokio::task::spawn_blocking(move || store.blob_writer()).await??;
        let (mut next, mut attempts) = (0, 0);
        loop {
            let mut chunks =
                pin!(self.connection.chunks(names::OUTPUTS, prefix, frames.bytes, next));
            let missing = loop {
                match chunks.next().await {
                    Some(Ok(chunk)) => {
                        figures::bytes("in", chunk.len());
                        let written = tokio::task::spawn_blocking(move || {
                            writer.write_all(&chunk).map(|()| writer)
                        });
                        writer = written.await??;
                        next += 1;
                    }
                    Some(Err(BlobError::Failed(reason))) => return Err(HubError::Fetch(reason)),
                    Some(Err(BlobError::Missing)) => break true,
                    Some(Err(BlobError::Damaged)) => return Ok(Err(BlobError::Damaged)),
                    None => break false,
                }
            };
            if !missing {
                break;
            }
            attempts += 1;
            if attempts == FETCH_ATTEMPTS {
                return Ok(Err(BlobError::Missing));
            }
            tokio::time::sleep(FETCH_PAUSE).await;
        }
        let staged = tokio::task::spawn_blocking(move || writer.finish()).await??;
        let is_intact = staged.sha256() == frames.sha256;
        Ok(if is_intact { Ok(staged) } else { Err(BlobError::Damaged) })
    }
}

/// Makes a worker's text safe for logs and pages: one line of limited length.
pub fn readable(text: &str) -> String {
    let plain = |c: char| if c.is_control() { ' ' } else { c };
    text.chars().take(MAX_REASON).map(plain).collect()
}
