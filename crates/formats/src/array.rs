//! Arrays in any order of their axes, read frame by frame.

use std::io::{self, Read, Seek};
use std::ops::Range;

use ndarray::Array2;

use super::axes::{Arranged, Layout};
use super::samples::{self, ByteOrder};
use super::{Format, FrameReader, Limits, SampleType, StackInfo};
use crate::error::Result;

/// The samples of an array as numbers, in the order in which they are stored.
pub(super) trait Samples {
    /// Goes back to the first one.
    fn rewind(&mut self) -> Result<()>;

    /// The next `count` samples: those of whole entries of the axis that varies slowest.
    fn read(&mut self, count: usize) -> Result<Vec<f32>>;

    /// Checks what follows the last sample.
    fn finish(&mut self) -> Result<()> {
        Ok(())
    }
}

/// Bytes that can be read again from the start: of a file, or of a member of an archive.
pub(super) trait Restart: Read + Send {
    /// Goes back to the first byte.
    fn restart(&mut self) -> io::Result<()>;
}

impl<R: Read + Seek + Send> Restart for R {
    fn restart(&mut self) -> io::Result<()> {
        self.rewind()
    }
}

/// Samples as they lie in memory, behind a header.
pub(super) struct RawSamples<R> {
    file: R,
    /// Where they begin.
    start: u64,
    sample: SampleType,
    order: ByteOrder,
    format: Format,
}

impl<R: Restart> RawSamples<R> {
    /// Of a file that stands at the first one, which is at byte `start`.
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
        // At the end of a member its checksum is looked at.
        let rest = self.file.read(&mut [0]);
        rest.map(drop).map_err(|error| samples::read_error(self.format, error))
    }
}

/// An array as a stack of frames. Where the frames of a pixel lie together, several frames are kept of each pass
/// over the file.
pub(super) struct ArrayReader<S> {
    samples: S,
    info: StackInfo,
    layout: Layout,
    next: usize,
    kept: Vec<f32>,
    /// The first frame that is kept, and the one behind the last.
    range: Range<usize>,
}

/// Bytes of the frames that are kept, unless more are needed for [`MOST_PASSES`].
const KEPT_BYTES: usize = if cfg!(test) { 200 } else { 64 << 20 };
/// Passes over a file. So at most a sixteenth of an array is kept, 512 MiB with the default limits.
const MOST_PASSES: usize = 16;
/// Bytes that are read at a time, unless a line of pixels with all their frames takes more.
const BLOCK_BYTES: usize = if cfg!(test) { 100 } else { 1 << 20 };

/// What an arranged array is as a stack. Errors: sizes beyond the limits.
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
    /// Of samples that stand at the first one.
    pub(super) fn new(samples: S, info: StackInfo, layout: Layout) -> Self {
        Self { samples, info, layout, next: 0, kept: Vec::new(), range: 0..0 }
    }

    /// Reads the array from the front and keeps frames from this one on.
    fn gather(&mut self, first: usize) -> Result<()> {
        let StackInfo { frames, height, width, .. } = self.info;
        let (pixels, by_columns) = (height * width, self.layout.by_columns);
        let count = (KEPT_BYTES / (pixels * size_of::<f32>()))
            .max(frames.div_ceil(MOST_PASSES))
            .clamp(1, frames - first);
        self.kept.clear();
        self.kept.resize(count * pixels, 0.0);
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
                    self.kept[frame * pixels + pixel] = *value;
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
                self.gather(frame)?;
            }
            let values = &self.kept[(frame - self.range.start) * pixels..][..pixels];
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
