//! From raw frames to masks and measurements: the scale that somebody stated is applied, and what
//! cannot be a mask or a measurement is refused. Nothing is guessed.

use ndarray::{Array2, ArrayView2};

use super::{FormatError, FrameReader, FullScale, StackInfo};
use crate::error::Result;

/// Masks may exceed 1 by this much (rounding of their own normalisation); they are set to 1 then.
const TOLERANCE: f32 = 1e-6;

/// What was seen in a set of masks. Values on the scale `[0,1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskStatistics {
    /// Pixels whose sum of squares over the masks is 0: nothing can be known there.
    pub dead_pixels: u64,
    /// Values below 0 (dark subtraction makes them) that were set to 0.
    pub clipped_negative: u64,
    /// Mean over all masks and pixels.
    pub mean: f64,
}

/// A value as stored, and where it is.
#[derive(Debug, Clone, Copy)]
struct Located {
    value: f32,
    frame: usize,
    row: usize,
    column: usize,
}

/// Reads all masks, hands each one scaled to `[0,1]` to `sink`, and tells the statistics.
///
/// Errors: those of the reader and the sink; NaN or infinite values; and at the end (so that
/// the message can name the largest value of all) values above the full scale, masks without
/// an open pixel. After an error what the sink received must be thrown away.
pub fn check_masks(
    reader: &mut dyn FrameReader,
    full_scale: FullScale,
    mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<()>,
) -> Result<MaskStatistics> {
    let (info, scale) = (*reader.info(), full_scale.value());
    // True where some mask so far is open (its square is above 0).
    let mut open = Array2::from_elem((info.height, info.width), false);
    let (mut clipped_negative, mut sum) = (0, 0.0);
    let mut largest = Located { value: 0.0, frame: 0, row: 0, column: 0 };
    let mut zero_frames = Vec::new();
    let mut frames = 0;
    while let Some(mut mask) = reader.next_frame()? {
        check_size(&info, frames, &mask)?;
        let mut frame_max = 0f32;
        for ((row, mut values), mut open) in
            mask.rows_mut().into_iter().enumerate().zip(open.rows_mut())
        {
            if let Some(column) = values.iter().position(|value| !value.is_finite()) {
                return Err(not_finite("masks", values[column], frames, row, column));
            }
            let row_max = values.iter().fold(0f32, |max, value| max.max(*value));
            if row_max > largest.value {
                let column = values.iter().position(|value| *value == row_max).unwrap_or_default();
                largest = Located { value: row_max, frame: frames, row, column };
            }
            frame_max = frame_max.max(row_max / scale);
            for (value, open) in values.iter_mut().zip(open.iter_mut()) {
                let scaled = *value / scale;
                clipped_negative += u64::from(scaled < 0.0);
                // A rounding above 1 becomes 1; anything more is refused at the end.
                *value = scaled.clamp(0.0, 1.0);
                *open |= *value * *value > 0.0;
                sum += f64::from(*value);
            }
        }
        if frame_max == 0.0 {
            zero_frames.push(frames);
        }
        frames += 1;
        sink(mask.view())?;
    }
    check_count(info.frames, frames)?;
    if largest.value / scale > 1.0 + TOLERANCE {
        let Located { value, frame, row, column } = largest;
        return Err(FormatError::AboveFullScale {
            largest: value,
            frame,
            row,
            column,
            full_scale: scale,
        });
    }
    match zero_frames.first() {
        Some(_) if zero_frames.len() == frames => Err(FormatError::AllMasksZero { frames }),
        Some(&frame) => Err(FormatError::MaskFrameZero { frame, frames }),
        None => Ok(MaskStatistics {
            dead_pixels: open.iter().filter(|open| !**open).count() as u64,
            clipped_negative,
            mean: sum / info.voxels() as f64,
        }),
    }
}

/// Reads all snapshots and hands each one divided by the full scale to `sink`. Values of any sign pass.
///
/// Errors: those of the reader and the sink; NaN or infinite values; a snapshot that is zero
/// everywhere. After an error what the sink received must be thrown away.
pub fn check_snapshots(
    reader: &mut dyn FrameReader,
    full_scale: FullScale,
    mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<()>,
) -> Result<()> {
    let (info, scale) = (*reader.info(), full_scale.value());
    let mut snapshots = 0;
    while let Some(mut snapshot) = reader.next_frame()? {
        check_size(&info, snapshots, &snapshot)?;
        let mut any = false;
        for ((row, column), value) in snapshot.indexed_iter_mut() {
            let scaled = *value / scale;
            // A small full scale can push a finite value out of range: that is the same trouble.
            if !scaled.is_finite() {
                return Err(not_finite("measurement", *value, snapshots, row, column));
            }
            any |= scaled != 0.0;
            *value = scaled;
        }
        if !any {
            return Err(FormatError::SnapshotZero { snapshot: snapshots, snapshots: info.frames });
        }
        snapshots += 1;
        sink(snapshot.view())?;
    }
    check_count(info.frames, snapshots)
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

fn check_size(info: &StackInfo, next: usize, frame: &Array2<f32>) -> Result<()> {
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

fn check_count(promised: usize, seen: usize) -> Result<()> {
    if promised == seen {
        return Ok(());
    }
    Err(FormatError::Internal(format!("{seen} of {promised} frames were checked")))
}

#[cfg(test)]
mod tests;
