//! Compares what is out by the store's account with what the message server has, and mends the
//! difference. It is the answer to every message that is lost, and to a lost disk of the message server.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::core::{Core, lock};
use super::figures;
use crate::cluster::connection::ClusterError;
use crate::cluster::names;
use crate::job::Pool;
use crate::store::{MessagePlace, RemoteTask, StoreError};

/// Time between sweeps.
const TICK: Duration = Duration::from_secs(30);
/// A pool without a worker for so long gives its tiles back.
const EMPTY: Duration = Duration::from_secs(60);

/// Why a sweep did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum SweepError {
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl Core {
    /// Sweeps for as long as this is awaited.
    pub async fn sweep(self: Arc<Self>) {
        let start = Instant::now();
        loop {
            if let Err(error) = self.sweep_once(start).await {
                tracing::warn!(%error, "the message server can't be compared with the store");
            }
            let pools = lock(&self.presence).pools();
            let out = self.store.remote_counts().await.unwrap_or_default();
            for (pool, (workers, _)) in pools {
                let count = out.get(pool.as_str()).map_or(0, |count| *count as usize);
                figures::pool(&pool, workers, count);
            }
            tokio::time::sleep(TICK).await;
        }
    }

    /// Makes the streams that are missing, and notes which they are.
    ///
    /// # Errors
    /// If the message server refuses, or has no quorum.
    pub async fn find_streams(&self) -> Result<(), ClusterError> {
        let made = self.connection.make_streams().await?;
        let before = std::mem::replace(&mut *lock(&self.stream), made.clone());
        if !before.is_empty() && before != made {
            tracing::warn!("the message server has lost its streams: they are made anew");
            self.forget_all_put();
        }
        Ok(())
    }

    async fn sweep_once(self: &Arc<Self>, start: Instant) -> Result<(), SweepError> {
        // 1. What a lost disk of the message server takes with it.
        self.find_streams().await?;
        let pools = lock(&self.presence).pools();
        for pool in pools.keys() {
            self.connection.make_pool(pool, self.ack_wait).await?;
        }
        // 2. What should be out; before the streams are looked at.
        let out = self.store.remote_tasks().await?;
        lock(&self.jobs).extend(out.iter().map(|remote| remote.job));
        // 3. What is there. A worker reports before it lets its message go: what is missing here and
        // has no event after this, and is still out after that, is lost.
        let messages = self.messages().await?;
        let quiet = self.events_are_dealt_with().await?;
        for remote in &out {
            let Ok(pool) = remote.pool.parse::<Pool>() else { continue };
            let worker_lives = remote.delivery > 0 && lock(&self.presence).lives(remote.worker);
            let empty = match pools.get(&pool) {
                Some((0, last)) => last.elapsed() > EMPTY,
                Some(_) => false,
                None => start.elapsed() > EMPTY,
            };
            let there = |place: &MessagePlace| {
                place.stream == *lock(&self.stream) && messages.contains(&place.seq)
            };
            match &remote.place {
                None if lock(&self.sending).contains(&remote.task) => {}
                // A server that was killed has claimed it.
                None => {
                    let claimed = self.store.remote_work(remote).await?;
                    let (hub, pool) = (self.clone(), pool);
                    tokio::spawn(async move { hub.send(&pool, claimed).await });
                }
                Some(place) if quiet && !there(place) && !worker_lives => {
                    self.mend(remote, "its message was lost").await?;
                }
                Some(place) if empty && !worker_lives => {
                    self.connection.drop_task(place.seq).await;
                    self.mend(remote, "its pool has no worker any more").await?;
                }
                Some(_) => {}
            }
        }
        // 4. When nothing is out, nothing needs the files.
        if out.is_empty() && lock(&self.sending).is_empty() {
            self.empty_files().await?;
        }
        Ok(())
    }

    /// Takes a tile back that is still out as it was when the sweep began.
    async fn mend(&self, remote: &RemoteTask, reason: &str) -> Result<(), StoreError> {
        if self.store.remote_task(remote.task).await?.as_ref() == Some(remote) {
            tracing::warn!(task = %remote.task, reason, "a tile is handed out again");
            figures::repaired(1);
            self.store.remote_lost(remote, reason).await?;
            self.more.notify_one();
        }
        Ok(())
    }

    /// The sequences of the messages of tiles.
    async fn messages(&self) -> Result<HashSet<i64>, ClusterError> {
        let failed = || ClusterError::nats("look at the stream of tiles");
        let stream = self.connection.context.get_stream_no_info(names::TASKS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of tiles"))?;
        let info = stream.info_builder().with_deleted(true).fetch().await.map_err(failed())?;
        let state = &info.info.state;
        let deleted: HashSet<u64> = state.deleted.iter().flatten().copied().collect();
        let all = state.first_sequence..state.last_sequence.saturating_add(1);
        if state.messages == 0 {
            return Ok(HashSet::new());
        }
        Ok(all.filter(|seq| !deleted.contains(seq)).map(u64::cast_signed).collect())
    }

    /// Whether no event waits or is being dealt with.
    async fn events_are_dealt_with(&self) -> Result<bool, ClusterError> {
        let consumer = self.connection.events().await?;
        let info = consumer.cached_info();
        Ok(info.num_pending == 0 && info.num_ack_pending == 0)
    }

    async fn empty_files(&self) -> Result<(), ClusterError> {
        self.forget_all_put();
        for stream in [names::INPUTS, names::OUTPUTS] {
            let found = self.connection.context.get_stream(stream).await;
            let found = found.map_err(ClusterError::nats("find a stream"))?;
            if found.cached_info().state.messages > 0 {
                found.purge().await.map_err(ClusterError::nats("empty a stream"))?;
            }
        }
        Ok(())
    }
}
