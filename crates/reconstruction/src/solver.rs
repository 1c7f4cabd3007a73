//! Reconstruction of a run of snapshots by the stages of a schedule.

use std::ops::ControlFlow;

use ndarray::{Array3, ArrayView3};
use strum::Display;

use super::assessment::{Coverage, Evidence, Features};
use super::error::{Result, check_shape, shape_text};
use super::gap::{Solver, run_stage};
use super::operator::SensingOperator;
use super::priors::Networks;
pub use super::progress::{Control, Observer, Progress};
use super::projection::Problem;
use super::schedule::Schedule;
use super::stage::Stage;
use super::state::State;
use super::static_regions::{blend_moving_regions, motion_map};
use super::unmeasured::Measured;

/// Why a reconstruction ended; by name `converged` or `max-iterations`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[strum(serialize_all = "kebab-case")]
pub enum StopReason {
    /// The last stage's change fell below its tolerance.
    Converged,
    /// All planned iterations were done.
    MaxIterations,
}

/// A reconstructed run of snapshots.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The frames of all snapshots \[S B,H,W\].
    pub frames: Array3<f32>,
    /// Iterations of all stages.
    pub iterations: usize,
    /// Iterations with total variation.
    pub tv_iterations: usize,
    /// Iterations with a network.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the result.
    pub residual: f32,
    /// Why it ended.
    pub stop_reason: StopReason,
    /// Features of the quality model, for each piece of the run, if requested.
    pub features: Vec<Features>,
    /// Hold-out evidence of the frames' error, if requested.
    pub evidence: Option<Evidence>,
    /// The coverage of each block by the measurement \[S, rows, columns\], if requested.
    pub coverage: Option<Array3<Coverage>>,
}

