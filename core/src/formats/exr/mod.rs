//! OpenEXR: 32-bit float frames, one a file or one a part, with their provenance as attributes.
//!
//! Every part has one channel `Y`, in scan lines. Values survive bit for bit.

mod order;
mod read;
mod write;

pub use read::{Part, read_stack};
pub use write::{Attributes, write_frame, write_stack};

/// The only channel, OpenEXR's name for luminance.
const CHANNEL: &str = "Y";
/// The attribute that holds a frame's time, a double, in seconds.
const FRAME_TIME: &str = "frameTime";

#[cfg(test)]
mod tests;
