//! Hold-out pixels of a measurement, by which the frames of a reconstruction without them are judged.

use ndarray::{Array3, ArrayView3, Axis, s};
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};

use super::operator::SensingOperator;

/// Share of pixels that are held out.
const SHARE: f64 = 0.07;

/// Pixels that are hidden from the solver.
pub(super) struct HoldOut {
    /// Snapshot, row and column of each pixel.
    pub(super) pixels: Vec<(usize, usize, usize)>,
}

impl HoldOut {
    /// Draws pixels that light reaches and that were measured; always the same ones for the same masks and snapshot. The
    /// operator's first snapshot has the index `first`.
    pub(super) fn draw(op: &SensingOperator, first: usize) -> Self {
        let gram = op.gram();
        let mut pixels = Vec::new();
        for snapshot in 0..op.snapshots() {
            let mut random = rand::rngs::ChaCha8Rng::seed_from_u64((first + snapshot) as u64);
            for ((row, column), _) in gram.indexed_iter() {
                if random.random_bool(SHARE) && op.uses((snapshot, row, column)) {
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
            let masked = |k| op.masks()[[k, i, j]] * v[[s * frames + k, i, j]];
            f64::from(y[[s, i, j]] - (0..frames).map(masked).sum::<f32>()).powi(2)
        };
        self.pixels.iter().map(residual).collect()
    }
}

/// Squared errors of two predictions of the hold-out pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Prediction {
    /// `||y - H v||^2` over the hold-out pixels.
    pub by_frames: f64,
    /// `||y - m||^2` over the same pixels, where `m` is the mean of the other pixels around each.
    pub by_neighbours: f64,
}

/// Distance in pixels of the farthest neighbours that predict a hold-out pixel.
const NEIGHBOURS: usize = 3;

impl HoldOut {
    /// Compares the frames' prediction of the hold-out pixels with one that knows no masks.
    pub(super) fn prediction(
        &self,
        op: &SensingOperator,
        y: ArrayView3<'_, f32>,
        v: ArrayView3<'_, f32>,
    ) -> Prediction {
        Prediction {
            by_frames: self.residuals(op, y, v).iter().sum(),
            by_neighbours: self.neighbour_error(y),
        }
    }

    /// `||y - m||^2`, where `m` is the mean of the other pixels around each.
    fn neighbour_error(&self, y: ArrayView3<'_, f32>) -> f64 {
        let mut is_held_out = Array3::from_elem(y.dim(), false);
        self.pixels.iter().for_each(|&pixel| is_held_out[pixel] = true);
        let (_, height, width) = y.dim();
        let around = |at: usize, length: usize| {
            at.saturating_sub(NEIGHBOURS)..length.min(at + NEIGHBOURS + 1)
        };
        let square = |&(snapshot, row, column): &(usize, usize, usize)| {
            let window = s![snapshot, around(row, height), around(column, width)];
            let (mut sum, mut count) = (0.0, 0.0);
            for (value, hidden) in y.slice(window).iter().zip(is_held_out.slice(window)) {
                if !hidden && !value.is_nan() {
                    sum += f64::from(*value);
                    count += 1.0;
                }
            }
            (f64::from(y[[snapshot, row, column]]) - sum / f64::max(count, 1.0)).powi(2)
        };
        self.pixels.iter().map(square).sum()
    }
}

/// t-statistic of the mean difference `one - other` of two candidates' squared hold-out errors, pixel by pixel; 0 if the
/// difference does not vary.
pub(super) fn t_statistic(one: &[f64], other: &[f64]) -> f64 {
    let differences = || one.iter().zip(other).map(|(one, other)| one - other);
    let count = one.len() as f64;
    let mean = differences().sum::<f64>() / count;
    let variance = differences().map(|difference| (difference - mean).powi(2)).sum::<f64>() / count;
    if variance > 0.0 { mean / (variance / count).sqrt() } else { 0.0 }
}
