//! Decides by hold-out validation on a crop whether neighbouring snapshots are reconstructed together.
//!
//! Some pixels are hidden from the solver, and the frames predict them, as in [`super::pilot`]. In a continuous scene
//! the hold-out error of two snapshots together is below that of each alone. Across a cut or jump it is above.

use std::ops::Range;

use ndarray::{ArrayView3, s};

use super::error::{ReconError, Result};
use super::hold_out::HoldOut;
use super::operator::SensingOperator;
use super::priors::Networks;
use super::schedule::Schedule;
use super::solver::{self, Observer};
use super::unmeasured::Measured;

/// Comparison of the two snapshots at a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointFinding {
    /// Index of the snapshot before the joint.
    pub after: usize,
    /// Hold-out error of both snapshots, `||y - Hv|| / ||y||`, each reconstructed alone; infinite if one diverged.
    pub alone: f64,
    /// Hold-out error of both snapshots reconstructed together.
    pub together: f64,
}

impl JointFinding {
    /// True if the snapshots are at least as good together.
    pub fn belong_together(&self) -> bool {
        self.together <= self.alone
    }
}

/// Divisor of the iterations of each stage. The better choice shows early.
pub const ITERATION_DIVISOR: usize = 3;

/// Compares the two snapshots of each joint, given by the index of the first one, alone and together, with shortened
/// stages. `op` is the operator of one snapshot; `y` \[S,H,W\] contains all snapshots, and `first` is the index of the
/// first one.
///
/// # Errors
/// As [`solver::reconstruct`].
pub fn compare(
    op: &SensingOperator,
    first: usize,
    y: ArrayView3<'_, f32>,
    joints: &[usize],
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Vec<JointFinding>> {
    let mut schedule = schedule.clone();
    for stage in &mut schedule.stages {
        stage.iterations = stage.iterations.div_ceil(ITERATION_DIVISOR);
    }
    let mut errors = |snapshots: Range<usize>| {
        let op = op.clone().over(snapshots.len())?;
        let y = y.slice(s![snapshots.start - first..snapshots.end - first, .., ..]);
        let Measured { op, y } = Measured::new(&op, y);
        let (op, y) = (&*op, y.view());
        let hold_out = HoldOut::draw(op, snapshots.start);
        let reduced = op.clone().without(&hold_out.pixels);
        match solver::reconstruct(&reduced, y, &schedule, networks, observer) {
            Ok(outcome) => Ok(hold_out.squares(op, y, outcome.frames.view())),
            Err(ReconError::Diverged { .. }) => Ok((f64::INFINITY, 1.0)),
            Err(error) => Err(error),
        }
    };
    let mut findings = Vec::with_capacity(joints.len());
    // The latest snapshot that was reconstructed alone.
    let mut last = None;
    for &after in joints {
        let mut alone = |snapshot: usize| match last {
            Some((known, squares)) if known == snapshot => Ok(squares),
            _ => errors(snapshot..snapshot + 1),
        };
        let (before, next) = (alone(after)?, alone(after + 1)?);
        last = Some((after + 1, next));
        let together = errors(after..after + 2)?;
        findings.push(JointFinding {
            after,
            alone: ((before.0 + next.0) / (before.1 + next.1)).sqrt(),
            together: (together.0 / together.1).sqrt(),
        });
    }
    Ok(findings)
}

#[cfg(test)]
mod tests {
    use super::{JointFinding, compare};
    use crate::operator::SensingOperator;
    use crate::schedule::Schedule;
    use ndarray::{Array3, Axis, stack};
    use optics::{iid_masks, measure};

    /// Compares two snapshots of a still scene, or of two scenes.
    fn compared(cut: bool) -> JointFinding {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let frames = |sign: f32| {
            Array3::from_shape_fn((6, 64, 64), |(_, i, j)| {
                0.5 + sign * 0.4 * (i as f32 * 0.2).sin() * (j as f32 * 0.15).sin()
            })
        };
        let snapshot = |sign| measure(masks.view(), frames(sign).view()).unwrap();
        let (before, next) = (snapshot(1.0), snapshot(if cut { -1.0 } else { 1.0 }));
        let y = stack(Axis(0), &[before.view(), next.view()]).unwrap();
        let op = SensingOperator::new(masks.clone()).unwrap();
        let schedule = Schedule { adaptive: false, ..Schedule::gap_tv3d() };
        compare(&op, 5, y.view(), &[5], &schedule, &mut (), &mut ()).unwrap()[0]
    }

    #[test]
    fn snapshots_of_one_scene_belong_together_and_those_of_two_do_not() {
        let (still, cut) = (compared(false), compared(true));
        assert_eq!(still.after, 5);
        assert!(still.belong_together() && !cut.belong_together(), "{still:?} {cut:?}");
    }
}
