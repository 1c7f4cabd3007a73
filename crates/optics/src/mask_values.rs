//! Signs that the values of masks were altered since their calibration, or that a mask is missing.
//!
//! A dark adds the same light to all blocks. Wrong values of masks, and a missing mask, leave light unexplained in
//! proportion to the scene.

use ndarray::Array1;

use super::measurement_fit::{BLOCK, Fit, Strip, reweighted};

/// What happened to the masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alteration {
    /// The masks are pictures with the gamma curve of sRGB.
    GammaEncoded,
    /// The curve of sRGB was removed from masks that had none.
    GammaDecoded,
    /// Masks with values between 0 and 1 were made binary.
    MadeBinary,
    /// A mask is missing.
    MissingMask,
}

/// Unexplained light, as a share of the mean, from which the curve of the masks is tested. Of 20 simulated scenes behind
/// grey masks, the curve of sRGB leaves -0.53 to -1.05.
const MIN_CURVE_LIGHT: f64 = 0.2;
/// The right curve leaves at most this share of the unexplained light.
const MAX_LIGHT_LEFT: f64 = 0.1;
/// The right curve explains at least this share of the fine structure that the masks explain without it. It explains 0.98 to
/// 1.07 of it, a curve that fits a wrong dark at most 0.975.
const MIN_CURVE_EXPLAINED: f64 = 0.98;
/// Grey masks that are made binary leave at least this share of the light, and more than this many masks transmit.
const MIN_BINARY_LIGHT: f64 = 0.2;
const MORE_THAN_A_MASK: f64 = 2.0;
/// Unexplained light of a missing mask, relative to the mean of the others.
const LIGHT_OF_A_MASK: std::ops::RangeInclusive<f64> = 0.4..=1.7;
/// Slope from which unexplained light follows the scene. Of 30 scenes, right masks have at most 1.02 with any dark, binary
/// ones that were grey at least 1.05. A missing mask gives 0.97 to 1.22.
const FOLLOWS_THE_SCENE: f64 = 1.035;
/// Smallest residual of the plainest blocks that a missing mask leaves, relative to the energy of a mask.
const MIN_RESIDUAL_OF_A_MASK: f64 = 0.75;
/// Masks are independent if they have this share of the energy of their sum, and resemble one another below the second
/// share, as grey masks do that are made binary.
const INDEPENDENT: f64 = 0.5;
const RESEMBLING: f64 = 0.3;

/// Figures of a fit that the diagnosis needs.
pub(super) struct Observed<'a> {
    pub(super) strips: &'a [Strip],
    /// The reweighted fit and its weights.
    pub(super) fit: &'a Fit,
    pub(super) weights: &'a [Array1<f64>],
    /// Energy that the masks explain with equal weights.
    pub(super) explained: f64,
    /// Mean of the measurement.
    pub(super) mean: f64,
    /// True if all mask values are 0 or 1.
    pub(super) is_binary: bool,
}

