//! Error estimates from the hold-out pixels of a reconstruction.
//!
//! At a hold-out pixel `y - Hv = sum_k C_k e_k + n` with the frames' errors `e` and the noise `n`. The masks at that
//! pixel had no influence on `v`, so `E (y - Hv)^2 = a S + b D + sigma^2`. Here `a` is the variance of the static
//! part of the errors and `b` that of their changes (DCT along time); `S` is the static part of the Gram diagonal and
//! `D` the remainder. `S` and `D` differ from pixel to pixel, so a fit separates `a`, `b` and `sigma^2`. Then `(a +
//! (B - 1) b) / B` is the mean squared error of the frames. Errors vary in space: `a` and `b` are multiples of local
//! estimates, from the residuals of other hold-out pixels and from texture and motion.

use ndarray::{Array2, ArrayView3, Axis, s};
use serde::{Deserialize, Serialize};

use super::hold_out::HoldOut;
use super::operator::SensingOperator;

/// The estimates, each in dB of the mean square of a voxel.
pub const SIGNS: [&str; 8] = [
    "residual after the first stage",
    "residual of the frames",
    "error, by local residuals and texture",
    "static part of the error",
    "error, by local residuals, without noise",
    "error, by local texture",
    "residual of the pixels with the least texture",
    "residual of the pixels with the most texture",
];

/// Values of [`SIGNS`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(transparent)]
pub struct Signs(pub [f32; SIGNS.len()]);

/// Squares below this are rounding errors.
const FLOOR: f64 = 1e-7;
/// Standard deviation of the weights of surrounding residuals, in pixels.
const WEIGHT_RADIUS: f64 = 3.0;
/// Weight of the mean of all residuals.
const MEAN_WEIGHT: f64 = 0.1;
/// Radius of the square over which texture is measured, in pixels.
const TEXTURE_RADIUS: usize = 3;
/// Share of the pixels with the least, and with the most, texture.
const EXTREME_SHARE: f64 = 0.2;
/// Number of steps of the fit, after which it no longer changes.
const STEPS: usize = 150;

