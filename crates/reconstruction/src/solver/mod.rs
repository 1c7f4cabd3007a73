//! Alternating projection with plugged-in priors (Algorithm 1 of the paper).

mod admm;
mod gap;
mod state;

use std::ops::Range;

use ndarray::{Array3, Array4, ArrayView3};

use super::assessment::{self, Evidence};
use super::error::{ReconError, Result, shape_text};
use super::prior::{Networks, Pass, Settings};
use super::rest;
use super::schedule::{Schedule, Stage};
use super::sensing::{SensingOperator, Statistics};
use state::{Change, State};
use strum::Display;

/// Values of a strip of all frames: three arrays of them (frames, masks, projection) stay in a
/// second-level cache.
const STRIP_VALUES: usize = 48 * 1024;
/// Fewer rows would cost more in going from frame to frame than they save.
const LEAST_ROWS: usize = 16;

/// Where a reconstruction stands, after an iteration.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Index of the stage, from 0.
    pub stage: usize,
    /// Iterations done, over all stages.
    pub done: usize,
    /// Most iterations there will be; shrinks when a stage converges early.
    pub planned: usize,
    /// `||y - H v|| / ||y||` of what the iteration started from.
    pub residual: f32,
    /// `||v_k - v_(k-1)|| / ||v_k||`.
    pub change: f32,
    /// Level of the prior in this iteration; none for total variation.
    pub sigma: Option<f32>,
    /// Whether a network was run.
    pub deep: bool,
}

/// What an observer wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Go on.
    Continue,
    /// Stop at once; the reconstruction ends with [`ReconError::Cancelled`].
    Cancel,
}

/// Watches a reconstruction; called after every iteration.
pub trait Observer {
    /// Looks at the progress and says whether to go on.
    fn iteration(&mut self, progress: &Progress) -> Control;

    /// Is told that a run of the solver begins that is this share of the whole, on \[0,1\], where there are
    /// several.
    fn part(&mut self, _share: Range<f64>) {}
}

/// An observer that never stops anything.
impl Observer for () {
    fn iteration(&mut self, _: &Progress) -> Control {
        Control::Continue
    }
}

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
    /// Iterations whose prior had a total-variation part.
    pub tv_iterations: usize,
    /// Passes of learned denoisers.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the result.
    pub residual: f32,
    /// Why it ended.
    pub stop_reason: StopReason,
    /// What an [`assessment`] sees of the frames \[features, S B, rows, columns\], where it was asked for.
    pub features: Option<Array4<f32>>,
    /// What a piece with held-out pixels tells of the frames' error, where that was asked for.
    pub evidence: Option<Evidence>,
}

