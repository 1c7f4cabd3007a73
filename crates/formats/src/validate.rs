//! Converts raw frames to masks and measurements: applies the full scale, and refuses invalid values. Nothing is
//! guessed.

use ndarray::{Array2, ArrayView2};

use super::{FormatError, FrameReader, FullScale, StackInfo};
use crate::error::{Lightless, Result};

/// Masks may exceed 1 by this much, due to rounding in their normalisation. Such values are set to 1.
const TOLERANCE: f32 = 1e-6;

/// A mask whose largest value is below this share of the full scale is closed: no camera resolves it. The squares of its
/// values, on which the projection divides, would leave the range of 32-bit floats.
pub const MIN_OPEN: f32 = 1e-6;

/// Smallest and largest size of a measured value relative to the full scale. No camera is beyond, and sums of squares of such
/// values stay within the range of 32-bit floats.
const MIN_LIGHT: f32 = 1e-15;
const MAX_LIGHT: f32 = 1e15;

/// Statistics of masks on `[0,1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskStatistics {
    /// Number of measured pixels with a sum of squares of 0 over the masks, which can't be reconstructed.
    pub dead_pixels: u64,
    /// Number of values below 0, for example from dark subtraction, that were set to 0.
    pub clipped_negative: u64,
    /// Mean over all masks and measured pixels.
    pub mean: f64,
}

/// A stored value and its position.
#[derive(Debug, Clone, Copy)]
struct Located {
    value: f32,
    frame: usize,
    row: usize,
    column: usize,
}

/// Reads all masks, passes each one (row, column) on `[0,1]` to `sink`, and returns the statistics. NaN are not measured and
/// stay NaN.
///
/// Errors: those of the reader and of the sink; [`FormatError::NotFinite`]. After the last mask, so that the message
/// can contain the largest value: [`FormatError::BipolarMasks`], [`FormatError::AboveFullScale`],
/// [`FormatError::AllMasksZero`] and [`FormatError::MaskFrameZero`]. After an error the output of the sink is invalid.
pub fn check_masks(
    reader: &mut dyn FrameReader,
    full_scale: FullScale,
    mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<()>,
) -> Result<MaskStatistics> {
    let (info, scale) = (*reader.info(), full_scale.value());
    // True where the square of a mask is above 0, or unknown.
    let mut open = Array2::from_elem((info.height, info.width), false);
    let (mut clipped_negative, mut sum, mut measured) = (0, 0.0, 0u64);
    let mut largest = Located { value: 0.0, frame: 0, row: 0, column: 0 };
    let (mut closed_frames, mut signs) = (Vec::new(), Signs::default());
    let mut frames = 0;
    while let Some(mut mask) = reader.next_frame()? {
        check_size(&info, frames, &mask)?;
        let mut frame_max = 0f32;
        for ((row, mut values), mut open) in
            mask.rows_mut().into_iter().enumerate().zip(open.rows_mut())
        {
            if let Some(column) = values.iter().position(|value| value.is_infinite()) {
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
                signs.add(*value);
                // Values above 1 by more than rounding are refused at the end.
                *value = scaled.clamp(0.0, 1.0);
                *open |= value.is_nan() || *value * *value > 0.0;
                if !value.is_nan() {
                    sum += f64::from(*value);
                    measured += 1;
                }
            }
        }
        if frame_max < MIN_OPEN {
            closed_frames.push(frames);
        }
        frames += 1;
        sink(mask.view())?;
    }
    check_count(info.frames, frames)?;
    signs.check()?;
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
    match closed_frames.first() {
        Some(_) if closed_frames.len() == frames => {
            let largest = largest.value;
            Err(FormatError::AllMasksZero { frames, largest, full_scale: scale })
        }
        Some(&frame) => Err(FormatError::MaskFrameZero { frame, frames, full_scale: scale }),
        None => Ok(MaskStatistics {
            dead_pixels: open.iter().filter(|open| !**open).count() as u64,
            clipped_negative,
            mean: sum / measured.max(1) as f64,
        }),
    }
}

/// Sums over the values on one side of 0.
#[derive(Debug, Clone, Copy, Default)]
struct Side {
    count: u64,
    sum: f64,
    squares: f64,
}

/// Sums over negative and over positive values.
#[derive(Debug, Default)]
struct Signs {
    negative: Side,
    positive: Side,
}

