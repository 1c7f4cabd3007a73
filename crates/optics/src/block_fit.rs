//! Tests block by block whether masks belong to a measurement.
//!
//! In a block of 16x16 pixels the scene is nearly uniform apart from a slope, and its light changes smoothly from band to
//! band: `x_k = sum_j a_j phi_j(k)` with a few hat functions `phi_j`. Least squares fits `y = plane + sum_j a_j D_j` with
//! `D_j = sum_k phi_j(k) C_k`. The right masks explain more of the residual of the plane than the masks of the four blocks
//! around do. The gain that a uniform spectrum would have is expected, whatever the noise and the texture of the scene.
//!
//! Masks that are displaced along the dispersion look like other wavelengths, and narrow spectra fit better behind them. So
//! all displacements along the dispersion count as none.

use ndarray::{Array1, Array2, ArrayView2, ArrayView3, Axis, s};

use super::measurement_check::REACH;
use super::measurement_fit::inverse;
use super::{DispersionAxis, Finding, FindingCode};

/// Side of a block, and margin of a window, in pixels.
pub const BLOCK_MARGIN: usize = 16;
/// Number of hat functions.
const FUNCTIONS: usize = 3;
/// Blocks with less of their pixels measured are left out.
const MIN_MEASURED: usize = BLOCK_MARGIN * BLOCK_MARGIN / 2;
/// Blocks with less energy than this share of the mean are left out: they are dark.
const MIN_ENERGY: f64 = 0.01;
/// Masks are refuted if their gain is surely below this share of the expected one. Of three published captures and 38
/// simulated ones with more than ten lit blocks, right masks exceed a share of 0.2, and turned masks and those of another
/// camera stay below 0.14.
const MIN_GAIN: f64 = 0.15;
/// Masks of another place are no comparison if their sum correlates by this much with that of the block, as that of
/// periodic masks does.
const MAX_LIKENESS: f32 = 0.5;
/// Standard errors of a sure statement.
const SURE: f64 = 3.0;
/// Masks are recognised if their gain exceeds that limit by this many standard errors.
const RECOGNISED: f64 = 2.2;
/// A shift needs this share of the expected gain, a gain this many times that without a shift, and this many standard
/// errors. The right masks of the captures gain nothing, masks shifted by a row 45 % and more, with at least 8.
const MIN_SHIFTED_GAIN: f64 = 0.2;
const MIN_IMPROVEMENT: f64 = 1.04;
const SHIFT_SIGNIFICANCE: f64 = 5.5;

/// Accumulates the fits of the blocks of some windows.
#[derive(Debug, Default)]
pub struct BlockStudy {
    blocks: Vec<Block>,
}

/// Shares of the energy of a block.
#[derive(Debug)]
struct Block {
    energy: f64,
    /// The share that its masks explain after each shift of up to [`REACH`] pixels along both axes.
    explained: Vec<f64>,
    /// The mean share that masks of the blocks around explain.
    elsewhere: f64,
    /// The share that a scene with the same light in all bands has.
    expected: f64,
}

/// The fit of masks to the blocks of a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlockFit {
    /// Mean share of the energy that the masks explain beyond those of other blocks, relative to the rest of these: the
    /// largest after a displacement along the dispersion.
    pub gain: f64,
    /// Standard error of `gain` if its true value is 0. It is larger than `scatter` where the masks gain.
    pub error: f64,
    /// Standard error of `gain` from its scatter between the blocks; infinite for up to three blocks.
    pub scatter: f64,
    /// The gain of the right masks if all bands have the same light.
    pub expected: f64,
    /// The shift (rows, columns) of the masks, in pixels, with the largest gain; none if it is along the dispersion.
    pub shift: (i32, i32),
    /// The gain after this shift.
    pub shifted_gain: f64,
    /// Difference between both gains, in standard errors.
    pub significance: f64,
}

fn shifts() -> impl Iterator<Item = (i32, i32)> {
    let reach = REACH as i32;
    (-reach..=reach).flat_map(move |row| (-reach..=reach).map(move |column| (row, column)))
}

/// A window: the measurement, the sums of the masks with hat functions, and the sum of all masks.
struct Window<'a> {
    y: ArrayView2<'a, f32>,
    hats: Vec<Array2<f32>>,
    sum: Array2<f32>,
}

