//! Independent random binary masks, as in the public benchmark.

use ndarray::Array3;
use rand::RngExt;

use super::{Result, check_size, generator};

/// Random binary masks \[frames, height, width\]. Each pixel is 1 with probability one half, independent of all others.
///
/// Errors: [`OpticsError::Parameter`](super::OpticsError::Parameter) if a size is 0.
pub fn iid_masks(frames: usize, height: usize, width: usize, seed: u64) -> Result<Array3<f32>> {
    check_size(frames, height, width)?;
    let mut rng = generator(seed);
    Ok(Array3::from_shape_simple_fn((frames, height, width), || {
        f32::from(u8::from(rng.random::<bool>()))
    }))
}

#[cfg(test)]
mod tests {
    use super::iid_masks;

    #[test]
    fn half_of_the_pixels_are_open_and_the_seed_determines_which() {
        let masks = iid_masks(4, 64, 64, 7).unwrap();
        assert!(masks.iter().all(|&value| value == 0.0 || value == 1.0));
        let mean = masks.mean().unwrap();
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        assert_eq!(masks, iid_masks(4, 64, 64, 7).unwrap());
        assert_ne!(masks, iid_masks(4, 64, 64, 8).unwrap());
    }

    #[test]
    fn empty_stacks_are_refused() {
        let error = iid_masks(0, 8, 8, 0).unwrap_err().to_string();
        assert!(error.contains("compression ratio is 0"), "{error}");
    }
}
