//! Hands tiles out: claims them from the store, cuts their windows, sends missing inputs, and publishes messages.

use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::message::PublishMessage;
use bytes::Bytes;
use tokio::sync::Semaphore;

use super::core::{Core, lock};
use super::error::HubError;
use super::figures;
use crate::local::tile_task;
use crate::nats::connection::ClusterError;
use crate::nats::message::{Input, Notice, TaskMessage};
use crate::nats::{arrays, names};
use crate::transport::TileTask;
use engine::job::{Pool, Sha256, TaskKind, without_paths};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::{mask_window, snapshot_window};
use formats::planar::Reader;
use formats::{FormatError, Limits};
use store::{Claimant, ClaimedTask, MessagePlace, RemoteTask, StoreError, Work};

/// Time between searches for tiles and for cancelled jobs.
const TICK: Duration = Duration::from_millis(200);
/// Tiles that are prepared and published at a time.
const AT_ONCE: usize = 4;
/// Pause after a failure of the store or the message server.
const RETRY_PAUSE: Duration = Duration::from_secs(2);

impl Core {
    /// Hands tiles out until the future is dropped.
    pub async fn dispatch(self: Arc<Self>) {
        let permits = Arc::new(Semaphore::new(AT_ONCE));
        loop {
            if let Err(error) = self.call_off().await {
                tracing::error!(%error, "cancelled tiles can't be called off");
            }
            loop {
                let Ok(permit) = permits.clone().acquire_owned().await else { return };
                match self.next().await {
                    Ok(Some((pool, task))) => {
                        let hub = self.clone();
                        tokio::spawn(async move {
                            hub.send(&pool, task).await;
                            drop(permit);
                        });
                    }
                    Ok(None) => break,
                    Err(error) => {
                        tracing::error!(%error, "no tile can be claimed");
                        tokio::time::sleep(RETRY_PAUSE).await;
                        break;
                    }
                }
            }
            tokio::select! {
                () = self.more.notified() => {}
                () = tokio::time::sleep(TICK) => {}
            }
        }
    }

    /// Claims the next tile for the pool with the most room. A pool has room for two tiles per worker. Returns `None`
    /// if there is no tile, or no pool with room.
    async fn next(&self) -> Result<Option<(Pool, ClaimedTask)>, StoreError> {
        let pools = lock(&self.presence).pools();
        if pools.values().all(|(workers, _)| *workers == 0) {
            return Ok(None);
        }
        let out = self.store.remote_counts().await?;
        let room = |(pool, (workers, _)): (Pool, (usize, _))| {
            let out = out.get(pool.as_str()).map_or(0, |count| *count as usize);
            let room = (2 * workers).saturating_sub(out);
            (room > 0).then_some((room, pool))
        };
        let Some((_, pool)) = pools.into_iter().filter_map(room).max() else { return Ok(None) };
        let claimed =
            self.store.claim_as(Claimant::Pool(pool.as_str()), self.id, Duration::ZERO).await?;
        Ok(claimed.map(|task| (pool, task)))
    }

