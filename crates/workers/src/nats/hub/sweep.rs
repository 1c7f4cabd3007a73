//! Compares the tiles that are out according to the store with the messages on the message server, and repairs the
//! differences. It handles every lost message, and the loss of the message server's disk.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::join_all;

use super::core::{Core, Undelivered, lock};
use super::error::HubError;
use super::figures;
use crate::nats::connection::ClusterError;
use crate::nats::names;
use engine::job::Pool;
use store::{MessagePlace, RemoteTask, StoreError};

/// Longest time between sweeps. With a shorter time until redelivery, sweeps are as frequent as that, so that lost
/// messages are detected as soon as lost workers.
const TICK: Duration = Duration::from_secs(30);
/// Time between polls for handled events.
const POLL: Duration = Duration::from_millis(200);
/// A message counts as stuck after twice the time until redelivery plus this.
const STUCK_MARGIN: Duration = Duration::from_secs(10);
/// Time without a worker after which a pool's tiles are taken back.
const EMPTY_POOL_TIME: Duration = Duration::from_secs(60);

impl Core {
    /// Sweeps until the future is dropped.
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

    /// Creates missing streams, and records the identity of the stream of tiles.
    /// Errors: the message server refuses, or has no quorum.
    pub async fn find_streams(&self) -> Result<(), ClusterError> {
        let identity = self.connection.make_streams().await?;
        let before = std::mem::replace(&mut *lock(&self.stream), identity.clone());
        if !before.is_empty() && before != identity {
            tracing::warn!("the message server has lost its streams: they are created again");
            self.forget_all_put();
        }
        Ok(())
    }

    async fn sweep_once(self: &Arc<Self>, start: Instant) -> Result<(), HubError> {
        // 1. Creates the streams and consumers that a lost disk of the message server has taken with it.
        self.find_streams().await?;
        let known = self.pools().await;
        for pool in &known {
            self.connection.make_pool(pool, self.ack_wait).await?;
        }
        let pools = lock(&self.presence).pools();
        lock(&self.replays).drop_old();
        // 2. Reads the tiles that should be out, before it reads the streams.
        let out = self.store.remote_tasks().await?;
        lock(&self.jobs).extend(out.iter().map(|remote| remote.job));
        // 3. Reads the messages. A worker reports before it acknowledges. A tile without a message is therefore lost
        // if it is still out when all earlier events have been handled.
        let messages = self.messages().await?;
        let reported = self.reported().await?;
        let mut missing: BTreeMap<Pool, Vec<&RemoteTask>> = BTreeMap::new();
        for remote in &out {
            let Ok(pool) = remote.pool.parse::<Pool>() else { continue };
            let held = self.is_held(remote);
            let is_pool_empty = match pools.get(&pool) {
                Some((0, last)) => last.elapsed() > EMPTY_POOL_TIME,
                Some(_) => false,
                None => start.elapsed() > EMPTY_POOL_TIME,
            };
            let exists = |place: &MessagePlace| {
                place.stream == *lock(&self.stream) && messages.contains(&place.seq)
            };
            match &remote.place {
                None if lock(&self.sending).contains(&remote.task) => {}
                // A server claimed the tile and was killed before it published the message.
                None => {
                    let claimed = self.store.remote_work(remote).await?;
                    let (hub, pool) = (self.clone(), pool);
                    tokio::spawn(async move { hub.send(&pool, claimed).await });
                }
                Some(place) if !exists(place) && !held => {
                    missing.entry(pool).or_default().push(remote);
                }
                Some(place) if is_pool_empty && !held => {
                    self.connection.drop_task(place.seq).await;
                    self.repair(remote, "its pool has lost all workers").await?;
                }
                Some(_) => {}
            }
        }
        // Pools do not wait for each other's events.
        let repaired = missing.iter().map(|(pool, missing)| async move {
            if self.is_handled(pool, reported).await? {
                for remote in missing {
                    self.repair(remote, "its message was lost").await?;
                }
            }
            Ok::<_, HubError>(())
        });
        join_all(repaired).await.into_iter().collect::<Result<(), _>>()?;
        self.deliver(&out).await?;
        self.drop_strays(messages).await?;
        // 4. Removes the files when no tile is out.
        if out.is_empty() && lock(&self.sending).is_empty() {
            self.empty_files().await?;
            self.empty_events(&known, reported).await?;
        }
        Ok(())
    }

