//! Pixels of a measurement that are kept from the solver, to judge its frames by.

use ndarray::{ArrayView3, Axis};
use rand::{Rng, SeedableRng};

use super::sensing::SensingOperator;

/// The share of pixels that are kept from the solver.
const HELD_OUT: f64 = 0.07;

/// Pixels that the solver does not see.
pub(super) struct HeldOut {
    /// Snapshots, rows and columns.
    pub(super) pixels: Vec<(usize, usize, usize)>,
}

impl HeldOut {
    /// Drawn from those that a mask reaches; always the same for the same masks and the same snapshot, of
    /// which the operator's first has the index `first`.
    pub(super) fn of(op: &SensingOperator, first: usize) -> Self {
        let gram = op.gram();
        let mut pixels = Vec::new();
        for snapshot in 0..op.snapshots() {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64((first + snapshot) as u64);
            for ((row, column), &gram) in gram.indexed_iter() {
                if random.random_bool(HELD_OUT) && gram > 0.0 {
                    pixels.push((snapshot, row, column));
                }
            }
        }
        Self { pixels }
    }

    /// `||y - Hv||^2` and `||y||^2` over the pixels.
    pub(super) fn squares(
        &self,
        op: &SensingOperator,
        y: ArrayView3<'_, f32>,
        v: ArrayView3<'_, f32>,
    ) -> (f64, f64) {
        (self.residuals(op, y, v).iter().sum(), self.norm(y))
    }

    /// `||y||^2` over the pixels, above 0.
    pub(super) fn norm(&self, y: ArrayView3<'_, f32>) -> f64 {
        let norm = self.pixels.iter().map(|&pixel| f64::from(y[pixel]).powi(2)).sum::<f64>();
        norm.max(f64::MIN_POSITIVE)
    }

    /// `(y - Hv)^2` of each pixel.
    pub(super) fn residuals(
        &self,
        op: &SensingOperator,
        y: ArrayView3<'_, f32>,
        v: ArrayView3<'_, f32>,
    ) -> Vec<f64> {
        let frames = op.masks().len_of(Axis(0));
        let residual = |&(s, i, j): &(usize, usize, usize)| {
            let seen = |k| op.masks()[[k, i, j]] * v[[s * frames + k, i, j]];
            f64::from(y[[s, i, j]] - (0..frames).map(seen).sum::<f32>()).powi(2)
        };
        self.pixels.iter().map(residual).collect()
    }
}