fn decoded(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

fn encoded(value: f32) -> f32 {
    if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

/// The alteration that explains the light that the masks do not explain; `None` if the light may be an offset.
pub(super) fn alteration(observed: &Observed<'_>) -> Option<Alteration> {
    let Observed { strips, fit, weights, explained, mean, is_binary } = *observed;
    let share = fit.offset / mean;
    if mean <= 0.0 || fit.offset.abs() < 4.0 * fit.offset_uncertainty {
        return None;
    }
    if !is_binary && share.abs() > MIN_CURVE_LIGHT {
        let (curve, alteration): (fn(f32) -> f32, _) = match share > 0.0 {
            false => (decoded, Alteration::GammaEncoded),
            true => (encoded, Alteration::GammaDecoded),
        };
        let strips: Vec<Strip> = strips.iter().map(|strip| strip.with_masks(curve)).collect();
        let (curved, energy, _) = reweighted(&strips)?;
        let fits = (curved.offset / mean).abs() < MAX_LIGHT_LEFT * share.abs()
            && energy > MIN_CURVE_EXPLAINED * explained;
        if fits {
            return Some(alteration);
        }
    }
    let expected = 1.0 / (fit.brightness.len() + 1) as f64;
    let follows_the_scene = slope(strips, fit, weights) > FOLLOWS_THE_SCENE;
    let (residual, independence) = plainest_blocks(strips, fit);
    if is_binary
        && (follows_the_scene || independence < RESEMBLING)
        && share > MIN_BINARY_LIGHT.max(MORE_THAN_A_MASK * expected)
    {
        return Some(Alteration::MadeBinary);
    }
    let is_mask = LIGHT_OF_A_MASK.contains(&(share / expected))
        && independence > INDEPENDENT
        && follows_the_scene
        && residual > MIN_RESIDUAL_OF_A_MASK;
    is_mask.then_some(Alteration::MissingMask)
}

/// A block: mean of the measurement, estimates by both halves of the frames, weight and energy of the masks.
type Block = (f64, [f64; 2], f64, f64);

/// Slope of the mean of a block against the light that its fine structure predicts. It is 1 with any offset, and below 1
/// where texture hides the fine structure.
///
/// Both halves of a block predict its light. Each is an instrument of the other, so noise does not lower the slope.
fn slope(strips: &[Strip], fit: &Fit, weights: &[Array1<f64>]) -> f64 {
    let mut blocks = Vec::new();
    for (strip, weights) in strips.iter().zip(weights) {
        let count = strip.y_means.len();
        let predicted = fit.brightness.mapv(|value| value as f32).dot(&strip.masks);
        // For each block and half: sums of p, y, pp, py, and the number of pixels.
        let mut sums = vec![[[0.0_f64; 5]; 2]; count];
        let pixels = predicted.iter().zip(&strip.y).zip(&strip.known).enumerate();
        for (at, ((p, y), _)) in pixels.filter(|(_, (_, known))| **known) {
            let (row, column) = (at / (BLOCK * count), at % (BLOCK * count));
            let (p, y) = (f64::from(*p), f64::from(*y));
            let half = &mut sums[column / BLOCK][(row + column) % 2];
            for (sum, value) in half.iter_mut().zip([p, y, p * p, p * y, 1.0]) {
                *sum += value;
            }
        }
        for (block, halves) in sums.iter().enumerate().filter(|(at, _)| strip.measured[*at] > 0.0) {
            let light = strip.mask_means.column(block).dot(&fit.brightness);
            let estimate = halves.map(|[p, y, pp, py, pixels]| {
                let pixels = pixels.max(1.0);
                let energy = pp - p * p / pixels;
                if energy > 0.0 { light * (py - p * y / pixels) / energy } else { 0.0 }
            });
            let energy = halves[0][2] + halves[1][2];
            blocks.push((strip.y_means[block], estimate, weights[block], energy));
        }
    }
    let mut energies: Vec<f64> = blocks.iter().map(|block| block.3).collect();
    energies.sort_by(f64::total_cmp);
    let median = energies.get(energies.len() / 2).copied().unwrap_or_default();
    blocks.retain(|block| block.3 > 0.2 * median);
    let total: f64 = blocks.iter().map(|block| block.2).sum();
    let mean = |value: &dyn Fn(&Block) -> f64| {
        blocks.iter().map(|block| block.2 * value(block)).sum::<f64>() / total
    };
    let (y, one, other) = (mean(&|b| b.0), mean(&|b| b.1[0]), mean(&|b| b.1[1]));
    let across = mean(&|b| (b.1[0] - one) * (b.1[1] - other));
    let with_y = mean(&|b| (b.0 - y) * (b.1[0] - one + b.1[1] - other));
    if across > 0.0 { 0.5 * with_y / across } else { 0.0 }
}

/// Residual of the plainest tenth of the blocks, relative to the energy of one missing mask there, and the energy of all masks
/// relative to that of their sum.
fn plainest_blocks(strips: &[Strip], fit: &Fit) -> (f64, f64) {
    let (mut mask_energy, mut sum_energy, mut pixels) = (0.0, 0.0, 0.0);
    for strip in strips {
        let energy = |values: ndarray::ArrayView1<'_, f32>| {
            values.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>()
        };
        let masks = strip.masks.outer_iter().zip(&fit.brightness);
        mask_energy += masks.map(|(mask, x)| x * x * energy(mask)).sum::<f64>();
        let predicted = fit.brightness.mapv(|value| value as f32).dot(&strip.masks);
        sum_energy += energy(predicted.view());
        pixels += strip.measured.sum() * (BLOCK * BLOCK) as f64;
    }
    let masks = fit.brightness.len().max(1) as f64;
    let energy_per_mask = mask_energy / pixels / masks;
    let mut residuals = Vec::new();
    for strip in strips {
        let squares = strip.squared_residuals(&fit.brightness);
        for (block, square) in squares.iter().enumerate() {
            if strip.measured[block] == 0.0 {
                continue;
            }
            let light = strip.mask_means.column(block).dot(&fit.brightness);
            // The light includes that of one more mask.
            let factor = (strip.y_means[block] / light * masks / (masks + 1.0)).max(0.1);
            residuals.push(square / (energy_per_mask * factor * factor).max(f64::MIN_POSITIVE));
        }
    }
    residuals.sort_by(f64::total_cmp);
    let plainest = residuals.get(residuals.len() / 10).copied().unwrap_or_default();
    (plainest, if sum_energy > 0.0 { mask_energy / sum_energy } else { 0.0 })
}
