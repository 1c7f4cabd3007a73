//! Handles the messages of workers outside the streams: hello, begin, signs of life, and missing inputs.

use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_nats::{Message, Subscriber};
use futures_util::StreamExt;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::accept::is_possible;
use super::core::{Core, lock};
use super::error::HubError;
use super::figures;
use super::presence::MAX_WORKERS;
use crate::nats::connection::ClusterError;
use crate::nats::message::{
    Beat, Begin, BeginAnswer, Hello, HelloAnswer, InputRequest, Notice, TileBeat,
};
use crate::nats::names;
use engine::job::Pool;
use engine::pipeline::progress::is_history;
use reconstruction::schedule::MAX_ITERATIONS;
use store::{Begun, Claimant, Heartbeat, RemoteBeat, StoreError, WorkerPlace};

/// Time between two transactions that record signs of life.
const FLUSH: Duration = Duration::from_secs(1);
/// Messages of one kind that are handled at a time.
const AT_ONCE: usize = 64;
/// Longest name of a host or a device, in bytes.
const MAX_NAME: usize = 255;

impl Core {
    /// Subscribes to the messages of this kind from all pools.
    /// Errors: the message server denies the subscription.
    pub async fn listen(&self, kind: &str) -> Result<Subscriber, ClusterError> {
        let subscribed = self.connection.client.subscribe(format!("sci.v1.{kind}.*")).await;
        subscribed.map_err(ClusterError::nats("listen to workers"))
    }

    pub async fn answer_hellos(self: Arc<Self>, messages: Subscriber) {
        each(messages, |pool, hello: Hello, message| {
            let hub = self.clone();
            async move {
                if let Some(answer) = hub.hello(&pool, hello).await {
                    hub.reply(&message, &answer).await;
                }
            }
        })
        .await;
    }

    pub async fn answer_begins(self: Arc<Self>, messages: Subscriber) {
        each(messages, |pool, begin: Begin, message| {
            let hub = self.clone();
            async move {
                match hub.begin(&pool, begin).await {
                    Ok(answer) => hub.reply(&message, &answer).await,
                    // The worker continues without an answer.
                    Err(error) => tracing::error!(%error, "a worker that begins is not answered"),
                }
            }
        })
        .await;
    }

    pub async fn answer_wants(self: Arc<Self>, messages: Subscriber) {
        each(messages, |pool, want: InputRequest, _| {
            let hub = self.clone();
            async move {
                match hub.store.remote_task(want.task).await {
                    Ok(Some(remote)) if remote.pool == pool.as_str() => {
                        // The requests of a tile are handled one at a time, however often its worker asks.
                        if !lock(&hub.wanted).insert(want.task) {
                            return;
                        }
                        if let Ok(_permit) = hub.putting_again.acquire().await {
                            hub.put_again(&remote, &pool, want.sha256).await;
                        }
                        lock(&hub.wanted).remove(&want.task);
                    }
                    Ok(_) => {}
                    Err(error) => {
                        tracing::error!(%error, "a request for an input can't be looked up")
                    }
                }
            }
        })
        .await;
    }

    pub async fn receive_beats(self: Arc<Self>, messages: Subscriber) {
        each(messages, |pool, beat: Beat, _| {
            let hub = self.clone();
            async move {
                if beat.leaves {
                    let known = lock(&hub.presence).leave(beat.worker, &pool);
                    if known && let Err(error) = hub.store.remote_worker_left(beat.worker).await {
                        tracing::error!(%error, "the departure of a worker is not recorded");
                    }
                } else if !lock(&hub.presence).sign(beat.worker, &pool, possible(beat.tile)) {
                    hub.notify(&pool, beat.worker, Notice::Introduce).await;
                }
            }
        })
        .await;
    }

    /// Records signs of life and progress once a second.
    pub async fn record_beats(self: Arc<Self>) {
        loop {
            tokio::time::sleep(FLUSH).await;
            if let Err(error) = self.flush().await {
                tracing::error!(%error, "signs of life are not recorded");
            }
        }
    }

    async fn flush(&self) -> Result<(), StoreError> {
        let (alive, tiles) = lock(&self.presence).news();
        if alive.is_empty() {
            return Ok(());
        }
        let beats: Vec<RemoteBeat> = tiles
            .iter()
            .map(|(worker, pool, tile)| RemoteBeat {
                worker: *worker,
                pool: pool.to_string(),
                task: tile.task,
                attempt: tile.attempt,
                progress: tile.progress,
                history: tile.history.clone(),
            })
            .collect();
        let answers = self.store.remote_beats(&beats, &alive).await?;
        for ((worker, pool, tile), answer) in tiles.iter().zip(answers) {
            let (task, attempt) = (tile.task, tile.attempt);
            match answer {
                Heartbeat::Continue => {}
                Heartbeat::Cancelled => {
                    self.notify(pool, *worker, Notice::Cancel { task, attempt }).await
                }
                Heartbeat::Lost => self.notify(pool, *worker, Notice::Lost { task, attempt }).await,
            }
        }
        Ok(())
    }

