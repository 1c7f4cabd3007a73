//! Results in the forms of other programs, made as they are read: nothing of them lies on the disk.

mod archive;
mod clip;
mod composed;

pub(super) use archive::archive;
pub(super) use clip::{array, chunk, tiff, zarr};