    /// Removes handled events up to number `last`, which a killed message server may have restored. Call it only while
    /// no tile is out.
    async fn empty_events(&self, pools: &[Pool], last: u64) -> Result<(), ClusterError> {
        let stream = self.connection.context.get_stream(names::EVENTS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of events"))?;
        if stream.cached_info().state.messages == 0 {
            return Ok(());
        }
        let handled = join_all(pools.iter().map(|pool| self.is_handled(pool, last))).await;
        if handled.into_iter().collect::<Result<Vec<_>, _>>()?.iter().all(|handled| *handled) {
            let purged = stream.purge().sequence(last + 1).await;
            let purged = purged.map_err(ClusterError::nats("empty the stream of events"))?.purged;
            if purged > 0 {
                tracing::warn!(purged, "events that were already handled are removed");
            }
        }
        Ok(())
    }

    /// Repairs messages that are not delivered although workers wait. A consumer that moves between nodes may forget
    /// messages or stall (nats-server issues 6905 and 7680). The first repair recreates the consumer; the second hands
    /// the tile out again.
    async fn deliver(&self, out: &[RemoteTask]) -> Result<(), HubError> {
        let (mut late, mut lost) = (BTreeSet::new(), Vec::new());
        {
            let mut undelivered = lock(&self.undelivered);
            let before = std::mem::take(&mut *undelivered);
            // A tile that needs a second worker may wait long.
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
                let now = Undelivered { seq, since: Instant::now(), consumer_recreated: false };
                let mut entry = known.copied().unwrap_or(now);
                if entry.since.elapsed() > 2 * self.ack_wait + STUCK_MARGIN {
                    if entry.consumer_recreated {
                        lost.push((remote, seq));
                        continue;
                    }
                    late.insert(pool);
                    entry = Undelivered { consumer_recreated: true, ..now };
                }
                undelivered.insert(remote.task, entry);
            }
        }
        for (remote, seq) in lost {
            self.connection.drop_task(seq).await;
            self.repair(remote, "its message was not delivered").await?;
        }
        for pool in late {
            tracing::warn!(%pool, "messages are not delivered: their consumer is created again");
            self.connection.drop_consumer(names::TASKS, pool.as_str()).await;
            self.connection.make_pool(&pool, self.ack_wait).await?;
        }
        Ok(())
    }

    /// Removes messages that belonged to no tile in two consecutive sweeps. A killed message server may restore messages
    /// that it had removed. Its consumer never delivers them, because they were acknowledged.
    async fn drop_strays(&self, mut messages: HashSet<i64>) -> Result<(), StoreError> {
        // A tile that is being published has no recorded message yet. This is read first, because its message is recorded
        // when publishing ends.
        let publishing = !lock(&self.sending).is_empty();
        for remote in self.store.remote_tasks().await? {
            if let Some(place) = &remote.place {
                messages.remove(&place.seq);
            }
        }
        if publishing {
            messages.clear();
        }
        let before = std::mem::replace(&mut *lock(&self.strays), messages.clone());
        for seq in messages.intersection(&before) {
            tracing::warn!(seq, "a message without a tile is removed");
            self.connection.drop_task(*seq).await;
        }
        Ok(())
    }

    /// True if a worker computes a tile. A worker that has reported the tile does not: if the report is lost, the tile
    /// counts as lost.
    fn is_held(&self, remote: &RemoteTask) -> bool {
        remote.delivery > 0 && lock(&self.presence).holds(remote.worker, remote.task)
    }

    /// Takes back a tile whose state has not changed since the sweep began.
    async fn repair(&self, remote: &RemoteTask, reason: &str) -> Result<(), StoreError> {
        if self.store.remote_task(remote.task).await?.as_ref() == Some(remote) {
            tracing::warn!(task = %remote.task, reason, "a tile is handed out again");
            figures::count(figures::REPAIRED, 1);
            self.store.remote_lost(remote, reason).await?;
            self.more.notify_one();
        }
        Ok(())
    }

    /// Sequence numbers of the messages of tiles.
    async fn messages(&self) -> Result<HashSet<i64>, ClusterError> {
        let failed = || ClusterError::nats("read the stream of tiles");
        let stream = self.connection.context.get_stream_no_info(names::TASKS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of tiles"))?;
        let info = stream.info_builder().with_deleted(true).fetch().await.map_err(failed())?;
        let state = &info.info.state;
        let deleted: HashSet<u64> = state.deleted.iter().flatten().copied().collect();
        let range = state.first_sequence..state.last_sequence.saturating_add(1);
        if state.messages == 0 {
            return Ok(HashSet::new());
        }
        Ok(range.filter(|seq| !deleted.contains(seq)).map(u64::cast_signed).collect())
    }

    /// Sequence number of the last event.
    async fn reported(&self) -> Result<u64, ClusterError> {
        let stream = self.connection.context.get_stream(names::EVENTS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of events"))?;
        Ok(stream.cached_info().state.last_sequence)
    }

    /// Waits until all events of a pool up to number `last` are handled. Returns false after [`TICK`].
    async fn is_handled(&self, pool: &Pool, last: u64) -> Result<bool, ClusterError> {
        let (start, mut first) = (Instant::now(), None);
        loop {
            let consumer = self.connection.events(pool).await?;
            let info = consumer.cached_info();
            let is_idle = info.num_pending == 0 && info.num_ack_pending == 0;
            let floor = info.ack_floor.stream_sequence;
            if is_idle || floor >= last {
                return Ok(true);
            }
            if start.elapsed() > TICK {
                if floor == *first.get_or_insert(floor) {
                    tracing::warn!(%pool, "events are not delivered: their consumer is created again");
                    self.connection.drop_consumer(names::EVENTS, &names::events(pool)).await;
                }
                return Ok(false);
            }
            first.get_or_insert(floor);
            tokio::time::sleep(POLL).await;
        }
    }

    async fn empty_files(&self) -> Result<(), ClusterError> {
        self.forget_all_put();
        for stream in [names::INPUTS, names::OUTPUTS] {
            let stream = self.connection.context.get_stream(stream).await;
            let stream = stream.map_err(ClusterError::nats("find a stream"))?;
            if stream.cached_info().state.messages > 0 {
                stream.purge().await.map_err(ClusterError::nats("empty a stream"))?;
            }
        }
        Ok(())
    }
}
