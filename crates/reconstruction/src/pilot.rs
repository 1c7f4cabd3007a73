//! How far along its schedule a reconstruction should go, found out on a piece of the measurement.
//!
//! Without the truth, only the measurement can judge. One in fourteen of the piece's pixels is
//! kept from the solver, and after each iteration what the frames say about these pixels is compared
//! with what was measured there (cross-validation). That error falls as long as the frames get
//! better and rises when the solver begins to fit noise or the network to invent. It also rises where
//! a prior takes over at a level far above the error that is left, and falls again with the level: so
//! the whole stage is run, and judged by its end.

use std::ops::Range;

use ndarray::{Array3, ArrayView2, ArrayView3, Axis, s};

use super::assessment::{Evidence, features};
use super::error::{ReconError, Result};
use super::held_out::HeldOut;
use super::prior::Networks;
use super::rest;
use super::schedule::{MAX_STATIC_VARIANCE, Schedule, Stage};
use super::sensing::SensingOperator;
use super::signs::Signs;
use super::solver::{self, Observer, Run};
use strum::Display;

/// Side of the piece that the pilot is run on: a tenth of a tile.
pub const SIDE: usize = 96;

/// The last iteration whose error comes this near to the least is the end. Where the error hardly changes any
/// more, the frames often still get better: in doubt the schedule goes on.
const SLACK: f64 = 0.005;

/// How much greater than the least the error after the last iteration may be, in standard errors of the
/// difference, for the whole plan to be run: one that has really turned loses far more by going on than this
/// can tell.
const CHANCE: f64 = 1.5;

/// What is behind by so many standard errors is clearly behind: a variant of a stage, from half of its
/// iterations on, is given up then.
const CLEAR: f64 = 2.0;

/// Correlation of the temporal changes under weak and under strong shrinkage. Below this value the scene counts as
/// static. Swept on 224 simulated scenes (`research/NOTEBOOK.md`): 27 of 33 static ones and 8 of 191 others are below.
const MOTION: f32 = 0.45;

/// Side in pixels of the squares over which a scene without texture and motion is even.
const EVEN: usize = 8;

