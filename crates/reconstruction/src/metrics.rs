//! PSNR and SSIM by the conventions of the field: mean over the frames, no clipping, data range 1.

use ndarray::{ArrayView2, ArrayView3};

use super::error::{Result, check_shape, shape_text};

/// Side of SSIM's uniform window; smaller frames have no SSIM.
pub const WINDOW: usize = 7;

/// Mean over the frames of `10 log10(1 / MSE)` in dB, of frames \[B,H,W\] on \[0,1\].
/// Infinite if a frame equals its truth.
pub fn psnr(frames: ArrayView3<'_, f32>, truth: ArrayView3<'_, f32>) -> Result<f64> {
    mean_over_frames(frames, truth, |frame, truth| {
        let squares: f64 = frame.iter().zip(truth).map(|(&a, &b)| square(a, b)).sum();
        -10.0 * (squares / frame.len() as f64).log10()
    })
}

/// Mean over the frames of the structural similarity (Wang et al. 2004) of frames \[B,H,W\] on
/// \[0,1\], with the defaults of scikit-image: 7x7 uniform window, sample covariance, the
/// border of 3 pixels left out. Frames must be at least 7x7.
pub fn ssim(frames: ArrayView3<'_, f32>, truth: ArrayView3<'_, f32>) -> Result<f64> {
    let (_, height, width) = frames.dim();
    let (fits, found) = (height.min(width) >= WINDOW, shape_text(&[height, width]));
    check_shape(fits, "a frame for SSIM", found, "at least 7x7")?;
    mean_over_frames(frames, truth, ssim_frame)
}

fn square(a: f32, b: f32) -> f64 {
    let difference = f64::from(a) - f64::from(b);
    difference * difference
}

fn mean_over_frames(
    frames: ArrayView3<'_, f32>,
    truth: ArrayView3<'_, f32>,
    metric: impl Fn(ArrayView2<'_, f32>, ArrayView2<'_, f32>) -> f64,
) -> Result<f64> {
    let fits = frames.shape() == truth.shape() && !frames.is_empty();
    let expected = format!("{} (the truth's size)", shape_text(truth.shape()));
    check_shape(fits, "the frame stack", shape_text(frames.shape()), expected)?;
    let pairs = frames.outer_iter().zip(truth.outer_iter());
    Ok(pairs.map(|(a, b)| metric(a, b)).sum::<f64>() / frames.dim().0 as f64)
}

/// Sums of a, b, aa, bb, ab over a window.
type Moments = [f64; 5];

fn ssim_frame(a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>) -> f64 {
    let (height, width) = a.dim();
    let moments = |i: usize, j: usize| -> Moments {
        let (x, y) = (f64::from(a[[i, j]]), f64::from(b[[i, j]]));
        [x, y, x * x, y * y, x * y]
    };
    // Vertical sums of WINDOW rows for each column, moved down row by row.
    let mut columns = vec![[0.0; 5]; width];
    let (mut total, mut count) = (0.0, 0usize);
    for i in 0..height {
        for (j, column) in columns.iter_mut().enumerate() {
            add(column, &moments(i, j), 1.0);
            if i >= WINDOW {
                add(column, &moments(i - WINDOW, j), -1.0);
            }
        }
        if i + 1 < WINDOW {
            continue;
        }
        for window in columns.windows(WINDOW) {
            let mut sums = [0.0; 5];
            window.iter().for_each(|column| add(&mut sums, column, 1.0));
            total += similarity(&sums);
            count += 1;
        }
    }
    total / count as f64
}

fn add(sums: &mut Moments, other: &Moments, sign: f64) {
    sums.iter_mut().zip(other).for_each(|(sum, value)| *sum += sign * value);
}

fn similarity([a, b, aa, bb, ab]: &Moments) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let n = (WINDOW * WINDOW) as f64;
    let (mean_a, mean_b) = (a / n, b / n);
    let sample = n / (n - 1.0);
    let variance_a = sample * (aa / n - mean_a * mean_a);
    let variance_b = sample * (bb / n - mean_b * mean_b);
    let covariance = sample * (ab / n - mean_a * mean_b);
    (2.0 * mean_a * mean_b + C1) * (2.0 * covariance + C2)
        / ((mean_a * mean_a + mean_b * mean_b + C1) * (variance_a + variance_b + C2))
}

#[cfg(test)]
mod tests {
    use super::{psnr, ssim};
    use ndarray::Array3;

    /// Frames that Python makes as easily: see `tests/judges/metrics_values.py`.
    fn pair() -> (Array3<f32>, Array3<f32>) {
        let wave = |k: usize, i: usize, j: usize, phase: f64| {
            let (k, i, j) = (k as f64, i as f64, j as f64);
            (0.5 + 0.4 * (0.3 * i + 0.2 * j + k + phase).sin() * (0.11 * i * j).cos()) as f32
        };
        (
            Array3::from_shape_fn((3, 20, 31), |(k, i, j)| wave(k, i, j, 0.0)),
            Array3::from_shape_fn((3, 20, 31), |(k, i, j)| wave(k, i, j, 0.25)),
        )
    }

    #[test]
    fn values_equal_scikit_image() {
        let (a, b) = pair();
        // skimage 0.26, data_range=1: see tests/judges/metrics_values.py.
        let (expected_psnr, expected_ssim) = (25.728610614972734, 0.9661982526665808);
        assert!((psnr(b.view(), a.view()).unwrap() - expected_psnr).abs() < 1e-6);
        assert!((ssim(b.view(), a.view()).unwrap() - expected_ssim).abs() < 1e-6);
    }

    #[test]
    fn equal_frames_are_perfect() {
        let (a, _) = pair();
        assert_eq!(psnr(a.view(), a.view()).unwrap(), f64::INFINITY);
        assert!((ssim(a.view(), a.view()).unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn sizes_must_agree() {
        let (a, b) = pair();
        let error = psnr(a.view(), b.slice(ndarray::s![..2, .., ..])).unwrap_err();
        assert!(error.to_string().contains("3x20x31"), "{error}");
        assert!(error.to_string().contains("2x20x31"), "{error}");
    }
}
