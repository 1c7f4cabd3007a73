//! Pixels that were not measured: NaN in a measurement.
//!
//! Saturated and defective pixels carry no information on the scene. The projection leaves them out, as it leaves out
//! hold-out pixels, so that the priors fill the frames there.

use std::borrow::Cow;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, s};

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
/// it that has any. An image without values becomes 0.
pub fn filled(image: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut result = image.to_owned();
    if !image.iter().any(|value| !value.is_nan()) {
        result.fill(0.0);
        return result;
    }
    let (height, width) = image.dim();
    for ((row, column), value) in result.indexed_iter_mut().filter(|(_, value)| value.is_nan()) {
        let mean = (1..height.max(width)).find_map(|reach| {
            let around =
                |at: usize, length: usize| at.saturating_sub(reach)..length.min(at + reach + 1);
            let (mut sum, mut count) = (0.0, 0.0);
            let square = image.slice(s![around(row, height), around(column, width)]);
            for value in square.iter().filter(|value| !value.is_nan()) {
                sum += value;
                count += 1.0;
            }
            (count > 0.0).then(|| sum / count)
        });
        *value = mean.unwrap_or_default();
    }
    result
}

#[cfg(test)]
mod tests {
    use super::filled;
    use crate::operator::SensingOperator;
    use crate::pilot;
    use crate::schedule::Schedule;
    use crate::solver::reconstruct;
    use ndarray::{Array3, ArrayView3, array};
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
}
