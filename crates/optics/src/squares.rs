//! "Random squares": the masks of the hybrid coded aperture in the paper's simulation.

use ndarray::Array3;

use super::{ApertureGrid, Draw, HybridAperture, Multiplexing, Result, check_size, generator};

/// `frames` masks of `height` x `width` on \[0,1\], and the openings that made them: the paper's
/// simulation.
///
/// A random binary lithography mask (half of it open) is seen through the sub-apertures of
/// [`ApertureGrid::for_frames`], half of them open in each frame: the mask of a frame is the sum
/// of the shifted lithography masks of its open sub-apertures (Eq. 1 of the paper), divided by
/// the largest value of all frames.
/// Errors: a size of 0, or no multiplexing matrix of full rank within bounded tries.
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

    /// Mean, mean over the pixels of the deviation over the frames, mean and largest correlation
    /// between two frames.
    fn statistics(seed: u64) -> (f32, f32, f32, f32) {
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
        let mean = correlations.iter().sum::<f32>() / correlations.len() as f32;
        let largest = correlations.iter().fold(0.0f32, |a, &b| a.max(b));
        (masks.mean().unwrap(), deviation, mean, largest)
    }

    #[test]
    fn statistics_are_those_of_the_paper() {
        for seed in 0..8 {
            let (mean, deviation, correlation, largest) = statistics(seed);
            assert!((0.45..=0.55).contains(&mean), "seed {seed}: mean {mean}");
            assert!((0.117..=0.143).contains(&deviation), "seed {seed}: deviation {deviation}");
            assert!((0.45..=0.58).contains(&correlation), "seed {seed}: {correlation}");
            assert!(largest <= 0.86, "seed {seed}: largest correlation {largest}");
        }
    }

    #[test]
    fn masks_reach_one_and_repeat_with_their_seed() {
        let (masks, openings) = random_squares(8, 40, 30, 1).unwrap();
        assert_eq!(masks.fold(0.0f32, |a, &b| a.max(b)), 1.0);
        assert!(masks.iter().all(|&v| v >= 0.0));
        let (again, same) = random_squares(8, 40, 30, 1).unwrap();
        assert_eq!((masks, openings), (again, same));
    }

    #[test]
    fn a_mask_is_the_sum_of_its_open_sub_apertures() {
        // Two frames that differ in their openings differ by shifts of one lithography mask:
        // the values are sixths.
        let (masks, _) = random_squares(10, 64, 64, 4).unwrap();
        assert!(masks.iter().all(|v| (v * 6.0 - (v * 6.0).round()).abs() < 1e-5));
    }
}
