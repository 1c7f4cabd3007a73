//! Compares what is out by the store's account with what the message server has, and mends the
//! difference. It is the answer to every message that is lost, and to a lost disk of the message server.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::join_all;

use super::core::{Core, Undelivered, lock};
use super::figures;
use crate::nats::connection::ClusterError;
use crate::nats::names;
use engine::job::Pool;
use store::{MessagePlace, RemoteTask, StoreError};

/// The longest time between sweeps. Where workers may be silent for less, sweeps come as often: what was
/// lost is found as soon as who was lost.
const TICK: Duration = Duration::from_secs(30);
/// Time between looks whether events are dealt with.
const LOOK: Duration = Duration::from_millis(200);
/// A message is held to be stuck after twice the time of a delivery to somebody who is gone, and this.
const PATIENCE: Duration = Duration::from_secs(10);
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
            tokio::time::sleep(TICK.min(self.ack_wait)).await;
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
        let known = self.pools().await;
        for pool in &known {
            self.connection.make_pool(pool, self.ack_wait).await?;
        }
        let pools = lock(&self.presence).pools();
        lock(&self.replays).drop_old();
        // 2. What should be out; before the streams are looked at.
        let out = self.store.remote_tasks().await?;
        lock(&self.jobs).extend(out.iter().map(|remote| remote.job));
        // 3. What is there. A worker reports before it lets its message go: what is missing here and is
        // still out when all that was reported before is dealt with, is lost.
        let messages = self.messages().await?;
        let reported = self.reported().await?;
        let mut missing: BTreeMap<Pool, Vec<&RemoteTask>> = BTreeMap::new();
        for remote in &out {
            let Ok(pool) = remote.pool.parse::<Pool>() else { continue };
            let held = self.is_held(remote);
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
                Some(place) if !there(place) && !held => {
                    missing.entry(pool).or_default().push(remote);
                }
                Some(place) if empty && !held => {
                    self.connection.drop_task(place.seq).await;
                    self.mend(remote, "its pool has no worker any more").await?;
                }
                Some(_) => {}
            }
        }
        // One pool's events hold up the tiles of no other.
        let mended = missing.iter().map(|(pool, missing)| async move {
            if self.is_dealt_with(pool, reported).await? {
                for remote in missing {
                    self.mend(remote, "its message was lost").await?;
                }
            }
            Ok::<_, SweepError>(())
        });
        join_all(mended).await.into_iter().collect::<Result<(), _>>()?;
        self.deliver(&out).await?;
        self.drop_strays(messages).await?;
        // 4. When nothing is out, nothing needs the files.
        if out.is_empty() && lock(&self.sending).is_empty() {
            self.empty_files().await?;
            self.empty_events(&known, reported).await?;
        }
        Ok(())
    }

    /// Removes events up to this one when nothing is out and no more of them are to come: those that a killed
    /// message server has again.
    async fn empty_events(&self, pools: &[Pool], last: u64) -> Result<(), ClusterError> {
        let stream = self.connection.context.get_stream(names::EVENTS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of events"))?;
        let there = stream.cached_info().state.messages;
        if there == 0 {
            return Ok(());
        }
        let dealt = join_all(pools.iter().map(|pool| self.is_dealt_with(pool, last))).await;
        if dealt.into_iter().collect::<Result<Vec<_>, _>>()?.iter().all(|dealt| *dealt) {
            let purged = stream.purge().sequence(last + 1).await;
            let purged = purged.map_err(ClusterError::nats("empty the stream of events"))?.purged;
            if purged > 0 {
                tracing::warn!(purged, "events that were dealt with are removed");
            }
        }
        Ok(())
    }

    /// Looks for messages of tiles that nobody holds though workers wait for them: a consumer that is moved from
    /// node to node may forget some, or stand still (nats-server 6905, 7680). It is made anew first; if that
    /// does not help, the tile is handed out again.
    async fn deliver(&self, out: &[RemoteTask]) -> Result<(), SweepError> {
        let (mut late, mut lost) = (BTreeSet::new(), Vec::new());
        {
            let mut undelivered = lock(&self.undelivered);
            let before = std::mem::take(&mut *undelivered);
            // A tile that its first worker leaves to another may wait for long.
            let replayed =
                |remote: &RemoteTask| lock(&self.replays).first_worker(remote.task).is_some();
            let waiting = out.iter().filter(|remote| !self.is_held(remote) && !replayed(remote));
            for remote in waiting {
                let (Some(place), Ok(pool)) = (&remote.place, remote.pool.parse::<Pool>()) else {
                    continue;
                };
                if !lock(&self.presence).waits(&pool) {
                    continue;
                }
                let seq = place.seq;
                let known = before.get(&remote.task).filter(|known| known.seq == seq);
                let now = Undelivered { seq, since: Instant::now(), again: false };
                let mut found = known.copied().unwrap_or(now);
                if found.since.elapsed() > 2 * self.ack_wait + PATIENCE {
                    if found.again {
                        lost.push((remote, seq));
                        continue;
                    }
                    late.insert(pool);
                    found = Undelivered { again: true, ..now };
                }
                undelivered.insert(remote.task, found);
            }
        }
        for (remote, seq) in lost {
            self.connection.drop_task(seq).await;
            self.mend(remote, "its message was not delivered").await?;
        }
        for pool in late {
            tracing::warn!(%pool, "messages are not delivered: their consumer is made anew");
            self.connection.drop_consumer(names::TASKS, pool.as_str()).await;
            self.connection.make_pool(&pool, self.ack_wait).await?;
        }
        Ok(())
    }

    /// Removes messages that belong to no tile that is out, in this sweep as in the one before. A message
    /// server that was killed may have messages again that it had removed, and its consumer, which knows
    /// that they were acknowledged, never delivers them.
    async fn drop_strays(&self, mut messages: HashSet<i64>) -> Result<(), StoreError> {
        // What is on its way has no place yet; looked at first, because it has one when it has arrived.
        let on_their_way = !lock(&self.sending).is_empty();
        for remote in self.store.remote_tasks().await? {
            if let Some(place) = &remote.place {
                messages.remove(&place.seq);
            }
        }
        if on_their_way {
            messages.clear();
        }
        let before = std::mem::replace(&mut *lock(&self.strays), messages.clone());
        for seq in messages.intersection(&before) {
            tracing::warn!(seq, "a message of no tile that is out is removed");
            self.connection.drop_task(*seq).await;
        }
        Ok(())
    }

    /// Whether a worker has a tile in hand. One that has reported it has not: if the report is lost, the tile is.
    fn is_held(&self, remote: &RemoteTask) -> bool {
        remote.delivery > 0 && lock(&self.presence).holds(remote.worker, remote.task)
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

    /// The number of the last event.
    async fn reported(&self) -> Result<u64, ClusterError> {
        let stream = self.connection.context.get_stream(names::EVENTS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of events"))?;
        Ok(stream.cached_info().state.last_sequence)
    }

    /// Waits until all events of a pool up to this number are dealt with; false if that takes long.
    async fn is_dealt_with(&self, pool: &Pool, last: u64) -> Result<bool, ClusterError> {
        let (start, mut first) = (Instant::now(), None);
        loop {
            let consumer = self.connection.events(pool).await?;
            let info = consumer.cached_info();
            let none_left = info.num_pending == 0 && info.num_ack_pending == 0;
            let floor = info.ack_floor.stream_sequence;
            if none_left || floor >= last {
                return Ok(true);
            }
            if start.elapsed() > TICK {
                if floor == *first.get_or_insert(floor) {
                    tracing::warn!(%pool, "events are not delivered: their consumer is made anew");
                    self.connection.drop_consumer(names::EVENTS, &names::events(pool)).await;
                }
                return Ok(false);
            }
            first.get_or_insert(floor);
            tokio::time::sleep(LOOK).await;
        }
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
