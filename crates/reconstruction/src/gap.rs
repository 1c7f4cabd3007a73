//! Generalized alternating projection with plug-and-play priors: Algorithm 1 of the paper (GAP: Liao, Li and Carin, SIAM
//! J. Imaging Sciences 2014).
//!
//! Given a measurement `y = H x + noise`, where `H x = Σ_k C_k ⊙ x_k` sums the `B` masked frames, one iteration is
//!
//! ```text
//! y1 ← y + m (y1 − H w)                      accelerated target, memory m ∈ [0, 1]
//! x  ← w + R Hᵀ (H R Hᵀ + γ)⁻¹ (y1 − H w)     projection P; R is the covariance of errors along time, usually 1
//! v' ← D(x)                                  prior: total variation, nonlocal low rank, FastDVDNet
//! w  ← v' + β (v' − v)                       extrapolation, momentum β
//! v  ← v'
//! ```
//!
//! All arrays are `f32` with axes (frame, row, column); frames live on \[0, 1\]. All variables start from 0.

use std::ops::ControlFlow;

use ndarray::{Array3, azip};

use super::admm;
use super::error::{ReconError, Result};
use super::iterate::{Iterate, Variables};
use super::operator::{SensingOperator, Statistics};
use super::priors::{Networks, Prior};
use super::progress::{Control, Observer, Progress};
use super::projection::{Problem, Projection, Settings, Step};
use super::schedule::{Method, Schedule};
use super::stage::{ProjectionSpec, Stage};
use super::state::State;

/// Runs a stage: up to `stage.iterations` times projection, prior and extrapolation.
///
/// `after` sees the variables after the last iteration, and after each one of a prior with a noise level; it may end the
/// stage. Returns true if the stage converged before its last iteration.
///
/// # Errors
/// A network fails, the frames are no longer finite, or [`ReconError::Cancelled`] if the observer asks for it.
pub(crate) fn run_stage(
    solver: &mut Solver<'_>,
    index: usize,
    stage: &Stage,
    observer: &mut dyn Observer,
    mut after: impl FnMut(&State) -> Result<ControlFlow<()>>,
) -> Result<bool> {
    let Solver { problem, method, gamma, y_norm, state, networks, counts } = solver;
    let settings = settings(problem.operator, stage, *gamma);
    let mut prior = stage.prior.start(problem.operator.dim(), &mut **networks)?;
    state.start(*problem, &settings, stage)?;
    for iteration in 0..stage.iterations {
        let sigma = stage.sigma_at(iteration);
        let level = sigma.unwrap_or(0.0);
        let (step, is_below) = match state {
            State::Host(iterate) => {
                let step = match method {
                    Method::Gap => self::iterate(*problem, &settings, &mut *prior, level, iterate),
                    Method::Admm => admm::iterate(*problem, &settings, &mut *prior, level, iterate),
                }?;
                let is_below = step.change.relative() < stage.tolerance;
                (step, is_below)
            }
            #[cfg(feature = "gpu")]
            State::Gpu(resident) => resident.iterate(&mut *prior, level)?,
        };
        let residual = (step.squared_residual.sqrt() / *y_norm) as f32;
        let change = step.change.relative();
        counts.add(stage);
        if !change.is_finite() {
            return Err(ReconError::Diverged { iteration: counts.done, planned: counts.planned });
        }
        let remaining = stage.iterations - iteration - 1;
        let converged = is_below && remaining > 0;
        if converged {
            counts.planned = counts.planned.saturating_sub(remaining);
        }
        let (done, planned, family) = (counts.done, counts.planned, stage.prior.family());
        let progress = Progress { stage: index, done, planned, residual, change, sigma, family };
        if observer.iteration(&progress) == Control::Cancel {
            return Err(ReconError::Cancelled);
        }
        let is_seen = converged || remaining == 0 || sigma.is_some();
        if is_seen && after(state)?.is_break() || converged {
            return Ok(converged);
        }
    }
    Ok(false)
}

