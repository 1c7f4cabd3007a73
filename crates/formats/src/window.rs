//! Windows of raw f32 stacks, read without reading the rest.

use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;

use ndarray::Array3;

use super::samples::{self, ByteOrder};
use super::{FormatError, SampleType, StackInfo};
use crate::error::Result;

const SAMPLE_BYTES: u64 = 4;

/// A file with little-endian f32 samples in the order (frame, row, column) behind a header. Reads at
/// positions, so it may be shared between threads.
#[derive(Debug)]
pub struct WindowReader {
    file: File,
    info: StackInfo,
    start: u64,
}

impl WindowReader {
    /// Of a file whose header was checked: the samples of `info` begin at byte `start`.
    pub(super) fn new(file: File, info: StackInfo, start: u64) -> Self {
        Self { file, info, start }
    }

    /// Shape and type.
    pub fn info(&self) -> &StackInfo {
        &self.info
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
        self.read_lattice(frames, (rows, columns), 1)
    }

    /// Reads every `step`th row and column of a window, from its first ones on.
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
                "window {frames:?} x {rows:?} x {columns:?} of a stack {} x {height} x {width}",
                self.info.frames
            )));
        }
        let step = step.max(1);
        let shape = (frames.len(), rows.len().div_ceil(step), columns.len().div_ceil(step));
        // Whole rows lie one after another and are read in one go.
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
