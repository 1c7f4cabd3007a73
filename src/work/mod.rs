//! The work itself: solving tiles, writing results, and what is recorded about them.
//!
//! The command line and the worker processes share everything here, so that a job gives the
//! same frames whichever way it came.

mod network;
mod result;
mod share;
mod snapshot;
mod tile;
mod usage;

pub mod manifest;

pub use network::{NetworkError, NetworkSource};
pub use result::{
    ResultError, ResultFile, ResultSpec, check_output, replace_result, sha256_of, write_result,
};
pub use share::ShareDone;
pub use snapshot::{SnapshotInput, SolveError, TileProgress, blended_frame, solve};
pub use tile::{TileInput, TileOutcome, reconstruct_tile, typical_white};
pub use usage::{Usage, peak_rss_bytes};
