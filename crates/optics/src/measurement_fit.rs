//! Least-squares fit of the mean brightness of each frame, and of the light that no mask explains.
//!
//! Within a block of 8x8 pixels the scene is nearly uniform, so the block-centred measurement is a sum of block-centred
//! masks. Pixels that were not measured, NaN in the measurement, are in no mean and no sum.

use ndarray::{Array1, Array2, ArrayView2, ArrayView3, Axis, s};

/// Side, in pixels, of the blocks in which the scene is assumed to be uniform.
pub(super) const BLOCK: usize = 8;
/// Regularisation of the weights: this share of the median squared residual is added to that of each block, so that no
/// few blocks dominate the fit.
const WEIGHT_REGULARISATION: f64 = 0.1;
/// Blocks with a smaller share of measured pixels are left out.
const MIN_MEASURED: f64 = 0.25;
/// Number of strips from which on their scatter gives a standard error.
pub(super) const MIN_STRIPS: usize = 3;
/// Number of blocks that are fitted each for itself.
const MOST_BLOCKS: usize = 4096;
/// Those with a smaller share of the mean energy are left out: they are dark.
const MIN_ENERGY: f64 = 0.1;
/// Number of reweighted fits. At 128x128 pixels they reduce its standard error from 0.8 % to 0.35 % of
/// the mean (median of 60 scenes); a third fit changes little.
const REWEIGHTED_FITS: usize = 2;

/// A row of n blocks. Primed values are block-centred: each is the difference from the mean of its block, and 0 where
/// nothing was measured.
#[derive(Debug)]
pub(super) struct Strip {
    /// Share of the pixels of each block that were measured; 0 for a block that is left out \[n\].
    pub(super) measured: Array1<f64>,
    /// `y'` \[64n\], pixel by pixel.
    pub(super) y: Array1<f32>,
    /// `C_k'` \[B,64n\], pixel by pixel.
    pub(super) masks: Array2<f32>,
    /// True where the pixel was measured, and its block is not left out \[64n\].
    pub(super) known: Array1<bool>,
    /// Block means of the measurement \[n\].
    pub(super) y_means: Array1<f64>,
    /// Block means of the masks \[B,n\].
    pub(super) mask_means: Array2<f64>,
    /// Means of the measurement at the four phases (row, column) modulo 2, relative to the overall mean \[4\].
    pub(super) y_phases: [f64; 4],
    /// Phase means of each mask \[B,4\], defined like `y_phases`.
    pub(super) mask_phases: Vec<[f64; 4]>,
    /// Phase means of the measurement in each block \[n,4\].
    pub(super) y_block_phases: Vec<[f64; 4]>,
    /// Phase means of each mask in each block \[B,n,4\].
    pub(super) mask_block_phases: Vec<Vec<[f64; 4]>>,
}

/// Weighted least-squares fit of the brightness of each frame, and of the offset.
pub(super) struct Fit {
    /// Inverse \[B,B\] of the weighted `sum C_k' C_l'`.
    pub(super) inverse: Array2<f64>,
    pub(super) brightness: Array1<f64>,
    /// Weighted energy of the fine structure that the masks explain.
    pub(super) explained: f64,
    pub(super) offset: f64,
    pub(super) offset_uncertainty: f64,
    /// Energy of the sum of the masks' fine structure relative to the sum of their energies: 1 for independent masks, 0 for
    /// masks with a constant sum.
    pub(super) balance: f64,
    /// `sum S'^2` over the pixels, S the sum of the masks relative to its mean: the energy of a uniform scene with a mean of 1.
    pub(super) structure: f64,
}

