//! How tiles ended: fetches the frames, has them checked, and tells the store.
//!
//! The events of each pool are handled on their own, a few at a time, so that what holds up those of one pool holds
//! up no other. Nothing that an event says is believed before it was checked, and an event that can't be
//! handled is acknowledged like any other: it costs its tile an attempt at most.

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
use super::error::EventError;
use super::figures;
use crate::nats::blobs::BlobError;
use crate::nats::connection::ClusterError;
use crate::nats::message::{Begin, BeginAnswer, End, Event, Input};
use crate::nats::names;
use crate::nats::setup::EVENT_WAIT;
use engine::job::Pool;
use store::{Heartbeat, RemoteBeat, RemoteTask, StagedBlob};

/// How long a request for events waits.
const PULL: Duration = Duration::from_secs(5);
/// Events of a pool that are dealt with at a time.
const AT_ONCE: usize = 4;
/// Looks for chunks that a replica may not have yet, and the time between them.
const LOOKS: (u32, Duration) = (10, Duration::from_millis(500));
/// Pause after the message server has failed.
const TROUBLE: Duration = Duration::from_secs(2);
/// Time between looks for pools whose events nobody takes.
const TICK: Duration = Duration::from_secs(1);
/// Deliveries of an event that the store refuses; then the attempt ends. About three minutes.
const MAX_DELIVERIES: i64 = 100;
/// The longest reason of a failure that is kept, in characters.
const REASON: usize = 1000;