    /// Sends a tile to a pool. Retries as long as the hub holds the tile.
    pub async fn send(&self, pool: &Pool, claimed: ClaimedTask) {
        let lease = claimed.lease;
        if !lock(&self.sending).insert(lease.task) {
            return;
        }
        if let Work::Job(task) = &claimed.work {
            lock(&self.jobs).insert(task.job);
        }
        while let Err(error) = self.try_send(pool, &claimed).await {
            tracing::warn!(%error, task = %lease.task, "a tile can't be sent");
            if let HubError::Tile(error) = &error {
                let reason = without_paths(&error.to_string());
                match self.store.fail(&lease, &reason, error.is_retryable()).await {
                    Ok(()) => break,
                    Err(error) => tracing::error!(%error, "the failure is not recorded"),
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
            let task = self.store.remote_task(lease.task).await;
            if !task.is_ok_and(|task| task.is_some_and(|task| task.attempt == lease.attempt)) {
                break;
            }
        }
        lock(&self.sending).remove(&lease.task);
    }

    async fn try_send(&self, pool: &Pool, claimed: &ClaimedTask) -> Result<(), HubError> {
        let (lease, message) = (claimed.lease, self.prepare(pool, claimed).await?);
        let text = serde_json::to_vec(&message).map_err(PipelineError::record("tile"))?;
        let id = format!("{}.{}", lease.task, lease.attempt);
        let message = PublishMessage::build().message_id(id).payload(text.into());
        let failed = ClusterError::nats("publish a tile");
        let sent = self.connection.context.send_publish(names::task(pool), message).await;
        let stored = sent.map_err(&failed)?.await.map_err(&failed)?;
        let stream = lock(&self.stream).clone();
        let place = MessagePlace { stream, seq: stored.sequence.cast_signed() };
        self.store.remote_published(&lease, &place).await?;
        Ok(())
    }

    /// Sends the inputs of a tile that are missing in the stream, and returns the tile's message.
    async fn prepare(&self, pool: &Pool, claimed: &ClaimedTask) -> Result<TaskMessage, HubError> {
        let wrong = || PipelineError::Record { what: "task", problem: "it is not a tile".into() };
        let Work::Job(job) = &claimed.work else { return Err(wrong().into()) };
        let TaskKind::Tile { snapshot, tile, .. } = claimed.kind else {
            return Err(wrong().into());
        };
        let tile = tile_task(job, snapshot, tile)?;
        let masks = match self.window(&tile) {
            Some(known) if self.is_put(pool, known.sha256) => known,
            _ => {
                let input = self.put_input(pool, self.cut(&tile, InputArray::Masks).await?).await?;
                self.note_window(&tile, input);
                input
            }
        };
        let snapshots = self.put_input(pool, self.cut(&tile, InputArray::Snapshots).await?).await?;
        self.note_snapshots(claimed.lease.task, pool, snapshots.sha256);
        let model = match tile.model {
            Some(sha256) => Some(self.put_model(pool, sha256).await?),
            None => None,
        };
        let (task, attempt) = (claimed.lease.task, claimed.lease.attempt);
        let (job, cost) = (job.job, claimed.cost);
        Ok(TaskMessage { task, attempt, job, cost, tile, masks, snapshots, model })
    }

    /// Cuts a window of a prepared array, and serializes it.
    async fn cut(&self, task: &TileTask, part: InputArray) -> Result<Vec<u8>, PipelineError> {
        let sha256 = if part == InputArray::Masks { task.masks } else { task.measurement };
        let (path, task) = (self.store.dir().blob(&sha256), task.clone());
        let cut = tokio::task::spawn_blocking(move || {
            let array = Reader::open(&path, &Limits::default())?;
            let place = task.tile.window();
            let frames = task.snapshots.start as usize..task.snapshots.end as usize;
            let window = match part {
                InputArray::Masks => mask_window(&array, &place, task.correction),
                InputArray::Snapshots => snapshot_window(&array, frames, &place, task.correction),
            };
            arrays::to_bytes(window?.view())
        });
        Ok(cut.await.map_err(|_| PipelineError::Thread)??)
    }

    async fn put_model(&self, pool: &Pool, sha256: Sha256) -> Result<Input, HubError> {
        let path = self.store.dir().blob(&sha256);
        let read = tokio::fs::read(path).await;
        let failed = |source| FormatError::Io { action: "read the network's file", source };
        self.put_input(pool, read.map_err(failed)?).await
    }

    /// Puts a file into the stream of inputs, unless it was sent recently.
    async fn put_input(&self, pool: &Pool, bytes: Vec<u8>) -> Result<Input, HubError> {
        let hashed = tokio::task::spawn_blocking(move || (Sha256::of(&bytes), bytes)).await;
        let (sha256, bytes) = hashed.map_err(|_| PipelineError::Thread)?;
        let size = bytes.len();
        if !self.is_put(pool, sha256) {
            self.connection.put(&names::input(pool, sha256), Bytes::from(bytes)).await?;
            figures::bytes("out", size);
            self.note_put(pool, sha256);
        }
        Ok(Input { sha256, bytes: size as u64 })
    }

    /// Sends an input again that a worker can't find.
    pub async fn put_again(&self, remote: &RemoteTask, pool: &Pool, sha256: Sha256) {
        self.forget_put(pool, sha256);
        let again = async {
            let claimed = self.store.remote_work(remote).await?;
            self.prepare(pool, &claimed).await
        };
        match again.await {
            Ok(_) => tracing::info!(%sha256, "an input that a worker could not find is sent again"),
            Err(error) => tracing::warn!(%error, "an input can't be sent again"),
        }
    }

    /// Calls off the tiles of cancelled jobs: notifies their workers, and takes back those that no living worker has.
    async fn call_off(&self) -> Result<(), StoreError> {
        let jobs: Vec<_> = lock(&self.jobs).iter().copied().collect();
        let unwanted = self.store.unwanted_jobs(&jobs).await?;
        if unwanted.is_empty() {
            return Ok(());
        }
        let mut any_out = false;
        for remote in self.store.remote_tasks().await?.into_iter().filter(|remote| !remote.wanted) {
            let Ok(pool) = remote.pool.parse::<Pool>() else { continue };
            any_out = true;
            if remote.delivery > 0 && lock(&self.presence).lives(remote.worker) {
                let (task, attempt) = (remote.task, remote.attempt);
                self.notify(&pool, remote.worker, Notice::Cancel { task, attempt }).await;
            } else if !lock(&self.sending).contains(&remote.task) {
                self.store.give_back(&remote.lease()).await?;
                if let Some(place) = &remote.place {
                    self.connection.drop_task(place.seq).await;
                }
                self.clear(&pool, remote.task).await;
            }
        }
        if !any_out {
            lock(&self.jobs).retain(|job| !unwanted.contains(job));
        }
        Ok(())
    }
}

/// The array from which a window is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum InputArray {
    Masks,
    Snapshots,
}