/// Reconstructs the `S B` frames of a run of snapshots `y` \[S,H,W\], both on the scale on which the scene is on \[0,1\].
/// The priors see the frames of all snapshots as one clip; each measured pixel depends on its own `B` frames. NaN of `y` were
/// not measured and are left out.
///
/// Starts from 0. Networks are requested when a stage needs them.
///
/// # Errors
/// Sizes that disagree, an invalid schedule, a missing or failing network, divergence, or [`super::ReconError::Cancelled`] when
/// the observer asks for it.
pub fn reconstruct(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome> {
    run_stages(op, y, schedule, networks, observer, |_, _, _| Ok(()))
}

/// As [`reconstruct`], with the features of the quality model; they include those of the encoder if a stage runs a network.
///
/// # Errors
/// As [`reconstruct`].
pub fn reconstruct_assessed(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome> {
    let (mut early, mut weakly_shrunk) = (None, None);
    let after = |stage: usize, state: &State, weak: Option<Array3<f32>>| {
        if stage == 0 && schedule.stages.len() > 1 {
            early = Some(state.frames()?.into_owned());
        }
        weakly_shrunk = weak;
        Ok(())
    };
    let mut outcome = run_stages(op, y, schedule, &mut *networks, observer, after)?;
    let early = early.as_ref().map(|early| early.view());
    let learned = schedule.needs_network();
    let mut features_of = |frames| {
        let encoder = if learned { networks.encoder()? } else { None };
        Features::of(op, early, frames, encoder)
    };
    let mut features = features_of(outcome.frames.view())?;
    if let Some(weak) = &weakly_shrunk {
        let weak = weak.view();
        features = features.with_first_run(features_of(weak)?, outcome.frames.view(), weak);
    }
    outcome.features.push(features);
    Ok(outcome)
}

/// Runs the stages. After each, `after` receives its index, the variables, and the frames of the weakly shrunk run if the
/// stage was run twice.
pub(crate) fn run_stages(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
    mut after: impl FnMut(usize, &State, Option<Array3<f32>>) -> Result<()>,
) -> Result<Outcome> {
    schedule.validate()?;
    let (snapshots, height, width) = op.measurement_dim();
    let expected = format!("{} (the masks' size)", shape_text(&[snapshots, height, width]));
    let fits = y.dim() == op.measurement_dim();
    check_shape(fits, "the measurement", shape_text(y.shape()), expected)?;
    // Before anything is computed, so that a missing network is reported at once.
    schedule.networks().into_iter().try_for_each(|which| networks.network(which).map(|_| ()))?;
    let measured = Measured::new(op, y);
    let problem = Problem { operator: &measured.op, y: &measured.y };
    let mut solver = Solver::new(problem, schedule, networks)?;
    let mut converged = false;
    for (index, stage) in schedule.stages.iter().enumerate() {
        let weak;
        (converged, weak) = match stage.static_shrinkage() {
            None => (run_once(&mut solver, index, stage, observer)?, None),
            Some(shrinkage) => run_twice(&mut solver, index, stage, shrinkage, observer)?,
        };
        after(index, &solver.state, weak)?;
    }
    let counts = solver.counts;
    let (frames, residual) = solver.finish()?;
    Ok(Outcome {
        frames,
        iterations: counts.done,
        tv_iterations: counts.total_variation,
        denoiser_passes: counts.network,
        residual,
        stop_reason: if converged { StopReason::Converged } else { StopReason::MaxIterations },
        features: Vec::new(),
        evidence: None,
        coverage: None,
    })
}

fn run_once(
    solver: &mut Solver<'_>,
    index: usize,
    stage: &Stage,
    observer: &mut dyn Observer,
) -> Result<bool> {
    run_stage(solver, index, stage, observer, |_| Ok(ControlFlow::Continue(())))
}

/// Runs a stage with weak, and again with strong temporal shrinkage from the same start, and blends the weakly shrunk frames
/// into the moving regions of the result. Returns those frames too.
fn run_twice(
    solver: &mut Solver<'_>,
    index: usize,
    stage: &Stage,
    strong_shrinkage: f32,
    observer: &mut dyn Observer,
) -> Result<(bool, Option<Array3<f32>>)> {
    let blended = stage.prior.nonlocal().is_some_and(|nonlocal| !nonlocal.all_static);
    let weak_stage = stage.without_static_regions();
    let mut strong_stage = weak_stage.clone();
    if let Some(nonlocal) = strong_stage.prior.nonlocal_mut() {
        nonlocal.temporal_shrinkage = strong_shrinkage;
    }
    let start = solver.state.snapshot()?;
    run_once(solver, index, &weak_stage, observer)?;
    let motion = match blended {
        true => Some(motion_map(&*start.frames()?, &*solver.state.frames()?)),
        false => None,
    };
    let weak = solver.state.restore(start).into_host()?;
    let converged = run_once(solver, index, &strong_stage, observer)?;
    if let Some(motion) = motion {
        solver.state.edit_frames(|frames| blend_moving_regions(frames, &weak, &motion))?;
    }
    Ok((converged, Some(weak)))
}

#[cfg(test)]
mod tests {
    use super::{
        Control, Observer, Progress, blend_moving_regions, motion_map, reconstruct,
        reconstruct_assessed,
    };
    use crate::operator::SensingOperator;
    use crate::schedule::Schedule;
    use ndarray::{Array3, ArrayView3, s};
    use rand::{RngExt, SeedableRng};

    #[test]
    fn a_stage_run_twice_is_the_blend_of_its_runs() {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(9);
        let masks = Array3::from_shape_simple_fn((5, 48, 48), || rng.random::<f32>());
        // Fine texture that is static on the left and moves on the right.
        let texture: Vec<f32> = (0..48 * 60).map(|_| rng.random()).collect();
        let truth = Array3::from_shape_fn((5, 48, 48), |(k, i, j)| {
            texture[60 * i + j + if j < 24 { 0 } else { 2 * k }]
        });
        let op = SensingOperator::new(masks).unwrap();
        let y = op.forward(truth.view()).unwrap();
        let solve = |shrinkage: Option<(f32, Option<f32>, bool)>| {
            let mut schedule = Schedule::pnp_nonlocal();
            let mut stage = schedule.stages.pop().unwrap();
            if let Some((temporal, in_static_regions, all_static)) = shrinkage {
                let nonlocal = stage.prior.nonlocal_mut().unwrap();
                nonlocal.temporal_shrinkage = temporal;
                (nonlocal.static_shrinkage, nonlocal.all_static) = (in_static_regions, all_static);
                stage.iterations = 8;
                schedule.stages.push(stage);
            }
            let mut steps = Vec::new();
            let mut watch = Steps(&mut steps);
            let outcome =
                reconstruct_assessed(&op, y.view(), &schedule, &mut (), &mut watch).unwrap();
            let twice = schedule.stages.iter().any(|stage| stage.static_shrinkage().is_some());
            assert_eq!(outcome.features[0].first_run.is_some(), twice, "the weakly shrunk run");
            assert!(steps.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 >= pair[1].1));
            assert_eq!(
                steps.last().map(|step| step.0 == step.1),
                Some(true),
                "all iterations are done"
            );
            outcome.frames
        };
        let (before, little) = (solve(None), solve(Some((0.35, None, false))));
        let much = solve(Some((1.4, None, false)));
        assert_eq!(solve(Some((0.35, Some(1.4), true))), much);
        let mut expected = much;
        let motion = motion_map(&before, &little);
        blend_moving_regions(&mut expected, &little, &motion);
        assert!(motion.iter().any(|share| *share < 0.1) && motion.iter().any(|share| *share > 0.9));
        assert_eq!(solve(Some((0.35, Some(1.4), false))), expected);
    }

    /// Iterations done, and planned.
    struct Steps<'a>(&'a mut Vec<(usize, usize)>);

    impl Observer for Steps<'_> {
        fn iteration(&mut self, progress: &Progress) -> Control {
            self.0.push((progress.done, progress.planned));
            Control::Continue
        }
    }

    /// If no prior looks along time, a run of snapshots gives the same bits as each snapshot alone.
    #[test]
    fn snapshots_are_independent_if_no_prior_looks_along_time() {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(9);
        let masks = Array3::from_shape_simple_fn((4, 40, 24), || rng.random::<f32>());
        let y = Array3::from_shape_simple_fn((3, 40, 24), || 2.0 * rng.random::<f32>());
        let solve = |y: ArrayView3<'_, f32>, schedule: &Schedule| {
            let op = SensingOperator::new(masks.clone()).unwrap().over(y.dim().0).unwrap();
            reconstruct(&op, y, schedule, &mut (), &mut ()).unwrap().frames
        };
        let schedule = Schedule::gap_tv().with_iterations(20);
        let together = solve(y.view(), &schedule);
        for snapshot in 0..3 {
            let alone = solve(y.slice(s![snapshot..=snapshot, .., ..]), &schedule);
            assert_eq!(alone, together.slice(s![4 * snapshot..4 * snapshot + 4, .., ..]));
        }
        let along_time = Schedule::gap_tv3d().with_iterations(20);
        let alone = solve(y.slice(s![1..2, .., ..]), &along_time);
        assert_ne!(alone, solve(y.view(), &along_time).slice(s![4..8, .., ..]));
    }
}
