//! Prepared arrays: raw f32 frames after a small header. Windows can be read without reading the rest.
//!
//! The layout is little-endian: the magic `SCIPLNR\0`; version (1), frames, height and width as u32; two reserved u32
//! (zero); the samples as f32 in the order (frame, row, column). Writers must publish such a file atomically (temporary
//! file, fsync, rename).

use std::fs::File;
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::Path;

use super::format::PLANAR_MAGIC;
use super::samples::StackWriter;
use super::{Format, FormatError, Limits, SampleType, StackInfo};
use crate::error::Result;

const VERSION: u32 = 1;
/// Length of the header in bytes.
pub const HEADER_BYTES: u64 = 32;
const SAMPLE_BYTES: u64 = 4;

/// Writes the header of a prepared array, and returns a writer for its frames. `to` should be buffered. It is written
/// sequentially, so it can hash the content.
///
/// Errors: I/O; [`FormatError::Internal`] for an axis longer than 32 bits allow.
pub fn writer<W: Write>(
    mut to: W,
    frames: usize,
    height: usize,
    width: usize,
) -> Result<StackWriter<W>> {
    let mut header = PLANAR_MAGIC.to_vec();
    header.extend(VERSION.to_le_bytes());
    for axis in [frames, height, width] {
        let axis = u32::try_from(axis)
            .map_err(|_| FormatError::Internal(format!("an axis of length {axis} is too long")))?;
        header.extend(axis.to_le_bytes());
    }
    header.extend([0; 8]);
    to.write_all(&header).map_err(FormatError::io("write the header"))?;
    Ok(StackWriter::new(to, frames, height, width))
}

/// Size of the file of a prepared array, in bytes.
pub fn bytes(info: &StackInfo) -> u64 {
    HEADER_BYTES + info.voxels() * SAMPLE_BYTES
}

/// An open prepared array.
pub use super::WindowReader as Reader;

impl Reader {
    /// Opens a prepared array, and checks its header against the limits and the length of the file.
    ///
    /// Errors: [`FormatError`].
    pub fn open(path: &Path, limits: &Limits) -> Result<Self> {
        let file = File::open(path).map_err(FormatError::io("open the prepared array"))?;
        let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
        limits.check_file(Format::Planar, length)?;
        let mut header = [0; HEADER_BYTES as usize];
        if length < HEADER_BYTES {
            return Err(FormatError::malformed(
                Format::Planar,
                format!(
                    "the file has {length} bytes, fewer than its header of {HEADER_BYTES} bytes"
                ),
            ));
        }
        file.read_exact_at(&mut header, 0).map_err(FormatError::io("read the header"))?;
        let info = parse_header(&header)?;
        limits.check_info(&info)?;
        let promised = bytes(&info);
        let shape = format!("{} frames of {}x{}", info.frames, info.height, info.width);
        if length < promised {
            return Err(FormatError::Truncated {
                format: Format::Planar,
                promised: format!("{shape} ({promised} bytes with the header)"),
                present: format!("{length} bytes"),
            });
        }
        if length > promised {
            return Err(FormatError::malformed(
                Format::Planar,
                format!("{} bytes follow the {shape}", length - promised),
            ));
        }
        Ok(Self::new(file, info, HEADER_BYTES))
    }
}

fn parse_header(header: &[u8; HEADER_BYTES as usize]) -> Result<StackInfo> {
    if !header.starts_with(PLANAR_MAGIC) {
        return Err(FormatError::malformed(Format::Planar, "the signature is wrong"));
    }
    let (words, _) = header[PLANAR_MAGIC.len()..].as_chunks::<4>();
    let word = |i: usize| words.get(i).map_or(0, |w| u32::from_le_bytes(*w));
    if word(0) != VERSION {
        return Err(FormatError::Unsupported {
            format: Format::Planar,
            found: format!("version {}", word(0)),
            accepted: "version 1",
        });
    }
    let [frames, height, width] = [1, 2, 3].map(|i| word(i) as usize);
    Ok(StackInfo::new(Format::Planar, SampleType::F32, frames, height, width))
}

#[cfg(test)]
mod tests;