impl Core {
    /// Deals with the events of all pools for as long as this is awaited.
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
        let hands = Arc::new(Semaphore::new(AT_ONCE));
        loop {
            if let Err(error) = self.take_some(&pool, &hands).await {
                tracing::warn!(%error, %pool, "no events can be had");
                tokio::time::sleep(TROUBLE).await;
            }
        }
    }

    /// Takes as many events as can be dealt with at once, and waits for the next free hand.
    async fn take_some(
        self: &Arc<Self>,
        pool: &Pool,
        hands: &Arc<Semaphore>,
    ) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("ask for events");
        // The semaphore is never closed.
        let Ok(mut hand) = hands.clone().acquire_owned().await else { return Ok(()) };
        let consumer = self.connection.events(pool).await?;
        let count = 1 + hands.available_permits();
        let batch = consumer.batch().max_messages(count).expires(PULL).messages();
        let batch = batch.await.map_err(failed)?;
        // A pull may be forgotten when the stream's leader changes.
        let mut batch = pin!(batch.take_until(tokio::time::sleep(PULL + TROUBLE)));
        while let Some(message) = batch.next().await {
            match message {
                Ok(message) => {
                    let (hub, pool) = (self.clone(), pool.clone());
                    tokio::spawn(async move {
                        hub.take(&pool, &message).await;
                        drop(hand);
                    });
                    let Ok(next) = hands.clone().acquire_owned().await else { return Ok(()) };
                    hand = next;
                }
                Err(error) => tracing::warn!(%error, "an event can't be had"),
            }
        }
        Ok(())
    }

    /// Handles an event, and tells NATS that it is in progress until then.
    async fn take(self: &Arc<Self>, pool: &Pool, message: &Message) {
        let event = serde_json::from_slice::<Event>(&message.payload);
        let mut dealing =
            pin!(AssertUnwindSafe(self.try_take(pool, message, event)).catch_unwind());
        let dealt = loop {
            tokio::select! {
                dealt = &mut dealing => break dealt,
                () = tokio::time::sleep(EVENT_WAIT / 3) => {
                    if let Err(error) = message.ack_with(AckKind::Progress).await {
                        tracing::debug!(%error, "an event may be delivered again");
                    }
                }
            }
        };
        let kind = match dealt {
            Ok(Ok(())) => AckKind::Ack,
            Ok(Err(error)) => {
                tracing::warn!(%error, "an event is left for later");
                AckKind::Nak(Some(TROUBLE))
            }
            Err(_) => {
                tracing::error!(%pool, "an event made the server's code panic; it is dropped");
                AckKind::Ack
            }
        };
        if let Err(error) = message.ack_with(kind).await {
            tracing::warn!(%error, "an event will come again");
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
    ) -> Result<(), EventError> {
        let event = match event {
            Ok(event) => event,
            Err(error) => {
                tracing::error!(%error, %pool, "an event can't be read; it is dropped");
                figures::refused(1);
                return Ok(());
            }
        };
        let task = event.task;
        let dealt = self.deal(pool, event).await;
        let deliveries = message.info().map_or(1, |info| info.delivered);
        match dealt {
            Err(error) if error.is_of_event() && deliveries >= MAX_DELIVERIES => {
                tracing::error!(%error, %task, deliveries, "an event can't be dealt with");
                if let Some(remote) = self.store.remote_task(task).await? {
                    self.store.remote_lost(&remote, "its report can't be dealt with").await?;
                }
                Ok(())
            }
            dealt => dealt,
        }
    }

    async fn deal(&self, pool: &Pool, event: Event) -> Result<(), EventError> {
        let Event { task, attempt, worker, .. } = event;
        let prefix = names::output(pool, task, attempt, worker);
        let Some(remote) = self.ended_by(pool, &event).await? else {
            tracing::info!(%task, attempt, %worker, "a report is refused: the attempt is not the worker's");
            figures::refused(1);
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
                            Heartbeat::Lost => figures::refused(1),
                            _ => tracing::info!(%task, attempt, %worker, "a tile is done"),
                        }
                    }
                    Accepted::Again => {
                        tracing::info!(%task, attempt, %worker, "a tile is computed a second time");
                    }
                    Accepted::Refused(reason) => {
                        tracing::error!(%task, attempt, %worker, reason, "a worker's result is rejected");
                        figures::rejected(1);
                        let reason = format!("the result of worker {worker} is rejected: {reason}");
                        self.store.fail(&lease, &reason, true).await?;
                    }
                    Accepted::Lost(error) => {
                        tracing::warn!(%error, %task, attempt, %worker, "a tile's frames are lost");
                        figures::repaired(1);
                        self.store
                            .remote_lost(&remote, "its frames were lost on their way")
                            .await?;
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
                tracing::warn!(%task, attempt, %worker, how, "a worker has died in a tile");
                self.store.remote_died(&remote, &how, fault).await?;
            }
            End::GivenBack => self.store.give_back(&lease).await?,
        }
        self.clear(pool, task).await;
        Ok(())
    }

    /// The tile that an event ends; none unless the worker has begun the attempt. A worker that began while the
    /// server was down is heard now.
    async fn ended_by(&self, pool: &Pool, event: &Event) -> Result<Option<RemoteTask>, EventError> {
        let &Event { task, attempt, worker, seq, delivery, .. } = event;
        let found = self.store.remote_task(task).await?;
        let Some(found) = found.filter(|found| found.pool == pool.as_str()) else {
            return Ok(None);
        };
        if (found.attempt, found.worker) == (attempt, worker) {
            return Ok(Some(found));
        }
        let begin = Begin { task, attempt, seq, delivery, worker };
        match self.begin(pool, begin).await? {
            BeginAnswer::Go(_) => Ok(self.store.remote_task(task).await?),
            BeginAnswer::Over | BeginAnswer::Lost | BeginAnswer::Another => Ok(None),
        }
    }

    /// Brings frames to the disk, chunk by chunk: memory holds a few chunks, whatever the size.
    pub async fn fetch(
        &self,
        prefix: &str,
        frames: Input,
    ) -> Result<Result<StagedBlob, BlobError>, EventError> {
        let store = self.store.clone();
        let mut writer = tokio::task::spawn_blocking(move || store.blob_writer()).await??;
        let (mut next, mut looks) = (0, 0);
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
                    Some(Err(BlobError::Failed(reason))) => return Err(EventError::Fetch(reason)),
                    Some(Err(BlobError::Missing)) => break true,
                    Some(Err(BlobError::Damaged)) => return Ok(Err(BlobError::Damaged)),
                    None => break false,
                }
            };
            if !missing {
                break;
            }
            looks += 1;
            if looks == LOOKS.0 {
                return Ok(Err(BlobError::Missing));
            }
            tokio::time::sleep(LOOKS.1).await;
        }
        let staged = tokio::task::spawn_blocking(move || writer.finish()).await??;
        let whole = staged.sha256() == frames.sha256;
        Ok(if whole { Ok(staged) } else { Err(BlobError::Damaged) })
    }
}

/// A worker's text as it may stand in a log and on a page: one line, not too long.
pub fn readable(text: &str) -> String {
    let plain = |c: char| if c.is_control() { ' ' } else { c };
    text.chars().take(REASON).map(plain).collect()
}
