//! Pixels that were not measured: NaN in a measurement.
//!
//! Saturated and defective pixels carry no information on the scene. The projection leaves them out, as it leaves out
//! hold-out pixels, so that the priors fill the frames there.

use std::borrow::Cow;
use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3};

use super::operator::SensingOperator;

/// An operator and a measurement \[S,H,W\] without NaN.
pub(super) struct Measured<'a> {
    /// The operator without the pixels that were not measured.
    pub(super) op: Cow<'a, SensingOperator>,
    /// The measurement, in standard layout, with the means of neighbours at those pixels.
    pub(super) y: Array3<f32>,
}

impl<'a> Measured<'a> {
    /// Leaves NaN of the measurement `y` \[S,H,W\] out of the operator. Both must have the same size.
    pub(super) fn new(op: &'a SensingOperator, y: ArrayView3<'_, f32>) -> Self {
        let pixels: Vec<_> =
            y.indexed_iter().filter(|(_, y)| y.is_nan()).map(|(pixel, _)| pixel).collect();
        let mut y = y.as_standard_layout().into_owned();
        if pixels.is_empty() {
            return Self { op: Cow::Borrowed(op), y };
        }
        y.outer_iter_mut().for_each(|mut snapshot| {
            let filled = filled(snapshot.view());
            snapshot.assign(&filled);
        });
        Self { op: Cow::Owned(op.clone().without(&pixels)), y }
    }
}

/// An image \[H,W\] in which each NaN is the mean of the nearest values that are none: those of the smallest square around
/// it that has any. An image without values becomes 0. Time and memory grow with the number of pixels alone.
pub fn filled(image: ArrayView2<'_, f32>) -> Array2<f32> {
    if !image.iter().any(|value| !value.is_nan()) {
        return Array2::zeros(image.dim());
    }
    let (height, width) = image.dim();
    let reaches = distances(image);
    let sums = Sums::new(image);
    Array2::from_shape_fn(image.dim(), |(row, column)| {
        let value = image[(row, column)];
        if !value.is_nan() {
            return value;
        }
        let reach = reaches[(row, column)];
        let around =
            |at: usize, length: usize| at.saturating_sub(reach)..length.min(at + reach + 1);
        sums.mean(around(row, height), around(column, width))
    })
}

/// The distance of each pixel to the nearest value that is no NaN, the larger of the distances in rows and columns. There
/// must be such a value.
fn distances(image: ArrayView2<'_, f32>) -> Array2<usize> {
    let (height, width) = image.dim();
    let far = height + width;
    let mut distances = image.mapv(|value| if value.is_nan() { far } else { 0 });
    // One pass downwards and one upwards reach every pixel by a shortest path.
    let mut improve = |row: usize, column: usize, neighbours: [(isize, isize); 4]| {
        let nearest = neighbours.iter().filter_map(|&(down, right)| {
            let at = (row.checked_add_signed(down)?, column.checked_add_signed(right)?);
            distances.get(at).copied()
        });
        let through = nearest.min().map_or(far, |nearest| nearest + 1);
        let distance = &mut distances[(row, column)];
        *distance = through.min(*distance);
    };
    for row in 0..height {
        for column in 0..width {
            improve(row, column, [(-1, -1), (-1, 0), (-1, 1), (0, -1)]);
        }
    }
    for row in (0..height).rev() {
        for column in (0..width).rev() {
            improve(row, column, [(1, 1), (1, 0), (1, -1), (0, 1)]);
        }
    }
    distances
}

/// Sums and counts of the values above and to the left of each corner of a pixel, \[H+1,W+1\].
struct Sums {
    values: Array2<f64>,
    counts: Array2<u32>,
}

impl Sums {
    fn new(image: ArrayView2<'_, f32>) -> Self {
        let (height, width) = image.dim();
        let mut values = Array2::zeros((height + 1, width + 1));
        let mut counts = Array2::zeros((height + 1, width + 1));
        for row in 0..height {
            let (mut sum, mut count) = (0.0, 0);
            for column in 0..width {
                let value = image[(row, column)];
                if !value.is_nan() {
                    sum += f64::from(value);
                    count += 1;
                }
                values[(row + 1, column + 1)] = values[(row, column + 1)] + sum;
                counts[(row + 1, column + 1)] = counts[(row, column + 1)] + count;
            }
        }
        Self { values, counts }
    }