/// The measured pixels of a block, and the plane in them.
struct Pixels {
    row: usize,
    column: usize,
    measured: Vec<(usize, usize)>,
    /// Orthonormal functions of the plane.
    plane: [Vec<f32>; 3],
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl Pixels {
    /// The pixels of the block of a window that begins at this row and column; `None` if too few were measured.
    fn new(window: &Window<'_>, (row, column): (usize, usize)) -> Option<Self> {
        let side = 0..BLOCK_MARGIN;
        let all = side.clone().flat_map(|i| side.clone().map(move |j| (i, j)));
        let is_measured = |&(i, j): &(usize, usize)| {
            let place = [row + i, column + j];
            !window.y[place].is_nan() && !window.sum[place].is_nan()
        };
        let measured: Vec<_> = all.filter(is_measured).collect();
        if measured.len() < MIN_MEASURED {
            return None;
        }
        let middle = (BLOCK_MARGIN - 1) as f32 / 2.0;
        let mut plane = [
            vec![1.0; measured.len()],
            measured.iter().map(|(i, _)| *i as f32 - middle).collect(),
            measured.iter().map(|(_, j)| *j as f32 - middle).collect(),
        ];
        for at in 0..plane.len() {
            let (before, rest) = plane.split_at_mut(at);
            let own = &mut rest[0];
            before.iter().for_each(|other| subtract(own, other));
            let length = dot(own, own).sqrt();
            own.iter_mut().for_each(|value| *value /= length);
        }
        Some(Self { row, column, measured, plane })
    }

    /// Values of an image at the pixels of the block, moved by a shift.
    fn values(&self, image: ArrayView2<'_, f32>, shift: (i32, i32)) -> Vec<f32> {
        let row = self.row.wrapping_add_signed(shift.0 as isize);
        let column = self.column.wrapping_add_signed(shift.1 as isize);
        let block = image.slice(s![row..row + BLOCK_MARGIN, column..column + BLOCK_MARGIN]);
        self.measured.iter().map(|&(i, j)| block[[i, j]]).collect()
    }

    /// The values without their plane.
    fn fine(&self, mut values: Vec<f32>) -> Vec<f32> {
        self.plane.iter().for_each(|function| subtract(&mut values, function));
        values
    }
}

/// The mean of the values that are not NaN; 0 if there is none.
fn mean_of_finite(values: &[f32]) -> f32 {
    let finite = || values.iter().filter(|value| !value.is_nan());
    finite().sum::<f32>() / finite().count().max(1) as f32
}

/// Subtracts the projection to a function of norm 1.
fn subtract(values: &mut [f32], function: &[f32]) {
    let share = dot(values, function);
    values.iter_mut().zip(function).for_each(|(value, function)| *value -= share * function);
}

impl Window<'_> {
    /// `None` if too few pixels were measured, or if masks of other places resemble those of the block.
    fn block(&self, place: (usize, usize)) -> Option<Block> {
        let pixels = Pixels::new(self, place)?;
        let (light, open) = (pixels.values(self.y, (0, 0)), pixels.values(self.sum.view(), (0, 0)));
        let ratio = light.iter().sum::<f32>() / open.iter().sum::<f32>().max(f32::MIN_POSITIVE);
        let (y, open) = (pixels.fine(light), pixels.fine(open));
        let energy = f64::from(dot(&y, &y));
        if energy <= 0.0 {
            return None;
        }
        let explained = |shift: (i32, i32)| {
            // Pixels that lose their mask by the shift are left out.
            let known: Vec<bool> =
                pixels.values(self.sum.view(), shift).iter().map(|sum| !sum.is_nan()).collect();
            let only_known = |mut values: Vec<f32>| {
                let pixels = values.iter_mut().zip(&known).filter(|(_, known)| !**known);
                pixels.for_each(|(value, _)| *value = 0.0);
                values
            };
            let fine_hat = |hat: &Array2<f32>| {
                let mut values = pixels.values(hat.view(), shift);
                let mean = mean_of_finite(&values);
                values.iter_mut().filter(|value| value.is_nan()).for_each(|value| *value = mean);
                only_known(pixels.fine(values))
            };
            let y = only_known(y.clone());
            let hats: Vec<_> = self.hats.iter().map(fine_hat).collect();
            let product = |at: (usize, usize)| f64::from(dot(&hats[at.0], &hats[at.1]));
            let products = Array2::from_shape_fn((hats.len(), hats.len()), product);
            let correlations: Array1<f64> =
                hats.iter().map(|hat| f64::from(dot(hat, &y))).collect();
            let Some(inverse) = inverse(&products) else { return 0.0 };
            let light = inverse.dot(&correlations);
            // Inverted masks fit to negative light.
            if light.sum() < 0.0 {
                return 0.0;
            }
            let energy = f64::from(dot(&y, &y)).max(f64::MIN_POSITIVE);
            (correlations.dot(&light) / energy).clamp(0.0, 1.0)
        };
        let side = BLOCK_MARGIN as i32;
        let is_other = |shift: &(i32, i32)| {
            let other = pixels.values(self.sum.view(), *shift);
            let other = pixels
                .fine(other.into_iter().map(|sum| if sum.is_nan() { 0.0 } else { sum }).collect());
            dot(&open, &other).abs()
                < MAX_LIKENESS * (dot(&open, &open) * dot(&other, &other)).sqrt()
        };
        let around = [(0, side), (0, -side), (side, 0), (-side, 0)].into_iter().filter(is_other);
        let elsewhere: Vec<f64> = around.map(explained).collect();
        if elsewhere.is_empty() {
            return None;
        }
        Some(Block {
            energy,
            elsewhere: elsewhere.iter().sum::<f64>() / elsewhere.len() as f64,
            explained: shifts().map(explained).collect(),
            expected: (f64::from(ratio * ratio * dot(&open, &open)) / energy).min(1.0),
        })
    }
}

