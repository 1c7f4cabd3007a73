//! Progress of a reconstruction, and its observers.

use std::ops::Range;

use super::priors::Family;

/// State of a reconstruction after an iteration.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Index of the stage, from 0.
    pub stage: usize,
    /// Iterations done, over all stages.
    pub done: usize,
    /// Largest number of iterations; shrinks when a stage converges early.
    pub planned: usize,
    /// `||y - H w|| / ||y||` of the frames `w` that the iteration started from.
    pub residual: f32,
    /// `||v_k - v_(k-1)|| / ||v_k||`.
    pub change: f32,
    /// Noise level of the prior in this iteration, if it has one.
    pub sigma: Option<f32>,
    /// Kind of the prior.
    pub family: Family,
}

/// An observer's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Go on.
    Continue,
    /// Stop at once; the reconstruction ends with [`super::ReconError::Cancelled`].
    Cancel,
}

/// Watches a reconstruction; called after every iteration.
pub trait Observer {
    /// Receives the progress, and answers whether to go on.
    fn iteration(&mut self, progress: &Progress) -> Control;

    /// A new reconstruction begins, which is this share of the whole work, on \[0,1\].
    fn part(&mut self, _share: Range<f64>) {}
}

/// An observer that never stops anything.
impl Observer for () {
    fn iteration(&mut self, _: &Progress) -> Control {
        Control::Continue
    }
}
