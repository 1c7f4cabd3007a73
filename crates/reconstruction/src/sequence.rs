//! Joint reconstruction of a sequence: its snapshots are cut into runs that overlap in time as tiles do in space.
//! Pure arithmetic.
//!
//! The frames of a run are solved as one clip. A cut or jump of the scene separates clips: the joint between two
//! snapshots can be cut, and the runs that contain it are then solved in pieces.

use std::ops::Range;

use super::error::{Result, check_parameter};
use super::tile::{parts, weights};

/// The runs of a sequence. They depend on the number of snapshots and the parameters alone, never on the number of
/// workers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SequencePlan {
    runs: Vec<Range<usize>>,
}

/// Snapshots of a run that are solved as one clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// Index of the run.
    pub run: usize,
    /// The snapshots, by their index in the measurement.
    pub snapshots: Range<usize>,
}

/// Contribution of one run to the frames of a snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct RunShare {
    /// Index of the run.
    pub run: usize,
    /// Position of the snapshot in the run.
    pub place: usize,
    /// Weight of each frame \[B\]; over all runs they add up to 1.
    pub weights: Vec<f32>,
}

impl RunShare {
    /// Index of frame `k` of the snapshot among the frames of the run.
    pub fn frame(&self, k: usize) -> usize {
        self.place * self.weights.len() + k
    }
}

impl SequencePlan {
    /// Cuts snapshots, given by their indices in the measurement, into as few and as short runs as possible, of at
    /// most `length` snapshots and with at least `overlap` in common with each neighbour.
    ///
    /// # Errors
    /// A length of 0, or an overlap that is not below it.
    pub fn new(snapshots: Range<usize>, length: usize, overlap: usize) -> Result<Self> {
        let (first, available) = (snapshots.start, length.min(snapshots.len()));
        check_parameter(available > 0, "the length of a run", available, "at least 1 snapshot")?;
        let range = "less than the length of a run";
        check_parameter(overlap < length, "the overlap of runs", overlap, range)?;
        let length = available;
        let runs = parts(snapshots.len(), length, overlap.min(length - 1), 1);
        Ok(Self { runs: runs.into_iter().map(|run| first + run.start..first + run.end).collect() })
    }

    /// A plan with each snapshot alone.
    pub fn separate(snapshots: Range<usize>) -> Self {
        Self { runs: snapshots.map(|snapshot| snapshot..snapshot + 1).collect() }
    }

    /// The snapshots of each run, by their indices in the measurement.
    pub fn runs(&self) -> &[Range<usize>] {
        &self.runs
    }

    /// The joints inside runs: `j` is the one between the snapshots `j` and `j + 1`.
    pub fn joints(&self) -> Vec<usize> {
        let mut joints: Vec<usize> =
            self.runs.iter().flat_map(|run| run.start..run.end - 1).collect();
        joints.sort_unstable();
        joints.dedup();
        joints
    }

    /// The pieces to be solved if the joints in `cuts` are cut, in the order of the runs. A piece inside another
    /// run's piece is left out, because it adds nothing.
    pub fn pieces(&self, cuts: &[usize]) -> Vec<Piece> {
        let mut pieces = Vec::with_capacity(self.runs.len());
        for run in 0..self.runs.len() {
            for snapshots in self.split(run, cuts) {
                // Runs are in order, so those that overlap this one are its neighbours.
                let meets = |other: &usize| {
                    let other = &self.runs[*other];
                    other.start < snapshots.end && snapshots.start < other.end
                };
                let before = (0..run).rev().take_while(meets);
                let after = (run + 1..self.runs.len()).take_while(meets);
                let is_covered_by = |other: usize| {
                    self.split(other, cuts).into_iter().any(|larger| {
                        let within = larger.start <= snapshots.start && snapshots.end <= larger.end;
                        within && (larger != snapshots || other < run)
                    })
                };
                if !before.chain(after).any(is_covered_by) {
                    pieces.push(Piece { run, snapshots });
                }
            }
        }
        pieces
    }

    /// The snapshots of a run, split at the cuts.
    fn split(&self, run: usize, cuts: &[usize]) -> Vec<Range<usize>> {
        let run = &self.runs[run];
        let mut split = Vec::new();
        let mut start = run.start;
        for last in run.clone() {
            if last + 1 == run.end || cuts.contains(&last) {
                split.push(start..last + 1);
                start = last + 1;
            }
        }
        split
    }

