//! The variables of an iteration, named as in the paper.

use std::ops::Range;

use ndarray::{Array3, Axis};

use super::operator::SensingOperator;

/// The variables that a reconstruction needs besides `v`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Variables {
    pub(crate) y1: bool,
    pub(crate) w: bool,
    pub(crate) u: bool,
}

/// The variables that one iteration hands to the next.
pub(crate) struct Iterate {
    /// Frames `v` \[S B,H,W\].
    pub(crate) v: Array3<f32>,
    /// Target `y1` of accelerated GAP \[S,H,W\]: the measurement plus the accumulated residual.
    pub(crate) y1: Option<Array3<f32>>,
    /// Frames `w` \[S B,H,W\] that are projected next, if they are not `v`.
    pub(crate) w: Option<Array3<f32>>,
    /// Scaled multiplier `u` of ADMM \[S B,H,W\].
    pub(crate) u: Option<Array3<f32>>,
    /// Array \[S B,H,W\] that the next projection fills; its values are irrelevant.
    pub(crate) x: Array3<f32>,
}

impl Iterate {
    /// All zero. `y1` is kept through all stages: resetting it between total variation and a learned denoiser loses the
    /// gain of the acceleration.
    pub(crate) fn zeros(operator: &SensingOperator, variables: Variables) -> Self {
        let zeros = || Array3::zeros(operator.dim());
        Self {
            v: zeros(),
            y1: variables.y1.then(|| Array3::zeros(operator.measurement_dim())),
            w: variables.w.then(zeros),
            u: variables.u.then(zeros),
            x: zeros(),
        }
    }

    /// Makes `v` of the new frames, and reuses the array of the old ones.
    pub(crate) fn replace_frames(&mut self, frames: Array3<f32>) {
        self.x = std::mem::replace(&mut self.v, frames);
    }

    /// A copy of the variables, for [`Iterate::restore`].
    pub(crate) fn snapshot(&self) -> Self {
        let Self { v, y1, w, u, .. } = self;
        let x = Array3::default((0, 0, 0));
        Self { v: v.clone(), y1: y1.clone(), w: w.clone(), u: u.clone(), x }
    }

    /// Goes back to a snapshot, and returns the frames `v` that it replaces.
    pub(crate) fn restore(&mut self, snapshot: Self) -> Array3<f32> {
        let x = std::mem::take(&mut self.x);
        std::mem::replace(self, Self { x, ..snapshot }).v
    }
}

/// Number of running sums side by side, enough for the compiler to keep them in registers over a loop.
const LANES: usize = 256;

/// Squared norms of the change between two iterates and of the new one.
#[derive(Debug, Default)]
pub(crate) struct Change {
    difference: f64,
    norm: f64,
}

impl Change {
    /// The change with these squared norms.
    #[cfg(feature = "gpu")]
    pub(crate) fn new(difference: f64, norm: f64) -> Self {
        Self { difference, norm }
    }

    /// The change from all of `old` to `new`.
    pub(crate) fn between(new: &Array3<f32>, old: &Array3<f32>) -> Self {
        let mut change = Self::default();
        let (count, height, _) = new.dim();
        (0..count).for_each(|k| change.add(new, old, k, 0..height));
        change
    }

    /// Adds rows of frame `k`.
    pub(crate) fn add(
        &mut self,
        new: &Array3<f32>,
        old: &Array3<f32>,
        k: usize,
        rows: Range<usize>,
    ) {
        let width = new.dim().2;
        let values = rows.start * width..rows.end * width;
        let (new, old) = (new.index_axis(Axis(0), k), old.index_axis(Axis(0), k));
        let (Some(new), Some(old)) = (new.to_slice(), old.to_slice()) else {
            unreachable!("arrays of the solver are in standard layout")
        };
        let (difference, norm) = change_sums(&new[values.clone()], &old[values]);
        self.difference += difference;
        self.norm += norm;
    }

    /// `||new - old|| / ||new||`; 0 if nothing changed.
    pub(crate) fn relative(&self) -> f32 {
        if self.difference == 0.0 { 0.0 } else { (self.difference / self.norm).sqrt() as f32 }
    }
}

/// `(||new - old||^2, ||new||^2)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn change_sums(new: &[f32], old: &[f32]) -> (f64, f64) {
    // Running sums in f32 side by side, added in f64: this vectorises, and is the same on every machine.
    let (mut difference, mut norm) = ([0.0f32; LANES], [0.0f32; LANES]);
    for (new, old) in new.chunks(LANES).zip(old.chunks(LANES)) {
        let sums = difference.iter_mut().zip(&mut norm);
        for ((difference, norm), (&new, &old)) in sums.zip(new.iter().zip(old)) {
            *difference += (new - old) * (new - old);
            *norm += new * new;
        }
    }
    let total = |sums: [f32; LANES]| sums.iter().copied().map(f64::from).sum();
    (total(difference), total(norm))
}