impl Fit {
    /// Fits the strips with a weight for each block \[n\]. `None` if the masks have no structure.
    pub(super) fn new(strips: &[Strip], weights: &[Array1<f64>]) -> Option<Self> {
        let sums: Vec<_> =
            strips.iter().zip(weights).map(|(strip, weights)| strip.sums(weights)).collect();
        let total = weights.iter().flatten().sum::<f64>();
        let (first, rest) = sums.split_first()?;
        let (mut products, mut correlations) = (first.products.clone(), first.correlations.clone());
        let (mut sum, mut mask_sums) = (first.sum, first.mask_sums.clone());
        for strip in rest {
            products += &strip.products;
            correlations += &strip.correlations;
            sum += strip.sum;
            mask_sums += &strip.mask_sums;
        }
        let inverse = inverse(&products)?;
        let brightness = inverse.dot(&correlations);
        let explained = brightness.dot(&correlations);
        let offset = (sum - brightness.dot(&mask_sums)) / total;
        // Residuals of neighbouring pixels are correlated. The standard error of the offset therefore comes from the
        // scatter between strips, each taken as one cluster (Liang and Zeger, Biometrika 1986).
        let sensitivity = inverse.dot(&mask_sums) / total;
        let influence = |strip: &Sums| {
            let coarse = strip.sum - brightness.dot(&strip.mask_sums) - offset * strip.weight;
            let fine = &strip.correlations - &strip.products.dot(&brightness);
            coarse / total - sensitivity.dot(&fine)
        };
        let scatter = sums.iter().map(|strip| influence(strip).powi(2)).sum::<f64>();
        let count = sums.len() as f64;
        let offset_uncertainty = if sums.len() < MIN_STRIPS {
            f64::INFINITY
        } else {
            (scatter * count / (count - 1.0)).sqrt()
        };
        let balance = products.sum() / products.diag().sum().max(f64::MIN_POSITIVE);
        let light = (mask_sums.sum() / total).max(f64::MIN_POSITIVE);
        let structure = products.sum() / light.powi(2);
        Some(Self {
            inverse,
            brightness,
            explained,
            offset,
            offset_uncertainty,
            balance,
            structure,
        })
    }
}

/// The reweighted fit, the energy that the first fit with equal weights explains, and the last weights. `None` if the masks
/// have no structure.
pub(super) fn reweighted(strips: &[Strip]) -> Option<(Fit, f64, Vec<Array1<f64>>)> {
    let mut last = equal_weights(strips);
    let mut fit = Fit::new(strips, &last)?;
    let explained = fit.explained;
    for _ in 0..REWEIGHTED_FITS {
        last = weights(strips, &fit.brightness);
        fit = Fit::new(strips, &last)?;
    }
    Some((fit, explained, last))
}

/// Weights of the blocks of each strip \[n\] that give all measured pixels the same weight.
pub(super) fn equal_weights(strips: &[Strip]) -> Vec<Array1<f64>> {
    strips.iter().map(|strip| strip.measured.clone()).collect()
}

/// Weights of the blocks of each strip \[n\], inversely related to the squared residuals of the fit. All measured pixels
/// have the same weight if the median residual is 0.
fn weights(strips: &[Strip], brightness: &Array1<f64>) -> Vec<Array1<f64>> {
    let residuals: Vec<Array1<f64>> =
        strips.iter().map(|strip| strip.squared_residuals(brightness)).collect();
    let blocks = strips.iter().flat_map(|strip| &strip.measured).zip(residuals.iter().flatten());
    let mut sorted: Vec<f64> =
        blocks.filter(|(measured, _)| **measured > 0.0).map(|(_, residual)| *residual).collect();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or_default();
    let weight = |residual| {
        if median > 0.0 { median / (residual + WEIGHT_REGULARISATION * median) } else { 1.0 }
    };
    let strips = residuals.iter().zip(strips);
    strips.map(|(residuals, strip)| residuals.mapv(weight) * &strip.measured).collect()
}

/// Standard errors \[B\] of the brightness: the larger of those from the scatter between blocks (Liang and Zeger, Biometrika
/// 1986) and from that of the pixels. Residuals of neighbouring pixels are correlated, which the second ignores. The first is
/// too small where the masks resemble one another so much that few blocks decide.
pub(super) fn brightness_errors(
    strips: &[Strip],
    fit: &Fit,
    weights: &[Array1<f64>],
) -> Array1<f64> {
    let frames = fit.brightness.len();
    let mut scatter = Array2::<f64>::zeros((frames, frames));
    for (strip, weights) in strips.iter().zip(weights) {
        let residual = strip.residual(&fit.brightness);
        let mut scores = Array2::<f64>::zeros((frames, strip.y_means.len()));
        for (mask, mut scores) in strip.masks.outer_iter().zip(scores.outer_iter_mut()) {
            for ((block, mask), residual) in strip.blocks().zip(mask).zip(&residual) {
                scores[block] += f64::from(mask * residual);
            }
            scores *= weights;
        }
        scatter += &scores.dot(&scores.t());
    }
    let between_blocks = fit.inverse.dot(&scatter).dot(&fit.inverse);
    let pixel_variance = weighted_scatter(strips, &fit.brightness, weights);
    let variances = between_blocks.diag().into_iter().zip(fit.inverse.diag());
    variances.map(|(blocks, share)| blocks.max(pixel_variance * share).max(0.0).sqrt()).collect()
}