impl BlockStudy {
    /// Adds a window of the masks \[B,h,w\] and of the measurement \[h,w\]. Both are NaN where nothing was measured.
    /// The outer [`BLOCK_MARGIN`] pixels on each side are a margin in which only the masks are used.
    pub fn add(&mut self, masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) {
        let (bands, height, width) = masks.dim();
        if y.dim() != (height, width) {
            return;
        }
        let count = bands.min(FUNCTIONS);
        let hat = |index: usize| {
            let mut sum = Array2::zeros((height, width));
            for (band, mask) in masks.outer_iter().enumerate() {
                let place = (band * (count - 1)) as f32 / (bands - 1).max(1) as f32;
                let share = 1.0 - (place - index as f32).abs();
                if share > 0.0 {
                    sum.scaled_add(share, &mask);
                }
            }
            sum
        };
        let window =
            Window { y, hats: (0..count).map(hat).collect(), sum: masks.sum_axis(Axis(0)) };
        let starts = |length: usize| {
            let last = length.saturating_sub(2 * BLOCK_MARGIN);
            (BLOCK_MARGIN..=last).step_by(BLOCK_MARGIN)
        };
        for row in starts(height) {
            self.blocks.extend(starts(width).filter_map(|column| window.block((row, column))));
        }
    }

    /// Returns the fit for a dispersion along this axis; `None` if all windows were too small, dark or not measured.
    pub fn finish(mut self, axis: DispersionAxis) -> Option<BlockFit> {
        let count = self.blocks.len() as f64;
        let mean = self.blocks.iter().map(|block| block.energy).sum::<f64>() / count;
        self.blocks.retain(|block| block.energy > MIN_ENERGY * mean);
        let sum = |value: &dyn Fn(&Block) -> f64| self.blocks.iter().map(value).sum::<f64>();
        let best = |is_candidate: &dyn Fn((i32, i32)) -> bool| {
            let candidates = shifts().enumerate().filter(|(_, shift)| is_candidate(*shift));
            candidates
                .map(|(at, shift)| (at, shift, sum(&|block| block.explained[at])))
                .max_by(|a, b| a.2.total_cmp(&b.2))
        };
        let is_along = |(rows, columns): (i32, i32)| match axis {
            DispersionAxis::Column => rows == 0,
            DispersionAxis::Row => columns == 0,
        };
        let (unshifted, _, own) = best(&is_along)?;
        let (at, shift, most) = best(&|_| true)?;
        let elsewhere = sum(&|block| block.elsewhere);
        let left = self.blocks.len() as f64 - elsewhere;
        if left <= 0.0 {
            return None;
        }
        let squares = sum(&|block| (block.explained[unshifted] - block.elsewhere).powi(2));
        let changes = sum(&|block| (block.explained[at] - block.explained[unshifted]).powi(2));
        let count = self.blocks.len() as f64;
        // The variance of the t distribution allows for few blocks.
        let variance =
            (squares - (own - elsewhere).powi(2) / count).max(0.0) / (count - 3.0).max(0.0);
        Some(BlockFit {
            gain: (own - elsewhere) / left,
            scatter: if count > 3.0 { (variance * count).sqrt() / left } else { f64::INFINITY },
            error: squares.sqrt() / left,
            expected: sum(&|block| block.expected) / self.blocks.len() as f64,
            // Masks that fit at a later pixel have moved back.
            shift: if is_along(shift) { (0, 0) } else { (-shift.0, -shift.1) },
            shifted_gain: (most - elsewhere) / left,
            significance: (most - own) / changes.sqrt().max(f64::MIN_POSITIVE),
        })
    }
}

