//! Reads arrays with any order of axes frame by frame.

use std::io::{self, Read, Seek};
use std::ops::Range;

use ndarray::Array2;

use super::axes::{Arranged, Layout};
use super::samples::{self, ByteOrder};
use super::{Format, FrameReader, Limits, SampleType, StackInfo};
use crate::error::Result;

/// The samples of an array in the order in which they are stored.
pub(super) trait Samples {
    /// Returns to the first sample.
    fn rewind(&mut self) -> Result<()>;

    /// Reads the next `count` samples, which are whole entries of the slowest axis.
    fn read(&mut self, count: usize) -> Result<Vec<f32>>;

    /// Checks the end of the data after the last sample.
    fn finish(&mut self) -> Result<()> {
        Ok(())
    }
}

/// A source of bytes that can be read again from the start.
pub(super) trait Restart: Read + Send {
    /// Returns to the first byte.
    fn restart(&mut self) -> io::Result<()>;
}

impl<R: Read + Seek + Send> Restart for R {
    fn restart(&mut self) -> io::Result<()> {
        self.rewind()
    }
}

/// Uncompressed samples after a header.
pub(super) struct RawSamples<R> {
    file: R,
    /// Offset of the first sample.
    start: u64,
    sample: SampleType,
    order: ByteOrder,
    format: Format,
}

impl<R: Restart> RawSamples<R> {
    /// Samples of a file that is positioned at the first one, at byte `start`.
    pub(super) fn new(
        file: R,
        start: u64,
        (sample, order): (SampleType, ByteOrder),
        format: Format,
    ) -> Self {
        Self { file, start, sample, order, format }
    }
}

impl<R: Restart> Samples for RawSamples<R> {
    fn rewind(&mut self) -> Result<()> {
        let restarted = self
            .file
            .restart()
            .and_then(|()| io::copy(&mut self.file.by_ref().take(self.start), &mut io::sink()));
        restarted.map(drop).map_err(|error| samples::read_error(self.format, error))
    }

    fn read(&mut self, count: usize) -> Result<Vec<f32>> {
        let mut bytes = vec![0; count * self.sample.bytes()];
        let filled = self.file.read_exact(&mut bytes);
        filled.map_err(|error| samples::read_error(self.format, error))?;
        Ok(samples::decode(&bytes, self.sample, self.order))
    }

    fn finish(&mut self) -> Result<()> {
        // Reading to the end of an archive member checks its checksum.
        let rest = self.file.read(&mut [0]);
        rest.map(drop).map_err(|error| samples::read_error(self.format, error))
    }
}

/// Reads an array as a stack of frames. If the frames of a pixel are adjacent in the file, each pass over the file
/// extracts several frames.
pub(super) struct ArrayReader<S> {
    samples: S,
    info: StackInfo,
    layout: Layout,
    next: usize,
    /// Frames that the last pass has extracted.
    buffer: Vec<f32>,
    /// Indices of these frames.
    range: Range<usize>,
}

/// Size of the extracted frames in bytes. More are extracted if [`MAX_PASSES`] requires it.
const BUFFER_BYTES: usize = if cfg!(test) { 200 } else { 64 << 20 };
/// Largest number of passes over a file. The buffer is therefore at most a sixteenth of an array, or 512 MiB with the
/// default limits, above [`BUFFER_BYTES`].
const MAX_PASSES: usize = 16;
/// Number of bytes that are read at a time, but at least one line of pixels with all their frames.
const BLOCK_BYTES: usize = if cfg!(test) { 100 } else { 1 << 20 };

/// The stack that an array represents. Errors: [`FormatError`](super::FormatError) for sizes beyond the limits.
pub(super) fn info(
    format: Format,
    sample: SampleType,
    arranged: &Arranged,
    limits: &Limits,
) -> Result<StackInfo> {
    let Arranged { frames, height, width, axes, .. } = *arranged;
    limits.check_shape(format, frames, height, width)?;
    let [frames, height, width] =
        [frames, height, width].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
    Ok(StackInfo { axes, ..StackInfo::new(format, sample, frames, height, width) })
}

impl<S: Samples> ArrayReader<S> {
    /// A reader of samples that are positioned at the first one.
    pub(super) fn new(samples: S, info: StackInfo, layout: Layout) -> Self {
        Self { samples, info, layout, next: 0, buffer: Vec::new(), range: 0..0 }
    }

    /// Makes a pass over the array, and extracts frames from `first` on.
    fn extract(&mut self, first: usize) -> Result<()> {
        let StackInfo { frames, height, width, .. } = self.info;
        let (pixels, by_columns) = (height * width, self.layout.by_columns);
        let count = (BUFFER_BYTES / (pixels * size_of::<f32>()))
            .max(frames.div_ceil(MAX_PASSES))
            .clamp(1, frames - first);
        self.buffer.clear();
        self.buffer.resize(count * pixels, 0.0);
        self.range = first..first + count;
        self.samples.rewind()?;
        let (lines, line) = if by_columns { (width, height) } else { (height, width) };
        let block = (BLOCK_BYTES / (line * frames * size_of::<f32>())).clamp(1, lines);
        for begin in (0..lines).step_by(block) {
            let count = block.min(lines - begin);
            let values = self.samples.read(count * line * frames)?;
            for (place, values) in (begin * line..).zip(values.chunks_exact(frames)) {
                let pixel =
                    if by_columns { place % height * width + place / height } else { place };
                for (frame, value) in values[self.range.clone()].iter().enumerate() {
                    self.buffer[frame * pixels + pixel] = *value;
                }
            }
        }
        self.samples.finish()
    }
}

impl<S: Samples> FrameReader for ArrayReader<S> {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let StackInfo { frames, height, width, .. } = self.info;
        if self.next == frames {
            return Ok(None);
        }
        let (frame, pixels) = (self.next, height * width);
        self.next += 1;
        if self.layout.interleaved {
            if !self.range.contains(&frame) {
                self.extract(frame)?;
            }
            let values = &self.buffer[(frame - self.range.start) * pixels..][..pixels];
            return samples::frame(height, width, values.to_vec()).map(Some);
        }
        let values = self.samples.read(pixels)?;
        if self.next == frames {
            self.samples.finish()?;
        }
        if self.layout.by_columns {
            let columns = samples::frame(width, height, values)?;
            return Ok(Some(columns.t().as_standard_layout().into_owned()));
        }
        samples::frame(height, width, values).map(Some)
    }
}
