//! A worker: takes tasks from the queue, has the pipeline do them, and hands over what came of them.

mod assemble;
mod calibration_task;
mod finish;
mod pilot;
mod prepare;
mod preview;
mod run;
mod task;
mod tile;

pub use run::{Worker, WorkerError};
