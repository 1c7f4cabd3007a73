//! From a snapshot to its frames: the network, the pilot, the tiles, and the files of a result.
//!
//! The command line and the workers share these steps, so that a job gives the same frames
//! whichever way it came.

mod camera;
pub mod history;
mod learned;
pub mod manifest;
pub mod models;
pub mod networks;
pub mod pilot;
mod share;
mod snapshot;
pub mod tile;
mod usage;
mod write;

pub use learned::{ModelFile, run_network};
pub use networks::{NetworkError, NetworkSource, WarmNetworks};
pub use share::ShareDone;
pub use snapshot::{SnapshotInput, SolveError, Solved, Solver, TileProgress, blended_frame, solve};
pub use tile::{TileInput, TileOutcome, reconstruct_tile, typical_white};
pub use usage::{Usage, peak_rss_bytes};
pub use write::{
    ResultError, ResultFile, ResultSpec, check_output, replace_result, sha256_of, write_result,
};