/// The rows and columns of the piece: of all that lie side by side in a measurement `y` \[H,W\], the one with
/// most texture and motion. An even part would tell nothing, and where it is bright its measurement varies as
/// much as any: by the sum of the masks, `light` \[H,W\], alone. So that counts which `y = light x`, with one
/// `x` for each square of the piece, leaves of the measurement's energy.
pub fn piece(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> (Range<usize>, Range<usize>) {
    let (height, width) = y.dim();
    let starts = |length: usize| {
        let last = length.saturating_sub(SIDE);
        (0..last).step_by(SIDE).chain([last])
    };
    let window =
        |row: usize, column: usize| (row..height.min(row + SIDE), column..width.min(column + SIDE));
    let uneven = |(rows, columns): &(Range<usize>, Range<usize>)| {
        let window = s![rows.clone(), columns.clone()];
        let (light, y) = (light.slice(window), y.slice(window));
        let squares =
            light.exact_chunks((EVEN, EVEN)).into_iter().zip(y.exact_chunks((EVEN, EVEN)));
        squares.map(|(light, y)| left(light, y)).sum::<f64>()
    };
    starts(height)
        .flat_map(|row| starts(width).map(move |column| window(row, column)))
        .max_by(|a, b| uneven(a).total_cmp(&uneven(b)))
        .unwrap_or((0..height, 0..width))
}

/// `min_x ||y - light x||^2`.
fn left(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> f64 {
    let (mut yy, mut ly, mut ll) = (0.0, 0.0, 0.0);
    for (&light, &y) in light.iter().zip(y) {
        let (light, y) = (f64::from(light), f64::from(y));
        yy += y * y;
        ly += light * y;
        ll += light * light;
    }
    if ll > 0.0 { yy - ly * ly / ll } else { yy }
}

/// What was found out about a stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageFinding {
    /// Iterations that pay; 0 for a stage that is better left out.
    pub iterations: usize,
    /// Weight of the total variation along time, if it pays; else 0.
    pub temporal_weight: f32,
    /// Shrinkage of changes along time; 0 in a stage that has none.
    pub temporal_shrinkage: f32,
    /// The same where nothing moves, if four times as much or more pays.
    pub rest_shrinkage: Option<f32>,
    /// Whether all is taken to be at rest then.
    pub rest_everywhere: bool,
    /// Static variance of the projection, if one pays.
    pub static_variance: Option<f32>,
    /// Noise term of the projection, where it is not the schedule's.
    pub gamma: Option<f32>,
    /// Error at the held-out pixels before the stage: `||y - Hv|| / ||y||` over them.
    pub before: f64,
    /// The same after so many iterations.
    pub after: f64,
    /// Why no more.
    pub end: StageEnd,
}

/// Why a stage has as many iterations as it has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[strum(serialize_all = "snake_case")]
pub enum StageEnd {
    /// Its number is fixed.
    Fixed,
    /// All that may be were done, and paid.
    #[strum(serialize = "max-iterations")]
    Planned,
    /// What followed, to the end of the schedule, raised the error.
    Converged,
    /// The iteration left the finite numbers soon after.
    Diverged,
}

/// Runs `schedule` on a piece of a measurement, both on the scale on which the scene is on \[0,1\],
/// and tells where it should end. Stages of total variation alone, which cost next to nothing, are taken
/// as they are, but for their part along time: it is left out if the stage's error is less without.
/// With what it tells of the error of the frames.
/// Errors: as [`super::solver::reconstruct`].
pub fn run(
    whole: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<(Vec<StageFinding>, Option<Evidence>)> {
    schedule.validate()?;
    let held_out = HeldOut::of(whole, 0);
    let op = whole.clone().without(&held_out.pixels);
    let mut run = Run::new(&op, y, schedule, &mut *networks);
    let mut courses: Vec<Course> = Vec::with_capacity(schedule.stages.len());
    let mut early = None;
    // The frames of the last stage before they were shrunk four times as much.
    let mut first = None;
    for (index, stage) in schedule.stages.iter().enumerate() {
        let mut watch = Watch { op: &op, y, held_out: &held_out, index, observer: &mut *observer };
        let start = run.state();
        first = None;
        let once = stage.run_once();
        let mut course = watch.stage(&once, None, &mut run)?;
        for variant in VARIANTS {
            let Some(variant) = variant(&op, &once, &course) else { continue };
            let end = run.state();
            run.restore(start.clone());
            let found = watch.stage(&variant, Some(&course), &mut run)?;
            if found.surpasses(&course) {
                let at_rest = course.at_rest || found.stills(&course);
                let taken = Course { at_rest, ..found };
                let before = std::mem::replace(&mut course, taken);
                if fourfold(course.shrinkage(), before.shrinkage()) {
                    first = before.best;
                }
            } else {
                course.last_given_up = found.given_up;
                run.restore(end);
            }
        }
        let diverged = course.diverged;
        courses.push(course);
        early.get_or_insert_with(|| run.frames().to_owned());
        if diverged {
            break;
        }
    }
    let last = courses.iter().rev().find_map(|course| course.best.as_ref());
    let evidence = early.as_ref().zip(last).and_then(|(early, last)| {
        let tell = |frames: &Array3<f32>| {
            tell((whole, &op, y), &held_out, schedule, (early.view(), frames.view()))
        };
        let first = first.as_ref().and_then(tell).map(Box::new);
        Some(Evidence { first, ..tell(last)? })
    });
    Ok((judge(schedule, &courses), evidence))
}

/// What the first snapshot tells of the error of a fixed schedule's frames, on the piece of it that [`piece`]
/// gives, and both on the scale on which the scene is on \[0,1\]; none if no light reaches it, or the
/// iteration diverges. Costs a run of the schedule on that piece.
/// Errors: as [`super::solver::reconstruct`].
pub fn evidence(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
) -> Result<Option<Evidence>> {
    let light = op.masks().sum_axis(Axis(0));
    let (rows, columns) = piece(light.view(), y.index_axis(Axis(0), 0));
    let masks = op.masks().slice(s![.., rows.clone(), columns.clone()]).to_owned();
    let whole = match SensingOperator::new(masks) {
        Err(ReconError::DarkMasks { .. }) => return Ok(None),
        other => other?,
    };
    let held_out = HeldOut::of(&whole, 0);
    let op = whole.clone().without(&held_out.pixels);
    let y = y.slice(s![..1, rows, columns]);
    let mut early: Option<Array3<f32>> = None;
    let solved = solver::stages((&op, y), schedule, networks, &mut (), |_, run| {
        early.get_or_insert_with(|| run.frames().to_owned());
    });
    let outcome = match solved {
        // Nothing is told then; whether the frames themselves diverge is the solver's to say.
        Err(ReconError::Diverged { .. }) => return Ok(None),
        other => other?,
    };
    let early = early.as_ref().unwrap_or(&outcome.frames).view();
    Ok(tell((&whole, &op, y), &held_out, schedule, (early, outcome.frames.view())))
}

/// What the frames of a piece, after the first stage and at the end, tell: by `y` at the held-out pixels,
/// which the operator `op` lacks, and by themselves.
fn tell(
    (whole, op, y): (&SensingOperator, &SensingOperator, ArrayView3<'_, f32>),
    held_out: &HeldOut,
    schedule: &Schedule,
    (early, last): (ArrayView3<'_, f32>, ArrayView3<'_, f32>),
) -> Option<Evidence> {
    let signs = Signs::of((op, y), held_out, early, last)?;
    let early = (schedule.stages.len() > 1).then_some(early);
    Some(Evidence::new(signs, &features(whole, early, last)))
}

/// What a stage, as planned, may be instead of what was taken last.
type Variant = fn(&SensingOperator, &Stage, &Course) -> Option<Stage>;

/// One after the other is run, and taken if it is better.
const VARIANTS: [Variant; 7] = [
    without_time,
    with_fourfold_shrinkage,
    with_other_shrinkage,
    with_more_variance,
    without_variance,
    with_noise,
    with_other_noise,
];

fn without_time(_: &SensingOperator, planned: &Stage, _: &Course) -> Option<Stage> {
    let weighs = planned.temporal_weight.is_some_and(|weight| weight > 0.0);
    weighs.then(|| Stage { temporal_weight: None, ..planned.clone() })
}

fn shrunk(planned: &Stage) -> Option<f32> {
    planned.temporal_shrinkage.filter(|shrinkage| *shrinkage > 0.0)
}

/// For scenes at rest, or with a background that is.
fn with_fourfold_shrinkage(_: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    let fourfold = Some(4.0 * shrunk(planned)?);
    Some(Stage { temporal_shrinkage: fourfold, ..taken.stage.clone() })
}

/// Still more, if that was taken; else less, unless that was clearly worse.
fn with_other_shrinkage(_: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    let as_planned = taken.stage.temporal_shrinkage == planned.temporal_shrinkage;
    if as_planned && taken.last_given_up {
        return None;
    }
    let times = if as_planned { 2.0 } else { 8.0 };
    Some(Stage { temporal_shrinkage: Some(times * shrunk(planned)?), ..taken.stage.clone() })
}

/// Where masks differ much it is at its bound.
fn with_more_variance(op: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    if op.differ_much() {
        return None;
    }
    let double = (2.0 * planned.static_variance?).min(MAX_STATIC_VARIANCE);
    Some(Stage { static_variance: Some(double), ..taken.stage.clone() })
}

fn without_variance(_: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    planned.static_variance?;
    Some(Stage { static_variance: None, ..taken.stage.clone() })
}

/// Noise terms in units of the variance of the error's slowest change. Less changes nothing.
const NOISE: [f32; 3] = [0.3, 1.0, 3.0];

/// Noise makes the error rise long before the stage ends. Without noise, a term only costs.
fn with_noise(_: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    let supposes = planned.static_variance.is_some() && planned.gamma.is_none();
    let early = taken.turn() * 10 <= planned.iterations * 9;
    (supposes && early).then(|| Stage { gamma: Some(NOISE[1]), ..taken.stage.clone() })
}

/// More, if that was taken; else, if it was tried, less.
fn with_other_noise(op: &SensingOperator, planned: &Stage, taken: &Course) -> Option<Stage> {
    if planned.gamma.is_none() && taken.stage.gamma.is_some() {
        return Some(Stage { gamma: Some(NOISE[2]), ..taken.stage.clone() });
    }
    Some(Stage { gamma: Some(NOISE[0]), ..with_noise(op, planned, taken)? })
}

impl Schedule {
    /// The most that a pilot of it may cost, CPU-nanoseconds per voxel of the piece.
    pub fn pilot_ns_per_voxel(&self) -> f64 {
        // As many as `VARIANTS` may ask for.
        let runs = |stage: &Stage| {
            1 + usize::from(stage.temporal_weight.is_some())
                + 2 * usize::from(shrunk(stage).is_some())
                + stage.static_variance.map_or(0, |_| 2 + usize::from(stage.gamma.is_none()) * 2)
        };
        self.stages.iter().map(|stage| stage.planned_ns() * runs(stage) as f64).sum()
    }
}

/// The errors of a stage on its way.
struct Course {
    /// As it was run.
    stage: Stage,
    /// After each iteration; of a stage without a level after the last one alone.
    errors: Vec<f64>,
    /// `(y - Hv)^2` of each held-out pixel, likewise.
    squares: Vec<Vec<f64>>,
    /// The frames where the error was least.
    best: Option<Array3<f32>>,
    /// The frames after the last iteration.
    last: Option<Array3<f32>>,
    /// Whether the next iteration left the finite numbers.
    diverged: bool,
    /// Whether it was clearly behind what it was to surpass, and not run to its end.
    given_up: bool,
    /// Whether the last variant was given up for it.
    last_given_up: bool,
    /// Whether shrinkage has left little of what changed.
    at_rest: bool,
}

/// Whether a shrinkage along time is four times another one or more.
fn fourfold(own: f32, others: f32) -> bool {
    others > 0.0 && own >= 4.0 * others
}

impl Course {
    /// Where the frames predict the held-out pixels best.
    fn least(&self) -> f64 {
        self.errors.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Iterations up to where the error is least.
    fn turn(&self) -> usize {
        let least = self.least();
        self.errors.iter().position(|error| *error == least).map_or(0, |index| index + 1)
    }

    /// `(y - Hv)^2` of each held-out pixel there.
    fn least_squares(&self) -> &[f64] {
        self.turn().checked_sub(1).map_or(&[], |index| &self.squares[index])
    }

    /// Iterations up to where the error is about least; all, if after the last one it is not greater by more
    /// than chance.
    fn paid(&self) -> usize {
        let all_done = !self.diverged && self.errors.len() == self.stage.iterations;
        let last = self.squares.last().map_or(&[][..], Vec::as_slice);
        if all_done && excess(last, self.least_squares()) <= CHANCE {
            return self.errors.len();
        }
        let near = self.least() * (1.0 + SLACK);
        self.errors.iter().rposition(|error| *error <= near).map_or(0, |index| index + 1)
    }

    /// The frames there. With noise the error may be least after the first iteration, which shrinks little.
    fn end(&self) -> Option<&Array3<f32>> {
        if self.paid() == self.errors.len() { self.last.as_ref() } else { self.best.as_ref() }
    }

    fn shrinkage(&self) -> f32 {
        self.stage.temporal_shrinkage.unwrap_or(0.0)
    }

    /// Whether it has four times the shrinkage of another, and little of what changed there.
    fn stills(&self, other: &Self) -> bool {
        let (own, others) = (self.shrinkage(), other.shrinkage());
        let frames = self.end().zip(other.end());
        let frames = frames.filter(|_| fourfold(own, others));
        frames.is_some_and(|(own, others)| rest::correlation(own, others) < MOTION)
    }

    /// Whether its least error is below that of another by more than chance: by more than the standard error of
    /// the mean difference. Where noise outweighs the frames' error, few pixels could tell anything.
    ///
    /// A static variance gives up changes for what frames have in common, of which a measurement tells more
    /// than it counts in the frames: so for another one the difference must be thrice as clear. What fourfold
    /// shrinkage of changes spares a scene at rest hardly shows in a measurement: where it has left little of what
    /// changed, it is enough not to be clearly worse, also for still more.
    fn surpasses(&self, other: &Self) -> bool {
        if self.given_up {
            return false;
        }
        let (own_squares, others_squares) = (self.least_squares(), other.least_squares());
        if own_squares.is_empty() || others_squares.is_empty() {
            return self.least() < other.least();
        }
        let (own, others) = (self.shrinkage(), other.shrinkage());
        let errors = if self.stage.static_variance != other.stage.static_variance {
            3.0
        } else if self.stills(other) || own > others && other.at_rest {
            -1.5
        } else {
            1.0
        };
        excess(others_squares, own_squares) > errors
    }
}

/// By how many standard errors of the mean difference one thing's squared errors at the held-out pixels are
/// greater than another's.
fn excess(one: &[f64], other: &[f64]) -> f64 {
    let differences = || one.iter().zip(other).map(|(one, other)| one - other);
    let count = one.len() as f64;
    let mean = differences().sum::<f64>() / count;
    let variance = differences().map(|difference| (difference - mean).powi(2)).sum::<f64>() / count;
    if variance > 0.0 { mean / (variance / count).sqrt() } else { 0.0 }
}

/// Ends the last stage with a level where its own error is about least. Those before it run as planned: what
/// follows builds on them, and their errors on so small a piece can't tell how. Stages that were not reached
/// are left out.
fn judge(schedule: &Schedule, courses: &[Course]) -> Vec<StageFinding> {
    let last = schedule.stages.iter().rposition(|stage| stage.sigma.is_some());
    let mut before = 1.0;
    let finding = |(index, stage): (usize, &Stage)| {
        let course = courses.get(index);
        let errors = course.map_or(&[][..], |course| &course.errors);
        let done = match course {
            Some(course) if last == Some(index) => course.paid(),
            _ => errors.len(),
        };
        let diverged = course.is_none_or(|course| course.diverged) && done == errors.len();
        let (iterations, end) = match (stage.sigma.is_none(), diverged) {
            (true, _) => (stage.iterations, StageEnd::Fixed),
            (false, true) => (done, StageEnd::Diverged),
            (false, false) if done < stage.iterations => (done, StageEnd::Converged),
            (false, false) => (done, StageEnd::Planned),
        };
        let after = errors[..done].last().copied().unwrap_or(before);
        let temporal_weight = course.and_then(|course| course.stage.temporal_weight).unwrap_or(0.0);
        let shrinkage = course.map_or(0.0, Course::shrinkage);
        let planned = stage.temporal_shrinkage.unwrap_or(0.0);
        let rest_shrinkage = fourfold(shrinkage, planned).then_some(shrinkage);
        let temporal_shrinkage = if rest_shrinkage.is_some() { planned } else { shrinkage };
        // Something may move elsewhere in the picture; what, the first iterations don't tell.
        let rest_everywhere = rest_shrinkage.is_some() && 2 * done < stage.iterations;
        let static_variance = course.and_then(|course| course.stage.static_variance);
        let gamma = course.and_then(|course| course.stage.gamma);
        let before = std::mem::replace(&mut before, after);
        StageFinding {
            iterations,
            temporal_weight,
            temporal_shrinkage,
            rest_shrinkage,
            rest_everywhere,
            static_variance,
            gamma,
            before,
            after,
            end,
        }
    };
    schedule.stages.iter().enumerate().map(finding).collect()
}

/// What becomes of a stage.
#[derive(Debug, Clone, Copy)]
pub struct Decision {
    /// So many iterations of it.
    pub iterations: usize,
    /// The weight of its total variation along time; 0 for none.
    pub temporal_weight: f32,
    /// Its shrinkage of changes along time; 0 for none.
    pub temporal_shrinkage: f32,
    /// The same where nothing moves, if it is another.
    pub rest_shrinkage: Option<f32>,
    /// Whether all is taken to be at rest then.
    pub rest_everywhere: bool,
    /// The static variance of its projection.
    pub static_variance: Option<f32>,
    /// The noise term of its projection.
    pub gamma: Option<f32>,
}

impl Schedule {
    /// The fixed schedule that the pilot has decided on, stage by stage: levels fall as they did, but end
    /// earlier. A stage of no iterations is left out, unless no other is left.
    pub fn decided(&self, decisions: &[Decision]) -> Self {
        let stage = |(stage, decision): (&Stage, &Decision)| {
            let &Decision { iterations, temporal_weight, temporal_shrinkage, .. } = decision;
            let last = stage.sigma_at(iterations.checked_sub(1)?);
            let sigma = stage.sigma.zip(last).map(|([first, _], last)| [first, last]);
            let positive = |value: f32| (value > 0.0).then_some(value);
            Some(Stage {
                iterations,
                temporal_weight: positive(temporal_weight),
                temporal_shrinkage: positive(temporal_shrinkage),
                rest_shrinkage: decision.rest_shrinkage,
                rest_everywhere: decision.rest_everywhere,
                static_variance: decision.static_variance,
                gamma: decision.gamma,
                sigma,
                ..stage.clone()
            })
        };
        let mut stages: Vec<Stage> = self.stages.iter().zip(decisions).filter_map(stage).collect();
        if stages.is_empty() {
            stages.clone_from(&self.stages);
        }
        Self { adaptive: false, stages, ..self.clone() }
    }
}

struct Watch<'a, 'b> {
    op: &'a SensingOperator,
    y: ArrayView3<'a, f32>,
    held_out: &'a HeldOut,
    index: usize,
    observer: &'b mut dyn Observer,
}

impl Watch<'_, '_> {
    /// Runs a stage to its end, unless it is clearly behind `rival`, the best of it so far.
    fn stage(
        &mut self,
        stage: &Stage,
        rival: Option<&Course>,
        run: &mut Run<'_>,
    ) -> Result<Course> {
        let fixed = stage.sigma.is_none();
        let mut course = Course {
            stage: stage.clone(),
            errors: vec![],
            squares: vec![],
            best: None,
            last: None,
            diverged: false,
            given_up: false,
            last_given_up: false,
            at_rest: false,
        };
        let (mut least, norm) = (f64::INFINITY, self.held_out.norm(self.y));
        run.enter(stage);
        for done in 1..=stage.iterations {
            let step = match run.iterate(stage, done - 1) {
                Err(ReconError::Diverged { .. }) if !fixed => {
                    course.diverged = true;
                    break;
                }
                other => other?,
            };
            run.tell((self.index, stage), done - 1, &step, &mut *self.observer)?;
            let last = done == stage.iterations || step.change < stage.tolerance;
            if !fixed || last {
                let squares = self.held_out.residuals(self.op, self.y, run.frames());
                let error = (squares.iter().sum::<f64>() / norm).sqrt();
                let rivals = rival.filter(|_| !fixed).and_then(|rival| rival.squares.get(done - 1));
                let behind = rivals.is_some_and(|rivals| excess(&squares, rivals) > CLEAR);
                course.errors.push(error);
                course.squares.push(squares);
                if error < least {
                    least = error;
                    course.best = Some(run.frames().to_owned());
                }
                if behind && 2 * done >= stage.iterations {
                    course.given_up = true;
                    break;
                }
            }
            if fixed && last {
                break;
            }
        }
        course.last = (!course.diverged).then(|| run.frames().to_owned());
        Ok(course)
    }
}

#[cfg(test)]
mod tests {
    use super::{Course, Decision, StageEnd, StageFinding, judge, piece, run};
    use crate::ReconError;
    use crate::prior::{Denoiser, Network, Networks};
    use crate::schedule::{Schedule, Stage};
    use crate::sensing::SensingOperator;
    use crate::solver::{Control, Observer, Progress};
    use ndarray::{Array2, Array3, Axis, s};
    use optics::{iid_masks, measure};
    use rand::{Rng, SeedableRng};
    use std::ops::Range;

    /// Goes to the truth in some passes, counted from 1, and away from it in the others.
    struct Moody {
        truth: Array3<f32>,
        good: Range<usize>,
        passes: usize,
        /// What it does to the frames in the others.
        harm: f32,
    }

    impl Denoiser for Moody {
        fn denoise(&mut self, frames: &mut Array3<f32>, _: f32) -> Result<(), ReconError> {
            self.passes += 1;
            match self.good.contains(&self.passes) {
                true => frames.zip_mut_with(&self.truth, |x, &truth| *x += 0.3 * (truth - *x)),
                false => frames.mapv_inplace(|x| x * self.harm),
            }
            Ok(())
        }
    }

    impl Networks for Moody {
        fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser, ReconError> {
            Ok(self)
        }
    }

    fn find(planned: usize, good: Range<usize>, harm: f32) -> (Schedule, Vec<StageFinding>) {
        let masks = iid_masks(4, 48, 48, 3).unwrap();
        let truth = Array3::from_shape_fn((4, 48, 48), |(k, i, j)| {
            0.5 + 0.4 * ((i + 3 * k) as f32 * 0.4).sin() * (j as f32 * 0.3).cos()
        });
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
        let op = SensingOperator::new(masks).unwrap();
        let mut schedule = Schedule::pnp_ffdnet();
        schedule.stages[1].iterations = planned;
        // So that each pass helps.
        schedule.stages[1].memory = 0.0;
        let mut network = Moody { truth, good, passes: 0, harm };
        let (found, _) = run(&op, y.view(), &schedule, &mut network, &mut ()).unwrap();
        (schedule, found)
    }

    fn iterations(iterations: usize) -> Decision {
        Decision {
            iterations,
            temporal_weight: 0.0,
            temporal_shrinkage: 0.0,
            rest_shrinkage: None,
            rest_everywhere: false,
            static_variance: None,
            gamma: None,
        }
    }

    #[test]
    fn passes_that_harm_are_left_out() {
        let (schedule, found) = find(60, 1..10, 0.7);
        assert_eq!((found[0].iterations, found[0].end), (60, StageEnd::Fixed));
        assert_eq!((found[1].iterations, found[1].end), (9, StageEnd::Converged));
        assert!(found[1].after < 0.5 * found[1].before && found[1].before == found[0].after);
        let decisions: Vec<_> = found.iter().map(|stage| iterations(stage.iterations)).collect();
        let decided = schedule.decided(&decisions);
        assert!(!decided.adaptive);
        let level = |schedule: &Schedule, index| schedule.stages[1].sigma_at(index);
        assert_eq!(level(&decided, 0), level(&schedule, 0));
        let (last, planned) = (level(&decided, 8).unwrap(), level(&schedule, 8).unwrap());
        assert!((last - planned).abs() < 1e-6, "levels fall as they were planned");
    }

    #[test]
    fn all_passes_that_help_are_kept() {
        let (_, found) = find(6, 1..7, 1.0);
        assert_eq!((found[1].iterations, found[1].end), (6, StageEnd::Planned));
    }

    /// A level far above the error that is left harms at first.
    #[test]
    fn a_stage_is_judged_by_its_end_not_by_its_first_passes() {
        let (_, found) = find(60, 30..61, 0.7);
        assert_eq!((found[1].iterations, found[1].end), (60, StageEnd::Planned));
        assert!(found[1].after < 0.5 * found[1].before);
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
            run(&op, y.view(), &Schedule::gap_tv3d(), &mut (), &mut ()).unwrap().0[0]
                .temporal_weight
        };
        let asked = Schedule::gap_tv3d().stages[0].temporal_weight;
        assert_eq!((Some(weight(false)), weight(true)), (asked, 0.0));
    }

    /// In a still scene all of the error is common to the frames.
    #[test]
    fn a_static_variance_that_is_too_small_is_not_kept() {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let op = SensingOperator::new(masks.clone()).unwrap();
        let mut schedule = Schedule::pnp_nonlocal();
        schedule.stages[1].iterations = 20;
        let mut found = |motion: f32, planned: f32| {
            let truth = Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
                0.5 + 0.4 * ((i as f32 + motion * k as f32) * 0.3).sin() * (j as f32 * 0.2).cos()
            });
            let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
            schedule.stages[1].static_variance = Some(planned);
            run(&op, y.view(), &schedule, &mut (), &mut ()).unwrap().0[1].static_variance
        };
        assert_eq!(found(2.0, 0.5), Some(0.5));
        assert_ne!(found(0.0, 0.05), Some(0.05));
    }

    #[test]
    fn changes_are_shrunk_more_where_nothing_moves() {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let op = SensingOperator::new(masks.clone()).unwrap();
        let mut schedule = Schedule::pnp_nonlocal();
        schedule.stages[1].iterations = 20;
        let planned = schedule.stages[1].temporal_shrinkage.unwrap();
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        // Too fine for the filter of groups.
        let texture = Array2::from_shape_simple_fn((64, 64), || random.random::<f32>());
        let wave = |i: usize, j: usize| 0.5 + 0.4 * (i as f32 * 0.3).sin() * (j as f32 * 0.2).cos();
        let found = |truth: Array3<f32>| {
            let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
            let found = run(&op, y.view(), &schedule, &mut (), &mut ()).unwrap().0[1];
            found.rest_shrinkage.unwrap_or(found.temporal_shrinkage)
        };
        let still = found(Array3::from_shape_fn((6, 64, 64), |(_, i, j)| texture[[i, j]]));
        let moving = found(Array3::from_shape_fn((6, 64, 64), |(k, i, j)| wave(i + 2 * k, j)));
        assert!(still >= 4.0 * planned && moving <= planned, "{still} {moving}");
    }

    /// A course whose four frames change by `changes`, and whose error at the held-out pixels is `behind`
    /// standard errors greater than that of one of another `side`.
    fn course(shrinkage: f32, changes: [f32; 4], (side, behind): (usize, f64)) -> Course {
        let planned = Schedule::pnp_nonlocal().stages[1].clone();
        let square = |pixel: usize| ((pixel + side) % 2) as f64 + behind / 10.0;
        let frames = Array3::from_shape_fn((4, 8, 8), |(k, i, _)| i as f32 + changes[k]);
        Course {
            stage: Stage { temporal_shrinkage: Some(shrinkage), ..planned },
            errors: vec![1.0],
            squares: vec![(0..100).map(square).collect()],
            best: Some(frames.clone()),
            last: Some(frames),
            diverged: false,
            given_up: false,
            last_given_up: false,
            at_rest: false,
        }
    }

    #[test]
    fn changes_of_which_shrinkage_leaves_nothing_were_no_motion() {
        let planned = course(0.35, [1.0, -1.0, 1.0, -1.0], (0, 0.0));
        let fourfold = |changes, behind| course(1.4, changes, (1, behind));
        let (others, fewer) = ([0.1, 0.1, -0.1, -0.1], [0.1, -0.1, 0.1, -0.1]);
        assert!(fourfold(others, 1.0).surpasses(&planned), "what changed was not in the scene");
        assert!(fourfold([0.0; 4], 1.0).surpasses(&planned), "nothing is left");
        assert!(!fourfold(others, 2.0).surpasses(&planned), "it is clearly worse");
        assert!(!fourfold(fewer, 1.0).surpasses(&planned), "what is left was there before");
        // With noise the error may be least before shrinkage has had any effect.
        let early = Course { best: planned.best.clone(), ..fourfold(others, 1.0) };
        assert!(early.surpasses(&planned), "the frames at the end tell");
        // So it is for still more shrinkage.
        let taken = Course { at_rest: true, ..fourfold(others, 1.0) };
        let eightfold = |behind| course(2.8, [0.0; 4], (0, behind));
        assert!(eightfold(2.0).surpasses(&taken) && !eightfold(3.0).surpasses(&taken));
        let moving = Course { at_rest: false, ..taken };
        assert!(!eightfold(0.5).surpasses(&moving), "by more than chance where something moves");
    }

    #[test]
    fn a_stage_that_ends_early_does_not_tell_what_moves() {
        let mut schedule = Schedule::pnp_nonlocal();
        let planned = schedule.stages[1].temporal_shrinkage.unwrap();
        let tv = schedule.stages[0].clone();
        let before = || Course { stage: tv.clone(), ..course(0.0, [0.0; 4], (0, 0.0)) };
        let mut found = |iterations, shrinkage| {
            schedule.stages[1].iterations = iterations;
            let taken = Course { diverged: true, ..course(shrinkage, [0.0; 4], (0, 0.0)) };
            let found = judge(&schedule, &[before(), taken])[1];
            assert_eq!(found.iterations, 1);
            (found.temporal_shrinkage, found.rest_shrinkage, found.rest_everywhere)
        };
        let fourfold = 4.0 * planned;
        assert_eq!(found(2, fourfold), (planned, Some(fourfold), false));
        assert_eq!(found(3, fourfold), (planned, Some(fourfold), true));
        assert_eq!(found(3, 2.0 * planned), (2.0 * planned, None, false));
    }

    #[test]
    fn a_variant_that_is_clearly_behind_is_given_up() {
        struct Steps(usize);
        impl Observer for Steps {
            fn iteration(&mut self, progress: &Progress) -> Control {
                self.0 += usize::from(progress.stage == 1);
                Control::Continue
            }
        }
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let truth = Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
            0.5 + 0.4 * ((i + 2 * k) as f32 * 0.3).sin() * (j as f32 * 0.2).cos()
        });
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
        let op = SensingOperator::new(masks).unwrap();
        let mut schedule = Schedule::pnp_nonlocal();
        schedule.stages[1].iterations = 20;
        schedule.stages[1].static_variance = None;
        let mut steps = Steps(0);
        run(&op, y.view(), &schedule, &mut (), &mut steps).unwrap();
        assert_eq!(steps.0, 30, "the plan, and half of four times the shrinkage");
    }

    #[test]
    fn a_noise_term_is_found_where_there_is_noise() {
        let masks = iid_masks(6, 64, 64, 3).unwrap();
        let truth = Array3::from_shape_fn((6, 64, 64), |(k, i, j)| {
            0.5 + 0.4 * ((i + 2 * k) as f32 * 0.3).sin() * (j as f32 * 0.2).cos()
        });
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0));
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let noise = y.mapv(|_| (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0);
        let op = SensingOperator::new(masks).unwrap();
        let found = |schedule: &Schedule, sigma: f32| {
            let y = &y + &(sigma * &noise);
            run(&op, y.view(), schedule, &mut (), &mut ()).unwrap().0[1].gamma
        };
        let mut schedule = Schedule::pnp_nonlocal();
        assert_eq!(found(&schedule, 0.0), None);
        assert!(found(&schedule, 0.2).is_some_and(|gamma| gamma > 0.0));
        schedule.stages[1].gamma = Some(0.1);
        assert_eq!(found(&schedule, 0.2), Some(0.1), "what a schedule states is kept");
    }

    #[test]
    fn divergence_ends_the_stage_before_it() {
        let (schedule, found) = find(60, 1..6, f32::INFINITY);
        assert_eq!((found[1].iterations, found[1].end), (5, StageEnd::Diverged));
        let (_, none) = find(60, 1..1, f32::INFINITY);
        assert_eq!((none[1].iterations, none[1].end), (0, StageEnd::Diverged));
        assert_eq!(
            schedule.decided(&[60, 0].map(iterations)).stages.len(),
            1,
            "a stage of none is left out"
        );
        assert_eq!(
            schedule.decided(&[0, 0].map(iterations)).stages.len(),
            2,
            "but not all of them"
        );
    }

    #[test]
    fn the_piece_has_the_greatest_contrast_and_lies_inside() {
        let mut y = Array2::zeros((200, 300));
        y.slice_mut(s![150.., 250..]).assign(&Array2::from_shape_fn((50, 50), |(i, _)| i as f32));
        let light = Array2::ones((200, 300));
        assert_eq!(piece(light.view(), y.view()), (104..200, 204..300));
        // Where it is bright and even the measurement varies more, by the masks alone.
        let light = Array2::from_shape_fn((200, 300), |(i, j)| ((7 * i + 11 * j) % 5) as f32);
        y.slice_mut(s![..96, ..96]).assign(&(100.0 * &light.slice(s![..96, ..96])));
        assert_eq!(piece(light.view(), y.view()), (104..200, 204..300));
        let nothing = Array2::zeros((40, 60));
        assert_eq!(piece(nothing.view(), nothing.view()), (0..40, 0..60));
    }
}
