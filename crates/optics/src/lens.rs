//! Degradation of ideal masks by lens blur and by light that leaks through closed pixels.

use ndarray::{Array3, ArrayViewMut1, Axis, Zip};

use super::{Result, check_parameter};

/// Radius of the blur kernel in standard deviations.
const KERNEL_RADIUS: f64 = 4.0;
/// Largest accepted blur in pixels; it erases any mask.
const MAX_BLUR: f64 = 50.0;

/// Degrades masks \[B,H,W\] on \[0,1\].
///
/// Masks are blurred by a Gaussian with a standard deviation of `blur` pixels, reflected at the edges. The result is
/// `leak + (1 - leak) C`: closed pixels transmit the share `leak` of the light of open ones.
///
/// Errors: [`OpticsError::Parameter`](super::OpticsError::Parameter) unless `blur` is on \[0,50\] and `leak` on \[0,1).
pub fn soften(masks: &mut Array3<f32>, blur: f64, leak: f32) -> Result<()> {
    check_parameter((0.0..=MAX_BLUR).contains(&blur), "blur", blur, "from 0 to 50 pixels")?;
    check_parameter((0.0..1.0).contains(&leak), "leak", leak, "from 0 to less than 1")?;
    if blur > 0.0 {
        let kernel = kernel(blur);
        for axis in [Axis(1), Axis(2)] {
            Zip::from(masks.lanes_mut(axis)).for_each(|lane| smooth(lane, &kernel));
        }
    }
    masks.mapv_inplace(|mask| leak + (1.0 - leak) * mask);
    Ok(())
}

/// One half of a Gaussian kernel, from its centre outwards. The whole kernel sums to 1.
fn kernel(deviation: f64) -> Vec<f32> {
    let weight = |at: usize| (-0.5 * (at as f64 / deviation).powi(2)).exp();
    let half: Vec<f64> = (0..=(KERNEL_RADIUS * deviation).ceil() as usize).map(weight).collect();
    let sum = 2.0 * half.iter().sum::<f64>() - half[0];
    half.iter().map(|weight| (weight / sum) as f32).collect()
}

/// Convolves a lane with the kernel, reflected at the ends: `... 1 0 | 0 1 2 ... n-1 | n-1 n-2 ...`.
fn smooth(mut lane: ArrayViewMut1<'_, f32>, kernel: &[f32]) {
    let values = lane.to_vec();
    let at = |place: isize| {
        let period = 2 * values.len().cast_signed();
        let place = place.rem_euclid(period).cast_unsigned();
        values[place.min(2 * values.len() - 1 - place)]
    };
    for (place, value) in lane.iter_mut().enumerate() {
        let sides = (1isize..).zip(&kernel[1..]);
        let place = place.cast_signed();
        *value = kernel[0] * at(place)
            + sides.map(|(by, weight)| weight * (at(place - by) + at(place + by))).sum::<f32>();
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::soften;

    #[test]
    fn blur_preserves_the_sum_and_has_the_stated_width() {
        let mut masks = Array3::zeros((2, 41, 51));
        masks[[1, 20, 25]] = 1.0;
        soften(&mut masks, 2.0, 0.0).unwrap();
        let total: f32 = masks.sum();
        assert!((total - 1.0).abs() < 1e-4, "{total}");
        for axis in [1, 2] {
            let place = |index: (usize, usize, usize)| [index.1, index.2][axis - 1] as f32;
            let middle = [20.0, 25.0][axis - 1];
            let spread = masks.indexed_iter().map(|(i, v)| v * (place(i) - middle).powi(2));
            let variance: f32 = spread.sum();
            assert!((variance - 4.0).abs() < 0.05, "{variance}");
        }
        // Nothing is lost at an edge, even if the image is smaller than the kernel.
        let mut edge = Array3::zeros((1, 3, 9));
        edge[[0, 0, 0]] = 1.0;
        soften(&mut edge, 2.0, 0.0).unwrap();
        assert!((edge.sum() - 1.0).abs() < 1e-4, "{}", edge.sum());
    }

    #[test]
    fn closed_pixels_transmit_the_leak() {
        let mut masks = Array3::from_shape_fn((1, 2, 2), |(_, i, _)| i as f32);
        soften(&mut masks, 0.0, 0.2).unwrap();
        assert_eq!(masks.as_slice().unwrap(), [0.2, 0.2, 1.0, 1.0]);
    }

    #[test]
    fn parameters_out_of_range_are_refused_by_name() {
        let refused =
            |blur, leak| soften(&mut Array3::zeros((1, 2, 2)), blur, leak).unwrap_err().to_string();
        assert_eq!(refused(-1.0, 0.0), "blur is -1; it must be from 0 to 50 pixels");
        assert_eq!(refused(f64::NAN, 0.0), "blur is NaN; it must be from 0 to 50 pixels");
        assert_eq!(refused(0.0, 1.0), "leak is 1; it must be from 0 to less than 1");
    }
}
