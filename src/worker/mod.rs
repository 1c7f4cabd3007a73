//! A worker: takes tasks from the queue, has the pipeline do them, and hands over what came of them.

mod local;
mod model_process;
mod perform;
mod run;
mod transport;

pub use local::Local;
#[cfg(feature = "nats")]
pub(crate) use local::tile_task;
pub use model_process::{ModelCommand, answer_worker};
pub use run::{Worker, WorkerError};
#[cfg(feature = "nats")]
pub(crate) use transport::{Claim, Done, Output, TaskInput, TileTask, Transport, TransportError};
