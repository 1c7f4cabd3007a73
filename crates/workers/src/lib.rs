//! A worker: one loop (claim a task, perform it, renew its lease, complete it) and the transports it reaches the
//! queue through: the store of the same machine, or NATS.

mod check;
mod local;
mod model_check;
mod model_process;
#[cfg(feature = "nats")]
pub mod nats;
mod perform;
mod run;
mod transport;

pub use local::Local;
pub use model_process::{ModelCommand, answer_worker};
pub use run::{Worker, WorkerError};