/// Weighted mean squared residual of the blocks: the variance of a pixel in a block of weight 1.
fn weighted_scatter(strips: &[Strip], brightness: &Array1<f64>, weights: &[Array1<f64>]) -> f64 {
    let sums = strips.iter().zip(weights);
    let sum: f64 =
        sums.map(|(strip, weights)| strip.squared_residuals(brightness).dot(weights)).sum();
    sum / strips.iter().map(|strip| strip.measured.sum()).sum::<f64>().max(f64::MIN_POSITIVE)
}

/// Fits of single blocks, in which the brightness of the frames is free. Masks that belong to the measurement explain a
/// block better than those of the next block do, whatever their sum and wherever the scene is dark.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LocalFit {
    /// Mean share of the energy that the masks of the blocks explain beyond those of the next blocks, relative to the share
    /// that these leave.
    pub gain: f64,
    /// Its significance in standard errors.
    pub significance: f64,
}

impl LocalFit {
    /// Compares the fits of [`MOST_BLOCKS`] blocks that were measured completely, spread over the strips.
    pub(super) fn new(strips: &[Strip]) -> Self {
        let pairs =
            strips.iter().flat_map(|strip| (1..strip.y_means.len()).map(move |at| (strip, at)));
        let step = pairs.clone().count().div_ceil(MOST_BLOCKS).max(1);
        let whole = |(strip, next): &(&Strip, usize)| {
            strip.measured[*next - 1] == 1.0 && strip.measured[*next] == 1.0
        };
        let blocks: Vec<_> = pairs
            .step_by(step)
            .filter(whole)
            .map(|(strip, next)| (strip.block(next - 1), strip.block(next).0))
            .collect();
        let energies = blocks.iter().map(|((_, y), _)| y.dot(y));
        let least = MIN_ENERGY * energies.sum::<f64>() / blocks.len().max(1) as f64;
        let (mut difference, mut squares, mut left) = (0.0, 0.0, 0.0);
        for ((masks, y), others) in &blocks {
            let energy = y.dot(y);
            if energy <= least {
                continue;
            }
            let explained = |masks: &Array2<f64>| {
                let correlations = masks.dot(y);
                let inverse = inverse(&masks.dot(&masks.t()))?;
                Some((correlations.dot(&inverse.dot(&correlations)) / energy).clamp(0.0, 1.0))
            };
            let (Some(own), Some(other)) = (explained(masks), explained(others)) else { continue };
            difference += own - other;
            squares += (own - other).powi(2);
            left += 1.0 - other;
        }
        Self {
            gain: difference / f64::max(left, f64::MIN_POSITIVE),
            significance: difference / f64::max(squares, f64::MIN_POSITIVE).sqrt(),
        }
    }
}

/// Weighted sums over the blocks of a strip.
struct Sums {
    /// `sum w` over the blocks.
    weight: f64,
    /// `sum w y` over the block means.
    sum: f64,
    /// `sum w C_k` over the block means \[B\].
    mask_sums: Array1<f64>,
    /// `sum w C_k' C_l'` over the pixels \[B,B\].
    products: Array2<f64>,
    /// `sum w C_k' y'` over the pixels \[B\].
    correlations: Array1<f64>,
}

impl Strip {
    /// The strip of masks \[B,8,8n\] and a measurement \[8,8n\], which is NaN where nothing was measured. Masks are finite.
    pub(super) fn new(masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) -> Self {
        let measured = share_measured(y);
        let mut known = y.mapv(|value| !value.is_nan());
        for (mut block, share) in known.exact_chunks_mut((BLOCK, BLOCK)).into_iter().zip(&measured)
        {
            block.mapv_inplace(|known| known && *share > 0.0);
        }
        let fine = |image| block_centred(image, known.view());
        let (y_means, y) = fine(y);
        let frames = masks.len_of(Axis(0));
        let mut fine_masks = Array2::zeros((frames, y.len()));
        let mut mask_means = Array2::zeros((frames, measured.len()));
        let (mut mask_phases, mut mask_block_phases) = (Vec::new(), Vec::new());
        for (k, mask) in masks.outer_iter().enumerate() {
            let (means, mask) = fine(mask);
            mask_phases.push(phases(mask.view(), known.view()));
            mask_block_phases.push(block_phases(mask.view(), known.view()));
            mask_means.row_mut(k).assign(&means);
            fine_masks.row_mut(k).assign(&mask.into_iter().collect::<Array1<f32>>());
        }
        Self {
            measured,
            y_phases: phases(y.view(), known.view()),
            y_block_phases: block_phases(y.view(), known.view()),
            y: y.into_iter().collect(),
            known: known.into_iter().collect(),
            masks: fine_masks,
            y_means,
            mask_means,
            mask_phases,
            mask_block_phases,
        }
    }

