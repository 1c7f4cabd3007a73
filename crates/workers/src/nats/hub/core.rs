//! What the parts of the hub share.

use std::collections::{HashMap, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, Semaphore};

use super::presence::Presence;
use super::replays::Replays;
use crate::nats::connection::Connection;
use crate::nats::message::{Input, Program, Tell};
use crate::nats::names;
use engine::job::{JobId, Pool, Sha256, TaskId, WorkerId};
use reconstruction::tile::Tile;
use store::Store;

/// The most windows of masks whose hashes are remembered.
const WINDOWS: usize = 65_536;
/// An input that was put longer ago may have grown too old for the stream.
const FRESH: Duration = Duration::from_secs(12 * 3600);

/// Tiles whose frames are checked at a time.
const VERIFIED_AT_ONCE: usize = 2;
/// Inputs that are put again at a time.
const PUT_AGAIN_AT_ONCE: usize = 2;

/// A message that is there and is not delivered.
#[derive(Debug, Clone, Copy)]
pub struct Undelivered {
    /// Its number.
    pub seq: i64,
    pub since: Instant,
    /// Whether the consumer was made anew since.
    pub again: bool,
}

/// What the parts of the hub share.
pub struct Core {
    pub store: Store,
    pub connection: Connection,
    /// In whose name tiles are claimed.
    pub id: WorkerId,
    pub program: Program,
    pub ack_wait: Duration,
    /// Called when there may be more to hand out.
    pub more: Notify,
    pub presence: Mutex<Presence>,
    /// Results that wait for a second one.
    pub replays: Mutex<Replays>,
    pub verifying: Semaphore,
    /// Tiles whose inputs are put again, and their turns.
    pub wanted: Mutex<HashSet<TaskId>>,
    pub putting_again: Semaphore,
    /// Tiles on their way out, and the jobs of those that are out.
    pub sending: Mutex<HashSet<TaskId>>,
    pub jobs: Mutex<HashSet<JobId>>,
    /// When the stream of tiles was made; another one has other messages under the same numbers.
    pub stream: Mutex<String>,
    /// Inputs in the stream, and when they were put.
    put: Mutex<HashMap<(Pool, Sha256), Instant>>,
    /// What windows of prepared masks are as files.
    windows: Mutex<HashMap<(Sha256, Tile), Input>>,
    /// Tiles that wait though workers of their pool wait, too; see `sweep.rs`.
    pub undelivered: Mutex<HashMap<TaskId, Undelivered>>,
    /// Messages of no tile that is out, by the last sweep.
    pub strays: Mutex<HashSet<i64>>,
    /// The snapshots' window of a tile that is out, which no other tile needs.
    snapshots: Mutex<HashMap<TaskId, (Pool, Sha256)>>,
}

impl Core {
    /// The hub of a server, with the share of tiles that are computed twice.
    pub fn new(
        store: Store,
        connection: Connection,
        (program, ack_wait): (Program, Duration),
        verify_fraction: f64,
    ) -> Self {
        Self {
            store,
            connection,
            id: WorkerId::new(),
            program,
            ack_wait,
            more: Notify::new(),
            presence: Mutex::default(),
            replays: Mutex::new(Replays::new(verify_fraction)),
            verifying: Semaphore::new(VERIFIED_AT_ONCE),
            wanted: Mutex::default(),
            putting_again: Semaphore::new(PUT_AGAIN_AT_ONCE),
            sending: Mutex::default(),
            jobs: Mutex::default(),
            stream: Mutex::default(),
            put: Mutex::default(),
            windows: Mutex::default(),
            undelivered: Mutex::default(),
            strays: Mutex::default(),
            snapshots: Mutex::default(),
        }
    }

    /// Tells a worker something; if it is not heard, the worker's next sign of life brings it up again.
    pub async fn tell(&self, pool: &Pool, worker: WorkerId, what: Tell) {
        if let Err(error) = self.connection.say(names::tell(pool, worker), &what).await {
            tracing::warn!(%error, "a worker can't be told something");
        }
    }

    /// Whether an input was put not long ago.
    pub fn is_put(&self, pool: &Pool, sha256: Sha256) -> bool {
        let put = lock(&self.put);
        put.get(&(pool.clone(), sha256)).is_some_and(|at| at.elapsed() < FRESH)
    }

    pub fn note_put(&self, pool: &Pool, sha256: Sha256) {
        lock(&self.put).insert((pool.clone(), sha256), Instant::now());
    }

    pub fn forget_put(&self, pool: &Pool, sha256: Sha256) {
        lock(&self.put).remove(&(pool.clone(), sha256));
    }

    /// The streams of files are empty.
    pub fn forget_all_put(&self) {
        lock(&self.put).clear();
    }

    /// What a window of prepared masks is as a file, if that is known.
    pub fn window(&self, masks: Sha256, tile: Tile) -> Option<Input> {
        lock(&self.windows).get(&(masks, tile)).copied()
    }

    pub fn note_window(&self, masks: Sha256, tile: Tile, input: Input) {
        let mut windows = lock(&self.windows);
        if windows.len() >= WINDOWS {
            windows.clear();
        }
        windows.insert((masks, tile), input);
    }

    pub fn note_snapshots(&self, task: TaskId, pool: &Pool, sha256: Sha256) {
        lock(&self.snapshots).insert(task, (pool.clone(), sha256));
    }

    /// Removes what a tile that has ended leaves in the streams. What stays behind after an error is
    /// removed when nothing is out, or grows too old.
    pub async fn clear(&self, pool: &Pool, task: TaskId) {
        let snapshots = lock(&self.snapshots).remove(&task);
        let outputs = self.connection.purge(names::OUTPUTS, names::outputs(pool, task));
        if let Err(error) = outputs.await {
            tracing::warn!(%error, "the chunks of a tile stay");
        }
        if let Some((pool, sha256)) = snapshots {
            self.forget_put(&pool, sha256);
            let subjects = format!("{}.>", names::input(&pool, sha256));
            if let Err(error) = self.connection.purge(names::INPUTS, subjects).await {
                tracing::warn!(%error, "the window of a tile stays");
            }
        }
    }
}

pub fn lock<T>(place: &Mutex<T>) -> MutexGuard<'_, T> {
    // Whole values are stored: a poisoned lock holds a good one.
    place.lock().unwrap_or_else(PoisonError::into_inner)
}
