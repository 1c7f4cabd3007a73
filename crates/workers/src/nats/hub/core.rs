//! State that the parts of the hub share.

use std::collections::{HashMap, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, Semaphore};

use super::presence::Presence;
use super::replays::Replays;
use crate::nats::connection::Connection;
use crate::nats::message::{Input, Notice, Program};
use crate::nats::names;
use crate::transport::TileTask;
use engine::job::{JobId, Pool, Sha256, TaskId, WorkerId};
use reconstruction::registration::{Correction, Interpolation, Similarity};
use reconstruction::tile::Tile;
use store::Store;

/// Largest number of windows of masks with a remembered hash.
const MAX_WINDOWS: usize = 65_536;
/// Age up to which an input is surely in the stream, which drops inputs after 24 hours.
const MAX_INPUT_AGE: Duration = Duration::from_secs(12 * 3600);

/// Tiles whose frames are checked at a time.
const VERIFIED_AT_ONCE: usize = 2;
/// Requests for missing inputs that are handled at a time.
const PUT_AGAIN_AT_ONCE: usize = 2;

/// A message that waits in the stream without being delivered.
#[derive(Debug, Clone, Copy)]
pub struct Undelivered {
    /// Sequence number of the message.
    pub seq: i64,
    pub since: Instant,
    /// True if the consumer was recreated in the meantime.
    pub consumer_recreated: bool,
}

/// A window of prepared masks, which may be moved.
#[derive(PartialEq, Eq, Hash)]
struct MaskWindow {
    masks: Sha256,
    /// The bits of the motion's parameters, and the interpolation.
    correction: Option<([u64; 4], Interpolation)>,
    tile: Tile,
}

impl MaskWindow {
    fn of(task: &TileTask) -> Self {
        let correction = task.correction.map(|Correction { motion, interpolation }| {
            let Similarity { shift: [rows, columns], rotation, scale } = motion;
            ([rows, columns, rotation, scale].map(f64::to_bits), interpolation)
        });
        Self { masks: task.masks, correction, tile: task.tile }
    }
}

/// State that the parts of the hub share.
pub struct Core {
    pub store: Store,
    pub connection: Connection,
    /// The hub claims tiles under this identifier.
    pub id: WorkerId,
    pub program: Program,
    pub ack_wait: Duration,
    /// Notified when a tile or a worker may have become available.
    pub more: Notify,
    pub presence: Mutex<Presence>,
    /// Results that wait for a second one.
    pub replays: Mutex<Replays>,
    pub verifying: Semaphore,
    /// Tiles with missing inputs that are being sent again.
    pub wanted: Mutex<HashSet<TaskId>>,
    pub putting_again: Semaphore,
    /// Tiles that are being published.
    pub sending: Mutex<HashSet<TaskId>>,
    /// Jobs of the tiles that are out.
    pub jobs: Mutex<HashSet<JobId>>,
    /// Creation time of the stream of tiles. A new stream reuses the sequence numbers.
    pub stream: Mutex<String>,
    /// Inputs in the stream, and when they were sent.
    put: Mutex<HashMap<(Pool, Sha256), Instant>>,
    /// Hashes and sizes of windows of prepared masks.
    windows: Mutex<HashMap<MaskWindow, Input>>,
    /// Tiles that wait although workers of their pool wait too; see `sweep.rs`.
    pub undelivered: Mutex<HashMap<TaskId, Undelivered>>,
    /// Messages that belonged to no tile at the last sweep.
    pub strays: Mutex<HashSet<i64>>,
    /// The window of the snapshots of each tile that is out. No other tile needs it.
    snapshots: Mutex<HashMap<TaskId, (Pool, Sha256)>>,
}

impl Core {
    /// The state of a new hub. `verify_fraction` is the share of tiles that are computed twice.
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

    /// Sends a notice to a worker. If it is lost, the worker's next sign of life triggers another one.
    pub async fn notify(&self, pool: &Pool, worker: WorkerId, notice: Notice) {
        if let Err(error) = self.connection.publish(names::notice(pool, worker), &notice).await {
            tracing::warn!(%error, "a notice to a worker can't be sent");
        }
    }

    /// True if an input was sent recently.
    pub fn is_put(&self, pool: &Pool, sha256: Sha256) -> bool {
        let put = lock(&self.put);
        put.get(&(pool.clone(), sha256)).is_some_and(|at| at.elapsed() < MAX_INPUT_AGE)
    }

    pub fn note_put(&self, pool: &Pool, sha256: Sha256) {
        lock(&self.put).insert((pool.clone(), sha256), Instant::now());
    }

    pub fn forget_put(&self, pool: &Pool, sha256: Sha256) {
        lock(&self.put).remove(&(pool.clone(), sha256));
    }

    /// Forgets all inputs, because the streams of files are empty.
    pub fn forget_all_put(&self) {
        lock(&self.put).clear();
    }

    /// Hash and size of a window of prepared masks, if they are known.
    pub fn window(&self, task: &TileTask) -> Option<Input> {
        lock(&self.windows).get(&MaskWindow::of(task)).copied()
    }

    pub fn note_window(&self, task: &TileTask, input: Input) {
        let mut windows = lock(&self.windows);
        if windows.len() >= MAX_WINDOWS {
            windows.clear();
        }
        windows.insert(MaskWindow::of(task), input);
    }

    pub fn note_snapshots(&self, task: TaskId, pool: &Pool, sha256: Sha256) {
        lock(&self.snapshots).insert(task, (pool.clone(), sha256));
    }

    /// Removes the files of a finished tile from the streams. After an error, they are removed when no tile is out, or
    /// when they expire.
    pub async fn clear(&self, pool: &Pool, task: TaskId) {
        let snapshots = lock(&self.snapshots).remove(&task);
        let outputs = self.connection.purge(names::OUTPUTS, names::outputs(pool, task));
        if let Err(error) = outputs.await {
            tracing::warn!(%error, "the chunks of a tile can't be removed");
        }
        if let Some((pool, sha256)) = snapshots {
            self.forget_put(&pool, sha256);
            let subjects = format!("{}.>", names::input(&pool, sha256));
            if let Err(error) = self.connection.purge(names::INPUTS, subjects).await {
                tracing::warn!(%error, "the window of a tile can't be removed");
            }
        }
    }
}

pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change is a single assignment, so the value is valid even if a thread panicked.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
