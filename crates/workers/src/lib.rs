//! The worker: a loop that claims a task, performs it, renews its lease and completes it. It reaches the queue
//! through a transport: the store of the same machine, or NATS.

mod check;
mod local;
mod model_check;
mod model_process;
pub mod nats;
mod perform;
mod run;
mod transport;

pub use local::Local;
pub use model_process::{ModelCommand, answer_worker};
pub use run::{Worker, WorkerError};