/// Reconstructs the `S B` frames of a run of snapshots `y` \[S,H,W\], both on the scale on which the
/// scene is on \[0,1\]. The priors see the frames of all snapshots as one clip; each measured pixel
/// stays tied to its own `B`.
///
/// Starts from `v = 0`, `y1 = 0`. `y1` is kept through all stages: resetting it between total variation and
/// the learned denoiser costs what the acceleration gained. Networks are asked for when a stage needs them.
/// Errors: sizes that disagree, an invalid schedule, a missing or failing network, divergence, or
/// [`ReconError::Cancelled`] when the observer says so.
pub fn reconstruct(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome> {
    stages((op, y), schedule, networks, observer, |_, _| ())
}

/// As [`reconstruct`], with what an [`assessment`] sees of the frames; with that of the encoder where a
/// network has had a part in them.
pub fn reconstruct_assessed(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome> {
    let (mut early, mut first) = (None, None);
    let mut outcome = stages((op, y), schedule, networks, observer, |stage, run| {
        if stage == 0 && schedule.stages.len() > 1 {
            early = Some(run.frames().to_owned());
        }
        first = run.first.take();
    })?;
    let early = early.as_ref().map(|early| early.view());
    let deep = !schedule.networks().is_empty();
    let mut see = |frames| {
        let encoder = if deep { networks.encoder()? } else { None };
        assessment::encoded_features(op, early, frames, encoder)
    };
    let seen = see(outcome.frames.view())?;
    outcome.features = Some(match &first {
        None => seen,
        Some(first) => {
            let frames = (outcome.frames.view(), first.view());
            assessment::with_first_run(&seen, &see(first.view())?, frames)?
        }
    });
    Ok(outcome)
}

/// Runs the stages, and shows after each of them its index and where the reconstruction stands.
pub(super) fn stages(
    (op, y): (&SensingOperator, ArrayView3<'_, f32>),
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
    mut done: impl FnMut(usize, &mut Run<'_>),
) -> Result<Outcome> {
    schedule.validate()?;
    if y.dim() != op.measurement_dim() {
        let (snapshots, height, width) = op.measurement_dim();
        return Err(ReconError::Shape {
            what: "the measurement",
            found: shape_text(y.shape()),
            expected: format!("{} (the masks' size)", shape_text(&[snapshots, height, width])),
        });
    }
    // Before anything is computed, so that a missing network is told at once.
    schedule.networks().into_iter().try_for_each(|which| networks.network(which).map(|_| ()))?;
    let mut run = Run::new(op, y, schedule, networks);
    let mut stop_reason = StopReason::MaxIterations;
    for (index, stage) in schedule.stages.iter().enumerate() {
        stop_reason = run.stage(index, stage, observer)?;
        done(index, &mut run);
    }
    let residual = run.residual();
    Ok(Outcome {
        frames: run.state.v,
        tv_iterations: run.tv_iterations,
        denoiser_passes: run.denoiser_passes,
        residual,
        stop_reason,
        features: None,
        evidence: None,
    })
}

/// What an iteration tells: see [`Progress`].
pub(super) struct Step {
    pub(super) residual: f32,
    pub(super) change: f32,
}

/// A reconstruction on its way.
pub(super) struct Run<'a> {
    op: &'a SensingOperator,
    y: Array3<f32>,
    y_norm: f64,
    state: State,
    x: Array3<f32>,
    /// The frames of the first run of a stage that is run twice, after it.
    first: Option<Array3<f32>>,
    /// The prior of the stage, at work.
    pass: Option<Box<dyn Pass>>,
    /// What the stage supposes of the error and the noise.
    supposed: Statistics,
    /// The noise term of stages that have none of their own.
    gamma: f32,
    networks: &'a mut dyn Networks,
    done: usize,
    planned: usize,
    tv_iterations: usize,
    denoiser_passes: usize,
}

impl<'a> Run<'a> {
    pub(super) fn new(
        op: &'a SensingOperator,
        y: ArrayView3<'_, f32>,
        schedule: &Schedule,
        networks: &'a mut dyn Networks,
    ) -> Self {
        let y = y.as_standard_layout().into_owned();
        let squares: f64 = y.iter().map(|&value| f64::from(value) * f64::from(value)).sum();
        Self {
            op,
            y_norm: squares.sqrt().max(f64::MIN_POSITIVE),
            y,
            state: State::new(op, schedule),
            x: Array3::zeros(op.dim()),
            first: None,
            pass: None,
            supposed: Statistics::default(),
            gamma: schedule.gamma,
            networks,
            done: 0,
            planned: schedule.planned_iterations(),
            tv_iterations: 0,
            denoiser_passes: 0,
        }
    }

    fn stage(
        &mut self,
        index: usize,
        stage: &Stage,
        observer: &mut dyn Observer,
    ) -> Result<StopReason> {
        let Some(shrinkage) = stage.rest_shrinkage else {
            return self.once(index, stage, observer);
        };
        let start = self.state();
        self.once(index, stage, observer)?;
        let moves = !stage.rest_everywhere;
        let motion = moves.then(|| rest::motion(&start.v, &self.state.v));
        let first = std::mem::replace(&mut self.state, start).v;
        let still = Stage { temporal_shrinkage: Some(shrinkage), ..stage.run_once() };
        let stop_reason = self.once(index, &still, observer)?;
        if let Some(motion) = motion {
            rest::keep_motion(&mut self.state.v, &first, &motion);
        }
        self.first = Some(first);
        Ok(stop_reason)
    }

    fn once(
        &mut self,
        index: usize,
        stage: &Stage,
        observer: &mut dyn Observer,
    ) -> Result<StopReason> {
        self.enter(stage);
        for iteration in 0..stage.iterations {
            let step = self.iterate(stage, iteration)?;
            let left = stage.iterations - iteration - 1;
            let converged = step.change < stage.tolerance && left > 0;
            if converged {
                self.planned -= left;
            }
            self.tell((index, stage), iteration, &step, observer)?;
            if converged {
                return Ok(StopReason::Converged);
            }
        }
        Ok(StopReason::MaxIterations)
    }

    /// To be called before the first iteration of a stage.
    pub(super) fn enter(&mut self, stage: &Stage) {
        // What a prior remembers belongs to the iterates of one stage.
        self.pass = None;
        let covariance = stage.static_variance.map(|variance| self.op.error_covariance(variance));
        self.supposed = Statistics { covariance, gamma: stage.gamma.unwrap_or(self.gamma) };
    }

    /// What the next iteration starts from.
    pub(super) fn state(&self) -> State {
        self.state.clone()
    }

    /// Goes back to where [`Run::state`] was called.
    pub(super) fn restore(&mut self, state: State) {
        self.state = state;
    }

    /// The frames as they stand \[S B,H,W\].
    pub(super) fn frames(&self) -> ArrayView3<'_, f32> {
        self.state.v.view()
    }

    /// Tells the observer of an iteration of the stage with this index.
    /// Errors: [`ReconError::Cancelled`] if it says so.
    pub(super) fn tell(
        &self,
        (index, stage): (usize, &Stage),
        iteration: usize,
        step: &Step,
        observer: &mut dyn Observer,
    ) -> Result<()> {
        let progress = Progress {
            stage: index,
            done: self.done,
            planned: self.planned,
            residual: step.residual,
            change: step.change,
            sigma: stage.sigma_at(iteration),
            deep: stage.prior.network().is_some(),
        };
        match observer.iteration(&progress) {
            Control::Continue => Ok(()),
            Control::Cancel => Err(ReconError::Cancelled),
        }
    }

    /// Iteration `iteration` (from 0) of a stage.
    /// Errors: a network that fails, or values that are no numbers any more.
    pub(super) fn iterate(&mut self, stage: &Stage, iteration: usize) -> Result<Step> {
        let (frames, height, width) = self.op.dim();
        let admm = self.state.multiplier.is_some();
        let strips = stage.prior.by_strips() && !admm;
        let strip = (STRIP_VALUES / (frames * width)).max(LEAST_ROWS);
        let settings = stage.settings(iteration);
        let (squares, change) =
            self.sweep(stage, &settings, if strips { strip } else { height })?;
        self.tv_iterations += usize::from(settings.tv_weight > 0.0);
        self.denoiser_passes += usize::from(stage.prior.network().is_some());
        let prepare_start = if admm { admm::prepare_start } else { gap::prepare_start };
        prepare_start(&mut self.state, &self.x, stage.momentum);
        std::mem::swap(&mut self.state.v, &mut self.x);
        self.done += 1;
        let change = change.relative();
        if !change.is_finite() {
            let (iteration, planned) = (self.done, self.planned);
            return Err(ReconError::Diverged { iteration, planned });
        }
        Ok(Step { residual: (squares.sqrt() / self.y_norm) as f32, change })
    }

    /// Projection, prior and the change, in strips of so many rows: what the memory hands over is used for all
    /// three while it is in cache. The new iterate is then in `x`. Returns `||y - H v||^2` of what the
    /// iteration started from.
    fn sweep(&mut self, stage: &Stage, settings: &Settings, rows: usize) -> Result<(f64, Change)> {
        let Self { op, y, state, x, networks, supposed, .. } = self;
        let pass = self.pass.get_or_insert_with(|| stage.prior.begin(op.dim()));
        let (mut squares, mut change) = (0.0, Change::default());
        for first in (0..y.dim().1).step_by(rows) {
            let strip = first..y.dim().1.min(first + rows);
            squares += state.project(op, strip.clone(), y, (stage.memory, supposed), x);
            admm::shift(state, x);
            pass.apply(x, strip, settings, &mut **networks, &mut |x, k, done| {
                change.add(x, &state.v, k, done);
            })?;
        }
        Ok((squares, change))
    }

    fn residual(&mut self) -> f32 {
        let rows = 0..self.y.dim().1;
        let squares = self.op.project(
            rows,
            &self.y,
            None,
            &Statistics::default(),
            &self.state.v,
            &mut self.x,
        );
        (squares.sqrt() / self.y_norm) as f32
    }
}

/// A slow, readable solver's parts, for the tests of GAP and ADMM.
#[cfg(test)]
mod reference {
    use super::{Observer, Outcome};
    use crate::ReconError;
    use crate::prior::{Denoiser, Network, Networks};
    use crate::schedule::Schedule;
    use crate::sensing::SensingOperator;
    use ndarray::{Array3, ArrayView3};
    use rand::{Rng, SeedableRng};
    use serde_json::json;
    use std::f64::consts::PI;

    /// A small random problem, with a denoiser that pulls every voxel towards a grey.
    pub(super) struct Problem {
        pub(super) schedule: Schedule,
        masks: Array3<f32>,
        /// [S,H,W].
        y: Array3<f32>,
    }

    const GREY: f64 = 0.4;
    const PULL: f64 = 0.25;

    struct Pull;

    impl Denoiser for Pull {
        fn denoise(&mut self, frames: &mut Array3<f32>, _: f32) -> Result<(), ReconError> {
            frames.mapv_inplace(|x| x + PULL as f32 * (GREY as f32 - x));
            Ok(())
        }
    }

    impl Networks for Pull {
        fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser, ReconError> {
            Ok(self)
        }
    }

    type Solver = fn(
        &SensingOperator,
        ArrayView3<'_, f32>,
        &Schedule,
        &mut dyn Networks,
        &mut dyn Observer,
    ) -> Result<Outcome, ReconError>;

    impl Problem {
        pub(super) fn random(seed: u64, method: &str) -> Self {
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let size = (rng.random_range(1..5), rng.random_range(1..8), rng.random_range(1..40));
            let masks = Array3::from_shape_simple_fn(size, || 0.2 + 0.8 * rng.random::<f32>());
            let snapshots = rng.random_range(1..4);
            let y = (snapshots, size.1, size.2);
            let y = Array3::from_shape_simple_fn(y, || 2.0 * rng.random::<f32>());
            let memory: f32 = rng.random();
            let variance = rng.random::<bool>().then(|| rng.random_range(0.1..1.0f32));
            let stage = json!({"prior": "ffdnet", "iterations": 7, "sigma": [0.1, 0.1],
                "memory": memory, "momentum": 0.5 * rng.random::<f32>(), "static_variance": variance,
                "gamma": rng.random::<bool>().then(|| 0.5 * rng.random::<f32>())});
            let schedule = json!({"method": method, "accelerated": rng.random::<bool>(),
                "gamma": 0.3 * rng.random::<f32>(), "stages": [stage]});
            Self { schedule: serde_json::from_value(schedule).unwrap(), masks, y }
        }

        pub(super) fn solve(&self, solver: Solver) -> Outcome {
            let op = SensingOperator::new(self.masks.clone()).unwrap();
            let op = op.over(self.y.dim().0).unwrap();
            solver(&op, self.y.view(), &self.schedule, &mut Pull, &mut ()).unwrap()
        }

        pub(super) fn pixels(&self) -> usize {
            self.y.len()
        }

        pub(super) fn zeros(&self) -> Vec<f64> {
            vec![0.0; self.y.dim().0 * self.masks.len()]
        }

        pub(super) fn denoise(&self, x: &mut [f64]) {
            x.iter_mut().for_each(|x| *x += PULL * (GREY - *x));
        }

        /// `P(w)` along the masks, or along `R C` (an orthogonal cosine at a time; bounded), with the target
        /// `y`, or, accelerated, `y1 = y + memory (y1 - H w)`.
        pub(super) fn project(&self, w: &[f64], y1: &mut [f64]) -> Vec<f64> {
            let plane = self.masks.dim().1 * self.masks.dim().2;
            let stage = &self.schedule.stages[0];
            let (gamma, memory) = (stage.gamma.unwrap_or(self.schedule.gamma), stage.memory);
            let mask: Vec<f64> = self.masks.iter().map(|&c| f64::from(c)).collect();
            // `R C`.
            let mut direction = mask.clone();
            if let Some(variance) = self.schedule.stages[0].static_variance {
                let frames = self.masks.dim().0;
                let sum = |pixel: usize, power: i32| -> f64 {
                    (0..frames).map(|k| mask[k * plane + pixel].powi(power)).sum()
                };
                let gram: f64 = (0..plane).map(|pixel| sum(pixel, 2)).sum();
                let steady: f64 = (0..plane).map(|pixel| sum(pixel, 1).powi(2)).sum();
                let contrast = 1.0 - steady / (frames as f64 * gram);
                let many = (10.0 / frames as f64).sqrt();
                let half = 0.5 * (1.0 - 1.0 / frames as f64);
                let part = (many * (contrast / (0.9 * half)).powf(0.9)).max(0.551);
                let part = part.min(many).min((contrast / 0.125).powf(1.5));
                let variance = f64::from(variance) * part;
                let cosine =
                    |m: usize, k: usize| (PI * m as f64 * (k as f64 + 0.5) / frames as f64).cos();
                direction.fill(0.0);
                for m in 0..frames {
                    let square: f64 = (0..frames).map(|k| cosine(m, k).powi(2)).sum();
                    let variance = if m == 0 { variance.max(0.01) } else { (m as f64).powf(-0.4) };
                    for pixel in 0..plane {
                        let part = |k: usize| cosine(m, k) * mask[k * plane + pixel];
                        let part = variance / square * (0..frames).map(part).sum::<f64>();
                        for k in 0..frames {
                            direction[k * plane + pixel] += cosine(m, k) * part;
                        }
                    }
                }
            }
            let mut x = w.to_vec();
            for (p, &y) in self.y.iter().enumerate() {
                // The snapshot's own frames at this pixel, and the masks there.
                let (first, pixel) = (p / plane * mask.len(), p % plane);
                let voxels = || (pixel..mask.len()).step_by(plane);
                let seen: f64 = voxels().map(|voxel| mask[voxel] * w[first + voxel]).sum();
                let of_all = |part: &dyn Fn(usize) -> f64| -> f64 {
                    voxels().map(|voxel| mask[voxel] * part(voxel)).sum::<f64>() + f64::from(gamma)
                };
                let least = -0.02 * of_all(&|voxel| direction[voxel]);
                let bounded = |voxel: usize| direction[voxel].max(least / mask[voxel]);
                let total = of_all(&bounded);
                let mut target = f64::from(y);
                if self.schedule.accelerated {
                    y1[p] = target + f64::from(memory) * (y1[p] - seen);
                    target = y1[p];
                }
                for voxel in voxels() {
                    x[first + voxel] += bounded(voxel) * (target - seen) / total;
                }
            }
            x
        }
    }

    /// The largest difference of two clips.
    pub(super) fn furthest(frames: &Array3<f32>, reference: &[f64]) -> f64 {
        let pairs = frames.iter().zip(reference);
        pairs.map(|(&a, b)| (f64::from(a) - b).abs()).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::{Control, Observer, Progress, Run, reconstruct, reconstruct_assessed, rest};
    use crate::assessment::FEATURES;
    use crate::prior::temporal::TemporalVariation;
    use crate::prior::tv::TotalVariation;
    use crate::schedule::Schedule;
    use crate::sensing::{SensingOperator, Statistics};
    use ndarray::{Array3, ArrayView3, Axis, s};
    use rand::{Rng, SeedableRng};

    /// Strip by strip is what projection, total variation along time and that of each frame do one after
    /// the other.
    #[test]
    fn the_sweep_by_strips_is_that_of_whole_frames_bit_by_bit() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let size = (3, 37, 21);
        let mut random = || Array3::from_shape_simple_fn(size, || rng.random::<f32>());
        let (masks, v) = (random(), random());
        let op = SensingOperator::new(masks).unwrap();
        let y = op.forward(random().view()).unwrap();
        let schedule = Schedule::gap_tv3d();
        let stage = &schedule.stages[0];
        let settings = stage.settings(0);

        let (mut expected, mut y1) = (Array3::zeros(size), Array3::zeros(y.raw_dim()));
        op.project(
            0..size.1,
            &y,
            Some((&mut y1, stage.memory)),
            &Statistics::default(),
            &v,
            &mut expected,
        );
        let (weight, updates) = (settings.temporal_weight, settings.tv_updates);
        let mut temporal = TemporalVariation::new(size.0);
        temporal.denoise(&mut expected, 0..size.1, weight, updates);
        TotalVariation::new(size).denoise(&mut expected, settings.tv_weight, updates);
        let difference = (&expected - &v).mapv(|d| d * d).sum() / expected.mapv(|x| x * x).sum();

        for rows in [1, 2, 5, 16, 36, 37] {
            let mut networks = ();
            let mut run = Run::new(&op, y.view(), &schedule, &mut networks);
            run.state.v.assign(&v);
            let (squares, change) = run.sweep(stage, &settings, rows).unwrap();
            assert_eq!(run.x, expected, "{rows} rows");
            let residual = (&y - &op.forward(v.view()).unwrap()).mapv(|r| r * r).sum();
            assert!((squares / f64::from(residual) - 1.0).abs() < 1e-4, "{rows} rows: {squares}");
            assert!((change.relative() / difference.sqrt() - 1.0).abs() < 1e-4, "{rows} rows");
        }
    }

    #[test]
    fn a_stage_run_twice_is_its_two_runs_put_together() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        let masks = Array3::from_shape_simple_fn((5, 48, 48), || rng.random::<f32>());
        // Fine texture at rest on the left, that moves on the right.
        let texture: Vec<f32> = (0..48 * 60).map(|_| rng.random()).collect();
        let truth = Array3::from_shape_fn((5, 48, 48), |(k, i, j)| {
            texture[60 * i + j + if j < 24 { 0 } else { 2 * k }]
        });
        let op = SensingOperator::new(masks).unwrap();
        let y = op.forward(truth.view()).unwrap();
        let solve = |shrinkage: Option<(f32, Option<f32>, bool)>| {
            let mut schedule = Schedule::pnp_nonlocal();
            let mut stage = schedule.stages.pop().unwrap();
            if let Some((temporal, rest, everywhere)) = shrinkage {
                (stage.temporal_shrinkage, stage.rest_shrinkage) = (Some(temporal), rest);
                stage.rest_everywhere = everywhere;
                stage.iterations = 8;
                schedule.stages.push(stage);
            }
            let mut steps = Vec::new();
            let mut watch = Steps(&mut steps);
            let outcome =
                reconstruct_assessed(&op, y.view(), &schedule, &mut (), &mut watch).unwrap();
            let seen = outcome.features.map(|seen| seen.len_of(Axis(0)));
            let rest = schedule.stages.iter().any(|stage| stage.rest_shrinkage.is_some());
            let both = if rest { 2 * FEATURES.len() + 1 } else { FEATURES.len() };
            assert_eq!(seen, Some(both), "what is seen of the first run, too");
            assert!(steps.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 >= pair[1].1));
            assert_eq!(steps.last().map(|step| step.0 == step.1), Some(true), "all is done");
            outcome.frames
        };
        let (before, little) = (solve(None), solve(Some((0.35, None, false))));
        let much = solve(Some((1.4, None, false)));
        assert_eq!(solve(Some((0.35, Some(1.4), true))), much);
        let mut expected = much;
        let motion = rest::motion(&before, &little);
        rest::keep_motion(&mut expected, &little, &motion);
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

    /// Where no prior looks along time, a run of snapshots is what they are alone, bit by bit.
    #[test]
    fn snapshots_together_are_those_alone_where_nothing_looks_along_time() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(9);
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
