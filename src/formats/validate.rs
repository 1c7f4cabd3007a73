//! From raw frames to masks and measurements: the scale that somebody stated is applied, and what
//! cannot be a mask or a measurement is refused. Nothing is guessed.

use ndarray::{Array2, ArrayView2, ArrayViewMut1};

use super::{FormatError, FrameReader, FullScale, StackInfo};

/// Masks may exceed 1 by this much (rounding of their own normalisation); they are set to 1 then.
const TOLERANCE: f32 = 1e-6;

/// What was seen in a set of masks. Values on the scale `[0,1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskStatistics {
    /// Number of masks, the compression ratio.
    pub frames: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// The full scale that was applied.
    pub full_scale: FullScale,
    /// Pixels whose sum of squares over the masks is 0: nothing can be known there.
    pub dead_pixels: u64,
    /// Values below 0 (dark subtraction makes them) that were set to 0.
    pub clipped_negative: u64,
    /// Mean over all masks and pixels.
    pub mean: f64,
    /// Largest value.
    pub max: f32,
}

/// What was seen in a sequence of snapshots. Values on the scale where an open mask passes the
/// scene's own `[0,1]`, so up to the number of masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasurementStatistics {
    /// Number of snapshots.
    pub snapshots: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// The full scale that was applied.
    pub full_scale: FullScale,
    /// Mean over all snapshots and pixels.
    pub mean: f64,
    /// Smallest value; dark subtraction makes some negative.
    pub min: f32,
    /// Largest value.
    pub max: f32,
}

/// Checks and scales masks frame by frame.
#[derive(Debug)]
pub struct MaskCheck {
    info: StackInfo,
    full_scale: FullScale,
    next: usize,
    /// True where some mask so far is open (its square is above 0).
    open: Vec<bool>,
    clipped_negative: u64,
    sum: f64,
    largest: Located,
    first_zero_frame: Option<usize>,
    zero_frames: usize,
}

/// A value as stored, and where it is.
#[derive(Debug, Clone, Copy)]
struct Located {
    value: f32,
    frame: usize,
    row: usize,
    column: usize,
}

impl MaskCheck {
    /// A check of a stack of this shape.
    pub fn new(info: &StackInfo, full_scale: FullScale) -> Self {
        Self {
            info: *info,
            full_scale,
            next: 0,
            open: vec![false; info.height * info.width],
            clipped_negative: 0,
            sum: 0.0,
            largest: Located { value: 0.0, frame: 0, row: 0, column: 0 },
            first_zero_frame: None,
            zero_frames: 0,
        }
    }

    /// Reads all frames, hands each one scaled to `[0,1]` to `sink`, and tells the statistics.
    ///
    /// Errors: those of the reader and the sink; NaN or infinite values; and at the end (so that
    /// the message can name the largest value of all) values above the full scale, masks without
    /// an open pixel. After an error what the sink received must be thrown away.
    pub fn run<E: From<FormatError>>(
        reader: &mut (impl FrameReader + ?Sized),
        full_scale: FullScale,
        mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), E>,
    ) -> Result<MaskStatistics, E> {
        let mut check = Self::new(reader.info(), full_scale);
        while let Some(mut frame) = reader.next_frame()? {
            check.frame(&mut frame)?;
            sink(frame.view())?;
        }
        Ok(check.finish()?)
    }

    /// Scales the next mask (row, column) in place and takes it into account.
    ///
    /// Errors: [`FormatError::NotFinite`]; a frame of another size is [`FormatError::Internal`].
    pub fn frame(&mut self, mask: &mut Array2<f32>) -> Result<(), FormatError> {
        check_size(&self.info, self.next, mask)?;
        let mut frame_max = 0f32;
        for row in 0..self.info.height {
            let raw = mask.row(row);
            if let Some(column) = raw.iter().position(|value| !value.is_finite()) {
                return Err(not_finite("masks", raw[column], self.next, row, column));
            }
            let row_max = raw.iter().fold(0f32, |max, value| max.max(*value));
            if row_max > self.largest.value {
                let column = raw.iter().position(|value| *value == row_max).unwrap_or_default();
                self.largest = Located { value: row_max, frame: self.next, row, column };
            }
            frame_max = frame_max.max(row_max / self.full_scale.value());
            self.scale_row(row, mask.row_mut(row));
        }
        if frame_max == 0.0 {
            self.first_zero_frame.get_or_insert(self.next);
            self.zero_frames += 1;
        }
        self.next += 1;
        Ok(())
    }

    /// Scales and clips one row, and counts its negative values and open pixels.
    fn scale_row(&mut self, row: usize, values: ArrayViewMut1<'_, f32>) {
        let scale = self.full_scale.value();
        let open = &mut self.open[row * self.info.width..][..self.info.width];
        let mut negative = 0;
        for (value, open) in values.into_iter().zip(open) {
            let scaled = *value / scale;
            negative += u64::from(scaled < 0.0);
            // A rounding above 1 becomes 1; anything more is refused at the end.
            *value = scaled.clamp(0.0, 1.0);
            *open |= *value * *value > 0.0;
            self.sum += f64::from(*value);
        }
        self.clipped_negative += negative;
    }

    /// The statistics, or why these are no masks; see [`MaskCheck::run`].
    pub fn finish(self) -> Result<MaskStatistics, FormatError> {
        let frames = self.info.frames;
        check_count(frames, self.next)?;
        let largest = self.largest.value / self.full_scale.value();
        if largest > 1.0 + TOLERANCE {
            return Err(FormatError::AboveFullScale {
                largest: self.largest.value,
                frame: self.largest.frame,
                row: self.largest.row,
                column: self.largest.column,
                full_scale: self.full_scale.value(),
            });
        }
        if self.zero_frames == frames {
            return Err(FormatError::AllMasksZero { frames });
        }
        if let Some(frame) = self.first_zero_frame {
            return Err(FormatError::MaskFrameZero { frame, frames });
        }
        Ok(MaskStatistics {
            frames,
            height: self.info.height,
            width: self.info.width,
            full_scale: self.full_scale,
            dead_pixels: self.open.iter().filter(|open| !**open).count() as u64,
            clipped_negative: self.clipped_negative,
            mean: self.sum / self.info.voxels() as f64,
            max: largest.min(1.0),
        })
    }
}

