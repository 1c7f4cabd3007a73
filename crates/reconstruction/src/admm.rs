//! Alternating direction method of multipliers (Boyd et al., Foundations and Trends in Machine Learning 2011).
//!
//! One iteration, with the projection `P` of [`super::gap`] and the momentum `β`:
//!
//! ```text
//! x  ← P(w)                       w = v + u at first
//! v' ← D(x − u)
//! u  ← u − (x − v')
//! w  ← v' + β (v' − v) + u
//! v  ← v'
//! ```

use ndarray::azip;

use super::error::Result;
use super::iterate::{Change, Iterate};
use super::priors::Prior;
use super::projection::{Problem, Projection, Settings, Step};

/// One iteration, on the variables in `iterate`.
pub(crate) fn iterate(
    problem: Problem<'_>,
    settings: &Settings,
    prior: &mut dyn Prior,
    sigma: f32,
    iterate: &mut Iterate,
) -> Result<Step> {
    let mut projection = Projection::new(problem, settings, iterate);
    let mut frames = projection.all_rows(); // x = P(w)
    let squared_residual = projection.squared_residual();

    let (Some(u), Some(w)) = (&mut iterate.u, &mut iterate.w) else {
        unreachable!("ADMM has a multiplier and its own start")
    };
    frames -= &*u; // x - u, kept in w until u follows from it
    w.assign(&frames);
    prior.denoise(&mut frames, sigma)?; // v' = D(x - u)

    let v = &iterate.v;
    let change = Change::between(&frames, v);
    let momentum = settings.momentum;
    azip!((u in &mut *u, &new in &frames, &z in &*w) *u = new - z);
    azip!((w in w, &new in &frames, &old in v, &u in &*u) *w = new + momentum * (new - old) + u);
    iterate.replace_frames(frames);
    Ok(Step { squared_residual, change })
}

#[cfg(test)]
pub(crate) mod tests {
    use crate::reference::{Problem, max_difference};

    /// The equations above in 64 bits and voxel by voxel.
    pub(crate) fn reference(problem: &Problem) -> Vec<f64> {
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
        v
    }

    #[test]
    fn iterations_are_those_of_the_equations() {
        for seed in 0..12 {
            let problem = Problem::random(seed, "admm");
            let difference = max_difference(&problem.solve(), &reference(&problem));
            assert!(difference < 1e-5, "{seed}: {difference}, {:?}", problem.schedule);
        }
    }
}
