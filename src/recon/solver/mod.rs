//! Alternating projection with plugged-in priors (Algorithm 1 of the paper).

mod state;

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3};

use super::error::{ReconError, shape_text};
use super::prior::{Networks, nonlocal::Nonlocal, temporal::TemporalVariation, tv::TotalVariation};
use super::schedule::{Method, Prior, Schedule, Sigma, Stage};
use super::sensing::SensingOperator;
use state::Change;

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
    pub sigma: Option<Sigma>,
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
}

/// An observer that never stops anything.
impl Observer for () {
    fn iteration(&mut self, _: &Progress) -> Control {
        Control::Continue
    }
}

/// Why a reconstruction ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// The last stage's change fell below its tolerance.
    Converged,
    /// All planned iterations were done.
    MaxIterations,
}

impl StopReason {
    /// Name for records: `converged` or `max-iterations`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Converged => "converged",
            Self::MaxIterations => "max-iterations",
        }
    }
}

/// A reconstructed snapshot.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The frames \[B,H,W\].
    pub frames: Array3<f32>,
    /// Iterations whose prior had a total-variation part.
    pub tv_iterations: usize,
    /// Passes of learned denoisers.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the result.
    pub residual: f32,
    /// Why it ended.
    pub stop_reason: StopReason,
}

/// Reconstructs `B` frames from one measurement `y` \[H,W\], both on the scale on which the
/// scene is on \[0,1\].
///
/// Starts from `v = 0`, `y1 = 0`. `y1` is kept through all stages: resetting it between total
/// variation and the learned denoiser costs what the acceleration gained. With `gamma` > 0 the
/// operator's regularised inverse is used. Networks are asked for when a stage needs them.
///
/// # Errors
/// Sizes that disagree, an invalid schedule, a missing or failing network, divergence, or
/// [`ReconError::Cancelled`] when the observer says so.
pub fn reconstruct(
    op: &SensingOperator,
    y: ArrayView2<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconError> {
    schedule.validate()?;
    if y.shape() != op.gram().shape() {
        return Err(ReconError::Shape {
            what: "the measurement",
            found: shape_text(y.shape()),
            expected: format!("{} (the masks' size)", shape_text(op.gram().shape())),
        });
    }
    // Before anything is computed, so that a missing network is told at once.
    schedule.networks().into_iter().try_for_each(|which| networks.network(which).map(|_| ()))?;
    let mut run = Run::new(op, y, schedule, networks);
    let mut stop_reason = StopReason::MaxIterations;
    for (index, stage) in schedule.stages.iter().enumerate() {
        stop_reason = run.stage(index, stage, observer)?;
    }
    let residual = run.residual();
    Ok(Outcome {
        frames: run.v,
        tv_iterations: run.tv_iterations,
        denoiser_passes: run.denoiser_passes,
        residual,
        stop_reason,
    })
}

/// What an iteration tells: see [`Progress`].
pub(super) struct Step {
    pub(super) sigma: Option<Sigma>,
    pub(super) residual: f32,
    pub(super) change: f32,
}

/// What an iteration starts from.
pub(super) struct State {
    v: Array3<f32>,
    y1: Option<Array2<f32>>,
    start: Option<Array3<f32>>,
    multiplier: Option<Array3<f32>>,
}

/// A reconstruction on its way.
pub(super) struct Run<'a> {
    op: &'a SensingOperator,
    y: Array2<f32>,
    y_norm: f64,
    y1: Option<Array2<f32>>,
    v: Array3<f32>,
    x: Array3<f32>,
    /// What is projected, where it is not `v`: extrapolated, or with ADMM's multiplier.
    start: Option<Array3<f32>>,
    /// ADMM's multiplier `u`.
    multiplier: Option<Array3<f32>>,
    tv: TotalVariation,
    temporal: TemporalVariation,
    nonlocal: Option<Nonlocal>,
    networks: &'a mut dyn Networks,
    done: usize,
    planned: usize,
    tv_iterations: usize,
    denoiser_passes: usize,
}

