//! "Random squares": the masks of the paper's simulated hybrid coded aperture.

use ndarray::Array3;

use super::{ApertureGrid, Draw, HybridAperture, Multiplexing, Result, check_size, generator};

/// Masks \[frames, height, width\] on \[0,1\] as in the paper's simulation, and their multiplexing matrix.
///
/// A random binary lithography mask, half open, is projected through the sub-apertures of [`ApertureGrid::for_frames`],
/// half of them open in each frame. A mask is the sum of the lithography masks shifted by the open sub-apertures (Eq. 1
/// of the paper). All masks are divided by their largest value.
///
/// Errors: [`OpticsError::Parameter`](super::OpticsError::Parameter) if a size is 0, and
/// [`OpticsError::Rank`](super::OpticsError::Rank) if no draw has full rank.
pub fn random_squares(
    frames: usize,
    height: usize,
    width: usize,
    seed: u64,
) -> Result<(Array3<f32>, Multiplexing)> {
    check_size(frames, height, width)?;
    let grid = ApertureGrid::for_frames(frames);
    let mut rng = generator(seed);
    let draw = Draw::of(grid.count() / 2);
    let openings = Multiplexing::random(frames, grid.count(), draw, &mut rng)?;
    let patterns = openings.patterns(grid);
    let projected = HybridAperture::default().masks(patterns.view(), (height, width), &mut rng)?;
    Ok((projected.masks, openings))
}

#[cfg(test)]
mod tests {
    use super::random_squares;
    use ndarray::{Array2, Axis};

    struct Statistics {
        mean: f32,
        /// Standard deviation over the masks, averaged over all pixels.
        deviation: f32,
        mean_correlation: f32,
        largest_correlation: f32,
    }

    fn statistics(seed: u64) -> Statistics {
        let (masks, openings) = random_squares(10, 128, 128, seed).unwrap();
        assert_eq!(openings.rank(), 10);
        let deviation = masks.std_axis(Axis(0), 0.0).mean().unwrap();
        let centred: Vec<Array2<f32>> =
            masks.outer_iter().map(|m| &m - m.mean().unwrap()).collect();
        let mut correlations = Vec::new();
        for (k, a) in centred.iter().enumerate() {
            for b in &centred[..k] {
                let norm = ((a * a).sum() * (b * b).sum()).sqrt();
                correlations.push((a * b).sum() / norm);
            }
        }
        Statistics {
            mean: masks.mean().unwrap(),
            deviation,
            mean_correlation: correlations.iter().sum::<f32>() / correlations.len() as f32,
            largest_correlation: correlations.iter().fold(0.0f32, |a, &b| a.max(b)),
        }
    }

    #[test]
    fn statistics_match_the_paper() {
        for seed in 0..8 {
            let Statistics { mean, deviation, mean_correlation, largest_correlation } =
                statistics(seed);
            assert!((0.45..=0.55).contains(&mean), "seed {seed}: mean {mean}");
            assert!((0.117..=0.143).contains(&deviation), "seed {seed}: deviation {deviation}");
            assert!((0.45..=0.58).contains(&mean_correlation), "seed {seed}: {mean_correlation}");
            assert!(largest_correlation <= 0.86, "seed {seed}: {largest_correlation}");
        }
    }

    #[test]
    fn masks_are_normalised_and_reproducible() {
        let (masks, openings) = random_squares(8, 40, 30, 1).unwrap();
        assert_eq!(masks.fold(0.0f32, |a, &b| a.max(b)), 1.0);
        assert!(masks.iter().all(|&v| v >= 0.0));
        let (again, same) = random_squares(8, 40, 30, 1).unwrap();
        assert_eq!((masks, openings), (again, same));
    }

    #[test]
    fn a_mask_is_the_sum_of_its_open_sub_apertures() {
        // Six of twelve sub-apertures are open, so values are multiples of one sixth.
        let (masks, _) = random_squares(10, 64, 64, 4).unwrap();
        assert!(masks.iter().all(|v| (v * 6.0 - (v * 6.0).round()).abs() < 1e-5));
    }
}
