//! The two scales of a job: that of the solver, which all tiles share, and the white level of the frames, for people.

use ndarray::{Array2, ArrayView2, ArrayView3};

use super::arrays::Arrays;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use crate::job::SnapshotRange;
use reconstruction::ReconError;
use reconstruction::error::check_shape;
use reconstruction::scale::{ScaleEstimator, least_light};

/// The solver's scale for snapshots \[S,H,W\] in memory. `light` \[H,W\] is that of their masks.
///
/// Errors: those of [`ScaleEstimator::white`]; [`ReconError::Shape`] without snapshots.
pub fn white(light: Array2<f32>, y: ArrayView3<'_, f32>) -> Result<f32, ReconError> {
    let estimator = ScaleEstimator::new(light);
    let whites = y.outer_iter().map(|snapshot| estimator.white(snapshot));
    let white = median_white(lit_snapshots(whites)?);
    check_shape(white.is_some(), "the measurement", "no snapshots", "at least one")?;
    Ok(white.unwrap_or_default())
}

/// The solver's scale for the stored snapshots of a job. It reads one plane at a time. Snapshots without light do not count.
///
/// Errors: those of reading, and of [`ScaleEstimator::white`] if no snapshot has light; a stop by the monitor.
pub fn job_white_level(
    arrays: &Arrays,
    snapshots: SnapshotRange,
    monitor: &Monitor,
) -> Result<f32> {
    let estimator = ScaleEstimator::new(arrays.light(monitor)?);
    let mut whites = Vec::with_capacity(snapshots.count as usize);
    for snapshot in snapshots.indices() {
        monitor.check()?;
        let white = estimator.white(arrays.snapshot(snapshot)?.view());
        whites.push(white.map_err(|source| PipelineError::Snapshot { snapshot, source }));
    }
    let whites = lit_snapshots(whites)?;
    let no_snapshots =
        || PipelineError::Record { what: "job", problem: "it has no snapshots".into() };
    median_white(whites).ok_or_else(no_snapshots)
}

/// The values of snapshots with light.
///
/// # Errors
/// The last error, if there are only errors.
fn lit_snapshots<E>(whites: impl IntoIterator<Item = Result<f32, E>>) -> Result<Vec<f32>, E> {
    let (mut lit, mut failure) = (Vec::new(), None);
    for white in whites {
        match white {
            Ok(white) => lit.push(white),
            Err(error) => failure = Some(error),
        }
    }
    match failure {
        Some(error) if lit.is_empty() => Err(error),
        _ => Ok(lit),
    }
}

/// The median (the lower one of two) of the snapshots' white levels; `None` without snapshots. Unlike the maximum, the
/// median is not set by a single flash, which would make all other snapshots dark for the denoiser.
fn median_white(mut whites: Vec<f32>) -> Option<f32> {
    whites.sort_by(f32::total_cmp);
    let middle = whites.len().checked_sub(1)? / 2;
    whites.get(middle).copied()
}

/// Share of a job's samples at or below its white level.
const WHITE_QUANTILE: f64 = 0.999;
/// Bits of a sample that select its bin: the exponent and 11 bits of the mantissa, a bin width of 0.05 %.
const BIN_BITS: u32 = 19;

/// 1 for the pixels that count for the white level, and 0 for those whose masks, with the sum `light` \[H,W\], pass too
/// little light. The map of a spectral camera is moved and interpolated as its frames are.
pub fn lit(light: ArrayView2<'_, f32>) -> Array2<f32> {
    let least = least_light(light);
    light.mapv(|light| f32::from(u8::from(light > least)))
}

/// Histogram of the samples of frames, from which their white level follows.
///
/// The order of the samples does not matter, so the white level is the same for all cuts into tasks.
#[derive(Debug)]
pub struct Histogram {
    /// Number of samples above 0 in each bin.
    counts: Vec<u64>,
    /// Number of finite samples.
    total: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: vec![0; 1 << BIN_BITS], total: 0 }
    }
}

impl Histogram {
    /// Adds the finite samples of a frame \[H,W\] where it is [lit].
    pub fn add(&mut self, frame: ArrayView2<'_, f32>, lit: ArrayView2<'_, f32>) {
        let is_lit = |(sample, lit): &(&f32, &f32)| sample.is_finite() && **lit > 0.999;
        for (sample, _) in frame.iter().zip(&lit).filter(is_lit) {
            self.total += 1;
            if *sample > 0.0 {
                self.counts[(sample.to_bits() >> (31 - BIN_BITS)) as usize] += 1;
            }
        }
    }

    /// The 99.9th percentile of the samples, to 0.05 %; `None` unless it is above 0.
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn white_level(&self) -> Option<f32> {
        let above = self.total as f64 * (1.0 - WHITE_QUANTILE);
        let mut count = 0;
        let bin = self.counts.iter().enumerate().rev().find(|(_, samples)| {
            count += **samples;
            count as f64 > above
        });
        let shift = 31 - BIN_BITS;
        // The middle of the bin.
        bin.map(|(bin, _)| f32::from_bits(((bin as u32) << shift) | 1 << (shift - 1)))
    }
}

/// The white level of the frames of a job from their histogram; the solver's scale if they are dark.
pub fn white_level(histogram: &Histogram, solver_white: f32) -> f32 {
    histogram.white_level().unwrap_or(solver_white)
}

#[cfg(test)]
mod tests {
    use super::{Histogram, lit, median_white};
    use ndarray::{Array2, ArrayView2};

    /// Samples as a row of lit pixels.
    fn add(histogram: &mut Histogram, samples: &[f32]) {
        let lit = Array2::ones((1, samples.len()));
        let row = ArrayView2::from_shape((1, samples.len()), samples).unwrap();
        histogram.add(row, lit.view());
    }

    #[test]
    fn white_levels_do_not_depend_on_order_and_unit() {
        let samples: Vec<f32> = (0..10_000).map(|k| (k * 7919 % 10_000) as f32 / 1e4).collect();
        let white = |scale: f32| {
            let (mut whole, mut parts) = (Histogram::default(), Histogram::default());
            let scaled: Vec<f32> = samples.iter().map(|sample| sample * scale).collect();
            add(&mut whole, &scaled);
            scaled.chunks(77).rev().for_each(|part| add(&mut parts, part));
            assert_eq!(whole.white_level(), parts.white_level());
            whole.white_level().unwrap()
        };
        for scale in [1.0, 1.0 / 3.0, 4095.0, 1e-6] {
            let level = white(scale) / scale;
            assert!((level - 0.999).abs() < 1e-3, "{scale}: {level}");
        }
        let mut dark = Histogram::default();
        add(&mut dark, &[0.0, -1.0, f32::NAN]);
        assert_eq!(dark.white_level(), None);
    }

    #[test]
    fn noise_in_dim_corners_does_not_set_the_white_level() {
        let mut light = Array2::from_elem((100, 100), 4.0);
        let mut frame = Array2::from_elem((100, 100), 0.8);
        for row in 0..10 {
            light[[row, 0]] = 0.5;
            frame[[row, 0]] = 7.0;
        }
        let mut histogram = Histogram::default();
        histogram.add(frame.view(), lit(light.view()).view());
        assert!((histogram.white_level().unwrap() - 0.8).abs() < 1e-3, "{histogram:?}");
    }

    #[test]
    fn single_flashes_do_not_set_the_scale() {
        assert_eq!(median_white(vec![0.9, 40.0, 1.0]), Some(1.0));
        assert_eq!(median_white(vec![2.0, 1.0]), Some(1.0));
        assert_eq!(median_white(vec![]), None);
    }
}
