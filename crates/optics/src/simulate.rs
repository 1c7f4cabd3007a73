//! Simulated measurements of known scenes.

use ndarray::{Array2, ArrayView3};
use rand_distr::{Distribution, Normal};

use super::{OpticsError, Result, check_parameter, generator};

/// The forward model `y = sum_k C_k x_k` \[H,W\] for masks C and frames x \[B,H,W\], both on \[0,1\].
///
/// Errors: [`OpticsError::Sizes`] if the sizes differ.
pub fn measure(masks: ArrayView3<'_, f32>, frames: ArrayView3<'_, f32>) -> Result<Array2<f32>> {
    if masks.dim() != frames.dim() {
        let text = |(b, h, w): (usize, usize, usize)| format!("{b}x{h}x{w}");
        return Err(OpticsError::Sizes { frames: text(frames.dim()), masks: text(masks.dim()) });
    }
    let mut y = Array2::zeros((masks.dim().1, masks.dim().2));
    for (mask, frame) in masks.outer_iter().zip(frames.outer_iter()) {
        ndarray::azip!((sum in &mut y, &c in &mask, &x in &frame) *sum += c * x);
    }
    Ok(y)
}

/// Adds white Gaussian noise of standard deviation `sigma` to `y`, on the scale of `y`. A noise level S on \[0,255\] is
/// `S / 255`.
///
/// Errors: [`OpticsError::Parameter`] unless `sigma` is finite and at least 0.
pub fn noisy(y: Array2<f32>, sigma: f32, seed: u64) -> Result<Array2<f32>> {
    let normal = Normal::new(0.0, sigma).ok().filter(|_| sigma >= 0.0);
    let range = "a finite number of at least 0";
    check_parameter(normal.is_some(), "noise sigma", sigma, range)?;
    let Some(noise) = normal.filter(|_| sigma > 0.0) else { return Ok(y) };
    // A separate stream: the noise is independent of masks drawn from the same seed.
    let mut rng = generator(seed);
    rng.set_stream(1);
    Ok(y.mapv_into(|value| value + noise.sample(&mut rng)))
}

#[cfg(test)]
mod tests {
    use super::{measure, noisy};
    use ndarray::{Array2, Array3};

    #[test]
    fn a_measurement_is_the_sum_of_the_coded_frames() {
        let masks = Array3::from_shape_fn((3, 2, 2), |(k, i, j)| (k + i + j) as f32 / 4.0);
        let frames = Array3::from_shape_fn((3, 2, 2), |(k, i, _)| (k * 2 + i) as f32 / 6.0);
        let y = measure(masks.view(), frames.view()).unwrap();
        let expected: f32 = (0..3).map(|k| masks[[k, 1, 0]] * frames[[k, 1, 0]]).sum();
        assert_eq!(y[[1, 0]], expected);
        let error = measure(masks.view(), Array3::zeros((2, 2, 2)).view()).unwrap_err();
        assert!(error.to_string().contains("2x2x2"), "{error}");
        assert!(error.to_string().contains("3x2x2"), "{error}");
    }

    #[test]
    fn noise_has_the_requested_level_and_is_reproducible() {
        let y = Array2::from_elem((200, 200), 3.0f32);
        let noisy_y = noisy(y.clone(), 0.02, 5).unwrap();
        let deviation = noisy_y.std(0.0);
        assert!((deviation - 0.02).abs() < 0.0005, "{deviation}");
        assert!((noisy_y.mean().unwrap() - 3.0).abs() < 0.0005);
        assert_eq!(noisy_y, noisy(y.clone(), 0.02, 5).unwrap());
        assert_eq!(noisy(y.clone(), 0.0, 5).unwrap(), y);
        assert!(noisy(y, f32::NAN, 5).is_err());
    }
}
