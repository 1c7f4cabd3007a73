//! OpenEXR: 32-bit float frames, one per file or one per part, with their provenance as attributes.
//!
//! Every part has the channel `Y`, a channel with the name of a wavelength, or the channels `R`, `G` and `B`, in scan lines. Values are stored bit for bit.

mod head;
mod layer;
mod order;
mod read;
mod write;

pub use layer::{Layered, SIGMA};
pub use read::{Part, read_stack};
pub use write::{Attributes, write_frame, write_stack};

use super::Channels;

/// Names of the channels in OpenEXR in their stored, alphabetical order, each with its index among the values of a
/// pixel.
fn names(channels: Channels) -> &'static [(&'static str, usize)] {
    match channels {
        Channels::Grey => &[("Y", 0)],
        Channels::Rgb => &[("B", 2), ("G", 1), ("R", 0)],
    }
}

/// Name of the attribute for the time of a frame in seconds (double).
const FRAME_TIME: &str = "frameTime";

#[cfg(test)]
mod tests;
