//! Which workers on other machines live, and what they told last.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use crate::nats::message::TileBeat;
use engine::job::{Pool, TaskId, WorkerId};

/// A worker that was silent for longer is not counted on.
const SILENCE: Duration = Duration::from_secs(15);

/// Living workers that a pool may have. An introduction costs its sender nothing, and takes a row and room in answers.
pub const MOST_WORKERS: usize = 2000;

/// The workers.
#[derive(Debug, Default)]
pub struct Presence {
    workers: HashMap<WorkerId, Sign>,
    /// Pools that had a worker since the server started, and when it gave its last sign.
    pools: BTreeMap<Pool, Instant>,
}

/// A worker's last sign of life.
#[derive(Debug)]
struct Sign {
    pool: Pool,
    at: Instant,
    /// Not yet on record.
    fresh: bool,
    /// The tile that it had then.
    holds: Option<TaskId>,
    tile: Option<TileBeat>,
}

impl Presence {
    /// True if a worker may join a pool: it is known there, or the pool has fewer living workers than it may.
    pub fn has_room(&self, worker: WorkerId, pool: &Pool) -> bool {
        let lives = |sign: &&Sign| sign.pool == *pool && sign.at.elapsed() < SILENCE;
        self.workers.get(&worker).is_some_and(|sign| sign.pool == *pool)
            || self.workers.values().filter(lives).count() < MOST_WORKERS
    }

    /// A worker has introduced itself.
    /// Nobody may take another's name.
    pub fn join(&mut self, worker: WorkerId, pool: &Pool) {
        if self.workers.get(&worker).is_some_and(|sign| sign.pool != *pool) {
            return;
        }
        let sign =
            Sign { pool: pool.clone(), at: Instant::now(), fresh: true, holds: None, tile: None };
        self.workers.insert(worker, sign);
        self.pools.insert(pool.clone(), Instant::now());
    }

    /// A sign of life; false if nobody knows who that is.
    pub fn sign(&mut self, worker: WorkerId, pool: &Pool, tile: Option<TileBeat>) -> bool {
        let known = self.workers.get_mut(&worker).filter(|sign| sign.pool == *pool);
        let Some(sign) = known else { return false };
        (sign.at, sign.fresh) = (Instant::now(), true);
        sign.holds = tile.as_ref().map(|tile| tile.task);
        self.pools.insert(sign.pool.clone(), sign.at);
        if let Some(mut tile) = tile {
            // News that are not on record yet stay news.
            let before = sign
                .tile
                .take()
                .filter(|last| (last.task, last.attempt) == (tile.task, tile.attempt));
            tile.history = tile.history.or(before.and_then(|last| last.history));
            sign.tile = Some(tile);
        }
        true
    }

    /// A worker has begun with a tile.
    pub fn begin(&mut self, worker: WorkerId, task: TaskId) {
        if let Some(sign) = self.workers.get_mut(&worker) {
            (sign.at, sign.fresh, sign.holds) = (Instant::now(), true, Some(task));
        }
    }

    /// A worker of a pool has said goodbye; false if there is none.
    pub fn leave(&mut self, worker: WorkerId, pool: &Pool) -> bool {
        let known = self.workers.get(&worker).is_some_and(|sign| sign.pool == *pool);
        known && self.workers.remove(&worker).is_some()
    }

    /// Whether a worker lives, as far as is known.
    pub fn lives(&self, worker: WorkerId) -> bool {
        self.workers.get(&worker).is_some_and(|sign| sign.at.elapsed() < SILENCE)
    }

    /// Whether a living worker has a tile in hand, as far as is known.
    pub fn holds(&self, worker: WorkerId, task: TaskId) -> bool {
        let sign = self.workers.get(&worker);
        sign.is_some_and(|sign| sign.holds == Some(task) && sign.at.elapsed() < SILENCE)
    }

    /// True if a pool has another living worker.
    pub fn has_another(&self, pool: &Pool, worker: WorkerId) -> bool {
        let mut others =
            self.workers.iter().filter(|(id, sign)| **id != worker && sign.pool == *pool);
        others.any(|(_, sign)| sign.at.elapsed() < SILENCE)
    }

    /// Whether a living worker of a pool waits for a tile.
    pub fn waits(&self, pool: &Pool) -> bool {
        let waits = |sign: &Sign| sign.pool == *pool && sign.holds.is_none();
        self.workers.values().any(|sign| waits(sign) && sign.at.elapsed() < SILENCE)
    }

    /// The number of living workers of each pool that ever had one, and since when a pool has none.
    pub fn pools(&mut self) -> BTreeMap<Pool, (usize, Instant)> {
        self.workers.retain(|_, sign| sign.at.elapsed() < SILENCE);
        let mut pools: BTreeMap<Pool, (usize, Instant)> =
            self.pools.iter().map(|(pool, last)| (pool.clone(), (0, *last))).collect();
        for sign in self.workers.values() {
            if let Some((count, _)) = pools.get_mut(&sign.pool) {
                *count += 1;
            }
        }
        pools
    }

    /// What was told since the last call: who gave a sign, and what of tiles.
    pub fn news(&mut self) -> (Vec<WorkerId>, Vec<(WorkerId, Pool, TileBeat)>) {
        let (mut seen, mut tiles) = (Vec::new(), Vec::new());
        for (worker, sign) in self.workers.iter_mut().filter(|(_, sign)| sign.fresh) {
            sign.fresh = false;
            seen.push(*worker);
            if let Some(tile) = sign.tile.take() {
                tiles.push((*worker, sign.pool.clone(), tile));
            }
        }
        (seen, tiles)
    }
}

#[cfg(test)]
mod tests {
    use super::{MOST_WORKERS, Pool, Presence, WorkerId};

    #[test]
    fn a_pool_takes_a_limited_number_of_workers() {
        let (gpu, cpu): (Pool, Pool) = ("gpu".parse().unwrap(), "cpu".parse().unwrap());
        let mut presence = Presence::default();
        let first = WorkerId::new();
        presence.join(first, &gpu);
        for _ in 1..MOST_WORKERS {
            let worker = WorkerId::new();
            assert!(presence.has_room(worker, &gpu));
            presence.join(worker, &gpu);
        }
        assert!(!presence.has_room(WorkerId::new(), &gpu));
        assert!(presence.has_room(first, &gpu), "it is one of them");
        assert!(presence.has_room(WorkerId::new(), &cpu));
        assert!(presence.leave(first, &gpu));
        assert!(presence.has_room(WorkerId::new(), &gpu));
    }
}
