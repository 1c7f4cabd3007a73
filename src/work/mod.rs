//! The work itself: solving tiles, writing results, and the worker that does so for the queue.
//!
//! A worker's tasks are one file each: `prepare`, `preview`, `pilot`, `tile`, `assemble`, `finish`. The
//! command line and the workers share `solve` and the writing of results, so that a job gives
//! the same frames whichever way it came.

mod assemble;
pub mod calibrate;
mod calibration_task;
mod camera;
mod finish;
mod history;
mod learned;
mod network;
pub mod pilot;
mod prepare;
mod preview;
mod result;
mod share;
mod snapshot;
mod solve;
mod task;
mod tile;
mod usage;
mod worker;

pub mod manifest;

pub use learned::{ModelFile, run_network};
pub use network::{NetworkError, NetworkSource};
pub use result::{
    ResultError, ResultFile, ResultSpec, check_output, replace_result, sha256_of, write_result,
};
pub use share::ShareDone;
pub use snapshot::{SnapshotInput, SolveError, Solved, Solver, TileProgress, blended_frame, solve};
pub use solve::{TileInput, TileOutcome, reconstruct_tile, typical_white};
pub use usage::{Usage, peak_rss_bytes};
pub use worker::{Worker, WorkerError};
