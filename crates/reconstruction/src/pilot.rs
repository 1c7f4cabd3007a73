//! The pilot: adapts a schedule to a measurement by hold-out validation on a crop (cross-validation for compressed
//! sensing: Ward 2009).
//!
//! Without the true frames, only the measurement can judge. One in fourteen pixels of the crop is hidden from the solver.
//! After each iteration the frames predict these pixels, and the squared error of the prediction is the hold-out error. It
//! falls while the frames improve, and rises when the solver begins to fit noise or the network to hallucinate. It also
//! rises at the start of a stage whose noise level is far above the remaining error, and falls again with that level. So a
//! stage is run to its end before it is judged.
//!
//! Stage by stage, the candidates of a grid (`GRID`) replace the planned settings where their smallest hold-out error
//! is significantly smaller. The last stage then ends early where its error is smallest.

use std::ops::ControlFlow;

use ndarray::{Array3, ArrayView3};
use serde::{Deserialize, Serialize};
use strum::Display;

use super::assessment::Evidence;
use super::error::{ReconError, Result};
use super::evidence;
use super::gap::{Solver, run_stage};
use super::hold_out::{HoldOut, t_statistic};
use super::operator::SensingOperator;
use super::priors::Networks;
use super::progress::Observer;
use super::projection::Problem;
use super::schedule::{Heuristic, Schedule};
use super::stage::Stage;
use super::state::{Frames, State};
use super::trial::{Trial, is_strong, temporal_shrinkage};
use super::unmeasured::Measured;

/// A candidate that trails by this t-statistic after half of its iterations is abandoned.
const ABANDON_T: f64 = 2.0;

/// The settings that are tried in place of the planned ones. The values of a heuristic are tried in their order, until one is
/// not accepted. They are factors of the planned value, where 0 drops the setting; those of the noise term are in units of
/// the variance of the slowest change.
const GRID: [(Heuristic, &[f32]); 4] = [
    (Heuristic::TemporalVariation, &[0.0]),
    (Heuristic::TemporalShrinkage, &[4.0, 8.0]),
    (Heuristic::StaticVariance, &[0.0]),
    (Heuristic::NoiseTerm, &[1.0, 3.0]),
];

/// True if the planned stage has the setting that a heuristic changes.
fn applies(heuristic: Heuristic, planned: &Stage) -> bool {
    let projection = planned.projection;
    match heuristic {
        Heuristic::TemporalVariation => {
            planned.prior.tv().is_some_and(|tv| tv.temporal_weight > 0.0)
        }
        Heuristic::TemporalShrinkage => temporal_shrinkage(planned) > 0.0,
        Heuristic::StaticVariance => projection.static_variance.is_some(),
        Heuristic::NoiseTerm => projection.static_variance.is_some() && projection.gamma.is_none(),
        Heuristic::EarlyStopping | Heuristic::StaticScene | Heuristic::StaticRegions => false,
    }
}

/// The stage to be tried in place of the best one, if it can be better.
fn candidate(heuristic: Heuristic, value: f32, planned: &Stage, best: &Trial) -> Option<Stage> {
    if !applies(heuristic, planned) {
        return None;
    }
    let mut stage = best.stage.clone();
    match heuristic {
        Heuristic::TemporalVariation => stage.prior.tv_mut()?.temporal_weight *= value,
        Heuristic::TemporalShrinkage => {
            stage.prior.nonlocal_mut()?.temporal_shrinkage = value * temporal_shrinkage(planned);
        }
        Heuristic::StaticVariance => stage.projection.static_variance = None,
        // Noise raises the error long before the stage ends. Without noise a term only costs.
        _ if stage.projection.gamma.is_none()
            && best.best_iteration() * 10 > planned.iterations * 9 =>
        {
            return None;
        }
        _ => stage.projection.gamma = Some(value),
    }
    Some(stage)
}

/// Decisions of the pilot on one stage, with their evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Decided {
    /// The planned stage.
    pub planned: Stage,
    /// The decided stage; with 0 iterations it is left out.
    pub stage: Stage,
    /// Hold-out error before the stage, `||y - Hv|| / ||y||` over the hold-out pixels.
    pub error_before: f64,
    /// Hold-out error after the decided iterations.
    pub error_after: f64,
    /// Reason for the number of iterations.
    pub end: StageEnd,
}

