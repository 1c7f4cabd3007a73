//! A worker: takes tasks from the queue, has the pipeline do them, and hands over what came of them.

mod local;
mod perform;
mod run;
mod transport;

pub use local::Local;
pub use run::{Worker, WorkerError};
