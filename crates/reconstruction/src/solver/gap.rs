//! Generalized alternating projection: `x = P(v)`, `v = D(x)` (Liao, Li and Carin, SIAM J. Imaging Sciences
//! 2014), with extrapolation.

use ndarray::Array3;

use super::state::State;

/// What is projected next, where there is momentum: from the new iterate, and the old one in the state.
pub(super) fn prepare_start(state: &mut State, new: &Array3<f32>, momentum: f32) {
    let Some(start) = &mut state.start else { return };
    ndarray::azip!((start in start, &new in new, &old in &state.v)
        *start = new + momentum * (new - old));
}

#[cfg(test)]
mod tests {
    use super::super::reconstruct;
    use super::super::reference::{Problem, furthest};

    /// `x = P(v_k + momentum (v_k - v_(k-1)))`, `v = D(x)`, everything in 64 bits and voxel by voxel, with
    /// GAP's own projection and with one that knows the error's covariance.
    #[test]
    fn iterations_are_those_of_the_equations() {
        for seed in 0..12 {
            let problem = Problem::random(seed, "gap");
            let stage = &problem.schedule.stages[0];
            let (mut v, mut start) = (problem.zeros(), problem.zeros());
            let mut y1 = vec![0.0; problem.pixels()];
            for _ in 0..stage.iterations {
                let mut x = problem.project(&start, &mut y1);
                problem.denoise(&mut x);
                let momentum = f64::from(stage.momentum);
                start = x.iter().zip(&v).map(|(new, old)| new + momentum * (new - old)).collect();
                v = x;
            }
            let outcome = problem.solve(reconstruct);
            assert!(furthest(&outcome.frames, &v) < 1e-5, "{seed}: {:?}", problem.schedule);
        }
    }
}
