//! Bytes and files to arrays and back, within [`Limits`].
//!
//! Inputs ([`open_stack`], [`mat`]) come from strangers: every claim of a header is checked against
//! the limits and the file's real length before memory is taken, and stacks are read one frame at
//! a time. [`validate`] brings raw frames onto their scale and refuses what cannot be a mask or a
//! measurement. Outputs are EXR, npy, PNG and prepared arrays ([`planar`]).
//!
//! Arrays are f32 with axes (frame, row, column).

mod error;
mod limits;
mod samples;
mod stack;
mod window;

pub mod exr;
pub mod mat;
pub mod npy;
pub mod planar;
pub mod png;
#[cfg(test)]
mod test_support;
mod tiff;
pub mod validate;

use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

use ndarray::Array3;

pub use error::FormatError;
pub use limits::Limits;
pub use stack::{Format, FrameReader, FullScale, SampleType, StackInfo};
pub use window::WindowReader;

const ACCEPTED: &str = "npy, TIFF, PNG (8 or 16 bit grey) and .mat level 5";

/// Opens a stack of frames. The format is told by the file's first bytes, never by its name.
///
/// npy: (frame, row, column) or (row, column) of uint8, uint16, float32, float64 or bool. TIFF and
/// BigTIFF: pages of one size and type, grey, uint8, uint16 or float32. PNG: one grey frame of 8
/// or 16 bit. Errors say what is wrong with the file; see [`FormatError`].
pub fn open_stack(
    path: &Path,
    limits: &Limits,
) -> Result<Box<dyn FrameReader + Send>, FormatError> {
    let (file, length, format) = open(path)?;
    limits.check_file(format, length)?;
    match format {
        Format::Npy => Ok(Box::new(npy::NpyReader::open(file, length, limits)?)),
        Format::Tiff => Ok(Box::new(tiff::TiffReader::open(file, length, limits)?)),
        Format::Png => Ok(Box::new(png::PngReader::open(file, length, limits)?)),
        Format::Mat => Err(FormatError::Unsupported {
            format,
            found: "a scene of several arrays".to_owned(),
            accepted: "one stack a file here; name the file as a .mat scene",
        }),
        Format::Exr | Format::Planar => Err(FormatError::UnknownFormat {
            found: format!("it is a {format} file"),
            accepted: ACCEPTED,
        }),
    }
}

/// Reads a whole stack into memory, axes (frame, row, column), values as stored.
///
/// For files that are known to be small; large ones are read with [`open_stack`].
pub fn read_stack(path: &Path, limits: &Limits) -> Result<(StackInfo, Array3<f32>), FormatError> {
    collect(&mut *open_stack(path, limits)?)
}

/// Reads the remaining frames of a reader into one array.
pub fn collect(
    reader: &mut (dyn FrameReader + Send),
) -> Result<(StackInfo, Array3<f32>), FormatError> {
    let info = *reader.info();
    // Grown frame by frame: a compressed file may promise far more than it then delivers.
    let mut values = Vec::new();
    let mut frames = 0;
    while let Some(frame) = reader.next_frame()? {
        values.extend(frame.iter());
        frames += 1;
    }
    let stack = Array3::from_shape_vec((frames, info.height, info.width), values)
        .map_err(|error| FormatError::Internal(error.to_string()))?;
    Ok((info, stack))
}

/// Opens a file and tells its length and format.
fn open(path: &Path) -> Result<(File, u64, Format), FormatError> {
    let mut file = File::open(path).map_err(FormatError::io("open the file"))?;
    let metadata = file.metadata().map_err(FormatError::io("read the file's length"))?;
    let unknown = |found: String| FormatError::UnknownFormat { found, accepted: ACCEPTED };
    if !metadata.is_file() {
        return Err(unknown("it is no regular file".to_owned()));
    }
    if metadata.len() == 0 {
        return Err(unknown("it is empty".to_owned()));
    }
    let mut head = Vec::with_capacity(128);
    (&mut file).take(128).read_to_end(&mut head).map_err(FormatError::io("read the file"))?;
    file.rewind().map_err(FormatError::io("read the file"))?;
    let format = Format::sniff(&head).ok_or_else(|| unknown(describe(&head)))?;
    Ok((file, metadata.len(), format))
}

/// What a file of an unknown format begins with.
fn describe(head: &[u8]) -> String {
    if head.starts_with(b"\x89HDF\r\n\x1a\n") || head.starts_with(b"MATLAB 7.3") {
        return "it is HDF5 or a .mat level 7.3 file (save with -v7 instead)".to_owned();
    }
    if head.starts_with(b"PK\x03\x04") {
        return "it is a zip archive, perhaps .npz (save one array as .npy instead)".to_owned();
    }
    if head.starts_with(b"\xff\xd8\xff") {
        return "it is a JPEG, which changes the values it stores".to_owned();
    }
    let start: Vec<String> = head.iter().take(8).map(|b| format!("{b:02x}")).collect();
    format!("it begins with the bytes {}", start.join(" "))
}