impl Signs {
    /// Estimates for one snapshot `y` \[1,H,W\] from its hold-out pixels: `early` are the frames \[B,H,W\] after the
    /// first stage, `last` those at the end, all on the scale on which the scene is on \[0,1\]. None without hold-out
    /// pixels.
    pub(super) fn of(
        (op, y): (&SensingOperator, ArrayView3<'_, f32>),
        hold_out: &HoldOut,
        early: ArrayView3<'_, f32>,
        last: ArrayView3<'_, f32>,
    ) -> Option<Self> {
        let count = hold_out.pixels.len() as f64;
        if hold_out.pixels.is_empty() {
            return None;
        }
        let residuals = hold_out.residuals(op, y, last);
        let gram = op.gram();
        let static_gram = op.static_gram();
        let at = |image: &dyn Fn((usize, usize)) -> f64| -> Vec<f64> {
            hold_out.pixels.iter().map(|&(_, i, j)| image((i, j))).collect()
        };
        let shared = at(&|p| f64::from(static_gram[p]));
        let changing = at(&|p| f64::from((gram[p] - static_gram[p]).max(0.0)));
        let mean_gram = at(&|p| f64::from(gram[p])).iter().sum::<f64>() / count;
        let texture = texture(last);
        let texture = at(&|p| texture[p]);

        let local = local_residuals(hold_out, &residuals);
        let textured = scaled(texture.iter().map(|texture| texture.sqrt()));
        let both = local.iter().zip(&textured).map(|(local, textured)| (local * textured).sqrt());
        let both = scaled(both);
        let frames = last.len_of(Axis(0)) as f64;
        let error = |scale: &[f64], noise: bool| {
            let times = |part: &[f64]| part.iter().zip(scale).map(|(part, s)| part * s).collect();
            let mut parts: Vec<Vec<f64>> = vec![times(&shared), times(&changing)];
            if noise {
                parts.push(vec![1.0; residuals.len()]);
            }
            let variances = variances(&residuals, &parts);
            ((variances[0] + (frames - 1.0) * variances[1]) / frames, variances[0] / frames)
        };
        let first = hold_out.residuals(op, y, early);
        let mean = |squares: &[f64]| squares.iter().sum::<f64>() / squares.len() as f64 / mean_gram;
        let [smooth, busy] = extremes(&texture, &residuals);
        let (both_errors, static_error) = error(&both, true);
        let squares = [
            mean(&first),
            mean(&residuals),
            both_errors,
            static_error,
            error(&local, false).0,
            error(&textured, true).0,
            smooth / mean_gram,
            busy / mean_gram,
        ];
        Some(Self(squares.map(|square| (10.0 * square.max(FLOOR).log10()) as f32)))
    }
}

/// Values divided by their mean.
fn scaled(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter_mut().for_each(|value| *value = (*value / mean.max(FLOOR)).max(FLOOR));
    values
}

/// Weighted mean of the residuals around each pixel, without the pixel, in units of the mean of all.
fn local_residuals(hold_out: &HoldOut, residuals: &[f64]) -> Vec<f64> {
    let mean = residuals.iter().sum::<f64>() / residuals.len() as f64;
    let around = |(index, &(_, i, j)): (usize, &(usize, usize, usize))| {
        let (mut sum, mut weights) = (MEAN_WEIGHT * mean, MEAN_WEIGHT);
        for (other, &(_, row, column)) in hold_out.pixels.iter().enumerate() {
            let distance = (i.abs_diff(row).pow(2) + j.abs_diff(column).pow(2)) as f64;
            if other != index && distance < (4.0 * WEIGHT_RADIUS).powi(2) {
                let weight = (-0.5 * distance / WEIGHT_RADIUS.powi(2)).exp();
                sum += weight * residuals[other];
                weights += weight;
            }
        }
        sum / weights
    };
    scaled(hold_out.pixels.iter().enumerate().map(around))
}

/// Squared differences from pixel to pixel and from frame to frame, averaged over the frames and a square around each
/// pixel \[H,W\].
fn texture(frames: ArrayView3<'_, f32>) -> Array2<f64> {
    let (count, height, width) = frames.dim();
    let mut steps = Array2::<f64>::zeros((height, width));
    for (k, frame) in frames.outer_iter().enumerate() {
        let next = (k + 1 < count).then(|| frames.index_axis(Axis(0), k + 1));
        for ((i, j), sum) in steps.indexed_iter_mut() {
            let here = frame[[i, j]];
            let step =
                |there: Option<&f32>| there.map_or(0.0, |there| f64::from(there - here).powi(2));
            let beside = step(frame.get((i + 1, j))) + step(frame.get((i, j + 1)));
            let later = step(next.as_ref().and_then(|next| next.get((i, j))));
            *sum += beside / count as f64 + later / (count - 1).max(1) as f64;
        }
    }
    Array2::from_shape_fn((height, width), |(i, j)| {
        let rows = i.saturating_sub(TEXTURE_RADIUS)..height.min(i + TEXTURE_RADIUS + 1);
        let columns = j.saturating_sub(TEXTURE_RADIUS)..width.min(j + TEXTURE_RADIUS + 1);
        steps.slice(s![rows, columns]).mean().unwrap_or(0.0)
    })
}

/// Mean squares where there is the least texture, and where there is the most.
fn extremes(texture: &[f64], squares: &[f64]) -> [f64; 2] {
    let mut order: Vec<usize> = (0..texture.len()).collect();
    order.sort_by(|a, b| texture[*a].total_cmp(&texture[*b]));
    let count = ((texture.len() as f64 * EXTREME_SHARE) as usize).max(1);
    let mean = |of: &[usize]| of.iter().map(|index| squares[*index]).sum::<f64>() / count as f64;
    [mean(&order[..count]), mean(&order[order.len() - count..])]
}

/// Non-negative factors of parts that add up to the expected square of each value: the maximum-likelihood ones for
/// Gaussian values, by multiplicative updates (Févotte, Bertin and Durrieu, Neural Computation 2009).
fn variances(squares: &[f64], parts: &[Vec<f64>]) -> Vec<f64> {
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    let all = parts.iter().flatten().sum::<f64>() / squares.len() as f64;
    let mut factors = vec![mean / all.max(FLOOR); parts.len()];
    for _ in 0..STEPS {
        let mut gains = vec![(0.0, 0.0); parts.len()];
        for (pixel, square) in squares.iter().enumerate() {
            let sum = parts.iter().zip(&factors).map(|(part, factor)| part[pixel] * factor);
            let expected = sum.sum::<f64>() + 1e-9;
            for ((up, down), part) in gains.iter_mut().zip(parts) {
                *up += part[pixel] * square / expected.powi(2);
                *down += part[pixel] / expected;
            }
        }
        for (factor, (up, down)) in factors.iter_mut().zip(gains) {
            *factor *= (up / f64::max(down, 1e-30)).sqrt();
        }
    }
    factors
}

#[cfg(test)]
mod tests {
    use super::{Signs, variances};
    use crate::hold_out::HoldOut;
    use crate::operator::SensingOperator;
    use ndarray::Array3;
    use optics::iid_masks;
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;