/// Bipolar masks have at least this share of negative values. Hadamard patterns have one half.
const BIPOLAR_SHARE: f64 = 0.05;
/// The root mean square of the negative values of bipolar masks is at least this share of that of the positive ones.
const BIPOLAR_LEVEL: f64 = 0.5;
/// The negative values of bipolar masks spread by less than this share of their mean. Noise has 0.76, because its
/// values crowd at 0; a uniform distribution has 0.58.
const BIPOLAR_SPREAD: f64 = 0.65;

impl Signs {
    fn add(&mut self, value: f32) {
        let value = f64::from(value);
        let side = match value {
            value if value < 0.0 => &mut self.negative,
            value if value > 0.0 => &mut self.positive,
            _ => return,
        };
        side.count += 1;
        side.sum += value;
        side.squares += value * value;
    }

    /// Refuses masks with positive and negative levels. Noise around 0, as a subtracted dark leaves it, is accepted.
    fn check(&self) -> Result<()> {
        let Self { negative, positive } = self;
        let share = negative.count as f64 / (negative.count + positive.count).max(1) as f64;
        let (low, high) = (negative.mean(), positive.mean());
        let spread = (negative.squares / negative.count.max(1) as f64 - low * low).max(0.0).sqrt();
        let bipolar = positive.count > 0
            && share >= BIPOLAR_SHARE
            && negative.rms() >= BIPOLAR_LEVEL * positive.rms()
            && spread < BIPOLAR_SPREAD * low.abs();
        if !bipolar {
            return Ok(());
        }
        let percent = (share * 100.0).round();
        Err(FormatError::BipolarMasks { percent, low: low as f32, high: high as f32 })
    }
}

impl Side {
    fn mean(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    fn rms(&self) -> f64 {
        (self.squares / self.count.max(1) as f64).sqrt()
    }
}

/// Reads all snapshots, and passes each one (row, column) divided by the full scale to `sink`. Values may have any
/// sign; NaN are not measured and stay NaN. Values below a 1e15th of the full scale become 0. Returns the snapshots without
/// light.
///
/// Errors: those of the reader and of the sink; [`FormatError::NotFinite`]; [`FormatError::Overflow`];
/// [`FormatError::NoLight`] if no snapshot has light. After an error the output of the sink is invalid.
pub fn check_snapshots(
    reader: &mut dyn FrameReader,
    full_scale: FullScale,
    mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<()>,
) -> Result<Vec<(usize, Lightless)>> {
    let (info, scale) = (*reader.info(), full_scale.value());
    let (mut snapshots, mut dark) = (0, Vec::new());
    while let Some(mut snapshot) = reader.next_frame()? {
        check_size(&info, snapshots, &snapshot)?;
        // The state that is reported if no pixel has light.
        let (mut has_light, mut state) = (false, Lightless::NotMeasured);
        for ((row, column), value) in snapshot.indexed_iter_mut() {
            let scaled = *value / scale;
            if value.is_infinite() {
                return Err(not_finite("measurement", *value, snapshots, row, column));
            }
            if scaled.abs() > MAX_LIGHT {
                let (value, frame, full_scale) = (*value, snapshots, scale);
                return Err(FormatError::Overflow { value, frame, row, column, full_scale });
            }
            let scaled = if scaled.abs() < MIN_LIGHT { 0.0 } else { scaled };
            has_light |= scaled != 0.0 && !scaled.is_nan();
            state = match state {
                _ if value.is_nan() => state,
                _ if *value != 0.0 => Lightless::Underflow,
                Lightless::NotMeasured => Lightless::Zero,
                state => state,
            };
            *value = scaled;
        }
        if !has_light {
            dark.push((snapshots, state));
        }
        snapshots += 1;
        sink(snapshot.view())?;
    }
    check_count(info.frames, snapshots)?;
    match dark.first() {
        Some(&(snapshot, state)) if dark.len() == snapshots => {
            Err(FormatError::NoLight { snapshot, snapshots, state })
        }
        _ => Ok(dark),
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

fn check_size(info: &StackInfo, next: usize, frame: &Array2<f32>) -> Result<()> {
    if next < info.frames && frame.dim() == (info.height, info.width) {
        return Ok(());
    }
    Err(FormatError::Internal(format!(
        "frame {next} has the size {:?}, but the stack has {} frames of {}x{}",
        frame.dim(),
        info.frames,
        info.height,
        info.width
    )))
}

fn check_count(promised: usize, read: usize) -> Result<()> {
    if promised == read {
        return Ok(());
    }
    Err(FormatError::Internal(format!("only {read} of {promised} frames were read")))
}

#[cfg(test)]
mod tests;