/// Reports masks that do not belong to a measurement, fit after a shift, or are not recognised: `None` is the fit of blocks
/// that are too few or not measured.
pub fn judge_blocks(fit: Option<&BlockFit>) -> Option<Finding> {
    let Some(fit) = fit else {
        return Some(unverified(
            "no block of 16x16 pixels has enough light and other masks around it".to_owned(),
        ));
    };
    let percent = |share: f64| 100.0 * share.max(0.0);
    let is_refuted = fit.gain + SURE * fit.error < MIN_GAIN * fit.expected;
    let least = if is_refuted { SURE } else { SHIFT_SIGNIFICANCE };
    let is_shifted = fit.shift != (0, 0)
        && fit.significance > least
        && fit.shifted_gain > MIN_IMPROVEMENT * fit.gain
        && fit.shifted_gain > MIN_SHIFTED_GAIN * fit.expected;
    if is_shifted {
        let (rows, columns) = fit.shift;
        let detail = format!(
            "block by block, the masks explain {:.0} % more of the measurement than masks of other places when shifted by \
             {rows} rows and {columns} columns, but only {:.0} % without a shift",
            percent(fit.shifted_gain),
            percent(fit.gain)
        );
        return Some(Finding::new(FindingCode::ShiftedMasks, detail));
    }
    let figures = format!(
        "block by block, the masks explain {:.1} % more of the measurement than masks of other places, where about \
         {:.0} % are expected",
        percent(fit.gain),
        percent(fit.expected)
    );
    if is_refuted {
        let detail =
            format!("{figures}: it was probably recorded with other masks, or these are turned");
        return Some(Finding::new(FindingCode::ForeignMasks, detail));
    }
    let is_recognised = fit.gain - RECOGNISED * fit.scatter > MIN_GAIN * fit.expected;
    (!is_recognised).then(|| {
        let certainty = match fit.scatter.is_finite() {
            true => format!("with a standard error of {:.1} %", percent(fit.scatter)),
            false => "and three blocks or fewer are too few to tell".to_owned(),
        };
        unverified(format!("{figures}, {certainty}"))
    })
}

