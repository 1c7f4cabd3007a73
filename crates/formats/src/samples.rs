//! Conversion of samples: from bytes of any accepted type to f32, and from f32 to little-endian bytes.

use std::io::{self, ErrorKind, Write};

use half::f16;
use ndarray::{Array2, ArrayView2};

use super::{Format, FormatError, SampleType};
use crate::error::Result;

/// The byte order of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// Decodes samples to f32. An incomplete last sample is ignored.
pub(super) fn decode(bytes: &[u8], sample: SampleType, order: ByteOrder) -> Vec<f32> {
    macro_rules! numbers {
        ($type:ty, $convert:expr) => {
            match order {
                ByteOrder::Little => each(bytes, |b| $convert(<$type>::from_le_bytes(b))),
                ByteOrder::Big => each(bytes, |b| $convert(<$type>::from_be_bytes(b))),
            }
        };
    }
    match sample {
        SampleType::Bool => bytes.iter().map(|&b| f32::from(u8::from(b != 0))).collect(),
        SampleType::U8 => bytes.iter().map(|&b| f32::from(b)).collect(),
        SampleType::I8 => numbers!(i8, f32::from),
        SampleType::U16 => numbers!(u16, f32::from),
        SampleType::I16 => numbers!(i16, f32::from),
        SampleType::U32 => numbers!(u32, |number| number as f32),
        SampleType::I32 => numbers!(i32, |number| number as f32),
        SampleType::U64 => numbers!(u64, |number| number as f32),
        SampleType::I64 => numbers!(i64, |number| number as f32),
        SampleType::F16 => numbers!(f16, f16::to_f32),
        SampleType::F32 => numbers!(f32, f32::from),
        SampleType::F64 => numbers!(f64, |number| number as f32),
    }
}

/// Converts each sample of N bytes.
pub(super) fn each<const N: usize>(bytes: &[u8], convert: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let (samples, _) = bytes.as_chunks::<N>();
    samples.iter().map(|&sample| convert(sample)).collect()
}

/// A frame (row, column) from its samples in row order.
pub(super) fn frame(height: usize, width: usize, samples: Vec<f32>) -> Result<Array2<f32>> {
    let count = samples.len();
    Array2::from_shape_vec((height, width), samples).map_err(|_| {
        FormatError::Internal(format!("{count} samples for a frame of {height}x{width}"))
    })
}

/// Converts an I/O error of a reader. Decompressors report invalid data as I/O errors, too; only errors of the
/// operating system have a number.
pub(super) fn read_error(format: Format, source: io::Error) -> FormatError {
    if source.raw_os_error().is_some() {
        return FormatError::Io { action: "read the file", source };
    }
    match source.kind() {
        ErrorKind::UnexpectedEof => FormatError::Truncated {
            format,
            promised: "more samples".to_owned(),
            present: "no more bytes".to_owned(),
        },
        _ => FormatError::malformed(format, format!("compressed data: {source}")),
    }
}

/// Writes the frames of a stack as little-endian f32, after a header from [`super::planar::writer`] or
/// [`super::npy::writer`].
#[derive(Debug)]
pub struct StackWriter<W> {
    writer: W,
    frames: usize,
    height: usize,
    width: usize,
    written: usize,
    row: Vec<u8>,
}

impl<W: Write> StackWriter<W> {
    pub(super) fn new(writer: W, frames: usize, height: usize, width: usize) -> Self {
        Self { writer, frames, height, width, written: 0, row: Vec::with_capacity(width * 4) }
    }

    /// Appends one frame (row, column).
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a frame of another size, or one too many.
    pub fn write_frame(&mut self, frame: ArrayView2<'_, f32>) -> Result<()> {
        if frame.dim() != (self.height, self.width) || self.written == self.frames {
            return Err(FormatError::Internal(format!(
                "frame {} of size {:?} does not fit a stack of {} frames of {}x{}",
                self.written,
                frame.dim(),
                self.frames,
                self.height,
                self.width
            )));
        }
        self.write_rows(frame).map_err(FormatError::io("write the frame"))?;
        self.written += 1;
        Ok(())
    }

    fn write_rows(&mut self, frame: ArrayView2<'_, f32>) -> io::Result<()> {
        for row in frame.rows() {
            self.row.clear();
            self.row.extend(row.iter().flat_map(|v| v.to_le_bytes()));
            self.writer.write_all(&self.row)?;
        }
        Ok(())
    }

    /// Flushes and returns the writer.
    ///
    /// Errors: I/O; [`FormatError::Internal`] if frames are missing.
    pub fn finish(mut self) -> Result<W> {
        if self.written != self.frames {
            return Err(FormatError::Internal(format!(
                "only {} of {} frames were written",
                self.written, self.frames
            )));
        }
        self.writer.flush().map_err(FormatError::io("write the file"))?;
        Ok(self.writer)
    }
}
