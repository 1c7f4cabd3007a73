//! Bytes and files to arrays and back, within [`Limits`].
//!
//! Inputs ([`open_stack`], [`mat`]) come from strangers: every claim of a header is checked against
//! the limits and the file's real length before memory is taken, and stacks are read one frame at
//! a time. [`validate`] brings raw frames onto their scale and refuses what cannot be a mask or a
//! measurement. Outputs are EXR, npy, PNG, BigTIFF, movies and prepared arrays ([`planar`]).
//!
//! Arrays are f32 with axes (frame, row, column); see [`Channels`] for those of
//! colours.

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
mod npz;
mod open;
mod pictures;
mod samples;
mod scene;
mod stack;
mod tar;
mod window;
mod zip;

pub mod bigtiff;
pub mod exr;
pub mod mat;
pub mod movie;
pub mod npy;
pub mod planar;
pub mod png;
#[cfg(test)]
mod test_support;
mod tiff;
pub mod validate;

pub use axes::{Axes, Expected};
pub use channels::Channels;
pub use colour::open_colours;
pub use error::FormatError;
pub use format::Format;
pub use limits::Limits;
pub use open::{Wanted, collect, open_array, open_stack, read_stack};
pub use samples::StackWriter;
pub use stack::{FrameReader, FullScale, SampleType, StackInfo};
pub use window::WindowReader;
