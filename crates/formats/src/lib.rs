//! File formats: converts files to arrays and back, within [`Limits`].
//!
//! Input files ([`open_stack`], [`mat`]) are untrusted. Every claim of a header is checked against the limits and the
//! length of the file before memory is allocated. Stacks are read one frame at a time. [`validate`] scales raw frames,
//! and refuses invalid masks and measurements. Output formats are EXR, npy, PNG, BigTIFF, movies, and prepared arrays
//! ([`planar`]).
//!
//! Arrays are f32 with the axes (frame, row, column). See [`Channels`] for colour frames.

#![warn(missing_docs)]

mod array;
mod axes;
mod channels;
mod colour;
mod error;
mod format;
mod hdf5;
mod limits;
mod member;
mod natural;
mod npz;
mod open;
mod photo;
mod pictures;
mod samples;
mod scene;
mod selection;
mod stack;
mod tar;
mod window;
mod zip;

pub mod clip_tiff;
pub mod display;
pub mod exr;
pub mod gif;
pub mod mat;
pub mod movie;
pub mod npy;
pub mod planar;
mod png;
#[cfg(test)]
#[path = "tests/support.rs"]
mod test_support;
mod tiff;
pub mod validate;

pub use axes::{Axes, Expected};
pub use channels::Channels;
pub use colour::open_colours;
pub use error::{DiskTrouble, FormatError, Lightless};
pub use format::Format;
pub use limits::Limits;
pub use natural::natural_key;
pub use open::{Wanted, collect, open_array, open_file, open_shown, open_stack, read_stack};
pub use samples::StackWriter;
pub use selection::{Crop, Packing, Selection};
pub use stack::{FrameReader, Frames, FullScale, Reader, SampleType, StackInfo};
pub use window::WindowReader;
