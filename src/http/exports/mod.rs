//! Results in the forms of other programs, made as they are read, so that nothing of them lies on the disk;
//! but for movies, which take too long.

mod archive;
mod clip;
mod composed;
mod exr;
mod lines;
mod movie;

pub(super) use archive::archive;
pub(super) use clip::{array, chunk, tiff, zarr};
pub(super) use exr::exr;
pub(super) use movie::movie;
