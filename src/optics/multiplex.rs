//! Which sub-apertures are open in which frame.

use rand::Rng;
use rand::seq::index;

use super::OpticsError;

/// Draws before giving up. With half of the sub-apertures open a draw of full rank comes within
/// the first few.
const TRIES: usize = 1000;

/// The multiplexing matrix: a row for each frame, a column for each sub-aperture, true where
/// the sub-aperture is open. Its rank bounds how many frames the masks can tell apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Multiplexing {
    rows: Vec<Vec<bool>>,
}

impl Multiplexing {
    /// Draws `frames` patterns with exactly `open` of `apertures` sub-apertures open, until the
    /// matrix has the largest rank that is possible.
    ///
    /// # Errors
    /// `open` outside `1..=apertures`, or no such matrix within a bounded number of draws.
    pub fn random(
        frames: usize,
        apertures: usize,
        open: usize,
        rng: &mut impl Rng,
    ) -> Result<Self, OpticsError> {
        if open == 0 || open > apertures {
            return Err(OpticsError::Parameter {
                name: "open sub-apertures",
                value: format!("{open} of {apertures}"),
                range: "at least 1 and at most all of them",
            });
        }
        // With all of them open there is one pattern only.
        let wanted = if open == apertures { 1 } else { frames.min(apertures) };
        let mut reached = 0;
        for _ in 0..TRIES {
            let matrix = Self::draw(frames, apertures, open, rng);
            reached = reached.max(matrix.rank());
            if reached == wanted {
                return Ok(matrix);
            }
        }
        Err(OpticsError::Rank { tries: TRIES, frames, open, apertures, reached, wanted })
    }

    fn draw(frames: usize, apertures: usize, open: usize, rng: &mut impl Rng) -> Self {
        let pattern = |rng: &mut _| {
            let mut row = vec![false; apertures];
            index::sample(rng, apertures, open).into_iter().for_each(|i| row[i] = true);
            row
        };
        Self { rows: (0..frames).map(|_| pattern(rng)).collect() }
    }

    /// The open sub-apertures of each frame.
    pub fn rows(&self) -> &[Vec<bool>] {
        &self.rows
    }

    /// Rank over the real numbers, by elimination with pivoting.
    pub fn rank(&self) -> usize {
        let number = |&open: &bool| f64::from(u8::from(open));
        let mut rows: Vec<Vec<f64>> =
            self.rows.iter().map(|row| row.iter().map(number).collect()).collect();
        let columns = rows.first().map_or(0, Vec::len);
        let mut rank = 0;
        for column in 0..columns {
            let size = |row: &Vec<f64>| row[column].abs();
            let candidates = rows.iter().enumerate().skip(rank);
            let best = candidates.max_by(|a, b| size(a.1).total_cmp(&size(b.1)));
            // The entries are small integers: anything this small is rounding.
            let Some((pivot, _)) = best.filter(|(_, row)| size(row) > 1e-9) else { continue };
            rows.swap(rank, pivot);
            let (above, below) = rows.split_at_mut(rank + 1);
            let pivot = &above[rank];
            for row in below {
                let factor = row[column] / pivot[column];
                row.iter_mut().zip(pivot).for_each(|(value, p)| *value -= factor * p);
            }
            rank += 1;
            if rank == rows.len() {
                break;
            }
        }
        rank
    }
}

#[cfg(test)]
mod tests {
    use super::Multiplexing;
    use crate::optics::{OpticsError, generator};

    fn matrix(rows: &[&[u8]]) -> Multiplexing {
        let row = |row: &&[u8]| row.iter().map(|&v| v == 1).collect();
        Multiplexing { rows: rows.iter().map(row).collect() }
    }

    #[test]
    fn rank_is_that_of_linear_algebra() {
        assert_eq!(matrix(&[&[1, 0], &[0, 1]]).rank(), 2);
        assert_eq!(matrix(&[&[1, 1], &[1, 1]]).rank(), 1);
        assert_eq!(matrix(&[&[0, 0], &[0, 0]]).rank(), 0);
        // The rows are different, but the first two add up to the other two.
        assert_eq!(matrix(&[&[1, 1, 0, 0], &[0, 0, 1, 1], &[1, 0, 1, 0], &[0, 1, 0, 1]]).rank(), 3);
        assert_eq!(matrix(&[&[0, 1, 1], &[1, 0, 1]]).rank(), 2);
    }

    #[test]
    fn draws_have_full_rank_and_the_stated_openings() {
        for (frames, apertures) in [(6, 12), (10, 12), (12, 12), (20, 20), (30, 30), (1, 12)] {
            let drawn =
                Multiplexing::random(frames, apertures, apertures / 2, &mut generator(3)).unwrap();
            assert_eq!(drawn.rank(), frames.min(apertures));
            assert!(drawn.rows().iter().all(|r| r.iter().filter(|&&o| o).count() == apertures / 2));
        }
        let all = Multiplexing::random(5, 4, 4, &mut generator(1)).unwrap();
        assert_eq!(all.rank(), 1);
    }

    #[test]
    fn impossible_openings_are_refused() {
        for open in [0, 5] {
            let error = Multiplexing::random(3, 4, open, &mut generator(1)).unwrap_err();
            assert!(matches!(error, OpticsError::Parameter { .. }), "{error}");
        }
    }
}