    /// Registers a worker. Returns `None` after a failure; the worker then asks again.
    async fn hello(&self, pool: &Pool, hello: Hello) -> Option<HelloAnswer> {
        let Hello { worker, host, pid, device, program } = hello;
        let is_name =
            |name: &String| name.len() <= MAX_NAME && !name.chars().any(|c: char| c.is_control());
        if !is_name(&host) || !is_name(&device) {
            return Some(HelloAnswer::Refused("the name of its host or device is too long".into()));
        }
        if let Some(reason) = self.program.refusal(&program) {
            tracing::warn!(%worker, host, reason, "a worker is refused");
            return Some(HelloAnswer::Refused(reason));
        }
        if !lock(&self.presence).has_room(worker, pool) {
            tracing::warn!(%worker, host, %pool, "a worker is refused: its pool is full");
            let reason = format!("the pool is full: it has {MAX_WORKERS} workers");
            return Some(HelloAnswer::Refused(reason));
        }
        if let Err(error) = self.connection.make_pool(pool, self.ack_wait).await {
            tracing::error!(%error, "the consumer of a pool can't be created");
            return None;
        }
        let location = WorkerPlace {
            host: Some(host.clone()),
            pool: Some(pool.to_string()),
            device: Some(device),
        };
        let started =
            self.store.worker_started(worker, pid, &location, Claimant::Pool(pool.as_str()));
        if let Err(error) = started.await {
            tracing::error!(%error, "a worker can't be recorded");
            return None;
        }
        lock(&self.presence).join(worker, pool);
        tracing::info!(%worker, host, %pool, "a worker has joined");
        self.more.notify_one();
        let ms = |duration: Duration| u64::try_from(duration.as_millis()).unwrap_or(u64::MAX);
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        Some(HelloAnswer::Welcome { ack_wait_ms: ms(self.ack_wait), now_ms: ms(now) })
    }

    /// Grants a worker an attempt, if no other worker owns the tile.
    pub async fn begin(&self, pool: &Pool, begin: Begin) -> Result<BeginAnswer, HubError> {
        let Begin { task, attempt, seq, delivery, worker } = begin;
        if self.leaves_to_another(pool, task, worker).await? {
            return Ok(BeginAnswer::Another);
        }
        let pool = pool.as_str();
        Ok(match self.store.remote_begin(task, pool, attempt, seq, delivery, worker).await? {
            Begun::Go(attempt, redelivered) => {
                lock(&self.presence).begin(worker, task);
                figures::count(figures::REDELIVERED, u64::from(redelivered));
                BeginAnswer::Go(attempt)
            }
            Begun::Over => BeginAnswer::Over,
            Begun::Lost => BeginAnswer::Lost,
        })
    }

    async fn reply(&self, message: &Message, answer: &impl Serialize) {
        let Some(to) = &message.reply else { return };
        if let Err(error) = self.connection.publish(to.to_string(), answer).await {
            tracing::warn!(%error, "a worker can't be answered");
        }
    }
}

/// Drops a beat's tile if its progress is impossible, and its history if that can't be read.
fn possible(tile: Option<TileBeat>) -> Option<TileBeat> {
    let mut tile = tile.filter(|tile| is_possible(&tile.progress))?;
    tile.history = tile.history.filter(|history| is_history(history, MAX_ITERATIONS));
    Some(tile)
}

/// Handles all messages of a subscription, several at a time. Unreadable messages are dropped.
async fn each<T, F>(messages: Subscriber, handle: impl Fn(Pool, T, Message) -> F)
where
    T: DeserializeOwned,
    F: Future<Output = ()>,
{
    let readable = messages.filter_map(|message| async move {
        let pool = names::pool_of(&message.subject)?;
        match serde_json::from_slice(&message.payload) {
            Ok(content) => Some((pool, content, message)),
            Err(error) => {
                tracing::warn!(%error, subject = %message.subject, "a worker's message can't be read");
                None
            }
        }
    });
    readable
        .for_each_concurrent(AT_ONCE, |(pool, content, message)| handle(pool, content, message))
        .await;
}
