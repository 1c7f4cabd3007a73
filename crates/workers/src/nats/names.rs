//! Names of streams and subjects. `v1` changes with what messages mean.

use engine::job::{Pool, Sha256, TaskId, WorkerId};

/// Streams: tiles that wait or are being computed, what workers tell of their end, the windows and
/// models that tiles need, and the frames that came of them.
pub const TASKS: &str = "SCI_TASKS";
pub const EVENTS: &str = "SCI_EVENTS";
pub const INPUTS: &str = "SCI_IN";
pub const OUTPUTS: &str = "SCI_OUT";

/// Where the messages of tiles go. Its one consumer is named after the pool.
pub fn task(pool: &Pool) -> String {
    format!("sci.v1.task.{pool}")
}

/// Where workers tell how tiles ended.
pub fn event(pool: &Pool) -> String {
    format!("sci.v1.event.{pool}")
}

/// The hub's consumer of a pool's events. Each pool has one: what holds up the events of one pool holds up no other.
pub fn events(pool: &Pool) -> String {
    format!("hub-{pool}")
}

/// What workers ask or tell the hub, without a stream.
pub fn ask(what: &str, pool: &Pool) -> String {
    format!("sci.v1.{what}.{pool}")
}

/// What the hub tells a worker.
pub fn tell(pool: &Pool, worker: WorkerId) -> String {
    format!("sci.v1.tell.{pool}.{worker}")
}

/// The chunks of an input, each with its number after a dot.
pub fn input(pool: &Pool, sha256: Sha256) -> String {
    format!("sci.v1.in.{pool}.{sha256}")
}

/// The chunks of the frames of an attempt.
pub fn output(pool: &Pool, task: TaskId, attempt: u32, worker: WorkerId) -> String {
    format!("sci.v1.out.{pool}.{task}.{attempt}.{worker}")
}

/// All chunks of all outputs of a task.
pub fn outputs(pool: &Pool, task: TaskId) -> String {
    format!("sci.v1.out.{pool}.{task}.>")
}

/// The pool in a subject of workers to the hub: its last word.
pub fn pool_of(subject: &str) -> Option<Pool> {
    subject.rsplit('.').next()?.parse().ok()
}
