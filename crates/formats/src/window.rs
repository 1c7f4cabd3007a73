//! Reads windows of raw f32 stacks without reading the rest.

use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;

use ndarray::Array3;

use super::samples::{self, ByteOrder};
use super::{FormatError, SampleType, StackInfo};
use crate::error::Result;

const SAMPLE_BYTES: u64 = 4;

/// A file with little-endian f32 samples in the order (frame, row, column). Reads are positional, so threads can share
/// it.
#[derive(Debug)]
pub struct WindowReader {
    file: File,
    info: StackInfo,
    /// Offset of the values of the first row.
    start: u64,
    /// Bytes from one row to the next.
    row_bytes: u64,
    /// Each row has the values of one channel after another. These are their places among the values of a pixel.
    channels: Vec<usize>,
}

impl WindowReader {
    /// A reader of a file after a check of its header. All samples follow each other from byte `start` on.
    pub(super) fn new(file: File, info: StackInfo, start: u64) -> Self {
        let row_bytes = info.width as u64 * SAMPLE_BYTES;
        Self::with_layout(file, info, (start, row_bytes), vec![0])
    }

    /// A reader of a file with other bytes between rows. `channels` has the places of the stored channels among the
    /// values of a pixel.
    pub(super) fn with_layout(
        file: File,
        info: StackInfo,
        (start, row_bytes): (u64, u64),
        channels: Vec<usize>,
    ) -> Self {
        Self { file, info, start, row_bytes, channels }
    }

    /// The description of the stack.
    pub fn info(&self) -> &StackInfo {
        &self.info
    }

    /// Reads a window (frame, row, column).
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a window outside the stack.
    pub fn read_window(
        &self,
        frames: Range<usize>,
        rows: Range<usize>,
        columns: Range<usize>,
    ) -> Result<Array3<f32>> {
        self.read_lattice(frames, (rows, columns), 1)
    }

    /// Reads every `step`th row and column of a window, starting with the first ones.
    ///
    /// Errors: as [`Self::read_window`].
    pub fn read_lattice(
        &self,
        frames: Range<usize>,
        (rows, columns): (Range<usize>, Range<usize>),
        step: usize,
    ) -> Result<Array3<f32>> {
        let (height, width) = (self.info.height, self.info.width);
        let inside = |range: &Range<usize>, axis| range.start <= range.end && range.end <= axis;
        if !(inside(&frames, self.info.frames) && inside(&rows, height) && inside(&columns, width))
        {
            return Err(FormatError::Internal(format!(
                "the window {frames:?} x {rows:?} x {columns:?} is outside the stack of {} x {height} x {width}",
                self.info.frames
            )));
        }
        let step = step.max(1);
        let shape = (frames.len(), rows.len().div_ceil(step), columns.len().div_ceil(step));
        // Whole rows are read together if nothing lies between them.
        let is_dense = self.channels.len() == 1 && self.row_bytes == width as u64 * SAMPLE_BYTES;
        let adjacent = if is_dense && columns.len() == width && step == 1 { rows.len() } else { 1 };
        let mut values = Vec::with_capacity(shape.0 * shape.1 * shape.2);
        for frame in frames {
            for row in rows.clone().step_by(step.max(adjacent)) {
                let row = (frame * height + row) as u64;
                let read = self.read_rows(row, adjacent, &columns)?;
                values.extend(read.into_iter().step_by(step));
            }
        }
        Array3::from_shape_vec(shape, values)
            .map_err(|error| FormatError::Internal(error.to_string()))
    }

    /// Reads these columns of a row, or of some adjacent rows without gaps.
    fn read_rows(&self, row: u64, rows: usize, columns: &Range<usize>) -> Result<Vec<f32>> {
        let count = self.channels.len();
        let pixels = columns.start / count..columns.end.div_ceil(count);
        let mut bytes = vec![0; rows * pixels.len() * SAMPLE_BYTES as usize];
        let mut values = vec![0.0; rows * pixels.len() * count];
        for (stored, place) in self.channels.iter().enumerate() {
            let sample = stored * (self.info.width / count) + pixels.start;
            let offset = self.start + row * self.row_bytes + sample as u64 * SAMPLE_BYTES;
            let read = self.file.read_exact_at(&mut bytes, offset);
            read.map_err(FormatError::io("read the window"))?;
            let channel = samples::decode(&bytes, SampleType::F32, ByteOrder::Little);
            if count == 1 {
                return Ok(channel);
            }
            let pixels = values.iter_mut().skip(*place).step_by(count);
            pixels.zip(channel).for_each(|(value, sample)| *value = sample);
        }
        values.truncate(columns.end - pixels.start * count);
        Ok(values.split_off(columns.start - pixels.start * count))
    }
}