    /// Mean of the values in a rectangle that has at least one.
    fn mean(&self, rows: Range<usize>, columns: Range<usize>) -> f32 {
        let (top, bottom, left, right) = (rows.start, rows.end, columns.start, columns.end);
        let values = &self.values;
        let sum = values[(bottom, right)] - values[(top, right)] - values[(bottom, left)]
            + values[(top, left)];
        let counts = &self.counts;
        let count = counts[(bottom, right)] + counts[(top, left)]
            - counts[(top, right)]
            - counts[(bottom, left)];
        (sum / f64::from(count)) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::filled;
    use crate::operator::SensingOperator;
    use crate::pilot;
    use crate::schedule::Schedule;
    use crate::solver::reconstruct;
    use ndarray::{Array2, Array3, ArrayView3, array, s};
    use optics::iid_masks;

    fn scene() -> (SensingOperator, Array3<f32>, Array3<f32>) {
        let op = SensingOperator::new(iid_masks(6, 64, 64, 3).unwrap()).unwrap();
        let truth = Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
            0.5 + 0.3 * ((i + k) as f32 * 0.2).sin() * (j as f32 * 0.15).cos()
        });
        let y = op.forward(truth.view()).unwrap();
        (op, truth, y)
    }

    fn psnr(frames: &Array3<f32>, truth: &Array3<f32>) -> f64 {
        crate::metrics::psnr(frames.view(), truth.view()).unwrap()
    }

    /// What stands at these pixels has no influence, in any algorithm without a network.
    #[test]
    fn pixels_that_were_not_measured_are_left_out() {
        let (op, truth, y) = scene();
        let mut holes = y.clone();
        for (at, value) in holes.iter_mut().enumerate() {
            if at % 17 == 3 {
                *value = f32::NAN;
            }
        }
        let schedules = [
            Schedule::gap_tv(),
            Schedule::gap_tv3d(),
            Schedule::admm_tv(),
            Schedule::pnp_nonlocal(),
        ];
        for schedule in schedules {
            let schedule = Schedule { adaptive: false, ..schedule }.with_iterations(30);
            let solve = |y: ArrayView3<'_, f32>| {
                reconstruct(&op, y, &schedule, &mut (), &mut ()).unwrap().frames
            };
            let (whole, without) =
                (psnr(&solve(y.view()), &truth), psnr(&solve(holes.view()), &truth));
            assert!(
                without > whole - 1.5,
                "{schedule:?}: {without} dB, {whole} dB with all pixels"
            );
        }
        let decided = pilot::decide(&op, holes.view(), &Schedule::gap_tv3d(), &mut (), &mut ());
        assert!(decided.unwrap().stages[0].error_after.is_finite());
    }

    #[test]
    fn holes_take_the_mean_of_the_nearest_values() {
        let nan = f32::NAN;
        let image = array![[1.0, nan, 3.0], [nan, nan, nan], [nan, nan, nan], [nan, nan, 9.0]];
        let filled = filled(image.view());
        assert_eq!(filled[[0, 0]], 1.0);
        assert_eq!(filled[[0, 1]], 2.0);
        assert_eq!(filled[[1, 0]], 1.0);
        assert_eq!(filled[[3, 1]], 9.0);
        assert!(filled.iter().all(|value| value.is_finite()));
        assert_eq!(super::filled(array![[nan, nan]].view()), array![[0.0, 0.0]]);
    }

    /// The definition of [`super::filled`], square by square.
    fn by_definition(image: &Array2<f32>, row: usize, column: usize) -> f64 {
        let (height, width) = image.dim();
        let around = |at: usize, reach: usize, length: usize| {
            at.saturating_sub(reach)..length.min(at + reach + 1)
        };
        let values = |reach: usize| -> Vec<f64> {
            let square = image.slice(s![around(row, reach, height), around(column, reach, width)]);
            square.iter().filter(|value| !value.is_nan()).map(|value| f64::from(*value)).collect()
        };
        let nearest = (0..).map(values).find(|values| !values.is_empty()).unwrap();
        nearest.iter().sum::<f64>() / nearest.len() as f64
    }

    #[test]
    fn holes_of_any_shape_are_filled_by_the_definition() {
        let noise = iid_masks(2, 37, 29, 11).unwrap();
        let image = Array2::from_shape_fn((37, 29), |(i, j)| {
            let is_far = (i as isize - 20).abs() < 9 && (j as isize - 12).abs() < 11;
            let is_hole = is_far || j > 24 || noise[[0, i, j]] > 0.5;
            if is_hole { f32::NAN } else { (i * 31 + j * 7) as f32 % 13.0 - 4.0 * noise[[1, i, j]] }
        });
        for ((at, filled), value) in super::filled(image.view()).indexed_iter().zip(&image) {
            let expected =
                if value.is_nan() { by_definition(&image, at.0, at.1) } else { f64::from(*value) };
            assert!((f64::from(*filled) - expected).abs() < 1e-5, "{at:?}: {filled}, {expected}");
        }
        // Summed square by square, these holes would take hours.
        let image =
            Array2::from_shape_fn((1500, 1500), |(i, _)| if i == 0 { 1.0 } else { f32::NAN });
        assert!(super::filled(image.view()).iter().all(|value| *value == 1.0));
    }
}