/// Reason for a stage's number of iterations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, Serialize, Deserialize, schemars::JsonSchema)]
#[strum(serialize_all = "kebab-case")]
#[serde(rename_all = "kebab-case")]
pub enum StageEnd {
    /// The number is fixed.
    Fixed,
    /// The full stage is run.
    MaxIterations,
    /// The remaining iterations raise the error.
    Converged,
    /// The frames are soon after no longer finite.
    Diverged,
}

/// The decisions of a pilot.
#[derive(Debug)]
pub struct Decisions {
    /// One for each stage of the schedule.
    pub stages: Vec<Decided>,
    /// Hold-out evidence of the error of the decided schedule's frames.
    pub evidence: Option<Evidence>,
}

/// Adapts `schedule` to the crop `y` \[1,H,W\] of a measurement, on the scale on which the scene is on \[0,1\].
///
/// # Errors
/// As [`super::solver::reconstruct`].
pub fn decide(
    whole: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Decisions> {
    schedule.validate()?;
    let Measured { op: whole, y: y_owned } = Measured::new(whole, y);
    let (whole, y) = (&*whole, y_owned.view());
    let hold_out = HoldOut::draw(whole, 0);
    let op = whole.clone().without(&hold_out.pixels);
    let problem = Problem { operator: &op, y: &y_owned };
    let mut solver = Solver::new(problem, schedule, networks)?;
    let mut judge = Judge { problem, hold_out: &hold_out, observer };
    let mut trials: Vec<Trial> = Vec::with_capacity(schedule.stages.len());
    let (mut early, mut weakly_shrunk) = (None, None);
    for (index, planned) in schedule.stages.iter().enumerate() {
        let (trial, weak) = judge.choose(&mut solver, schedule, index, planned)?;
        weakly_shrunk = weak;
        if early.is_none() {
            early = Some(solver.state.frames()?.into_owned());
        }
        let diverged = trial.diverged;
        trials.push(trial);
        if diverged {
            break;
        }
    }
    let last = trials.iter().rev().find_map(|trial| trial.best_frames.as_ref());
    let evidence = early.as_ref().zip(last).and_then(|(early, last)| {
        let measurement = evidence::HeldOutMeasurement { whole, op: &op, y, hold_out: &hold_out };
        let evidence = |frames: &Array3<f32>| measurement.evidence(schedule, early, frames);
        let first = weakly_shrunk.as_ref().and_then(evidence).map(Box::new);
        Some(Evidence { first, ..evidence(last)? })
    });
    Ok(Decisions { stages: conclude(schedule, &trials), evidence })
}

/// Runs stages and measures their hold-out errors.
struct Judge<'a> {
    problem: Problem<'a>,
    hold_out: &'a HoldOut,
    observer: &'a mut dyn Observer,
}

