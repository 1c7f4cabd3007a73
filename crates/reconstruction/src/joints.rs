//! Whether snapshots that follow one another belong together, found out on a piece of them.
//!
//! As for [`super::pilot`], only the measurement can judge: some pixels are kept from the solver, and what the
//! frames say about them is compared with what was measured there. Where the scene goes on, the error of two
//! snapshots together is less than that of each alone; behind a cut or a jump it is more.

use std::ops::Range;

use ndarray::{ArrayView3, s};

use super::error::{ReconError, Result};
use super::held_out::HeldOut;
use super::prior::Networks;
use super::schedule::Schedule;
use super::sensing::SensingOperator;
use super::solver::{self, Observer};

/// What was found out about the joint between two snapshots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointFinding {
    /// The index of the snapshot before it.
    pub after: usize,
    /// Error at the held-out pixels of both, `||y - Hv|| / ||y||`, each alone; infinite if one diverged.
    pub alone: f64,
    /// The same of both together.
    pub together: f64,
}

impl JointFinding {
    /// Whether they are as good together.
    pub fn belong_together(&self) -> bool {
        self.together <= self.alone
    }
}

/// One in so many iterations of each stage is enough: which is better shows early.
pub const SHORTER: usize = 3;

/// Compares the two snapshots of each joint, given by the index of the one before it, alone and together, by
/// a schedule whose stages are shortened, their levels falling as far. `op` is that of a snapshot, `y`
/// \[S,H,W\] has all of them, the first with the index `first`.
/// Errors: as [`solver::reconstruct`].
pub fn compare(
    op: &SensingOperator,
    (first, y): (usize, ArrayView3<'_, f32>),
    joints: &[usize],
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Vec<JointFinding>> {
    let mut schedule = schedule.clone();
    for stage in &mut schedule.stages {
        stage.iterations = stage.iterations.div_ceil(SHORTER);
    }
    let mut errors = |snapshots: Range<usize>| {
        let op = op.clone().over(snapshots.len())?;
        let held_out = HeldOut::of(&op, snapshots.start);
        let y = y.slice(s![snapshots.start - first..snapshots.end - first, .., ..]);
        let seen = op.clone().without(&held_out.pixels);
        match solver::reconstruct(&seen, y, &schedule, networks, observer) {
            Ok(outcome) => Ok(held_out.squares(&op, y, outcome.frames.view())),
            Err(ReconError::Diverged { .. }) => Ok((f64::INFINITY, 1.0)),
            Err(error) => Err(error),
        }
    };
    let mut findings = Vec::with_capacity(joints.len());
    // The snapshot that was looked at last, alone.
    let mut last = None;
    for &after in joints {
        let mut alone = |snapshot: usize| match last {
            Some((found, squares)) if found == snapshot => Ok(squares),
            _ => errors(snapshot..snapshot + 1),
        };
        let (before, behind) = (alone(after)?, alone(after + 1)?);
        last = Some((after + 1, behind));
        let together = errors(after..after + 2)?;
        findings.push(JointFinding {
            after,
            alone: ((before.0 + behind.0) / (before.1 + behind.1)).sqrt(),
            together: (together.0 / together.1).sqrt(),
        });
    }
    Ok(findings)
}

#[cfg(test)]
mod tests {
    use super::{JointFinding, compare};
    use crate::schedule::Schedule;
    use crate::sensing::SensingOperator;
    use ndarray::{Array3, Axis, stack};
    use optics::{iid_masks, measure};

    /// Of two snapshots of a still scene, or of two scenes.
    fn find(cut: bool) -> JointFinding {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let frames = |sign: f32| {
            Array3::from_shape_fn((6, 64, 64), |(_, i, j)| {
                0.5 + sign * 0.4 * (i as f32 * 0.2).sin() * (j as f32 * 0.15).sin()
            })
        };
        let snapshot = |sign| measure(masks.view(), frames(sign).view()).unwrap();
        let (before, behind) = (snapshot(1.0), snapshot(if cut { -1.0 } else { 1.0 }));
        let y = stack(Axis(0), &[before.view(), behind.view()]).unwrap();
        let op = SensingOperator::new(masks.clone()).unwrap();
        let schedule = Schedule { adaptive: false, ..Schedule::gap_tv3d() };
        compare(&op, (5, y.view()), &[5], &schedule, &mut (), &mut ()).unwrap()[0]
    }

    #[test]
    fn snapshots_of_one_scene_belong_together_and_those_of_two_do_not() {
        let (still, cut) = (find(false), find(true));
        assert_eq!(still.after, 5);
        assert!(still.belong_together() && !cut.belong_together(), "{still:?} {cut:?}");
    }
}
