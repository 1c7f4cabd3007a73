//! Reads windows of raw f32 stacks without reading the rest.

use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;

use ndarray::Array3;

use super::samples::{self, ByteOrder};
use super::{FormatError, SampleType, StackInfo};
use crate::error::Result;

const SAMPLE_BYTES: u64 = 4;

/// A file with little-endian f32 samples in the order (frame, row, column) after a header. Reads are positional, so
/// threads can share it.
#[derive(Debug)]
pub struct WindowReader {
    file: File,
    info: StackInfo,
    start: u64,
}

impl WindowReader {
    /// A reader of a file after a check of its header. The samples start at byte `start`.
    pub(super) fn new(file: File, info: StackInfo, start: u64) -> Self {
        Self { file, info, start }
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
        // Whole rows are adjacent and are read together.
        let segments = if columns.len() == width && step == 1 { 1 } else { rows.len() };
        let segment_samples = rows.len() * columns.len() / segments.max(1);
        let mut bytes = vec![0; segment_samples * SAMPLE_BYTES as usize];
        let mut values = Vec::with_capacity(shape.0 * shape.1 * shape.2);
        for frame in frames {
            for segment in (0..segments).step_by(step) {
                let sample = (frame * height + rows.start + segment) * width + columns.start;
                self.file
                    .read_exact_at(&mut bytes, self.start + sample as u64 * SAMPLE_BYTES)
                    .map_err(FormatError::io("read the window"))?;
                let read = samples::decode(&bytes, SampleType::F32, ByteOrder::Little);
                values.extend(read.into_iter().step_by(step));
            }
        }
        Array3::from_shape_vec(shape, values)
            .map_err(|error| FormatError::Internal(error.to_string()))
    }
}
