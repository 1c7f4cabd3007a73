//! Tracks which workers on other machines are alive, and their last reports.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use crate::nats::message::TileBeat;
use engine::job::{Pool, TaskId, WorkerId};

/// A worker that was silent for longer counts as dead. Idle workers send a sign of life every 5 seconds.
const MAX_SILENCE: Duration = Duration::from_secs(15);

/// Largest number of living workers in a pool. An introduction costs its sender nothing, but takes a row in the store and
/// space in answers.
pub const MAX_WORKERS: usize = 2000;

/// The workers on other machines.
#[derive(Debug, Default)]
pub struct Presence {
    workers: HashMap<WorkerId, Sign>,
    /// Pools that had a worker since the server started, and the time of the last sign from one.
    pools: BTreeMap<Pool, Instant>,
}

/// A worker's last sign of life.
#[derive(Debug)]
struct Sign {
    pool: Pool,
    at: Instant,
    /// True until the store has recorded the sign.
    fresh: bool,
    /// The worker's tile.
    holds: Option<TaskId>,
    tile: Option<TileBeat>,
}

impl Presence {
    /// True if a worker may join a pool: it is known there, or the pool has fewer than [`MAX_WORKERS`] living workers.
    pub fn has_room(&self, worker: WorkerId, pool: &Pool) -> bool {
        let is_alive = |sign: &&Sign| sign.pool == *pool && sign.at.elapsed() < MAX_SILENCE;
        self.workers.get(&worker).is_some_and(|sign| sign.pool == *pool)
            || self.workers.values().filter(is_alive).count() < MAX_WORKERS
    }

    /// Records that a worker introduced itself. A worker of another pool can't take over its identifier.
    pub fn join(&mut self, worker: WorkerId, pool: &Pool) {
        if self.workers.get(&worker).is_some_and(|sign| sign.pool != *pool) {
            return;
        }
        let sign =
            Sign { pool: pool.clone(), at: Instant::now(), fresh: true, holds: None, tile: None };
        self.workers.insert(worker, sign);
        self.pools.insert(pool.clone(), Instant::now());
    }

    /// Records a sign of life. Returns false if the worker is unknown.
    pub fn sign(&mut self, worker: WorkerId, pool: &Pool, tile: Option<TileBeat>) -> bool {
        let known = self.workers.get_mut(&worker).filter(|sign| sign.pool == *pool);
        let Some(sign) = known else { return false };
        (sign.at, sign.fresh) = (Instant::now(), true);
        sign.holds = tile.as_ref().map(|tile| tile.task);
        self.pools.insert(sign.pool.clone(), sign.at);
        if let Some(mut tile) = tile {
            // Keeps a history that is not recorded yet.
            let before = sign
                .tile
                .take()
                .filter(|last| (last.task, last.attempt) == (tile.task, tile.attempt));
            tile.history = tile.history.or(before.and_then(|last| last.history));
            sign.tile = Some(tile);
        }
        true
    }

    /// Records that a worker has begun a tile.
    pub fn begin(&mut self, worker: WorkerId, task: TaskId) {
        if let Some(sign) = self.workers.get_mut(&worker) {
            (sign.at, sign.fresh, sign.holds) = (Instant::now(), true, Some(task));
        }
    }

    /// Records that a worker of a pool leaves. Returns false if it is unknown.
    pub fn leave(&mut self, worker: WorkerId, pool: &Pool) -> bool {
        let known = self.workers.get(&worker).is_some_and(|sign| sign.pool == *pool);
        known && self.workers.remove(&worker).is_some()
    }

    /// True if a worker gave a sign of life recently.
    pub fn lives(&self, worker: WorkerId) -> bool {
        self.workers.get(&worker).is_some_and(|sign| sign.at.elapsed() < MAX_SILENCE)
    }

    /// True if a living worker computes this tile.
    pub fn holds(&self, worker: WorkerId, task: TaskId) -> bool {
        let sign = self.workers.get(&worker);
        sign.is_some_and(|sign| sign.holds == Some(task) && sign.at.elapsed() < MAX_SILENCE)
    }

    /// True if a pool has another living worker.
    pub fn has_another(&self, pool: &Pool, worker: WorkerId) -> bool {
        let mut others =
            self.workers.iter().filter(|(id, sign)| **id != worker && sign.pool == *pool);
        others.any(|(_, sign)| sign.at.elapsed() < MAX_SILENCE)
    }

    /// True if a living worker of a pool waits for a tile.
    pub fn waits(&self, pool: &Pool) -> bool {
        let waits = |sign: &Sign| sign.pool == *pool && sign.holds.is_none();
        self.workers.values().any(|sign| waits(sign) && sign.at.elapsed() < MAX_SILENCE)
    }

    /// For each known pool, the number of living workers and the time of the last sign of life.
    pub fn pools(&mut self) -> BTreeMap<Pool, (usize, Instant)> {
        self.workers.retain(|_, sign| sign.at.elapsed() < MAX_SILENCE);
        let mut pools: BTreeMap<Pool, (usize, Instant)> =
            self.pools.iter().map(|(pool, last)| (pool.clone(), (0, *last))).collect();
        for sign in self.workers.values() {
            if let Some((count, _)) = pools.get_mut(&sign.pool) {
                *count += 1;
            }
        }
        pools
    }

    /// Takes the workers with a new sign of life since the last call, and their tiles' progress.
    pub fn news(&mut self) -> (Vec<WorkerId>, Vec<(WorkerId, Pool, TileBeat)>) {
        let (mut alive, mut tiles) = (Vec::new(), Vec::new());
        for (worker, sign) in self.workers.iter_mut().filter(|(_, sign)| sign.fresh) {
            sign.fresh = false;
            alive.push(*worker);
            if let Some(tile) = sign.tile.take() {
                tiles.push((*worker, sign.pool.clone(), tile));
            }
        }
        (alive, tiles)
    }
}

#[cfg(test)]
mod tests {
    use super::{MAX_WORKERS, Pool, Presence, WorkerId};

    #[test]
    fn a_pool_takes_a_limited_number_of_workers() {
        let (gpu, cpu): (Pool, Pool) = ("gpu".parse().unwrap(), "cpu".parse().unwrap());
        let mut presence = Presence::default();
        let first = WorkerId::new();
        presence.join(first, &gpu);
        for _ in 1..MAX_WORKERS {
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
