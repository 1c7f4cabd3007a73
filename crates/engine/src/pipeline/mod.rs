//! The steps from snapshots to frames: white level, pilot, tiles, blending, and the files of a result.
//!
//! The command line and the workers share these steps, so both give the same frames. The steps work on arrays and
//! files, and know neither the store nor the queue.

pub mod arrays;
pub mod assessment;
pub mod blend;
pub mod derived;
pub mod error;
pub mod manifest;
pub mod movie;
pub mod networks;
pub mod pilot;
pub mod preview;
pub mod progress;
pub mod quality;
pub mod records;
pub mod registration;
pub mod residual;
pub mod scale;
pub mod sequence;
pub mod tile;
pub mod usage;
pub mod verify;
pub mod write;

pub use error::PipelineError;
pub use networks::NetworkSource;
