//! How tiles ended: fetches the frames, checks them, and tells the store.

use std::io::Write;
use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::{AckKind, Message};
use futures_util::StreamExt;
use serde::Deserialize;

use super::core::Core;
use super::figures;
use crate::nats::blobs::BlobError;
use crate::nats::connection::ClusterError;
use crate::nats::message::{End, Event, Input};
use crate::nats::names;
use engine::job::Pool;
use engine::pipeline::records::TileTaskRecord;
use store::{Completion, Heartbeat, Product, RemoteBeat, RemoteTask, StagedBlob, StoreError};

/// How long a request for events waits, and how many it asks for.
const PULL: (Duration, usize) = (Duration::from_secs(5), 64);
/// Events that are dealt with at a time.
const AT_ONCE: usize = 4;
/// Looks for frames that a replica may not have yet, and the time between them.
const LOOKS: (u32, Duration) = (10, Duration::from_millis(500));
/// Pause after the message server has failed.
const TROUBLE: Duration = Duration::from_secs(2);

/// Why an event is left for later.
#[derive(Debug, thiserror::Error)]
enum EventError {
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("the frames can't be written: {0}")]
    Write(#[from] std::io::Error),
    #[error("a thread ended unexpectedly")]
    Thread(#[from] tokio::task::JoinError),
    #[error("the frames can't be fetched: {0}")]
    Fetch(String),
}

impl Core {
    /// Deals with events for as long as this is awaited.
    pub async fn take_events(self: Arc<Self>) {
        loop {
            if let Err(error) = self.take_some().await {
                tracing::warn!(%error, "no events can be had");
                tokio::time::sleep(TROUBLE).await;
            }
        }
    }

    async fn take_some(&self) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("ask for events");
        let consumer = self.connection.events().await?;
        let (wait, count) = PULL;
        let batch = consumer.batch().max_messages(count).expires(wait).messages();
        let batch = batch.await.map_err(failed)?;
        // A pull may be forgotten when the stream's leader changes.
        let batch = batch.take_until(tokio::time::sleep(wait + TROUBLE));
        batch
            .for_each_concurrent(AT_ONCE, |message| async {
                match message {
                    Ok(message) => self.take(&message).await,
                    Err(error) => tracing::warn!(%error, "an event can't be had"),
                }
            })
            .await;
        Ok(())
    }

    async fn take(&self, message: &Message) {
        let pool = names::pool_of(&message.subject);
        let event = serde_json::from_slice::<Event>(&message.payload);
        let dealt = match (pool, event) {
            (Some(pool), Ok(event)) => self.deal(&pool, event).await,
            _ => {
                tracing::error!(subject = %message.subject, "an event can't be read");
                Ok(())
            }
        };
        let kind = match &dealt {
            Ok(()) => AckKind::Ack,
            Err(error) => {
                tracing::warn!(%error, "an event is left for later");
                AckKind::Nak(Some(TROUBLE))
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

    async fn deal(&self, pool: &Pool, event: Event) -> Result<(), EventError> {
        let Event { task, attempt, worker, end } = event;
        let found = self.store.remote_task(task).await?;
        // One attempt has one report; another pool's worker has none to make.
        let found = found.filter(|found| found.attempt == attempt && found.pool == pool.as_str());
        let Some(remote) = found else {
            tracing::info!(%task, attempt, %worker, "a report is refused: it comes too late");
            figures::refused(1);
            let subjects = format!("{}.>", names::output(pool, task, attempt, worker));
            self.connection.purge(names::OUTPUTS, subjects).await?;
            return Ok(());
        };
        let lease = remote.lease();
        match end {
            End::Done { frames, progress, record, history } => {
                if TileTaskRecord::deserialize(&record).is_err() {
                    self.store.fail(&lease, "its record can't be read", true).await?;
                } else {
                    let prefix = names::output(pool, task, attempt, worker);
                    let Some(staged) = self.fetch(&remote, &prefix, frames).await? else {
                        return Ok(());
                    };
                    let last =
                        RemoteBeat { task, attempt, pool: pool.to_string(), progress, history };
                    self.store.remote_beats(&[last], &[]).await?;
                    let product = Product::File(staged);
                    let completion = Completion { progress, record, product };
                    match self.store.complete(&lease, completion).await? {
                        Heartbeat::Lost => figures::refused(1),
                        _ => tracing::info!(%task, attempt, %worker, "a tile is done"),
                    }
                }
            }
            End::Failed { reason, retry } => {
                tracing::warn!(%task, attempt, %worker, reason, "a tile has failed");
                self.store.fail(&lease, &reason, retry).await?;
            }
            End::Died { .. } if remote.delivery > 0 && remote.worker != worker => {
                tracing::info!(%task, attempt, %worker, "a worker has died before its tile was its own");
                return Ok(());
            }
            End::Died { how, fault } => {
                tracing::warn!(%task, attempt, %worker, how, "a worker has died in a tile");
                self.store.remote_died(&remote, &how, fault).await?;
            }
            End::GivenBack => self.store.give_back(&lease).await?,
        }
        self.clear(pool, task).await;
        Ok(())
    }

    /// The frames of a tile, on the disk; none if they are lost or damaged, and the tile is to be
    /// computed again.
    async fn fetch(
        &self,
        remote: &RemoteTask,
        prefix: &str,
        frames: Input,
    ) -> Result<Option<StagedBlob>, EventError> {
        for look in 0..LOOKS.0 {
            if look > 0 {
                tokio::time::sleep(LOOKS.1).await;
            }
            match self.connection.get(names::OUTPUTS, prefix, frames).await {
                Ok(bytes) => {
                    figures::bytes("in", bytes.len());
                    let store = self.store.clone();
                    let staged = tokio::task::spawn_blocking(move || {
                        let mut writer = store.blob_writer()?;
                        writer.write_all(&bytes)?;
                        Ok::<_, EventError>(writer.finish()?)
                    });
                    return Ok(Some(staged.await??));
                }
                Err(BlobError::Failed(reason)) => return Err(EventError::Fetch(reason)),
                Err(error) => tracing::warn!(%error, task = %remote.task, "frames are not there"),
            }
        }
        figures::repaired(1);
        self.store.remote_lost(remote, "its frames were lost on their way").await?;
        self.clear_of(remote).await;
        Ok(None)
    }

    async fn clear_of(&self, remote: &RemoteTask) {
        if let Ok(pool) = remote.pool.parse() {
            self.clear(&pool, remote.task).await;
        }
    }
}
