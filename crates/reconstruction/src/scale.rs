//! The scale that brings a scene to \[0,1\] for the denoiser.

use ndarray::{Array2, ArrayView2};

use super::error::{ReconError, Result, check_parameter, check_shape, shape_text};

/// Share of the pixels that lie at or below the white level.
const WHITE_QUANTILE: f64 = 0.995;

/// Light below which pixels do not count for a white level: a quarter of the mean of `light` \[H,W\], the sum of the masks. In
/// less light the noise is too strong.
pub fn least_light(light: ArrayView2<'_, f32>) -> f32 {
    0.25 * light.mean().unwrap_or(0.0)
}

/// Estimates the white level of a scene from its masks and one measurement.
///
/// At each pixel `y / sum_k C_k` is a mean of the frames, weighted by the masks. The white level is its upper
/// quantile over the pixels: robust against hot pixels, and estimated once for the whole picture, so that all tiles
/// share it.
#[derive(Debug)]
pub struct ScaleEstimator {
    light: Array2<f32>,
}

impl ScaleEstimator {
    /// An estimator for masks with the sum `light` \[H,W\].
    pub fn new(light: Array2<f32>) -> Self {
        Self { light }
    }

    /// White level of the scene behind measurement `y` \[H,W\]. The measurement is divided by it before reconstruction,
    /// and the frames are multiplied by it afterwards.
    ///
    /// # Errors
    /// Sizes that differ, or a measurement without light. NaN were not measured.
    pub fn white(&self, y: ArrayView2<'_, f32>) -> Result<f32> {
        let (found, expected) = (shape_text(y.shape()), shape_text(self.light.shape()));
        check_shape(y.dim() == self.light.dim(), "the measurement", found, expected)?;
        let least = least_light(self.light.view());
        let is_lit = |&(y, light): &(&f32, &f32)| *light > least && !y.is_nan();
        let lit = y.iter().zip(&self.light).filter(is_lit);
        let mut ratios: Vec<f32> = lit.map(|(&y, &light)| y / light).collect();
        if ratios.is_empty() {
            return Err(ReconError::DarkMasks { frames: 0 });
        }
        let index = ((ratios.len() - 1) as f64 * WHITE_QUANTILE).round() as usize;
        let (_, &mut white, _) = ratios.select_nth_unstable_by(index, f32::total_cmp);
        let is_lit = white.is_finite() && white > 0.0;
        let range = "above 0: the measurement holds no light (is the dark frame too bright?)";
        check_parameter(is_lit, "the measurement's white level", white, range)?;
        Ok(white)
    }
}

#[cfg(test)]
mod tests {
    use super::ScaleEstimator;
    use ndarray::{Array2, Array3, Axis};
    use rand::{RngExt, SeedableRng};

    fn scene(factor: f32) -> (Array3<f32>, Array2<f32>) {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(5);
        let masks =
            Array3::from_shape_fn((8, 64, 64), |_| f32::from(u8::from(rng.random::<bool>())));
        let mut y = Array2::zeros((64, 64));
        for mask in masks.outer_iter() {
            for ((i, j), c) in mask.indexed_iter() {
                y[[i, j]] += factor * c * ((i + j) as f32 / 126.0);
            }
        }
        (masks, y)
    }

    fn white(masks: &Array3<f32>, y: &Array2<f32>) -> f32 {
        ScaleEstimator::new(masks.sum_axis(Axis(0))).white(y.view()).unwrap()
    }

    #[test]
    fn white_is_the_scenes_upper_end_whatever_the_unit() {
        let (masks, y) = scene(1.0);
        let level = white(&masks, &y);
        assert!((0.9..=1.0).contains(&level), "{level}");
        let (_, dim) = scene(0.013);
        assert!((white(&masks, &dim) / level - 0.013).abs() < 1e-4);
    }

    #[test]
    fn hot_pixels_do_not_move_it() {
        let (masks, mut y) = scene(1.0);
        let clean = white(&masks, &y);
        for k in 0..8 {
            y[[7 * k, 3 * k]] = 1e6;
        }
        assert!((white(&masks, &y) - clean).abs() < 0.02);
    }

    #[test]
    fn darkness_is_refused() {
        let (masks, y) = scene(1.0);
        let estimator = ScaleEstimator::new(masks.sum_axis(Axis(0)));
        let error = estimator.white((y * -1.0).view()).unwrap_err();
        assert!(error.to_string().contains("holds no light"), "{error}");
        assert!(estimator.white(Array2::zeros((3, 3)).view()).is_err());
    }
}