    fn random() -> rand::rngs::ChaCha8Rng {
        rand::rngs::ChaCha8Rng::seed_from_u64(4)
    }

    #[test]
    fn variances_of_parts_are_estimated() {
        let mut random = random();
        let parts: Vec<Vec<f64>> =
            (0..2).map(|_| (0..20_000).map(|_| random.random::<f64>()).collect()).collect();
        let square = |(a, b): (&f64, &f64)| {
            (3.0 * a + 0.5 * b) * random.sample::<f64, _>(StandardNormal).powi(2)
        };
        let squares: Vec<f64> = parts[0].iter().zip(&parts[1]).map(square).collect();
        let found = variances(&squares, &parts);
        assert!(
            (found[0] / 3.0 - 1.0).abs() < 0.05 && (found[1] / 0.5 - 1.0).abs() < 0.2,
            "{found:?}"
        );
    }

    /// Errors of a known size where there is texture, in the left half, with noise everywhere and without.
    #[test]
    fn the_error_of_frames_is_distinguished_from_noise() {
        let (frames, side) = (8, 192);
        let masks = iid_masks(frames, side, side, 3).unwrap();
        let op = SensingOperator::new(masks).unwrap();
        let hold_out = HoldOut::draw(&op, 0);
        let texture = |j: usize| if j < side / 2 { 1.0 } else { 0.0 };
        let truth = Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            0.5 + 0.2 * texture(j) * ((i + k) as f32 * 0.3).sin() * (j as f32 * 0.2).cos()
        });
        for (error, noise) in [(0.03f32, 0.0f32), (0.03, 0.06), (0.1, 0.06)] {
            let mut random = random();
            let mut normal = |deviation: f32| deviation * random.sample::<f32, _>(StandardNormal);
            let mut found = truth.clone();
            found.indexed_iter_mut().for_each(|((_, _, j), x)| *x += normal(error) * texture(j));
            let y = op.forward(truth.view()).unwrap().mapv(|y| y + normal(noise));
            let signs = Signs::of((&op, y.view()), &hold_out, found.view(), found.view()).unwrap();
            let decibels = |square: f32| 10.0 * square.log10();
            let expected = decibels(error.powi(2) / 2.0);
            let Signs([early, late, both, _, without_noise, by_texture, smooth, _]) = signs;
            assert_eq!(early, late);
            assert!((by_texture - expected).abs() < 2.5, "{error}, {noise}: {signs:?}");
            assert!((both - expected).abs() < 4.0, "{error}, {noise}: {signs:?}");
            if noise == 0.0 {
                assert!(smooth < expected - 10.0, "{signs:?}");
            } else {
                // Half of the pixels are open.
                assert!((smooth - decibels(noise.powi(2) / 4.0)).abs() < 1.5, "{signs:?}");
                assert!(without_noise > expected + 2.0, "noise is taken for an error: {signs:?}");
            }
        }
    }
}