impl<'a> Run<'a> {
    pub(super) fn new(
        op: &'a SensingOperator,
        y: ArrayView2<'_, f32>,
        schedule: &Schedule,
        networks: &'a mut dyn Networks,
    ) -> Self {
        let y = y.as_standard_layout().into_owned();
        let squares: f64 = y.iter().map(|&value| f64::from(value) * f64::from(value)).sum();
        let zeros = || Array3::zeros(op.dim());
        Self {
            op,
            y_norm: squares.sqrt().max(f64::MIN_POSITIVE),
            y1: schedule.accelerated.then(|| Array2::zeros(y.raw_dim())),
            y,
            v: zeros(),
            x: zeros(),
            start: schedule.has_own_start().then(zeros),
            multiplier: (schedule.method == Method::Admm).then(zeros),
            tv: TotalVariation::new(op.dim()),
            temporal: TemporalVariation::new(op.dim().0),
            nonlocal: None,
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
    ) -> Result<StopReason, ReconError> {
        self.enter();
        for iteration in 0..stage.iterations {
            let step = self.iterate(stage, iteration)?;
            let left = stage.iterations - iteration - 1;
            let converged = step.change < stage.tolerance && left > 0;
            if converged {
                self.planned -= left;
            }
            self.tell(index, stage, &step, observer)?;
            if converged {
                return Ok(StopReason::Converged);
            }
        }
        Ok(StopReason::MaxIterations)
    }

    /// To be called before the first iteration of a stage.
    pub(super) fn enter(&mut self) {
        // Its groups belong to the iterates of one stage.
        self.nonlocal = None;
    }

    /// What the next iteration starts from.
    pub(super) fn state(&self) -> State {
        State {
            v: self.v.clone(),
            y1: self.y1.clone(),
            start: self.start.clone(),
            multiplier: self.multiplier.clone(),
        }
    }

    /// Goes back to where [`Run::state`] was called.
    pub(super) fn restore(&mut self, state: &State) {
        self.v.clone_from(&state.v);
        self.y1.clone_from(&state.y1);
        self.start.clone_from(&state.start);
        self.multiplier.clone_from(&state.multiplier);
    }

    /// The frames as they stand \[B,H,W\].
    pub(super) fn frames(&self) -> ArrayView3<'_, f32> {
        self.v.view()
    }

    /// Tells the observer of an iteration of the stage with this index.
    ///
    /// # Errors
    /// [`ReconError::Cancelled`] if it says so.
    pub(super) fn tell(
        &self,
        index: usize,
        stage: &Stage,
        step: &Step,
        observer: &mut dyn Observer,
    ) -> Result<(), ReconError> {
        let progress = Progress {
            stage: index,
            done: self.done,
            planned: self.planned,
            residual: step.residual,
            change: step.change,
            sigma: step.sigma,
            deep: stage.prior.network().is_some(),
        };
        match observer.iteration(&progress) {
            Control::Continue => Ok(()),
            Control::Cancel => Err(ReconError::Cancelled),
        }
    }

    /// Iteration `iteration` (from 0) of a stage.
    ///
    /// # Errors
    /// A network that fails, or values that are no numbers any more.
    pub(super) fn iterate(&mut self, stage: &Stage, iteration: usize) -> Result<Step, ReconError> {
        let sigma = stage.sigma_at(iteration);
        let (squares, change) = if stage.prior == Prior::Tv && self.multiplier.is_none() {
            self.project_and_smooth(stage)
        } else {
            let squares = self.project(stage.memory, 0..self.y.nrows());
            if let (Some(u), Some(z)) = (&self.multiplier, &mut self.start) {
                self.x -= u;
                z.assign(&self.x);
            }
            self.apply(stage, sigma)?;
            (squares, self.change(0..self.y.nrows()))
        };
        let change = change.relative();
        self.prepare_start(stage.momentum);
        std::mem::swap(&mut self.v, &mut self.x);
        self.done += 1;
        if !change.is_finite() {
            let (iteration, planned) = (self.done, self.planned);
            return Err(ReconError::Diverged { iteration, planned });
        }
        Ok(Step { sigma, residual: (squares.sqrt() / self.y_norm) as f32, change })
    }