fn unverified(detail: String) -> Finding {
    Finding::new(FindingCode::UnverifiedMasks, detail)
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, ArrayView2, s};

    use super::{BlockStudy, judge_blocks};
    use crate::{Dispersion, DispersionAxis, MaskExtent, iid_masks, noisy};

    const BANDS: usize = 12;

    fn dispersion() -> Dispersion {
        Dispersion {
            axis: DispersionAxis::Column,
            offsets: (0..BANDS).map(|band| 2.0 * band as f64).collect(),
            wavelengths: None,
            mask: MaskExtent::Scene,
        }
    }

    /// The mask of each band.
    fn masks(mask: ArrayView2<'_, f32>) -> Array3<f32> {
        let bands: Vec<_> = (0..BANDS).map(|band| dispersion().shear(mask, band)).collect();
        let views: Vec<_> = bands.iter().map(|band| band.view()).collect();
        ndarray::stack(ndarray::Axis(0), &views).unwrap()
    }

    /// A dark scene with a few discs of different colours.
    fn measurement(mask: ArrayView2<'_, f32>) -> Array2<f32> {
        let (height, width) = mask.dim();
        let mut y = Array2::<f32>::zeros((height, width + 2 * (BANDS - 1)));
        for band in 0..BANDS {
            let light = |(i, j): (usize, usize)| {
                let disc = |row: f32, column: f32, radius: f32, colour: f32| {
                    let inside = (i as f32 - row).hypot(j as f32 - column) < radius;
                    let spectrum = (-((band as f32 - colour) / 3.0).powi(2)).exp();
                    if inside { spectrum } else { 0.02 }
                };
                disc(60.0, 70.0, 38.0, 3.0) + disc(130.0, 120.0, 36.0, 8.0)
            };
            let frame = Array2::from_shape_fn((height, width), |at| light(at) * mask[at]);
            y += &dispersion().shear(frame.view(), band);
        }
        y
    }

    fn code(mask: ArrayView2<'_, f32>, y: &Array2<f32>) -> Option<&'static str> {
        let mut study = BlockStudy::default();
        study.add(masks(mask).view(), y.view());
        let finding = judge_blocks(study.finish(DispersionAxis::Column).as_ref());
        finding.map(|finding| finding.code.as_str())
    }

    #[test]
    fn masks_of_a_spectral_camera_belong_to_their_measurement_alone() {
        let drawn = iid_masks(1, 192, 192, 4).unwrap();
        let mask = drawn.slice(s![0, .., ..]);
        for noise in [0.0, 0.05] {
            let mut y = measurement(mask);
            y = noisy(y, noise, 7).unwrap();
            y.iter_mut().step_by(19).for_each(|value| *value = f32::NAN);
            assert_eq!(code(mask, &y), None, "noise {noise}");
            assert_eq!(code(mask.slice(s![..;-1, ..]), &y), Some("foreign_masks"), "noise {noise}");
            assert_eq!(code(mask.slice(s![.., ..;-1]), &y), Some("foreign_masks"), "noise {noise}");
            let mut shifted = mask.to_owned();
            shifted.slice_mut(s![1.., ..]).assign(&mask.slice(s![..-1, ..]));
            assert_eq!(code(shifted.view(), &y), Some("shifted_masks"), "noise {noise}");
            let mut along = mask.to_owned();
            along.slice_mut(s![.., 1..]).assign(&mask.slice(s![.., ..-1]));
            assert_eq!(code(along.view(), &y), None, "another wavelength, noise {noise}");
            let inverted = mask.mapv(|value| 1.0 - value);
            assert_eq!(code(inverted.view(), &y), Some("foreign_masks"), "noise {noise}");
        }
    }

    #[test]
    fn periodic_masks_have_no_comparison() {
        let mask = Array2::from_shape_fn((192, 192), |(i, j)| f32::from((i * 5 + j) % 16 < 4));
        assert_eq!(code(mask.view(), &measurement(mask.view())), Some("unverified_masks"));
    }

    /// Five blocks of a bright scene, with and without noise.
    #[test]
    fn few_blocks_of_a_bright_scene_show_the_masks() {
        let drawn = iid_masks(2, 64, 64, 4).unwrap();
        let (mask, other) = (drawn.slice(s![0, .., ..]), drawn.slice(s![1, .., ..]));
        let mut y = Array2::<f32>::zeros((64, 64 + 2 * (BANDS - 1)));
        for band in 0..BANDS {
            let light = |(i, j): (usize, usize)| {
                0.5 + 0.3 * ((i + band) as f32 / 9.0).sin() * (j as f32 / 8.0).cos()
            };
            let frame = Array2::from_shape_fn((64, 64), |at| light(at) * mask[at]);
            y += &dispersion().shear(frame.view(), band);
        }
        for noise in [0.0, 0.02] {
            let y = noisy(y.clone(), noise, 7).unwrap();
            assert_eq!(code(mask, &y), None, "noise {noise}");
            assert!(code(other, &y).is_some(), "noise {noise}");
            assert!(code(mask.slice(s![..;-1, ..]), &y).is_some(), "noise {noise}");
        }
    }

    #[test]
    fn noise_alone_and_small_pictures_do_not_show_the_masks() {
        let drawn = iid_masks(2, 192, 192, 4).unwrap();
        let (mask, other) = (drawn.slice(s![0, .., ..]), drawn.slice(s![1, .., ..]));
        let y = noisy(measurement(mask) * 0.002, 0.2, 7).unwrap();
        let small = s![..40, ..40];
        let few = measurement(mask.slice(small));
        for mask in [mask, other] {
            assert_eq!(code(mask, &y), Some("unverified_masks"), "noise hides the masks");
            assert_eq!(code(mask.slice(small), &few), Some("unverified_masks"), "too few blocks");
        }
    }
}
