//! Multiplexing matrices: which sub-apertures are open in which frame.

use rand::Rng;
use rand::seq::index;

use super::{OpticsError, Result, check_parameter};

/// Options for drawing random patterns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Draw {
    /// Number of open sub-apertures of each pattern.
    pub open: usize,
    /// Required rank of the matrix; `None` requires the largest possible rank.
    pub rank: Option<usize>,
    /// Largest number of draws. With half of the sub-apertures open, a few draws usually suffice.
    pub tries: usize,
}

impl Draw {
    /// Patterns with `open` sub-apertures each and the largest possible rank, in at most 1000 draws.
    pub fn of(open: usize) -> Self {
        Self { open, rank: None, tries: 1000 }
    }

    /// The required rank, checked against what `frames` patterns of `apertures` sub-apertures allow.
    fn required_rank(self, frames: usize, apertures: usize) -> Result<usize> {
        let (fits, value) =
            ((1..=apertures).contains(&self.open), format!("{} of {apertures}", self.open));
        check_parameter(fits, "open sub-apertures", value, "at least 1 and at most all of them")?;
        // With all sub-apertures open there is only one pattern.
        let possible = if self.open == apertures { 1 } else { frames.min(apertures) };
        match self.rank {
            Some(rank) if rank > possible => Err(OpticsError::Pattern(format!(
                "rank {rank} can't be reached: {frames} patterns with {} of {apertures} \
                 sub-apertures open have at most rank {possible}",
                self.open
            ))),
            rank => Ok(rank.unwrap_or(possible)),
        }
    }
}

/// The multiplexing matrix: one row per frame, one column per sub-aperture, true where it is open. Its rank limits the
/// number of frames that the masks can separate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Multiplexing {
    rows: Vec<Vec<bool>>,
}

impl Multiplexing {
    /// Draws `frames` patterns of `apertures` sub-apertures until their matrix has the required rank.
    ///
    /// Errors: [`OpticsError::Parameter`] or [`OpticsError::Pattern`] for impossible options, [`OpticsError::Rank`] if
    /// no draw has the required rank.
    pub fn random(frames: usize, apertures: usize, draw: Draw, rng: &mut impl Rng) -> Result<Self> {
        let wanted = draw.required_rank(frames, apertures)?;
        let Draw { open, tries, .. } = draw;
        let mut reached = 0;
        for _ in 0..tries {
            let matrix = Self::draw(frames, apertures, open, rng);
            reached = reached.max(matrix.rank());
            if reached >= wanted {
                return Ok(matrix);
            }
        }
        Err(OpticsError::Rank { tries, frames, open, apertures, reached, wanted })
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

    /// Rank of the matrix over the real numbers.
    pub fn rank(&self) -> usize {
        let number = |&open: &bool| f64::from(u8::from(open));
        // Entries are 0 or 1, so such small values are rounding errors.
        rank(self.rows.iter().map(|row| row.iter().map(number).collect()).collect(), 1e-9)
    }
}

/// Rank of a matrix by Gaussian elimination with pivoting. Entries up to `tolerance` count as 0.
pub(super) fn rank(mut rows: Vec<Vec<f64>>, tolerance: f64) -> usize {
    let columns = rows.first().map_or(0, Vec::len);
    let mut rank = 0;
    for column in 0..columns {
        let size = |row: &Vec<f64>| row[column].abs();
        let candidates = rows.iter().enumerate().skip(rank);
        let best = candidates.max_by(|a, b| size(a.1).total_cmp(&size(b.1)));
        let Some((pivot, _)) = best.filter(|(_, row)| size(row) > tolerance) else { continue };
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

#[cfg(test)]
mod tests {
    use super::{Draw, Multiplexing};
    use crate::{OpticsError, generator};

    fn matrix(rows: &[&[u8]]) -> Multiplexing {
        let row = |row: &&[u8]| row.iter().map(|&v| v == 1).collect();
        Multiplexing { rows: rows.iter().map(row).collect() }
    }

    #[test]
    fn rank_counts_independent_rows() {
        assert_eq!(matrix(&[&[1, 0], &[0, 1]]).rank(), 2);
        assert_eq!(matrix(&[&[1, 1], &[1, 1]]).rank(), 1);
        assert_eq!(matrix(&[&[0, 0], &[0, 0]]).rank(), 0);
        // All rows differ, but the sum of the first two equals that of the other two.
        assert_eq!(matrix(&[&[1, 1, 0, 0], &[0, 0, 1, 1], &[1, 0, 1, 0], &[0, 1, 0, 1]]).rank(), 3);
        assert_eq!(matrix(&[&[0, 1, 1], &[1, 0, 1]]).rank(), 2);
    }

    #[test]
    fn draws_have_full_rank_and_the_requested_openings() {
        for (frames, apertures) in [(6, 12), (10, 12), (12, 12), (20, 20), (30, 30), (1, 12)] {
            let drawn =
                Multiplexing::random(frames, apertures, Draw::of(apertures / 2), &mut generator(3))
                    .unwrap();
            assert_eq!(drawn.rank(), frames.min(apertures));
            assert!(drawn.rows().iter().all(|r| r.iter().filter(|&&o| o).count() == apertures / 2));
        }
        let all = Multiplexing::random(5, 4, Draw::of(4), &mut generator(1)).unwrap();
        assert_eq!(all.rank(), 1);
    }

    #[test]
    fn impossible_numbers_of_openings_are_refused() {
        for open in [0, 5] {
            let error = Multiplexing::random(3, 4, Draw::of(open), &mut generator(1)).unwrap_err();
            assert!(matches!(error, OpticsError::Parameter { .. }), "{error}");
        }
    }

    #[test]
    fn unreachable_ranks_are_refused() {
        let draw = |open, rank| Draw { rank, ..Draw::of(open) };
        let random = |frames, draw| {
            Multiplexing::random(frames, 12, draw, &mut generator(1)).unwrap_err().to_string()
        };
        let error = random(20, draw(6, Some(20)));
        assert!(error.contains("rank 20 can't be reached") && error.contains("12"), "{error}");
        // Twelve different single openings are possible, but practically never drawn by chance.
        let error = random(12, draw(1, None));
        assert!(error.contains("1000 random draws"), "{error}");
        let fewer = Multiplexing::random(6, 12, draw(6, Some(3)), &mut generator(1)).unwrap();
        assert!(fewer.rank() >= 3);
    }
}
