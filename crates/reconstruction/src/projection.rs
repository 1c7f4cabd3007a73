//! The projection of one iteration, on request strip by strip.

use std::ops::Range;

use ndarray::Array3;

use super::iterate::{Change, Iterate};
use super::operator::{Accumulation, SensingOperator, Statistics};

/// A measurement \[S,H,W\] and its operator.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Problem<'a> {
    pub(crate) operator: &'a SensingOperator,
    /// On the scale on which the scene is on \[0,1\]; in standard layout.
    pub(crate) y: &'a Array3<f32>,
}

/// The settings of a stage's iterations.
pub(crate) struct Settings {
    /// Share of the accumulated residual that is kept.
    pub(crate) memory: f32,
    /// Factor of the extrapolation.
    pub(crate) momentum: f32,
    /// Covariance of the frames' errors, and variance of the noise.
    pub(crate) statistics: Statistics,
}

/// `x = w + R H^T (H R H^T + gamma)^-1 (y1 - H w)`, computed as a prior asks for it.
///
/// It also measures the residual `||y - H w||` and the change from the last iterate to the denoised frames.
pub struct Projection<'a> {
    problem: Problem<'a>,
    settings: &'a Settings,
    iterate: &'a mut Iterate,
    squared_residual: f64,
    change: Option<Change>,
}

/// Residual and change of an iteration.
#[derive(Debug)]
pub(crate) struct Step {
    /// `||y - H w||^2`.
    pub(crate) squared_residual: f64,
    /// The change from the last iterate to the new one.
    pub(crate) change: Change,
}

impl<'a> Projection<'a> {
    /// A projection that starts from `iterate`.
    pub(crate) fn new(
        problem: Problem<'a>,
        settings: &'a Settings,
        iterate: &'a mut Iterate,
    ) -> Self {
        Self { problem, settings, iterate, squared_residual: 0.0, change: None }
    }

    /// Frames of all snapshots, height and width.
    pub fn size(&self) -> (usize, usize, usize) {
        self.problem.operator.dim()
    }

    /// An array \[S B,H,W\] for the result, in standard layout.
    pub fn take_buffer(&mut self) -> Array3<f32> {
        std::mem::take(&mut self.iterate.x)
    }

    /// Projects some rows of all frames, each row once.
    pub fn rows(&mut self, rows: Range<usize>, frames: &mut Array3<f32>) {
        let Problem { operator, y } = self.problem;
        let Iterate { v, y1, w, .. } = &mut *self.iterate;
        let Settings { memory, statistics, .. } = self.settings;
        let y1 = y1.as_mut().map(|y1| Accumulation { y1, memory: *memory });
        let start = w.as_ref().unwrap_or(v);
        self.squared_residual += operator.project(rows, y, y1, statistics, start, frames);
    }

    /// Projects all rows.
    pub fn all_rows(&mut self) -> Array3<f32> {
        let mut frames = self.take_buffer();
        self.rows(0..self.size().1, &mut frames);
        frames
    }

    /// Compares rows of frame `k`, which are denoised, with the last iterate. A prior that works strip by strip calls this
    /// once for each row, while the row is in cache; else `Projection::finish` compares all rows.
    pub fn compare(&mut self, denoised: &Array3<f32>, k: usize, rows: Range<usize>) {
        self.change.get_or_insert_default().add(denoised, &self.iterate.v, k, rows);
    }

    /// `||y - H w||^2` of the projected rows.
    pub(crate) fn squared_residual(&self) -> f64 {
        self.squared_residual
    }

    /// Residual and change, once all frames are denoised.
    pub(crate) fn finish(self, denoised: &Array3<f32>) -> Step {
        let change = self.change.unwrap_or_else(|| Change::between(denoised, &self.iterate.v));
        Step { squared_residual: self.squared_residual, change }
    }
}

#[cfg(test)]
mod tests {
    use super::{Problem, Projection, Settings};
    use crate::iterate::{Change, Iterate, Variables};
    use crate::operator::{SensingOperator, Statistics};
    use crate::schedule::Schedule;
    use ndarray::Array3;
    use rand::{RngExt, SeedableRng};

    /// Projection and total variation strip by strip equal those of whole frames, bit by bit.
    #[test]
    fn strips_equal_whole_frames() {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(8);
        // Wide enough for several strips.
        let size = (3, 50, 1100);
        let mut random = || Array3::from_shape_simple_fn(size, || rng.random::<f32>());
        let (masks, v) = (random(), random());
        let operator = SensingOperator::new(masks).unwrap();
        let y = operator.forward(random().view()).unwrap();
        let schedule = Schedule::gap_tv3d();
        let stage = &schedule.stages[0];
        let statistics = Statistics::default();
        let settings = Settings { memory: 1.0, momentum: 0.0, statistics };
        let variables = Variables { y1: true, w: false, u: false };
        let problem = Problem { operator: &operator, y: &y };
        let run = |by_strips: bool| {
            let mut iterate = Iterate { v: v.clone(), ..Iterate::zeros(&operator, variables) };
            let mut networks = ();
            let mut prior = stage.prior.start(size, &mut networks).unwrap();
            let mut projection = Projection::new(problem, &settings, &mut iterate);
            let frames = if by_strips {
                prior.step(&mut projection, 0.0).unwrap()
            } else {
                let mut frames = projection.all_rows();
                prior.denoise(&mut frames, 0.0).unwrap();
                frames
            };
            assert_eq!(projection.change.is_some(), by_strips);
            let step = projection.finish(&frames);
            (frames, iterate.y1, step)
        };
        let ((strips, strips_y1, strips_step), (whole, whole_y1, whole_step)) =
            (run(true), run(false));
        assert_eq!((&strips, strips_y1), (&whole, whole_y1));
        let expected = Change::between(&whole, &v).relative();
        let residual = (&y - &operator.forward(v.view()).unwrap()).mapv(|r| r * r).sum();
        for step in [strips_step, whole_step] {
            assert!((step.change.relative() / expected - 1.0).abs() < 1e-4);
            assert!((step.squared_residual / f64::from(residual) - 1.0).abs() < 1e-4);
        }
    }
}