/// One iteration, on the variables in `iterate`. On a GPU, the kernels of `resident.rs` do the same.
fn iterate(
    problem: Problem<'_>,
    settings: &Settings,
    prior: &mut dyn Prior,
    sigma: f32,
    iterate: &mut Iterate,
) -> Result<Step> {
    let mut projection = Projection::new(problem, settings, iterate);
    let denoised = prior.step(&mut projection, sigma)?; // x = P(w), v' = D(x)
    let step = projection.finish(&denoised);
    if let Some(w) = &mut iterate.w {
        let momentum = settings.momentum;
        azip!((w in w, &new in &denoised, &old in &iterate.v) *w = new + momentum * (new - old));
    }
    iterate.replace_frames(denoised);
    Ok(step)
}

/// The settings of a stage's iterations; `gamma` is the noise term of a stage without one.
fn settings(operator: &SensingOperator, stage: &Stage, gamma: f32) -> Settings {
    let ProjectionSpec { memory, static_variance, gamma: own } = stage.projection;
    let covariance = static_variance.map(|variance| operator.error_covariance(variance));
    let statistics = Statistics { covariance, gamma: own.unwrap_or(gamma) };
    Settings { memory, momentum: stage.momentum, statistics }
}

/// A reconstruction in progress.
pub(crate) struct Solver<'a> {
    problem: Problem<'a>,
    method: Method,
    /// Noise term of stages without one.
    gamma: f32,
    y_norm: f64,
    pub(crate) state: State,
    pub(crate) networks: &'a mut dyn Networks,
    pub(crate) counts: Counts,
}

/// Iterations of a reconstruction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Counts {
    /// Iterations done.
    pub(crate) done: usize,
    /// Largest number of iterations.
    planned: usize,
    /// Iterations with total variation.
    pub(crate) total_variation: usize,
    /// Iterations with a network.
    pub(crate) network: usize,
}

impl Counts {
    /// Counts an iteration of `stage`.
    fn add(&mut self, stage: &Stage) {
        self.done += 1;
        self.total_variation += usize::from(stage.prior.has_total_variation());
        self.network += usize::from(stage.prior.network().is_some());
    }
}

impl<'a> Solver<'a> {
    /// A reconstruction that starts from 0.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new(
        problem: Problem<'a>,
        schedule: &Schedule,
        networks: &'a mut dyn Networks,
    ) -> Result<Self> {
        let squares: f64 = problem.y.iter().map(|&value| f64::from(value) * f64::from(value)).sum();
        let planned = schedule.planned_iterations();
        let variables = Variables {
            y1: schedule.accelerated,
            w: schedule.extrapolates(),
            u: schedule.method == Method::Admm,
        };
        Ok(Self {
            problem,
            method: schedule.method,
            gamma: schedule.gamma,
            y_norm: squares.sqrt().max(f64::MIN_POSITIVE),
            state: State::new(problem, variables, &mut *networks)?,
            networks,
            counts: Counts { done: 0, planned, total_variation: 0, network: 0 },
        })
    }

    /// The frames `v` \[S B,H,W\] and their residual `||y - H v|| / ||y||`.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn finish(self) -> Result<(Array3<f32>, f32)> {
        let Problem { operator, y } = self.problem;
        let v = self.state.into_frames()?;
        let mut x = Array3::zeros(v.dim());
        let squares = operator.project(0..y.dim().1, y, None, &Statistics::default(), &v, &mut x);
        Ok((v, (squares.sqrt() / self.y_norm) as f32))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use crate::reference::{Problem, max_difference};

    /// The equations above in 64 bits and voxel by voxel.
    pub(crate) fn reference(problem: &Problem) -> Vec<f64> {
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
        v
    }

    /// With GAP's own projection and with an error covariance.
    #[test]
    fn iterations_are_those_of_the_equations() {
        for seed in 0..12 {
            let problem = Problem::random(seed, "gap");
            let difference = max_difference(&problem.solve(), &reference(&problem));
            assert!(difference < 1e-5, "{seed}: {difference}, {:?}", problem.schedule);
        }
    }
}
