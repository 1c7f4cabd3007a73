//! What an iteration starts from, and how far it moves.

use std::ops::Range;

use ndarray::{Array3, Axis};

use crate::schedule::{Method, Schedule};
use crate::sensing::{SensingOperator, Statistics};

/// What an iteration starts from.
#[derive(Clone)]
pub(crate) struct State {
    /// The iterate \[S B,H,W\].
    pub(super) v: Array3<f32>,
    /// The target of accelerated GAP \[S,H,W\].
    pub(super) y1: Option<Array3<f32>>,
    /// What is projected, where it is not `v`: extrapolated, or with ADMM's multiplier.
    pub(super) start: Option<Array3<f32>>,
    /// ADMM's multiplier `u`.
    pub(super) multiplier: Option<Array3<f32>>,
}

impl State {
    /// All zero.
    pub(super) fn new(op: &SensingOperator, schedule: &Schedule) -> Self {
        let zeros = || Array3::zeros(op.dim());
        Self {
            v: zeros(),
            y1: schedule.accelerated.then(|| Array3::zeros(op.measurement_dim())),
            start: schedule.has_own_start().then(zeros),
            multiplier: (schedule.method == Method::Admm).then(zeros),
        }
    }

    /// Projects some rows into `x`; `||y - H v||^2` of them.
    pub(super) fn project(
        &mut self,
        op: &SensingOperator,
        rows: Range<usize>,
        y: &Array3<f32>,
        (memory, supposed): (f32, &Statistics),
        x: &mut Array3<f32>,
    ) -> f64 {
        let y1 = self.y1.as_mut().map(|y1| (y1, memory));
        op.project(rows, y, y1, supposed, self.start.as_ref().unwrap_or(&self.v), x)
    }
}

/// Running sums side by side: so many that the compiler keeps them in a loop over registers.
const LANES: usize = 256;

/// Squares of the change and of the new values, added up.
#[derive(Debug, Default)]
pub(super) struct Change {
    difference: f64,
    norm: f64,
}

impl Change {
    /// Adds rows of frame `k`.
    pub(super) fn add(
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
    pub(super) fn relative(&self) -> f32 {
        if self.difference == 0.0 { 0.0 } else { (self.difference / self.norm).sqrt() as f32 }
    }
}

/// `(||new - old||^2, ||new||^2)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn change_sums(new: &[f32], old: &[f32]) -> (f64, f64) {
    // Running sums in f32 side by side, added up in f64: vectorises, and is the same on every
    // machine.
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
