//! Prepared arrays: raw f32 frames behind a small header, from which a window is read without
//! reading the rest.
//!
//! Layout, all little-endian: the magic `SCIPLNR\0`, then u32 version (1), frames, height, width,
//! then two reserved u32 (zero), then the samples as f32 in the order (frame, row, column).
//! Whoever writes such a file makes it appear at once (temporary file, fsync, rename).

use std::fs::File;
use std::io::Write;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;

use ndarray::Array3;

use super::format::PLANAR_MAGIC;
use super::samples::StackWriter;
use super::{Format, FormatError, Limits, SampleType, StackInfo, WindowReader};
use crate::error::Result;

const VERSION: u32 = 1;
const HEADER_BYTES: u64 = 32;
const SAMPLE_BYTES: u64 = 4;

/// Writes the header of a prepared array; the frames come next. `to` should be buffered; it only ever
/// moves forward, so it may hash what passes.
pub fn writer<W: Write>(
    mut to: W,
    frames: usize,
    height: usize,
    width: usize,
) -> Result<StackWriter<W>> {
    let mut header = PLANAR_MAGIC.to_vec();
    header.extend(VERSION.to_le_bytes());
    for axis in [frames, height, width] {
        let axis =
            u32::try_from(axis).map_err(|_| FormatError::Internal(format!("an axis of {axis}")))?;
        header.extend(axis.to_le_bytes());
    }
    header.extend([0; 8]);
    to.write_all(&header).map_err(FormatError::io("write the header"))?;
    Ok(StackWriter::new(to, frames, height, width))
}

/// Bytes of a prepared array of this shape.
pub fn bytes(info: &StackInfo) -> u64 {
    HEADER_BYTES + info.voxels() * SAMPLE_BYTES
}

/// An open prepared array. Reads at positions, so it may be shared between threads.
#[derive(Debug)]
pub struct Reader {
    windows: WindowReader,
}

impl Reader {
    /// Opens `path` and checks its header against the limits and the file's length.
    pub fn open(path: &Path, limits: &Limits) -> Result<Self> {
        let file = File::open(path).map_err(FormatError::io("open the prepared array"))?;
        let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
        limits.check_file(Format::Planar, length)?;
        let mut header = [0; HEADER_BYTES as usize];
        if length < HEADER_BYTES {
            return Err(FormatError::malformed(
                Format::Planar,
                format!("{length} bytes are less than a header of {HEADER_BYTES}"),
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
        Ok(Self { windows: WindowReader::new(file, info, HEADER_BYTES) })
    }

    /// Shape and type (always float32 on the scale that the writer chose).
    pub fn info(&self) -> &StackInfo {
        self.windows.info()
    }

    /// The same without the format's name, for those who read windows of several formats.
    pub fn into_windows(self) -> WindowReader {
        self.windows
    }

    /// Reads a window; the result has the axes (frame, row, column) of the ranges.
    ///
    /// Errors: I/O, or [`FormatError::Internal`] for a window that is not inside the stack.
    pub fn read_window(
        &self,
        frames: Range<usize>,
        rows: Range<usize>,
        columns: Range<usize>,
    ) -> Result<Array3<f32>> {
        self.windows.read_window(frames, rows, columns)
    }

    /// Reads every `step`th row and column of a window; see [`WindowReader::read_lattice`].
    pub fn read_lattice(
        &self,
        frames: Range<usize>,
        place: (Range<usize>, Range<usize>),
        step: usize,
    ) -> Result<Array3<f32>> {
        self.windows.read_lattice(frames, place, step)
    }
}

/// Opens `path` and reads one window; see [`Reader::read_window`].
pub fn read_window(
    path: &Path,
    frames: Range<usize>,
    rows: Range<usize>,
    columns: Range<usize>,
    limits: &Limits,
) -> Result<Array3<f32>> {
    Reader::open(path, limits)?.read_window(frames, rows, columns)
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