/// Checks and scales snapshots one by one.
#[derive(Debug)]
pub struct MeasurementCheck {
    info: StackInfo,
    full_scale: FullScale,
    next: usize,
    sum: f64,
    min: f32,
    max: f32,
}

impl MeasurementCheck {
    /// A check of a sequence of this shape.
    pub fn new(info: &StackInfo, full_scale: FullScale) -> Self {
        Self {
            info: *info,
            full_scale,
            next: 0,
            sum: 0.0,
            min: f32::INFINITY,
            max: f32::NEG_INFINITY,
        }
    }

    /// Reads all snapshots, hands each one divided by the full scale to `sink`, and tells the
    /// statistics. Values of any sign pass.
    ///
    /// Errors: those of the reader and the sink; NaN or infinite values; a snapshot that is zero
    /// everywhere. After an error what the sink received must be thrown away.
    pub fn run<E: From<FormatError>>(
        reader: &mut (impl FrameReader + ?Sized),
        full_scale: FullScale,
        mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), E>,
    ) -> Result<MeasurementStatistics, E> {
        let mut check = Self::new(reader.info(), full_scale);
        while let Some(mut snapshot) = reader.next_frame()? {
            check.snapshot(&mut snapshot)?;
            sink(snapshot.view())?;
        }
        Ok(check.finish()?)
    }

    /// Scales the next snapshot (row, column) in place and takes it into account.
    ///
    /// Errors: [`FormatError::NotFinite`], [`FormatError::SnapshotZero`]; a snapshot of another
    /// size is [`FormatError::Internal`].
    pub fn snapshot(&mut self, snapshot: &mut Array2<f32>) -> Result<(), FormatError> {
        check_size(&self.info, self.next, snapshot)?;
        let scale = self.full_scale.value();
        let mut any = false;
        for (row, mut values) in snapshot.rows_mut().into_iter().enumerate() {
            for (column, value) in values.iter_mut().enumerate() {
                let scaled = *value / scale;
                // A small full scale can push a finite value out of range: that is the same trouble.
                if !scaled.is_finite() {
                    return Err(not_finite("measurement", *value, self.next, row, column));
                }
                any |= scaled != 0.0;
                self.min = self.min.min(scaled);
                self.max = self.max.max(scaled);
                self.sum += f64::from(scaled);
                *value = scaled;
            }
        }
        if !any {
            return Err(FormatError::SnapshotZero {
                snapshot: self.next,
                snapshots: self.info.frames,
            });
        }
        self.next += 1;
        Ok(())
    }

    /// The statistics. Errors: [`FormatError::Internal`] when snapshots are missing.
    pub fn finish(self) -> Result<MeasurementStatistics, FormatError> {
        check_count(self.info.frames, self.next)?;
        Ok(MeasurementStatistics {
            snapshots: self.info.frames,
            height: self.info.height,
            width: self.info.width,
            full_scale: self.full_scale,
            mean: self.sum / self.info.voxels() as f64,
            min: self.min,
            max: self.max,
        })
    }
}

fn not_finite(
    subject: &'static str,
    value: f32,
    frame: usize,
    row: usize,
    column: usize,
) -> FormatError {
    FormatError::NotFinite { subject, value, frame, row, column }
}

fn check_size(info: &StackInfo, next: usize, frame: &Array2<f32>) -> Result<(), FormatError> {
    if next < info.frames && frame.dim() == (info.height, info.width) {
        return Ok(());
    }
    Err(FormatError::Internal(format!(
        "frame {next} of size {:?} in a check of {} frames of {}x{}",
        frame.dim(),
        info.frames,
        info.height,
        info.width
    )))
}

fn check_count(promised: usize, seen: usize) -> Result<(), FormatError> {
    if promised == seen {
        return Ok(());
    }
    Err(FormatError::Internal(format!("{seen} of {promised} frames were checked")))
}

#[cfg(test)]
mod tests;
