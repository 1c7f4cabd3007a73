//! The queue: how tasks get to workers and come back, and what becomes of their jobs.
//!
//! A worker *claims* a task and holds it under a *lease* that its heartbeats renew. A lease that
//! runs out makes the task ready again, so a dead worker costs one attempt. Each claim has a number,
//! and what an earlier attempt says later is refused: that is the fence. Everything that changes a
//! task also settles its job, in the same transaction.

mod claim;
mod complete;
mod forecast;
mod forecasting;
pub(super) mod graph;
mod job;
mod lease;
mod movie;
mod progress;
mod remote;

pub use claim::{CalibrationTask, CheckTask, ClaimedTask, JobTask, MovieWork, Work};
pub use complete::{CalibrationDone, Checked, Completion, Product};
pub(super) use forecast::Forecasts;
pub use lease::{Heartbeat, Lease, MAX_FAILURES, MAX_LOSSES, MAX_STARVED, WorkerEnd};
pub use movie::Movie;
pub use progress::{Estimate, JobProgress, ProgressStage};
pub use remote::{Begun, MessagePlace, RemoteBeat, RemoteTask};