    /// Projection, total variation and the change, strip by strip, so that what the memory hands
    /// over is used for all three while it is in cache.
    fn project_and_smooth(&mut self, stage: &Stage) -> (f64, Change) {
        let (frames, height, width) = self.op.dim();
        let rows = (STRIP_VALUES / (frames * width)).max(LEAST_ROWS);
        let (mut squares, mut change) = (0.0, Change::default());
        for start in (0..height).step_by(rows) {
            let strip = start..height.min(start + rows);
            squares += self.project(stage.memory, strip.clone());
            self.smooth_in_time(stage, strip.clone());
            let (weight, updates) = (stage.tv_weight, stage.tv_updates);
            for k in 0..frames {
                let done = self.tv.advance(k, &mut self.x, strip.clone(), weight, updates);
                change.add(&self.x, &self.v, k, done);
            }
        }
        self.tv_iterations += usize::from(stage.tv_weight > 0.0);
        (squares, change)
    }

    /// Projects some rows into `x`; `||y - H v||^2` of them.
    fn project(&mut self, memory: f32, rows: Range<usize>) -> f64 {
        let y1 = self.y1.as_mut().map(|y1| (y1, memory));
        let start = self.start.as_ref().unwrap_or(&self.v);
        self.op.project(rows, &self.y, y1, start, &mut self.x)
    }

    fn smooth_in_time(&mut self, stage: &Stage, rows: Range<usize>) {
        if stage.temporal_weight > 0.0 {
            self.temporal.denoise(&mut self.x, rows, stage.temporal_weight, stage.tv_updates);
        }
    }

    fn change(&self, rows: Range<usize>) -> Change {
        let mut change = Change::default();
        (0..self.op.dim().0).for_each(|k| change.add(&self.x, &self.v, k, rows.clone()));
        change
    }

    /// `v = D(x)`, in place.
    fn apply(&mut self, stage: &Stage, sigma: Option<Sigma>) -> Result<(), ReconError> {
        if stage.prior.uses_tv() {
            self.smooth_in_time(stage, 0..self.y.nrows());
        }
        if stage.prior.uses_tv() && stage.tv_weight > 0.0 {
            self.tv.denoise(&mut self.x, stage.tv_weight, stage.tv_updates);
            self.tv_iterations += 1;
        }
        let Some(sigma) = sigma else { return Ok(()) };
        if stage.prior == Prior::Nonlocal {
            let size = self.x.dim();
            let nonlocal = self.nonlocal.get_or_insert_with(|| Nonlocal::new(size));
            nonlocal.denoise(&mut self.x, sigma);
        }
        if let Some(network) = stage.prior.network() {
            self.networks.network(network)?.denoise(&mut self.x, sigma)?;
            self.denoiser_passes += 1;
        }
        Ok(())
    }

    /// What is projected next, from the new iterate in `x` and the old one in `v`. For ADMM
    /// `start` holds `z`, what went into the denoiser, so that `u = v - z`.
    fn prepare_start(&mut self, momentum: f32) {
        let Some(start) = &mut self.start else { return };
        if let Some(u) = &mut self.multiplier {
            ndarray::azip!((u in &mut *u, &new in &self.x, &z in &*start) *u = new - z);
            ndarray::azip!((start in start, &new in &self.x, &old in &self.v, &u in &*u)
                *start = new + momentum * (new - old) + u);
        } else {
            ndarray::azip!((start in start, &new in &self.x, &old in &self.v)
                *start = new + momentum * (new - old));
        }
    }

    fn residual(&mut self) -> f32 {
        let squares = self.op.project(0..self.y.nrows(), &self.y, None, &self.v, &mut self.x);
        (squares.sqrt() / self.y_norm) as f32
    }
}
