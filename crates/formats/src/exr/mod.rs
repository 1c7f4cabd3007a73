//! OpenEXR: 32-bit float frames, one a file or one a part, with their provenance as attributes.
//!
//! Every part has one channel `Y`, or the channels `R`, `G` and `B`, in scan lines. Values survive bit for bit.

mod head;
mod layer;
mod order;
mod read;
mod write;

pub use layer::{Layered, SIGMA};
pub use read::{Part, read_stack};
pub use write::{Attributes, write_frame, write_stack};

use super::Channels;

/// What OpenEXR calls the channels, in the order of the alphabet, in which they lie in a file, and the place of
/// each among the values of a pixel.
fn names(channels: Channels) -> &'static [(&'static str, usize)] {
    match channels {
        // Luminance.
        Channels::Grey => &[("Y", 0)],
        Channels::Rgb => &[("B", 2), ("G", 1), ("R", 0)],
    }
}

/// The attribute that holds a frame's time, a double, in seconds.
const FRAME_TIME: &str = "frameTime";

#[cfg(test)]
mod tests;