impl Judge<'_> {
    /// Tries the planned stage and the candidates. The solver then stands after the best trial, which is returned with the
    /// weakly shrunk frames, if strong shrinkage was accepted and static regions are to be blended.
    fn choose(
        &mut self,
        solver: &mut Solver<'_>,
        schedule: &Schedule,
        index: usize,
        planned: &Stage,
    ) -> Result<(Trial, Option<Array3<f32>>)> {
        let start = solver.state.snapshot()?;
        let planned = planned.without_static_regions();
        let mut best = self.run(solver, index, &planned, None)?;
        let mut weakly_shrunk = None;
        for (heuristic, values) in GRID.iter().filter(|(heuristic, _)| schedule.has(*heuristic)) {
            for value in *values {
                let Some(stage) = candidate(*heuristic, *value, &planned, &best) else { break };
                let end = solver.state.snapshot()?;
                solver.state.restore(start.copied()?);
                let trial = self.run(solver, index, &stage, Some(&best))?;
                if !trial.is_better_than(&best, schedule) {
                    solver.state.restore(end);
                    break;
                }
                let is_static = best.is_static || trial.indicates_static_scene(&best, schedule);
                let replaced = std::mem::replace(&mut best, Trial { is_static, ..trial });
                if is_strong(best.shrinkage(), replaced.shrinkage()) {
                    weakly_shrunk = replaced.best_frames;
                }
            }
        }
        Ok((best, weakly_shrunk.filter(|_| schedule.has(Heuristic::StaticRegions))))
    }

    /// Runs a stage to its end, unless it clearly trails `rival`, the best trial so far. A stage without a noise level is
    /// measured after its last iteration only.
    fn run(
        &mut self,
        solver: &mut Solver<'_>,
        index: usize,
        stage: &Stage,
        rival: Option<&Trial>,
    ) -> Result<Trial> {
        let fixed = stage.prior.sigma().is_none();
        let norm = self.hold_out.norm(self.problem.y.view());
        let mut trial = Trial::new(stage.clone());
        let mut best = None;
        let measure = |state: &State| {
            let squares = state.hold_out_residuals(self.problem, self.hold_out)?;
            let done = trial.errors.len() + 1;
            let rivals = rival.filter(|_| !fixed).and_then(|rival| rival.squares.get(done - 1));
            let trails = rivals.is_some_and(|rivals| t_statistic(&squares, rivals) > ABANDON_T);
            if trial.add((squares.iter().sum::<f64>() / norm).sqrt(), squares) {
                best = Some(state.keep_frames()?);
            }
            trial.abandoned = trails && 2 * done >= stage.iterations;
            Ok(if trial.abandoned { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
        };
        // A stage with a noise level is judged at its full length.
        let tolerance = if fixed { stage.tolerance } else { 0.0 };
        let run = Stage { tolerance, ..stage.clone() };
        match run_stage(solver, index, &run, &mut *self.observer, measure) {
            Err(ReconError::Diverged { .. }) if !fixed => trial.diverged = true,
            other => {
                other?;
                trial.last_frames = Some(solver.state.frames()?.into_owned());
            }
        }
        trial.best_frames = best.map(Frames::into_host).transpose()?;
        Ok(trial)
    }
}

/// The decisions that follow from the trials. Early stopping ends the last stage with a noise level; earlier stages run as
/// planned, because later ones depend on them in a way that a small crop does not show. A stage after one that diverged is
/// left out.
fn conclude(schedule: &Schedule, trials: &[Trial]) -> Vec<Decided> {
    let last = schedule.stages.iter().rposition(|stage| stage.prior.sigma().is_some());
    let last = last.filter(|_| schedule.has(Heuristic::EarlyStopping));
    let mut error_before = 1.0;
    let decide = |(index, planned): (usize, &Stage)| {
        let trial = trials.get(index);
        let errors = trial.map_or(&[][..], |trial| &trial.errors);
        let done = match trial {
            Some(trial) if last == Some(index) => trial.early_stopping_iteration(),
            _ => errors.len(),
        };
        let error_after = errors[..done].last().copied().unwrap_or(error_before);
        let fixed = planned.prior.sigma().is_none();
        let diverged = trial.is_none_or(|trial| trial.diverged) && done == errors.len();
        let (iterations, end) = match (fixed && trial.is_some(), diverged) {
            (true, _) => (planned.iterations, StageEnd::Fixed),
            (false, true) => (done, StageEnd::Diverged),
            (false, false) if done < planned.iterations => (done, StageEnd::Converged),
            (false, false) => (done, StageEnd::MaxIterations),
        };
        // The planned noise levels, and the settings of the best trial.
        let mut stage = trial.map_or(planned, |trial| &trial.stage).shortened(iterations);
        let early = 2 * done < planned.iterations;
        restrict_to_static_regions(&mut stage, planned, early, schedule);
        let error_before = std::mem::replace(&mut error_before, error_after);
        Decided { planned: planned.clone(), stage, error_before, error_after, end }
    };
    schedule.stages.iter().enumerate().map(decide).collect()
}

/// Restricts strong shrinkage to static regions, because something outside of the crop may move. The first iterations do not
/// show what does, so a stage that stops `early` treats the whole picture as static.
fn restrict_to_static_regions(
    stage: &mut Stage,
    planned: &Stage,
    early: bool,
    schedule: &Schedule,
) {
    let Some(nonlocal) = stage.prior.nonlocal_mut() else { return };
    let weak = temporal_shrinkage(planned);
    let strong = nonlocal.temporal_shrinkage;
    if is_strong(strong, weak) && schedule.has(Heuristic::StaticRegions) {
        nonlocal.temporal_shrinkage = weak;
        nonlocal.static_shrinkage = Some(strong);
        nonlocal.all_static = early;
    }
}

impl Schedule {
    /// Largest cost of a pilot, CPU-nanoseconds per voxel of the crop.
    pub fn pilot_ns_per_voxel(&self) -> f64 {
        let trials = |stage: &Stage| {
            let tried = GRID.iter().filter(|(heuristic, _)| self.has(*heuristic));
            let values = tried.filter(|(heuristic, _)| applies(*heuristic, stage));
            1 + values.map(|(_, values)| values.len()).sum::<usize>()
        };
        self.stages.iter().map(|stage| stage.planned_ns() * trials(stage) as f64).sum()
    }

    /// The fixed schedule that a pilot decided on. A stage without iterations is left out, unless no other remains.
    pub fn decided(&self, decisions: &[Decided]) -> Self {
        let stages = decisions.iter().map(|decided| decided.stage.clone());
        let mut stages: Vec<Stage> = stages.filter(|stage| stage.iterations > 0).collect();
        if stages.is_empty() {
            stages.clone_from(&self.stages);
        }
        Self { adaptive: false, stages, ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::{Decided, StageEnd, Trial, conclude, decide};
    use crate::ReconError;
    use crate::operator::SensingOperator;
    use crate::priors::nonlocal::NonlocalSpec;
    use crate::priors::{Denoiser, Network, Networks};
    use crate::schedule::{Heuristic, Schedule};
    use crate::solver::{Control, Observer, Progress};
    use crate::stage::Stage;
    use ndarray::{Array2, Array3, Axis};
    use optics::{iid_masks, measure};
    use rand::{RngExt, SeedableRng};
    use std::ops::Range;

    /// Moves towards the true frames in some iterations, counted from 1, and away from them in the others.
    struct Unreliable {
        truth: Array3<f32>,
        good: Range<usize>,
        iterations: usize,
        /// Factor of the frames in the others.
        harm: f32,
    }

    impl Denoiser for Unreliable {
        fn denoise(&mut self, frames: &mut Array3<f32>, _: f32) -> Result<(), ReconError> {
            self.iterations += 1;
            match self.good.contains(&self.iterations) {
                true => frames.zip_mut_with(&self.truth, |x, &truth| *x += 0.3 * (truth - *x)),
                false => frames.mapv_inplace(|x| x * self.harm),
            }
            Ok(())
        }
    }

    impl Networks for Unreliable {
        fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser, ReconError> {
            Ok(self)
        }
    }

    fn pilot(planned: usize, good: Range<usize>, harm: f32) -> (Schedule, Vec<Decided>) {
        let masks = iid_masks(4, 48, 48, 3).unwrap();
        let truth = Array3::from_shape_fn((4, 48, 48), |(k, i, j)| {
            0.5 + 0.4 * ((i + 3 * k) as f32 * 0.4).sin() * (j as f32 * 0.3).cos()
        });
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
        let op = SensingOperator::new(masks).unwrap();
        let mut schedule = Schedule::pnp_ffdnet();
        schedule.stages[1].iterations = planned;
        // So that each iteration helps.
        schedule.stages[1].projection.memory = 0.0;
        let mut network = Unreliable { truth, good, iterations: 0, harm };
        let decisions = decide(&op, y.view(), &schedule, &mut network, &mut ()).unwrap();
        (schedule, decisions.stages)
    }

    #[test]
    fn iterations_that_harm_are_left_out() {
        let (schedule, stages) = pilot(60, 1..10, 0.7);
        assert_eq!((stages[0].stage.iterations, stages[0].end), (60, StageEnd::Fixed));
        assert_eq!((stages[1].stage.iterations, stages[1].end), (9, StageEnd::Converged));
        assert!(stages[1].error_after < 0.5 * stages[1].error_before);
        assert_eq!(stages[1].error_before, stages[0].error_after);
        let decided = schedule.decided(&stages);
        assert!(!decided.adaptive);
        let level = |schedule: &Schedule, index| schedule.stages[1].sigma_at(index);
        assert_eq!(level(&decided, 0), level(&schedule, 0));
        let (last, planned) = (level(&decided, 8).unwrap(), level(&schedule, 8).unwrap());
        assert!((last - planned).abs() < 1e-6, "levels fall as planned");
    }

    #[test]
    fn iterations_that_help_are_kept() {
        let (_, stages) = pilot(6, 1..7, 1.0);
        assert_eq!((stages[1].stage.iterations, stages[1].end), (6, StageEnd::MaxIterations));
    }

    /// A noise level far above the remaining error harms at first.
    #[test]
    fn a_stage_is_judged_by_its_end_not_by_its_start() {
        let (_, stages) = pilot(60, 30..61, 0.7);
        assert_eq!((stages[1].stage.iterations, stages[1].end), (60, StageEnd::MaxIterations));
        assert!(stages[1].error_after < 0.5 * stages[1].error_before);
    }

    /// Adapts the default schedule of the nonlocal prior to a scene of 6 frames, and returns its nonlocal stage.
    fn nonlocal_stage(schedule: &Schedule, truth: &Array3<f32>) -> Stage {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
        let op = SensingOperator::new(masks).unwrap();
        let mut decisions = decide(&op, y.view(), schedule, &mut (), &mut ()).unwrap();
        decisions.stages.remove(1).stage
    }

    fn nonlocal(stage: &Stage) -> NonlocalSpec {
        stage.prior.nonlocal().unwrap().clone()
    }

    fn drifting_wave(speed: f32) -> Array3<f32> {
        Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
            0.5 + 0.4 * ((i as f32 + speed * k as f32) * 0.3).sin() * (j as f32 * 0.2).cos()
        })
    }

    fn still_texture() -> Array3<f32> {
        let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(5);
        // Too fine for the filter of groups.
        let texture = Array2::from_shape_simple_fn((64, 64), || random.random::<f32>());
        Array3::from_shape_fn((6, 64, 64), |(_, i, j)| texture[[i, j]])
    }

    fn short_nonlocal_schedule() -> Schedule {
        let mut schedule = Schedule::pnp_nonlocal();
        schedule.stages[1].iterations = 20;
        schedule
    }

    #[test]
    fn total_variation_along_time_is_left_out_where_it_blurs() {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let weight = |flicker: bool| {
            let truth = Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
                let wave = 0.4 * (i as f32 * 0.2).sin() * (j as f32 * 0.15).sin();
                0.5 + if flicker && k % 2 == 1 { -wave } else { wave }
            });
            let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
            let op = SensingOperator::new(masks.clone()).unwrap();
            let schedule = Schedule::gap_tv3d();
            let decisions = decide(&op, y.view(), &schedule, &mut (), &mut ()).unwrap();
            decisions.stages[0].stage.prior.tv().unwrap().temporal_weight
        };
        let planned = Schedule::gap_tv3d().stages[0].prior.tv().unwrap().temporal_weight;
        assert_eq!((weight(false), weight(true)), (planned, 0.0));
    }

    /// In a static scene the whole error is static.
    #[test]
    fn a_static_variance_that_is_too_small_is_not_kept() {
        let mut schedule = short_nonlocal_schedule();
        let mut decided = |speed: f32, planned: f32| {
            schedule.stages[1].projection.static_variance = Some(planned);
            nonlocal_stage(&schedule, &drifting_wave(speed)).projection.static_variance
        };
        assert_eq!(decided(2.0, 0.5), Some(0.5));
        assert_ne!(decided(0.0, 0.05), Some(0.05));
    }

    #[test]
    fn static_scenes_are_strongly_shrunk_and_moving_ones_are_not() {
        let schedule = short_nonlocal_schedule();
        let planned = nonlocal(&schedule.stages[1]).temporal_shrinkage;
        let still = nonlocal(&nonlocal_stage(&schedule, &still_texture()));
        assert_eq!(still.temporal_shrinkage, planned);
        assert!(still.static_shrinkage.is_some_and(|strong| strong >= 4.0 * planned), "{still:?}");
        let moving = nonlocal(&nonlocal_stage(&schedule, &drifting_wave(2.0)));
        assert!(moving.static_shrinkage.is_none() && moving.temporal_shrinkage <= planned);
    }

    #[test]
    fn heuristics_can_be_disabled_one_by_one() {
        use Heuristic::{EarlyStopping, StaticRegions, TemporalShrinkage};
        let decided = |disabled: Vec<Heuristic>| {
            let schedule = Schedule { disabled, ..short_nonlocal_schedule() };
            (schedule.pilot_ns_per_voxel(), nonlocal_stage(&schedule, &still_texture()))
        };
        let (cost, _) = decided(vec![]);
        let (cheaper, unshrunk) = decided(vec![TemporalShrinkage, EarlyStopping]);
        let planned = nonlocal(&short_nonlocal_schedule().stages[1]);
        assert_eq!(nonlocal(&unshrunk).temporal_shrinkage, planned.temporal_shrinkage);
        assert_eq!((nonlocal(&unshrunk).static_shrinkage, unshrunk.iterations), (None, 20));
        assert!(cheaper < cost, "fewer candidates are tried");
        let (same, everywhere) = decided(vec![StaticRegions]);
        assert!(nonlocal(&everywhere).temporal_shrinkage >= 4.0 * planned.temporal_shrinkage);
        assert_eq!((nonlocal(&everywhere).static_shrinkage, same), (None, cost));
    }

    /// A trial whose four frames change by `changes`, and whose hold-out error is `behind` standard errors greater than that
    /// of a trial with the other `side`.
    fn trial(shrinkage: f32, changes: [f32; 4], (side, behind): (usize, f64)) -> Trial {
        let mut stage = Schedule::pnp_nonlocal().stages[1].clone();
        stage.prior.nonlocal_mut().unwrap().temporal_shrinkage = shrinkage;
        let square = |pixel: usize| ((pixel + side) % 2) as f64 + behind / 10.0;
        let frames = Array3::from_shape_fn((4, 8, 8), |(k, i, _)| i as f32 + changes[k]);
        Trial {
            errors: vec![1.0],
            squares: vec![(0..100).map(square).collect()],
            best_frames: Some(frames.clone()),
            last_frames: Some(frames),
            ..Trial::new(stage)
        }
    }

    #[test]
    fn changes_that_strong_shrinkage_removes_were_no_motion() {
        let schedule = Schedule::pnp_nonlocal();
        let planned = trial(0.35, [1.0, -1.0, 1.0, -1.0], (0, 0.0));
        let strong = |changes, behind| trial(1.4, changes, (1, behind));
        let is_better = |one: &Trial, other: &Trial| one.is_better_than(other, &schedule);
        let (others, fewer) = ([0.1, 0.1, -0.1, -0.1], [0.1, -0.1, 0.1, -0.1]);
        assert!(is_better(&strong(others, 1.0), &planned), "the changes were not in the scene");
        assert!(is_better(&strong([0.0; 4], 1.0), &planned), "no change remains");
        assert!(!is_better(&strong(others, 2.0), &planned), "it is clearly worse");
        assert!(
            !is_better(&strong(fewer, 1.0), &planned),
            "the remaining changes existed before shrinkage"
        );
        let disabled = vec![Heuristic::StaticScene];
        let without = Schedule { disabled, ..schedule.clone() };
        assert!(!strong(others, 1.0).is_better_than(&planned, &without));
        // With noise the error may be smallest before shrinkage has had any effect.
        let early = Trial { best_frames: planned.best_frames.clone(), ..strong(others, 1.0) };
        assert!(is_better(&early, &planned), "the frames at the end decide");
        // This applies to eightfold shrinkage too.
        let best = Trial { is_static: true, ..strong(others, 1.0) };
        let eightfold = |behind| trial(2.8, [0.0; 4], (0, behind));
        assert!(is_better(&eightfold(2.0), &best) && !is_better(&eightfold(3.0), &best));
        let moving = Trial { is_static: false, ..best };
        assert!(!is_better(&eightfold(0.5), &moving), "significantly, where something moves");
    }

    #[test]
    fn a_stage_that_ends_early_treats_the_whole_picture_as_static() {
        let mut schedule = Schedule::pnp_nonlocal();
        let planned = nonlocal(&schedule.stages[1]).temporal_shrinkage;
        let tv = Trial { errors: vec![1.0], ..Trial::new(schedule.stages[0].clone()) };
        let mut trials = [tv, Trial::new(schedule.stages[1].clone())];
        let mut decided = |iterations, shrinkage| {
            schedule.stages[1].iterations = iterations;
            trials[1] = Trial { diverged: true, ..trial(shrinkage, [0.0; 4], (0, 0.0)) };
            let decided = conclude(&schedule, &trials).remove(1).stage;
            assert_eq!(decided.iterations, 1);
            let decided = nonlocal(&decided);
            (decided.temporal_shrinkage, decided.static_shrinkage, decided.all_static)
        };
        let strong = 4.0 * planned;
        assert_eq!(decided(2, strong), (planned, Some(strong), false));
        assert_eq!(decided(3, strong), (planned, Some(strong), true));
        assert_eq!(decided(3, 2.0 * planned), (2.0 * planned, None, false));
    }

    #[test]
    fn a_candidate_that_clearly_trails_is_abandoned() {
        struct Steps(usize);
        impl Observer for Steps {
            fn iteration(&mut self, progress: &Progress) -> Control {
                self.0 += usize::from(progress.stage == 1);
                Control::Continue
            }
        }
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let y = measure(masks.view(), drifting_wave(2.0).view()).unwrap().insert_axis(Axis(0));
        let op = SensingOperator::new(masks).unwrap();
        let mut schedule = short_nonlocal_schedule();
        schedule.stages[1].projection.static_variance = None;
        let mut steps = Steps(0);
        decide(&op, y.view(), &schedule, &mut (), &mut steps).unwrap();
        assert_eq!(steps.0, 30, "the planned stage, and half of one with strong shrinkage");
    }

    #[test]
    fn noise_brings_a_noise_term() {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let y = measure(masks.view(), drifting_wave(2.0).view()).unwrap().insert_axis(Axis(0));
        let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(3);
        let noise = y.mapv(|_| (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0);
        let op = SensingOperator::new(masks).unwrap();
        let gamma = |schedule: &Schedule, sigma: f32| {
            let y = &y + &(sigma * &noise);
            let decisions = decide(&op, y.view(), schedule, &mut (), &mut ()).unwrap();
            decisions.stages[1].stage.projection.gamma
        };
        let mut schedule = Schedule::pnp_nonlocal();
        assert_eq!(gamma(&schedule, 0.0), None);
        assert!(gamma(&schedule, 0.2).is_some_and(|gamma| gamma > 0.0));
        schedule.stages[1].projection.gamma = Some(0.1);
        assert_eq!(gamma(&schedule, 0.2), Some(0.1), "a stated term is kept");
    }

    #[test]
    fn divergence_ends_the_stage_before_it() {
        let (schedule, mut stages) = pilot(60, 1..6, f32::INFINITY);
        assert_eq!((stages[1].stage.iterations, stages[1].end), (5, StageEnd::Diverged));
        let (_, none) = pilot(60, 1..1, f32::INFINITY);
        assert_eq!((none[1].stage.iterations, none[1].end), (0, StageEnd::Diverged));
        assert_eq!(
            schedule.decided(&none).stages.len(),
            1,
            "a stage without iterations is left out"
        );
        stages.iter_mut().for_each(|decided| decided.stage.iterations = 0);
        assert_eq!(schedule.decided(&stages).stages.len(), 2, "but not all stages");
    }
}