    /// The strip with changed values of the masks.
    pub(super) fn with_masks(&self, change: impl Fn(f32) -> f32) -> Self {
        let (mut masks, mut mask_means) = (self.masks.clone(), self.mask_means.clone());
        for (mut mask, mut means) in masks.outer_iter_mut().zip(mask_means.outer_iter_mut()) {
            let before = means.to_owned();
            means.fill(0.0);
            for ((block, value), known) in self.blocks().zip(&mut mask).zip(&self.known) {
                if *known {
                    *value = change(*value + before[block] as f32);
                    means[block] += f64::from(*value) / self.pixels(block);
                }
            }
            for ((block, value), known) in self.blocks().zip(&mut mask).zip(&self.known) {
                if *known {
                    *value -= means[block] as f32;
                }
            }
        }
        Self {
            measured: self.measured.clone(),
            known: self.known.clone(),
            y: self.y.clone(),
            masks,
            y_means: self.y_means.clone(),
            mask_means,
            y_phases: self.y_phases,
            mask_phases: self.mask_phases.clone(),
            y_block_phases: self.y_block_phases.clone(),
            mask_block_phases: self.mask_block_phases.clone(),
        }
    }

    /// Index of the block of each pixel.
    pub(super) fn blocks(&self) -> impl Iterator<Item = usize> {
        let count = self.y_means.len();
        (0..self.y.len()).map(move |pixel| pixel / BLOCK % count)
    }

    /// The masks \[B,64\] and the measurement \[64\] of a block, block-centred.
    fn block(&self, block: usize) -> (Array2<f64>, Array1<f64>) {
        let width = BLOCK * self.y_means.len();
        let pixels: Vec<usize> = (0..BLOCK)
            .flat_map(|row| row * width + BLOCK * block..row * width + BLOCK * (block + 1))
            .collect();
        let masks = self.masks.select(Axis(1), &pixels).mapv(f64::from);
        (masks, self.y.select(Axis(0), &pixels).mapv(f64::from))
    }

    /// Number of measured pixels of a block; 1 for a block that is left out.
    fn pixels(&self, block: usize) -> f64 {
        (self.measured[block] * (BLOCK * BLOCK) as f64).max(1.0)
    }

    /// Sums over the strip with the weights \[n\] of the blocks.
    fn sums(&self, weights: &Array1<f64>) -> Sums {
        let roots: Array1<f32> = self.blocks().map(|block| weights[block].sqrt() as f32).collect();
        let (masks, y) = (&self.masks * &roots, &self.y * &roots);
        Sums {
            weight: weights.sum(),
            sum: weights.dot(&self.y_means),
            mask_sums: self.mask_means.dot(weights),
            products: masks.dot(&masks.t()).mapv(f64::from),
            correlations: masks.dot(&y).mapv(f64::from),
        }
    }

    /// Number of blocks whose mean is below 0 by more than `least` and by more than noise explains.
    pub(super) fn negative(&self, least: f64, standard_errors: f64) -> f64 {
        let mut squares = Array1::<f64>::zeros(self.y_means.len());
        for (block, y) in self.blocks().zip(&self.y) {
            squares[block] += f64::from(*y).powi(2);
        }
        let is_negative = |block: &usize| {
            let pixels = self.pixels(*block);
            let error = (squares[*block] / pixels / pixels).sqrt();
            self.y_means[*block] < -least.max(standard_errors * error)
        };
        (0..self.y_means.len()).filter(is_negative).map(|block| self.measured[block]).sum()
    }

    /// Residual `y' - sum_k x_k C_k'` \[64n\].
    fn residual(&self, brightness: &Array1<f64>) -> Array1<f32> {
        &self.y - &brightness.mapv(|value| value as f32).dot(&self.masks)
    }

