//! Rings from the centre to the rim. Masks of a hybrid aperture are worst at the rim, where fewer
//! sub-apertures reach, so a mean over the whole picture hides where an algorithm fails.

use ndarray::ArrayView2;

/// Rings inside the largest circle; what lies outside it, the corners, is one zone more.
const RINGS: usize = 4;

/// Which pixels of a picture belong to which zone.
pub(super) struct Zones {
    height: usize,
    width: usize,
    /// Radius of the largest circle that fits into the picture, in pixels.
    radius: f64,
}

impl Zones {
    /// Of pictures of `height` x `width` pixels.
    pub(super) fn new(height: usize, width: usize) -> Self {
        Self { height, width, radius: height.min(width) as f64 / 2.0 }
    }

    /// The outer radius of each zone in pixels, from the centre on; none for the corners.
    pub(super) fn radii(&self) -> [Option<f64>; RINGS + 1] {
        std::array::from_fn(|zone| {
            (zone < RINGS).then(|| self.radius * (zone + 1) as f64 / RINGS as f64)
        })
    }

    /// Mean squared error of a frame \[H,W\] in each zone; NaN for a zone without pixels.
    pub(super) fn errors(
        &self,
        frame: ArrayView2<'_, f32>,
        truth: ArrayView2<'_, f32>,
    ) -> [f64; RINGS + 1] {
        let (mut sums, mut counts) = ([0.0; RINGS + 1], [0usize; RINGS + 1]);
        for ((place, &value), &true_value) in frame.indexed_iter().zip(truth) {
            let zone = self.zone(place);
            sums[zone] += (f64::from(value) - f64::from(true_value)).powi(2);
            counts[zone] += 1;
        }
        std::array::from_fn(|zone| sums[zone] / counts[zone] as f64)
    }

    fn zone(&self, (row, column): (usize, usize)) -> usize {
        let middle = |length: usize| (length as f64 - 1.0) / 2.0;
        let (down, right) = (row as f64 - middle(self.height), column as f64 - middle(self.width));
        let share = down.hypot(right) / self.radius;
        ((share * RINGS as f64) as usize).min(RINGS)
    }
}

#[cfg(test)]
mod tests {
    use super::Zones;
    use ndarray::Array2;

    #[test]
    fn an_error_shows_in_its_own_zone() {
        let zones = Zones::new(64, 64);
        assert_eq!(zones.radii(), [Some(8.0), Some(16.0), Some(24.0), Some(32.0), None]);
        let truth = Array2::<f32>::zeros((64, 64));
        // (row, column) of a pixel at a known distance from the centre, and its zone.
        for (place, zone) in
            [((32, 32), 0), ((32, 45), 1), ((52, 32), 2), ((1, 32), 3), ((0, 0), 4)]
        {
            let mut frame = truth.clone();
            frame[place] = 1.0;
            let errors = zones.errors(frame.view(), truth.view());
            let hit: Vec<usize> = (0..5).filter(|&zone| errors[zone] > 0.0).collect();
            assert_eq!(hit, [zone], "{place:?}");
        }
        let ones = Array2::<f32>::ones((64, 64));
        assert_eq!(zones.errors(ones.view(), truth.view()), [1.0; 5]);
    }
}
