//! Alternating direction method of multipliers: `x = P(v + u)`, `v = D(x - u)`, `u <- u - (x - v)`.

use ndarray::Array3;

use super::state::State;

/// `z = x - u` in place of `x`: what goes into the prior. It is kept where the next start will stand.
pub(super) fn shift(state: &mut State, x: &mut Array3<f32>) {
    if let (Some(u), Some(z)) = (&state.multiplier, &mut state.start) {
        *x -= u;
        z.assign(x);
    }
}

/// `u = v - z`, and what is projected next, from the new iterate and the old one in the state.
pub(super) fn prepare_start(state: &mut State, new: &Array3<f32>, momentum: f32) {
    let (Some(u), Some(start)) = (&mut state.multiplier, &mut state.start) else { return };
    ndarray::azip!((u in &mut *u, &new in new, &z in &*start) *u = new - z);
    ndarray::azip!((start in start, &new in new, &old in &state.v, &u in &*u)
        *start = new + momentum * (new - old) + u);
}

#[cfg(test)]
mod tests {
    use super::super::reconstruct;
    use super::super::reference::{Problem, furthest};

    /// The equations above, with `v` extrapolated where there is momentum, in 64 bits and voxel by voxel.
    #[test]
    fn iterations_are_those_of_the_equations() {
        for seed in 0..12 {
            let problem = Problem::random(seed, "admm");
            let stage = &problem.schedule.stages[0];
            let (mut v, mut ahead, mut u) = (problem.zeros(), problem.zeros(), problem.zeros());
            let mut y1 = vec![0.0; problem.pixels()];
            for _ in 0..stage.iterations {
                let start: Vec<f64> = ahead.iter().zip(&u).map(|(v, u)| v + u).collect();
                let x = problem.project(&start, &mut y1);
                let mut new: Vec<f64> = x.iter().zip(&u).map(|(x, u)| x - u).collect();
                problem.denoise(&mut new);
                for (u, (x, v)) in u.iter_mut().zip(x.iter().zip(&new)) {
                    *u -= x - v;
                }
                let momentum = f64::from(stage.momentum);
                ahead = new.iter().zip(&v).map(|(new, old)| new + momentum * (new - old)).collect();
                v = new;
            }
            let outcome = problem.solve(reconstruct);
            assert!(furthest(&outcome.frames, &v) < 1e-5, "{seed}: {:?}", problem.schedule);
        }
    }
}