    /// Contributions of the runs to the `frames` frames of a snapshot, with the joints in `cuts` cut. Over the frames
    /// that two runs share, the weights change as a squared sine.
    pub fn shares(&self, snapshot: usize, cuts: &[usize], frames: usize) -> Vec<RunShare> {
        // The snapshots that no cut separates from this one.
        let (Some(first), Some(last)) = (self.runs.first(), self.runs.last()) else {
            return Vec::new();
        };
        let start = (first.start..snapshot).rev().find(|joint| cuts.contains(joint));
        let end = (snapshot..last.end).find(|joint| cuts.contains(joint));
        let (start, end) = (start.map_or(first.start, |j| j + 1), end.map_or(last.end, |j| j + 1));
        let mut pieces = self.pieces(cuts);
        pieces.retain(|piece| start <= piece.snapshots.start && piece.snapshots.end <= end);
        let frame = |snapshot: usize| (snapshot - start) * frames;
        let parts: Vec<Range<usize>> = pieces
            .iter()
            .map(|Piece { snapshots, .. }| frame(snapshots.start)..frame(snapshots.end))
            .collect();
        let weights = weights(&parts, frame(end));
        let own = |(piece, weights): (Piece, Vec<f32>)| {
            piece.snapshots.contains(&snapshot).then(|| {
                let at = frame(snapshot) - frame(piece.snapshots.start);
                RunShare {
                    run: piece.run,
                    place: snapshot - self.runs[piece.run].start,
                    weights: weights[at..at + frames].to_vec(),
                }
            })
        };
        pieces.into_iter().zip(weights).filter_map(own).collect()
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)] // lists of ranges, some of one
mod tests {
    use super::{Piece, SequencePlan};
    use proptest::prelude::{any, proptest};

    #[test]
    fn runs_are_few_and_even() {
        for (count, length, overlap, runs) in [
            (1, 5, 1, vec![0..1]),
            (5, 5, 1, vec![0..5]),
            (6, 5, 1, vec![0..4, 2..6]),
            (7, 4, 1, vec![0..4, 3..7]),
            (3, 1, 0, vec![0..1, 1..2, 2..3]),
        ] {
            let plan = SequencePlan::new(0..count, length, overlap).unwrap();
            assert_eq!(plan.runs(), runs, "{count} snapshots");
        }
        let plan = SequencePlan::new(3..10, 4, 1).unwrap();
        assert_eq!(plan.runs(), [3..7, 6..10]);
        assert_eq!(plan.joints(), (3..9).collect::<Vec<_>>());
        assert_eq!(SequencePlan::separate(2..4), SequencePlan::new(2..4, 1, 0).unwrap());
        assert!(SequencePlan::new(0..3, 0, 0).is_err());
        assert!(SequencePlan::new(0..3, 2, 2).is_err());
    }

    #[test]
    fn an_overlap_that_is_cut_is_solved_once() {
        let plan = SequencePlan::new(0..7, 4, 1).unwrap();
        let pieces = |cuts: &[usize]| -> Vec<_> {
            plan.pieces(cuts).into_iter().map(|Piece { run, snapshots }| (run, snapshots)).collect()
        };
        assert_eq!(pieces(&[]), [(0, 0..4), (1, 3..7)]);
        assert_eq!(pieces(&[1]), [(0, 0..2), (0, 2..4), (1, 3..7)]);
        // Cuts before and after the shared snapshot.
        assert_eq!(pieces(&[2]), [(0, 0..3), (1, 3..7)]);
        assert_eq!(pieces(&[3]), [(0, 0..4), (1, 4..7)]);
        let all: Vec<usize> = (0..6).collect();
        let alone = pieces(&all);
        assert_eq!(alone.len(), 7, "each once: {alone:?}");
        for snapshot in 0..7 {
            let shares = plan.shares(snapshot, &all, 3);
            assert_eq!((shares.len(), &shares[0].weights[..]), (1, &[1.0; 3][..]));
        }
    }

    proptest! {
        #[test]
        fn weights_add_up_to_one(
            first in 0usize..4,
            count in 1usize..20,
            length in 1usize..6,
            overlap in 0usize..5,
            frames in 1usize..6,
            cuts in any::<u32>(),
        ) {
            let plan = SequencePlan::new(first..first + count, length, overlap.min(length - 1)).unwrap();
            let cuts: Vec<usize> = (0..24).filter(|joint| cuts >> joint & 1 == 1).collect();
            let pieces = plan.pieces(&cuts);
            for snapshot in first..first + count {
                let shares = plan.shares(snapshot, &cuts, frames);
                for frame in 0..frames {
                    let sum: f32 = shares.iter().map(|share| share.weights[frame]).sum();
                    assert!((sum - 1.0).abs() < 1e-5, "{snapshot} {frame}: {sum}");
                }
                for share in shares {
                    let piece = |piece: &&Piece| piece.run == share.run && piece.snapshots.contains(&snapshot);
                    assert_eq!(pieces.iter().filter(piece).count(), 1);
                    assert_eq!(plan.runs()[share.run].start + share.place, snapshot);
                }
            }
        }
    }
}
