//! A stage that was tried on a crop, and how it compares with others by its hold-out errors.

use ndarray::Array3;

use super::hold_out::t_statistic;
use super::schedule::{Heuristic, Schedule};
use super::stage::Stage;
use super::static_regions::temporal_correlation;

/// Largest t-statistic of the final against the smallest error for which the full schedule is run. Overfitting costs far more
/// than the error shows.
const MAX_FULL_SCHEDULE_T: f64 = 1.5;

/// Smallest t-statistic for which a candidate is accepted. A larger one would rarely be reached if noise outweighs the
/// frames' error.
const ACCEPT_T: f64 = 1.0;

/// [`ACCEPT_T`] for another static variance. It trades changes for the static part, which counts more in a measurement than
/// in the frames.
const ACCEPT_STATIC_VARIANCE_T: f64 = 3.0;

/// [`ACCEPT_T`] for strong shrinkage of a static scene. A measurement hardly shows its benefit.
const ACCEPT_STATIC_T: f64 = -1.5;

/// Correlation of the temporal changes under weak and under strong shrinkage below which the scene is static. Swept on 224
/// simulated scenes (`research/NOTEBOOK.md`): 27 of 33 static ones and 8 of 191 others are below.
const MAX_STATIC_CORRELATION: f32 = 0.45;

/// Shrinkage from which on it is strong, relative to the planned one.
const STRONG: f32 = 4.0;

/// A stage that was run on the crop, and its hold-out errors.
pub(crate) struct Trial {
    pub(crate) stage: Stage,
    /// Hold-out error after each iteration.
    pub(crate) errors: Vec<f64>,
    /// `(y - Hv)^2` of each hold-out pixel, after each iteration.
    pub(crate) squares: Vec<Vec<f64>>,
    /// The frames with the smallest error.
    pub(crate) best_frames: Option<Array3<f32>>,
    /// The frames after the last iteration, unless it diverged.
    pub(crate) last_frames: Option<Array3<f32>>,
    pub(crate) diverged: bool,
    /// True if it clearly trailed and was not run to its end.
    pub(crate) abandoned: bool,
    /// True if strong shrinkage has removed nearly all temporal change.
    pub(crate) is_static: bool,
}

impl Trial {
    pub(crate) fn new(stage: Stage) -> Self {
        Self {
            stage,
            errors: Vec::new(),
            squares: Vec::new(),
            best_frames: None,
            last_frames: None,
            diverged: false,
            abandoned: false,
            is_static: false,
        }
    }

    /// Adds the hold-out errors after an iteration. Returns true if no other one was as small.
    pub(crate) fn add(&mut self, error: f64, squares: Vec<f64>) -> bool {
        let is_smallest = error < self.smallest_error();
        self.errors.push(error);
        self.squares.push(squares);
        is_smallest
    }

    fn smallest_error(&self) -> f64 {
        self.errors.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Number of iterations up to the smallest error.
    pub(crate) fn best_iteration(&self) -> usize {
        let smallest = self.smallest_error();
        self.errors.iter().position(|error| *error == smallest).map_or(0, |index| index + 1)
    }

    /// The squared errors there.
    fn best_squares(&self) -> &[f64] {
        self.best_iteration().checked_sub(1).map_or(&[], |index| &self.squares[index])
    }

    /// Number of iterations to be run: all, unless the final error is significantly above the smallest; else those up to the
    /// smallest.
    pub(crate) fn early_stopping_iteration(&self) -> usize {
        let complete = !self.diverged && self.errors.len() == self.stage.iterations;
        let last = self.squares.last().map_or(&[][..], Vec::as_slice);
        let in_full = complete && t_statistic(last, self.best_squares()) <= MAX_FULL_SCHEDULE_T;
        if in_full { self.errors.len() } else { self.best_iteration() }
    }

    /// The frames of the result. With noise the smallest error may come first, when little is shrunk.
    fn result(&self) -> Option<&Array3<f32>> {
        let full = self.early_stopping_iteration() == self.errors.len();
        if full { self.last_frames.as_ref() } else { self.best_frames.as_ref() }
    }

    pub(crate) fn shrinkage(&self) -> f32 {
        temporal_shrinkage(&self.stage)
    }

    /// True if strong shrinkage removed nearly all temporal change, which indicates a static scene.
    pub(crate) fn indicates_static_scene(&self, weaker: &Self, schedule: &Schedule) -> bool {
        let enabled = schedule.has(Heuristic::StaticScene);
        let frames = self.result().zip(weaker.result());
        let frames = frames.filter(|_| enabled && is_strong(self.shrinkage(), weaker.shrinkage()));
        frames
            .is_some_and(|(own, weaker)| temporal_correlation(own, weaker) < MAX_STATIC_CORRELATION)
    }

    /// True if its smallest error is significantly below that of the best trial so far. Strong shrinkage of a static scene
    /// must not be significantly worse.
    pub(crate) fn is_better_than(&self, best: &Self, schedule: &Schedule) -> bool {
        if self.abandoned {
            return false;
        }
        let (own_squares, best_squares) = (self.best_squares(), best.best_squares());
        if own_squares.is_empty() || best_squares.is_empty() {
            return self.smallest_error() < best.smallest_error();
        }
        let variance = |trial: &Self| trial.stage.projection.static_variance;
        let stronger = self.shrinkage() > best.shrinkage();
        let threshold = if variance(self) != variance(best) {
            ACCEPT_STATIC_VARIANCE_T
        } else if self.indicates_static_scene(best, schedule) || stronger && best.is_static {
            ACCEPT_STATIC_T
        } else {
            ACCEPT_T
        };
        t_statistic(best_squares, own_squares) > threshold
    }
}

/// True if a temporal shrinkage is strong relative to a planned one.
pub(crate) fn is_strong(shrinkage: f32, planned: f32) -> bool {
    planned > 0.0 && shrinkage >= STRONG * planned
}

/// The temporal shrinkage of a stage; 0 without the nonlocal prior.
pub(crate) fn temporal_shrinkage(stage: &Stage) -> f32 {
    stage.prior.nonlocal().map_or(0.0, |nonlocal| nonlocal.temporal_shrinkage)
}