    /// Mean squared residual `y' - sum_k x_k C_k'` of the measured pixels of each block \[n\].
    pub(super) fn squared_residuals(&self, brightness: &Array1<f64>) -> Array1<f64> {
        let residual = self.residual(brightness);
        let mut squares = Array1::zeros(self.y_means.len());
        for (block, residual) in self.blocks().zip(residual) {
            squares[block] += f64::from(residual).powi(2) / self.pixels(block);
        }
        squares
    }
}

/// Share of the pixels of each block \[n\] that were measured; 0 for blocks that are left out.
fn share_measured(y: ArrayView2<'_, f32>) -> Array1<f64> {
    let share = |block: ArrayView2<'_, f32>| {
        let count = block.iter().filter(|value| !value.is_nan()).count();
        count as f64 / block.len() as f64
    };
    let shares = y.exact_chunks((BLOCK, BLOCK)).into_iter().map(share);
    shares.map(|share| if share < MIN_MEASURED { 0.0 } else { share }).collect()
}

/// Means of a block-centred image over the `known` pixels of each of the four phases (row, column) modulo 2, relative to
/// their average. They are 0 if a phase has no known pixel.
fn phases(image: ArrayView2<'_, f32>, known: ArrayView2<'_, bool>) -> [f64; 4] {
    let mean = |phase: usize| {
        let place = s![phase / 2..;2, phase % 2..;2];
        let count = known.slice(place).iter().filter(|known| **known).count();
        let sum = image.slice(place).iter().map(|&value| f64::from(value)).sum::<f64>();
        (count > 0).then(|| sum / count as f64)
    };
    let means: Option<Vec<f64>> = (0..4).map(mean).collect();
    means.map_or([0.0; 4], |means| {
        let average = means.iter().sum::<f64>() / 4.0;
        [0, 1, 2, 3].map(|phase| means[phase] - average)
    })
}

/// Phase means of each block of a strip, as [`phases`].
fn block_phases(strip: ArrayView2<'_, f32>, known: ArrayView2<'_, bool>) -> Vec<[f64; 4]> {
    let blocks = strip.exact_chunks((BLOCK, BLOCK)).into_iter();
    blocks
        .zip(known.exact_chunks((BLOCK, BLOCK)))
        .map(|(strip, known)| phases(strip, known))
        .collect()
}

/// Means of the `known` pixels of each block of [`BLOCK`] x [`BLOCK`] pixels, and the differences from them, which are 0 at
/// the other pixels. A block without known pixels has the mean 0.
pub(super) fn block_centred(
    image: ArrayView2<'_, f32>,
    known: ArrayView2<'_, bool>,
) -> (Array1<f64>, Array2<f32>) {
    let mut centred = image.to_owned();
    let blocks = centred.exact_chunks_mut((BLOCK, BLOCK)).into_iter();
    let means = blocks.zip(known.exact_chunks((BLOCK, BLOCK))).map(|(mut block, known)| {
        let values = || block.iter().zip(known).filter(|(_, known)| **known);
        let sum = values().map(|(value, _)| f64::from(*value)).sum::<f64>();
        let mean = sum / values().count().max(1) as f64;
        block.zip_mut_with(&known, |value, known| {
            *value = if *known { *value - mean as f32 } else { 0.0 };
        });
        mean
    });
    (means.collect(), centred)
}

/// Inverse of a symmetric positive matrix by Gauss-Jordan elimination. A millionth of the mean diagonal is added first,
/// so that highly correlated masks do not make the matrix singular. `None` if the matrix is 0.
pub(super) fn inverse(matrix: &Array2<f64>) -> Option<Array2<f64>> {
    let size = matrix.nrows();
    let ridge = matrix.diag().sum() / size as f64 * 1e-6;
    if ridge.is_nan() || ridge <= 0.0 {
        return None;
    }
    let mut left = matrix + &(Array2::<f64>::eye(size) * ridge);
    let mut right = Array2::<f64>::eye(size);
    for pivot in 0..size {
        let scale = left[[pivot, pivot]];
        if scale.is_nan() || scale <= 0.0 {
            return None;
        }
        left.row_mut(pivot).mapv_inplace(|value| value / scale);
        right.row_mut(pivot).mapv_inplace(|value| value / scale);
        for row in (0..size).filter(|&row| row != pivot) {
            let factor = left[[row, pivot]];
            let (a, b) = (left.row(pivot).to_owned(), right.row(pivot).to_owned());
            left.row_mut(row).scaled_add(-factor, &a);
            right.row_mut(row).scaled_add(-factor, &b);
        }
    }
    Some(right)
}
