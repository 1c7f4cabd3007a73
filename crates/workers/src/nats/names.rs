//! Names of streams and subjects. `v1` is the version of the messages.

use engine::job::{Pool, Sha256, TaskId, WorkerId};

/// Stream of the tiles that wait or are being computed.
pub const TASKS: &str = "SCI_TASKS";
/// Stream of the workers' reports on finished tiles.
pub const EVENTS: &str = "SCI_EVENTS";
/// Stream of the windows and models that tiles need.
pub const INPUTS: &str = "SCI_IN";
/// Stream of the frames of tiles.
pub const OUTPUTS: &str = "SCI_OUT";

/// Subject of a pool's tiles. They have one consumer, which is named after the pool.
pub fn task(pool: &Pool) -> String {
    format!("sci.v1.task.{pool}")
}

/// Subject of a pool's events.
pub fn event(pool: &Pool) -> String {
    format!("sci.v1.event.{pool}")
}

/// The hub's consumer of a pool's events. Separate consumers keep one pool from delaying another.
pub fn events(pool: &Pool) -> String {
    format!("hub-{pool}")
}

/// Subject of workers' messages to the hub, outside the streams. `kind` is one of hello, begin, beat and want.
pub fn ask(kind: &str, pool: &Pool) -> String {
    format!("sci.v1.{kind}.{pool}")
}

/// Subject of the hub's notices to a worker.
pub fn notice(pool: &Pool, worker: WorkerId) -> String {
    format!("sci.v1.tell.{pool}.{worker}")
}

/// Prefix of the subjects of an input's chunks. The number of the chunk follows after a dot.
pub fn input(pool: &Pool, sha256: Sha256) -> String {
    format!("sci.v1.in.{pool}.{sha256}")
}

/// Prefix of the subjects of the chunks of an attempt's frames.
pub fn output(pool: &Pool, task: TaskId, attempt: u32, worker: WorkerId) -> String {
    format!("sci.v1.out.{pool}.{task}.{attempt}.{worker}")
}

/// Pattern of the subjects of all output chunks of a task.
pub fn outputs(pool: &Pool, task: TaskId) -> String {
    format!("sci.v1.out.{pool}.{task}.>")
}

/// The pool in the subject of a worker's message: its last token.
pub fn pool_of(subject: &str) -> Option<Pool> {
    subject.rsplit('.').next()?.parse().ok()
}
