//! Checks a measurement against the masks of its calibration.
//!
//! Within a block of 8x8 pixels the scene is nearly uniform, so the measurement follows its masks there:
//! `y = sum_k x_k C_k + offset`. A least-squares fit to the block-centred values of many blocks gives the mean
//! brightness x_k of each frame. The block means that the fit does not explain give the offset. Fits with shifted masks
//! show whether the optics have moved since the calibration.
//!
//! Brightness and offset are estimated by iteratively reweighted least squares: textured blocks are fitted badly, and get
//! little weight. Pixels that were not measured, NaN in the measurement or in a mask, are left out.

use std::ops::{Range, RangeInclusive};

use ndarray::{Array1, Array2, Array3, ArrayView2, ArrayView3, Axis, s};

use super::calibration_check::mask_scale;
use super::distortion::{Distortion, MovedParts, Region, distortion, moved_parts};
use super::mask_values::{Alteration, Observed, alteration};
use super::measurement_fit::{
    BLOCK, Fit, LocalFit, MIN_STRIPS, Strip, brightness_errors, equal_weights, reweighted,
};
use super::modulation::{Run, Unmodulated, unmodulated};
use super::{Finding, FindingCode};

/// Largest shift between masks and measurement that is searched, in pixels along each axis.
pub const REACH: usize = 4;
/// A shift is reported if its gain is this many times the gain expected from chance.
const SHIFT_SIGNIFICANCE: f64 = 30.0;
/// A mosaic is reported if its phases differ by this share of the mean, and by this many standard errors.
/// Simulated grey scenes behind masks of single pixels stay below 0.007 and 3.
const MOSAIC_AMPLITUDE: f64 = 0.02;
const MOSAIC_SIGNIFICANCE: f64 = 8.0;
/// A mosaic is also reported if the colours of neighbouring blocks agree by this share of the mean, and by this many
/// standard errors: colours that cancel over the picture do so. Compressed clips behind right masks reach 0.034, tints of
/// 30 % exceed 0.28.
const LOCAL_MOSAIC_AMPLITUDE: f64 = 0.06;
const LOCAL_MOSAIC_SIGNIFICANCE: f64 = 5.0;
/// Largest energy of the difference between the two green phases, relative to that of the other differences.
const MAX_GREEN_DIFFERENCE: f64 = 0.25;
/// A drift is reported if neighbouring displacements differ by this much; see [`Drift`]. Of 176 scenes, right masks stay below
/// 0.17 and 0.49, also after a blur of 0.6 pixels. Independent masks that drift by a quarter of a pixel exceed 0.2, and others
/// that drift by 0.35 pixels along both axes 0.55. Behind a rotating circle, light that fades to a fifth gives 0.53.
const MIN_DRIFT: f64 = 0.2;
const MIN_DRIFT_EXCESS: f64 = 0.54;
/// Frames differ in brightness from this share of their mean on, and from this many standard errors on. Of 37 simulated
/// scenes, right masks have at most 2.8 standard errors. A missing mask that resembles the others mostly exceeds both,
/// unless masks resemble one another too much.
const MIN_UNEVEN: f64 = 0.12;
const UNEVEN_SIGNIFICANCE: f64 = 3.2;
/// A frame has no light below this share of that of the brightest one.
const NO_LIGHT: f64 = 0.1;
/// Offsets below this share of the mean are not reported.
const OFFSET_SHARE: f64 = 0.03;
/// A block counts as negative if its mean is below 0 by more than this share of the mean of the measurement, and by more
/// than this many standard errors.
const NEGATIVE_SHARE: f64 = 0.05;
const NEGATIVE_SIGNIFICANCE: f64 = 4.0;
/// Plausible brightness of the brightest parts of a scene, as a share of the full scale.
const PLAUSIBLE_BRIGHTNESS: RangeInclusive<f64> = 0.12..=1.1;
/// The brightest parts are the blocks from this quantile on.
const BRIGHTEST: f64 = 0.99;
/// Share of the mean light from which the brightness of a single block counts, and from which a block is not dark.
const ENOUGH_LIGHT: f64 = 0.5;
const MIN_LIGHT: f64 = 0.1;
/// Inverted masks explain at least this share of the fine structure.
const MIN_INVERTED: f64 = 0.05;
/// Smallest negative brightness of all frames together, relative to the mean of the measurement. Behind inverted masks it
/// exceeds that mean. The sum is certain even where similar masks leave single frames uncertain.
const MIN_NEGATIVE: f64 = 0.5;
/// A shift may seem to explain more than all of the fine structure, if the shifted masks have more energy than those of the fit.
/// From this share on it says nothing about masks that explain [`UNSHIFTED`] without it.
const TOO_MUCH: f64 = 1.1;
const UNSHIFTED: f64 = 0.6;
/// Masks that explain less than this share of the fine structure show no displacement.
const MIN_EXPLAINED: f64 = 0.02;
/// From this expected share on, masks that explain less than [`MIN_EXPLAINED`] are others.
const ENOUGH_EXPECTED: f64 = 0.08;
/// Masks that explain this share of a sparse scene are checked as those of others.
const ENOUGH_EXPLAINED: f64 = 0.1;
/// Masks whose balance is below this have a nearly constant sum. The mean light of the frames then leaves no fine structure.
const MIN_BALANCE: f64 = 0.3;
/// Fits of single blocks show the masks of a measurement from this gain and significance on.
const MIN_LOCAL_GAIN: f64 = 0.04;
const LOCAL_SIGNIFICANCE: f64 = 2.2;
/// A snapshot is a copy of a mask if it has no light of other masks, and if that mask explains this share.
const COPY: f64 = 0.95;
/// A snapshot is flat if its pixels differ from the mean of their block by less than this share of the mean of the
/// measurement. Values with single precision have that rounding error.
const FLAT: f64 = 1e-6;
const FLAT_BEHIND_BALANCED: f64 = 0.05;
/// Length of the pieces into which the strips of a low picture are cut, in blocks.
const PIECE: usize = 2;
/// Side of the parts with a displacement each, in blocks.
const PART: usize = 4;

/// Accumulates statistics over windows of a measurement and its masks.
#[derive(Debug)]
pub struct MeasurementStudy {
    frames: usize,
    /// `sum C_k'(p + shift) y'(p)` for each shift and frame; primed values are block-centred.
    correlations: Vec<Array1<f64>>,
    parts: Vec<CorrelatedRegion>,
    /// `sum y'(p)^2`.
    energy: f64,
    /// Number of measured pixels.
    pixels: f64,
    /// The largest mask value.
    largest_mask: f32,
    /// True if all mask values are 0 or 1.
    is_binary: bool,
    strips: Vec<Strip>,
    runs: Vec<Run>,
}

/// A part of a window.
#[derive(Debug)]
struct CorrelatedRegion {
    /// Row and column of its middle.
    place: [f64; 2],
    /// As those of the whole study.
    correlations: Vec<Array1<f64>>,
    /// `sum y'(p)^2`.
    energy: f64,
}

/// Statistics of a measurement with respect to its masks. Values are shares of the measurement's full scale.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MeasurementFigures {
    /// Number of measured pixels.
    pub pixels: f64,
    /// Mean of the measurement.
    pub mean: f64,
    /// Largest value of the masks.
    pub largest_mask: f32,
    /// Share of the area, in blocks of 8x8 pixels, that is below 0 by more than noise explains.
    pub negative_area: f64,
    /// Mean brightness of each frame, where the masks are 1.
    pub brightness: Vec<f64>,
    /// Standard errors of `brightness`.
    pub uncertainty: Vec<f64>,
    /// Mean of the measurement that the masks do not explain.
    pub offset: f64,
    /// Standard error of `offset`.
    pub offset_uncertainty: f64,
    /// The shift (rows, columns) of the masks, in pixels, that explains the measurement best.
    pub shift: (i32, i32),
    /// Share of the measurement's fine structure that the masks explain at that shift.
    pub explained: f64,
    /// Share of the measurement's fine structure that the masks explain without a shift.
    pub explained_unshifted: f64,
    /// Share of the fine structure that the right masks explain if the scene is uniform apart from texture and noise.
    pub expected: f64,
    /// Gain of the shift, as a multiple of the gain expected from chance for the brightness of one frame.
    pub shift_significance: f64,
    /// Largest difference between pixels of even and odd rows and columns that the masks do not explain.
    pub mosaic: PhaseDifference,
    /// Difference between the colours of a mosaic on which neighbouring blocks agree.
    pub local_mosaic: PhaseDifference,
    /// Magnification and rotation of the masks against the measurement.
    pub distortion: Option<Distortion>,
    /// Parts that the masks fit at another place than the rest.
    pub moved_parts: Option<MovedParts>,
    /// A change of the masks' values that explains an offset.
    pub alteration: Option<Alteration>,
    /// Signs of a displacement of the masks by less than a pixel along the rows and the columns.
    pub drift: [Drift; 2],
    /// Parts whose light the masks do not modulate.
    pub unmodulated: Option<Unmodulated>,
    /// Brightness of the brightest parts of the scene.
    pub brightest: f64,
    /// Brightness of the brightest block, which may be a small object.
    pub brightest_block: f64,
    /// True if the measurement has no fine structure, so that no fit was possible.
    pub is_flat: bool,
    /// True if the masks have a nearly constant sum, so that the mean brightness of the frames shows nothing.
    pub is_balanced: bool,
    /// True if the scene is dark but for a few objects that the masks explain badly.
    pub is_sparse: bool,
    /// Fits of single blocks, where the mean brightness of the frames shows nothing or explains next to nothing.
    pub local: Option<LocalFit>,
}

impl MeasurementFigures {
    /// True if the mean brightness of the frames shows nothing. Hold-out pixels of a job then judge the masks.
    fn is_uncertain(&self) -> bool {
        self.is_balanced || self.is_sparse
    }

    /// True if fits of single blocks show that the masks belong to the measurement.
    fn fits_locally(&self) -> bool {
        self.local.is_some_and(|local| {
            local.gain > MIN_LOCAL_GAIN && local.significance > LOCAL_SIGNIFICANCE
        })
    }
}

/// Comparison of the masks with those displaced by one pixel to and fro along an axis, by the products `sum y' S'` of the
/// measurement with the sum S of the masks. Masks at the right place have a maximum there, whether they are sharp or blurred.
/// Single masks that resemble one another would explain other places, too.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Drift {
    /// Difference between the two displacements, relative to the sum of the larger one and of no displacement: about the
    /// drift in pixels of independent masks.
    pub asymmetry: f64,
    /// Their difference, relative to that between no displacement and the smaller one. It is 1 halfway between two pixels.
    pub excess: f64,
    /// Shares that the masks explain after a displacement to and fro.
    pub explained: [f64; 2],
}

/// A difference between the four phases (row, column) modulo 2 of a sensor's pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PhaseDifference {
    /// The difference as a share of the mean of the measurement.
    pub amplitude: f64,
    /// The difference in standard errors.
    pub significance: f64,
}

fn shifts() -> impl Iterator<Item = (usize, usize)> {
    (0..=2 * REACH).flat_map(|row| (0..=2 * REACH).map(move |column| (row, column)))
}

/// Parts of a side in whole blocks, of [`PART`] blocks or a few more.
fn parts(length: usize) -> impl Iterator<Item = Range<usize>> + Clone {
    let blocks = length / BLOCK;
    let count = (blocks / PART).max(1);
    (0..count).map(move |at| at * blocks / count * BLOCK..(at + 1) * blocks / count * BLOCK)
}

impl MeasurementStudy {
    /// A study of a measurement through `frames` masks.
    pub fn new(frames: usize) -> Self {
        Self {
            frames,
            correlations: shifts().map(|_| Array1::zeros(frames)).collect(),
            parts: Vec::new(),
            energy: 0.0,
            pixels: 0.0,
            largest_mask: 0.0,
            is_binary: true,
            strips: Vec::new(),
            runs: Vec::new(),
        }
    }

    /// Adds a window of the masks \[B,h,w\] and of the measurement \[h,w\] that begins at this row and column. Both are NaN
    /// where nothing was measured.
    ///
    /// The window starts at an even row and column. Its outer [`REACH`] pixels on each side are a margin in which only
    /// the masks are used. Windows too small for a block are ignored.
    pub fn add(
        &mut self,
        masks: ArrayView3<'_, f32>,
        y: ArrayView2<'_, f32>,
        (first_row, first_column): (usize, usize),
    ) {
        let (frames, height, width) = masks.dim();
        let inner = |length: usize| length.saturating_sub(2 * REACH) / BLOCK * BLOCK;
        let (rows, columns) = (inner(height), inner(width));
        if frames != self.frames || y.dim() != (height, width) || rows == 0 || columns == 0 {
            return;
        }
        let inside = s![REACH..REACH + rows, REACH..REACH + columns];
        let mut y = y.slice(inside).to_owned();
        for mask in masks.outer_iter() {
            y.zip_mut_with(&mask.slice(inside), |y, mask| {
                if mask.is_nan() {
                    *y = f32::NAN;
                }
            });
        }
        self.largest_mask = masks.iter().copied().fold(self.largest_mask, f32::max);
        self.is_binary &= masks.iter().all(|mask| mask.is_nan() || *mask == 0.0 || *mask == 1.0);
        let masks = with_means(masks);
        let mut fine = Array2::zeros(y.dim());
        // Low pictures have too few whole strips for a standard error.
        let width = if rows < MIN_STRIPS * BLOCK { PIECE * BLOCK } else { columns };
        for first in (0..columns).step_by(width) {
            let piece = first..columns.min(first + width);
            let mut in_run = false;
            for row in (0..rows).step_by(BLOCK) {
                let place = s![
                    ..,
                    REACH + row..REACH + row + BLOCK,
                    REACH + piece.start..REACH + piece.end
                ];
                let inside = s![row..row + BLOCK, piece.clone()];
                let strip = Strip::new(masks.slice(place), y.slice(inside));
                if strip.measured.sum() == 0.0 {
                    in_run = false;
                    continue;
                }
                let at = self.strips.len();
                match self.runs.last_mut() {
                    Some(run) if in_run => run.strips.end = at + 1,
                    _ => {
                        let place = [first_row + REACH + row, first_column + REACH + first];
                        self.runs.push(Run { strips: at..at + 1, place });
                    }
                }
                in_run = true;
                let own = fine.slice_mut(inside);
                own.into_iter().zip(&strip.y).for_each(|(fine, y)| *fine = *y);
                self.pixels += strip.measured.sum() * (BLOCK * BLOCK) as f64;
                self.strips.push(strip);
            }
        }
        let y = fine;
        for part_rows in parts(rows) {
            for part_columns in parts(columns) {
                let y = y.slice(s![part_rows.clone(), part_columns.clone()]);
                let middle = |first: usize, part: &Range<usize>| {
                    (first + REACH) as f64 + (part.start + part.end) as f64 / 2.0
                };
                let mut part = CorrelatedRegion {
                    place: [middle(first_row, &part_rows), middle(first_column, &part_columns)],
                    correlations: shifts().map(|_| Array1::zeros(frames)).collect(),
                    energy: y.iter().map(|&value| f64::from(value).powi(2)).sum(),
                };
                for (k, mask) in masks.outer_iter().enumerate() {
                    for ((row, column), correlations) in shifts().zip(&mut part.correlations) {
                        // Centring the mask would change nothing: the sum of y' over a block is 0.
                        let shifted = mask.slice(s![
                            row + part_rows.start..row + part_rows.end,
                            column + part_columns.start..column + part_columns.end
                        ]);
                        let product: f32 = shifted.iter().zip(&y).map(|(mask, y)| mask * y).sum();
                        correlations[k] += f64::from(product);
                    }
                }
                self.energy += part.energy;
                for (sum, own) in self.correlations.iter_mut().zip(&part.correlations) {
                    *sum += own;
                }
                self.parts.push(part);
            }
        }
    }

    /// Returns the statistics; `None` if all windows were too small or not measured, the masks have no structure, or the
    /// measurement is 0.
    pub fn finish(self) -> Option<MeasurementFigures> {
        if self.pixels == 0.0 {
            return None;
        }
        let fit = Fit::new(&self.strips, &equal_weights(&self.strips));
        let blocks =
            || self.strips.iter().flat_map(|strip| strip.y_means.iter().zip(&strip.measured));
        let measured = self.pixels / (BLOCK * BLOCK) as f64;
        let mean = blocks().map(|(mean, measured)| mean * measured).sum::<f64>() / measured;
        let negative = self
            .strips
            .iter()
            .map(|strip| strip.negative(NEGATIVE_SHARE * mean.abs(), NEGATIVE_SIGNIFICANCE));
        let negative_area = negative.sum::<f64>() / measured;
        // Masks with a constant sum leave no structure of a still scene, only noise.
        let balanced = fit.as_ref().is_some_and(|fit| fit.balance < MIN_BALANCE);
        let flat = if balanced { FLAT_BEHIND_BALANCED } else { FLAT };
        if self.energy <= self.pixels * (flat * mean).powi(2) {
            let masks_vary = fit.is_some() && !balanced;
            return (mean != 0.0).then(|| self.flat(mean, negative_area, masks_vary));
        }
        let fit = fit?;
        let explained = |correlations: &Array1<f64>| {
            correlations.dot(&fit.inverse.dot(correlations)) / self.energy
        };
        let ((row, column), explained_shifted) = shifts()
            .zip(&self.correlations)
            .map(|(shift, correlations)| (shift, explained(correlations)))
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        let unshifted = explained(&self.correlations[REACH * (2 * REACH + 1) + REACH]);
        let gain = explained_shifted - unshifted;
        let pixels_from_centre = |index: usize| REACH as i32 - index as i32;
        let mosaic = phase_difference(&self.strips, &fit.brightness, mean);
        let local_mosaic = local_phase_difference(&self.strips, &fit.brightness);
        let centre = REACH * (2 * REACH + 1) + REACH;
        let drift = [2 * REACH + 1, 1].map(|step| {
            let at = [centre - step, centre, centre + step];
            let explained = [at[0], at[2]].map(|at| explained(&self.correlations[at]).max(0.0));
            Drift::new(at.map(|at| self.correlations[at].sum()), explained)
        });
        let parts = self.parts.iter().filter(|part| part.energy > 0.0).map(|part| {
            let shares = part
                .correlations
                .iter()
                .map(|correlations| correlations.dot(&fit.inverse.dot(correlations)) / part.energy);
            let side = 2 * REACH + 1;
            let explained = Array2::from_shape_vec((side, side), shares.collect()).ok()?;
            let products = part.correlations.iter().map(|sums| sums.sum()).collect();
            let products = Array2::from_shape_vec((side, side), products).ok()?;
            Some(Region { place: part.place, explained, products })
        });
        let parts: Vec<_> = parts.flatten().collect();
        let (weighted, explained_energy, weights) = reweighted(&self.strips)?;
        let alteration = alteration(&Observed {
            strips: &self.strips,
            fit: &weighted,
            weights: &weights,
            explained: explained_energy,
            mean,
            is_binary: self.is_binary,
        });
        let (brightest, brightest_block) = brightest(&self.strips, weighted.offset);
        let uncertainty = brightness_errors(&self.strips, &weighted, &weights);
        let sparse = is_sparse(&self.strips) && explained_shifted < ENOUGH_EXPLAINED;
        Some(MeasurementFigures {
            pixels: self.pixels,
            mean,
            largest_mask: self.largest_mask,
            negative_area,
            offset: weighted.offset,
            offset_uncertainty: weighted.offset_uncertainty,
            brightness: weighted.brightness.to_vec(),
            uncertainty: uncertainty.to_vec(),
            mosaic,
            local_mosaic,
            distortion: distortion(&parts),
            moved_parts: moved_parts(&parts),
            alteration,
            drift,
            unmodulated: unmodulated(&self.strips, &self.runs, &fit.brightness, weighted.offset),
            brightest,
            brightest_block,
            is_flat: false,
            is_balanced: balanced,
            is_sparse: sparse,
            local: (balanced || sparse || unshifted < MIN_EXPLAINED)
                .then(|| LocalFit::new(&self.strips)),
            shift: (pixels_from_centre(row), pixels_from_centre(column)),
            explained: explained_shifted,
            explained_unshifted: unshifted,
            expected: mean.powi(2) * fit.structure / self.energy,
            shift_significance: gain * self.pixels
                / (1.0 - explained_shifted).max(1e-3)
                / self.frames as f64,
        })
    }

    /// The figures of a measurement without fine structure: masks that have one explain none of it.
    fn flat(&self, mean: f64, negative_area: f64, masks_vary: bool) -> MeasurementFigures {
        let explained = if masks_vary { 0.0 } else { 1.0 };
        let (brightest, brightest_block) = brightest(&self.strips, 0.0);
        MeasurementFigures {
            pixels: self.pixels,
            mean,
            largest_mask: self.largest_mask,
            negative_area,
            brightness: vec![0.0; self.frames],
            uncertainty: vec![0.0; self.frames],
            explained,
            explained_unshifted: explained,
            brightest,
            brightest_block,
            is_flat: true,
            ..MeasurementFigures::default()
        }
    }
}

impl Drift {
    /// Compares the products before, at and after the place of the masks.
    fn new([before, centre, after]: [f64; 3], explained: [f64; 2]) -> Self {
        let (smaller, larger) = (before.min(after), before.max(after));
        if centre <= smaller.max(0.0) {
            return Self { explained, ..Self::default() };
        }
        Self {
            asymmetry: (larger - smaller) / (larger.max(0.0) + centre),
            excess: (larger - smaller) / (centre - smaller),
            explained,
        }
    }
}

/// The masks \[B,h,w\] with the mean of each one in place of NaN. Masks that are shifted or resampled have such pixels beside
/// measured ones.
pub fn with_means(masks: ArrayView3<'_, f32>) -> Array3<f32> {
    let mut masks = masks.to_owned();
    masks.outer_iter_mut().for_each(|mut mask| {
        let known = mask.iter().filter(|value| !value.is_nan());
        let (sum, count) =
            known.fold((0.0, 0usize), |(sum, count), v| (sum + f64::from(*v), count + 1));
        let mean = (sum / count.max(1) as f64) as f32;
        mask.mapv_inplace(|value| if value.is_nan() { mean } else { value });
    });
    masks
}

/// A scene is sparse if at most this share of the blocks have this share of the light of the brightest parts.
const SPARSE_SHARE: f64 = 1.0 / 3.0;
const SPARSE_LIGHT: f64 = 0.1;

/// True if the scene is dark but for a few objects.
fn is_sparse(strips: &[Strip]) -> bool {
    let blocks = || {
        let blocks = strips.iter().flat_map(|strip| strip.y_means.iter().zip(&strip.measured));
        blocks.filter(|(_, measured)| **measured > 0.0).map(|(mean, _)| *mean)
    };
    let brightest = blocks().fold(0.0, f64::max);
    let lit = blocks().filter(|mean| *mean > SPARSE_LIGHT * brightest).count();
    lit as f64 <= SPARSE_SHARE * blocks().count() as f64
}

/// Light of the brightest blocks, and of the brightest one, without the offset, relative to that of a scene of 1. The
/// second counts blocks with enough light of the masks only.
fn brightest(strips: &[Strip], offset: f64) -> (f64, f64) {
    let blocks: Vec<(f64, f64)> = strips
        .iter()
        .flat_map(|strip| {
            let light = strip.mask_means.sum_axis(Axis(0));
            let blocks = strip.y_means.iter().copied().zip(light).zip(&strip.measured);
            let measured = blocks.filter(|(_, measured)| **measured > 0.0);
            measured.map(|(block, _)| block).collect::<Vec<_>>()
        })
        .collect();
    let lit = || blocks.iter().map(|(_, light)| *light).filter(|light| *light > 0.0);
    let mean_light = lit().sum::<f64>() / lit().count().max(1) as f64;
    let sorted = |min_light: f64| {
        let lit = blocks.iter().filter(|(_, light)| *light > min_light);
        let mut values: Vec<f64> = lit.map(|(y, light)| (y - offset) / light).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let values = sorted(MIN_LIGHT * mean_light);
    let last = values.len().saturating_sub(1);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // below the number of blocks
    let index = (last as f64 * BRIGHTEST) as usize;
    let brightest = values.get(index).copied().unwrap_or_default();
    (brightest, sorted(ENOUGH_LIGHT * mean_light).last().copied().unwrap_or(brightest))
}

/// The diagonals of a cell: phases that may be green, and the other two.
const DIAGONALS: [([usize; 2], [usize; 2]); 2] = [([1, 2], [0, 3]), ([0, 3], [1, 2])];

/// Differences between the phases of a cell.
struct Colours {
    /// Between the phases that are not green.
    own: f64,
    /// Between their mean and that of the green ones.
    across: f64,
    /// Between the green phases.
    green: f64,
}

impl Colours {
    fn new(phases: &[f64; 4], green: [usize; 2], other: [usize; 2]) -> Self {
        let [green, other] = [green, other].map(|pair| pair.map(|phase| phases[phase]));
        Self {
            own: other[0] - other[1],
            across: 0.5 * (other[0] + other[1] - green[0] - green[1]),
            green: green[0] - green[1],
        }
    }
}

/// The colour difference on which neighbouring blocks agree.
///
/// A mosaic has two green phases on a diagonal of its cell. The differences between the other two, and between them and
/// green, follow the colours of the scene, which change slowly. The texture of a grey scene has no preferred diagonal, and its
/// sign changes from block to block. Stripes differ on both diagonals.
fn local_phase_difference(strips: &[Strip], brightness: &Array1<f64>) -> PhaseDifference {
    // Residual phases of each block, relative to its mean. The masks explain the light of a block up to a factor.
    let residuals = |strip: &Strip| -> Vec<Option<[f64; 4]>> {
        let blocks = strip.y_block_phases.iter().zip(&strip.y_means).enumerate();
        let residual = |(block, (phases, mean)): (usize, (&[f64; 4], &f64))| {
            if strip.measured[block] == 0.0 {
                return None;
            }
            let light = strip.mask_means.column(block).dot(brightness);
            let factor = if light > 0.0 { mean / light } else { 0.0 };
            let mut rest = *phases;
            for (mask, x) in strip.mask_block_phases.iter().zip(brightness) {
                rest.iter_mut()
                    .zip(&mask[block])
                    .for_each(|(rest, mask)| *rest -= factor * x * mask);
            }
            Some(rest.map(|rest| if *mean > 0.0 { rest / mean } else { 0.0 }))
        };
        blocks.map(residual).collect()
    };
    let strips: Vec<_> = strips.iter().map(residuals).collect();
    let on_diagonal = |(green, other): ([usize; 2], [usize; 2])| {
        let (mut sum, mut squares, mut green_sum, mut count) = (0.0, 0.0, 0.0, 0.0);
        for pair in strips.iter().flat_map(|strip| strip.windows(2)) {
            let [Some(one), Some(next)] = pair else { continue };
            let [one, next] = [one, next].map(|phases| Colours::new(phases, green, other));
            let product = one.own * next.own + one.across * next.across;
            sum += product;
            squares += product * product;
            green_sum += one.green * next.green;
            count += 1.0;
        }
        if sum <= 0.0 || green_sum > MAX_GREEN_DIFFERENCE * sum {
            return PhaseDifference::default();
        }
        PhaseDifference {
            amplitude: (sum / f64::max(count, 1.0)).sqrt(),
            significance: sum / f64::max(squares, 1e-30).sqrt(),
        }
    };
    let [one, other] = DIAGONALS.map(on_diagonal);
    if one.significance > other.significance { one } else { other }
}

/// The largest phase difference that the masks do not explain. The standard error comes from the scatter between
/// strips: a mosaic has the same sign everywhere, whereas the texture of a scene changes sign.
fn phase_difference(strips: &[Strip], brightness: &Array1<f64>, mean: f64) -> PhaseDifference {
    if strips.len() < MIN_STRIPS {
        return PhaseDifference::default();
    }
    let count = strips.len() as f64;
    let measured: Vec<f64> = strips.iter().map(|strip| strip.measured.sum()).collect();
    let total: f64 = measured.iter().sum();
    let residuals = [0, 1, 2, 3].map(|phase: usize| -> Vec<(f64, &f64)> {
        let residual = |strip: &Strip| {
            let explained =
                strip.mask_phases.iter().zip(brightness).map(|(mask, x)| mask[phase] * x);
            (strip.y_phases[phase] - explained.sum::<f64>()) / mean
        };
        strips.iter().map(residual).zip(&measured).collect()
    });
    let averages = residuals.each_ref().map(|residuals| {
        residuals.iter().map(|(residual, weight)| residual * **weight).sum::<f64>() / total
    });
    let has_equal_greens = |green: [usize; 2], other: [usize; 2]| {
        let colours = Colours::new(&averages, green, other);
        let colour = colours.own.powi(2) + colours.across.powi(2);
        colours.green.powi(2) <= MAX_GREEN_DIFFERENCE * colour
    };
    // Stripes of a scene differ along one axis, so neither diagonal has equal phases.
    if !DIAGONALS.into_iter().any(|(green, other)| has_equal_greens(green, other)) {
        return PhaseDifference::default();
    }
    let difference = |phase: usize| {
        let average = averages[phase];
        let scatter = residuals[phase]
            .iter()
            .map(|(residual, weight)| ((residual - average) * **weight).powi(2))
            .sum::<f64>();
        let error = (scatter * count / (count - 1.0)).sqrt() / total;
        PhaseDifference { amplitude: average.abs(), significance: average.abs() / error.max(1e-9) }
    };
    let differences = (0..4).map(difference);
    differences.max_by(|a, b| a.amplitude.total_cmp(&b.amplitude)).unwrap_or_default()
}

/// Detects the bit depth and alignment of 16-bit camera values.
#[derive(Debug, Clone, Copy, Default)]
pub struct BitUsage {
    /// The bits that are set in any value.
    used: u16,
}

impl BitUsage {
    /// Adds values as stored.
    pub fn add<'a>(&mut self, values: impl IntoIterator<Item = &'a f32>) {
        self.used = values.into_iter().fold(self.used, |used, value| used | *value as u16);
    }

    /// Reports 12-bit values in 16 bits whose full scale or saturation level is not that of 12 bits.
    pub fn judge(self, full_scale: f32, saturation: f32) -> Option<Finding> {
        const LEFT_ALIGNED_MAXIMUM: f32 = 65_520.0;
        const RIGHT_ALIGNED_MAXIMUM: f32 = 4095.0;
        if self.used.trailing_zeros() == 4 && saturation > LEFT_ALIGNED_MAXIMUM {
            return Some(Finding::new(
                FindingCode::LeftAligned,
                "all values are multiples of 16, so these are probably 12-bit values: saturated pixels have the value \
                 65520 and are not recognised",
            ));
        }
        if (1..=RIGHT_ALIGNED_MAXIMUM as u16).contains(&self.used)
            && full_scale > RIGHT_ALIGNED_MAXIMUM
        {
            return Some(Finding::new(
                FindingCode::RightAligned,
                format!(
                    "no value is above 4095, but the full scale is {full_scale}: these are probably 12-bit values"
                ),
            ));
        }
        None
    }
}

/// Checks a measurement of a spectral camera, which has one mask for all bands: its scale, its sign and its sensor.
/// [`judge_blocks`](super::judge_blocks) tests the masks. `dark_subtracted` is true if dark frames were subtracted.
///
/// The colour of a scene varies from place to place. This looks like an offset that the masks do not explain, and like
/// missing modulation. A spectral line has the light of one mask.
pub fn judge_dispersed(figures: &MeasurementFigures, dark_subtracted: bool) -> Vec<Finding> {
    let mut findings = scale_and_sign(figures, dark_subtracted);
    if !figures.is_uncertain() {
        findings.extend(inverted_masks(figures).or_else(|| mosaic(figures)));
    }
    findings.extend(implausible_brightness(figures));
    findings
}

/// Findings that need no fit.
fn scale_and_sign(figures: &MeasurementFigures, dark_subtracted: bool) -> Vec<Finding> {
    let mut findings: Vec<Finding> = mask_scale(figures.largest_mask).into_iter().collect();
    let negative = figures.negative_area;
    if negative > 0.01 {
        let cause = if dark_subtracted {
            "the dark frames are brighter than the measurement"
        } else {
            "too much was subtracted before the upload"
        };
        let detail = format!(
            "{:.1} % of the image is below 0 by more than noise: {cause}",
            negative * 100.0
        );
        findings.push(Finding::new(FindingCode::Negative, detail).escalate_if(negative > 0.1));
    }
    findings
}

/// Checks a measurement. `dark_subtracted` is true if dark frames were subtracted.
pub fn judge_measurement(figures: &MeasurementFigures, dark_subtracted: bool) -> Vec<Finding> {
    let mut findings = scale_and_sign(figures, dark_subtracted);
    // Without a correct fit the other figures are meaningless, so the checks end at the first of these.
    let wrong = copy_of_a_mask(figures)
        .or_else(|| inverted_masks(figures))
        .or_else(|| partly_moved_masks(figures))
        .or_else(|| resampled_masks(figures))
        .or_else(|| shifted_masks(figures));
    let wrong = wrong.filter(|_| !figures.is_uncertain());
    // The other figures need the mean brightness of the frames.
    if wrong.is_none() && (figures.is_uncertain() || figures.fits_locally()) {
        if figures.is_sparse && !figures.fits_locally() {
            let detail = "the scene is dark but for a few objects, and fits of single blocks do not recognise the masks";
            findings.push(Finding::new(FindingCode::UnverifiedMasks, detail));
        }
        findings.extend(implausible_brightness(figures));
        return findings;
    }
    if let Some(finding) = wrong.or_else(|| foreign_masks(figures)) {
        findings.push(finding);
        // Without a fit, all light counts as light of the scene.
        if figures.is_flat {
            findings.extend(implausible_brightness(figures));
        }
        return findings;
    }
    findings.extend(mosaic(figures));
    // Masks between two pixels, and altered masks, explain the light badly, which looks like an offset and like missing
    // light. The curve of sRGB makes binary masks sharper after a drift, so the drift comes first.
    match drifted_masks(figures).or_else(|| altered_masks(figures)) {
        Some(cause) => findings.push(cause),
        None => {
            let not_shown = dark_frames(figures);
            findings.extend(uneven_brightness(figures, &not_shown));
            findings.extend(missing_patterns(figures, not_shown));
            // Stray light in a part of the picture also looks like an offset.
            findings.extend(unmodulated_area(figures));
            findings.extend(unexplained_light(figures, dark_subtracted));
        }
    }
    findings.extend(implausible_brightness(figures));
    findings
}

/// Masks that fit the parts of the picture only after a magnification or a rotation.
fn resampled_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let Distortion { magnification, rotation, largest } = figures.distortion?;
    if figures.explained < MIN_EXPLAINED {
        return None;
    }
    let change = match magnification.abs() > rotation.abs() {
        true if magnification > 0.0 => format!("enlarged by {:.1} %", 100.0 * magnification),
        true => format!("reduced by {:.1} %", -100.0 * magnification),
        false => format!("turned by {:.2} degrees", rotation.to_degrees().abs()),
    };
    let detail = format!(
        "the masks fit all parts of the measurement when they are {change}, which moves them by {largest:.1} pixels at \
         the border. Most likely one of the two was resized, undistorted or registered after its recording: compare the \
         sizes of the raw files. Otherwise the lens was refocused or turned since the calibration"
    );
    Some(Finding::new(FindingCode::ResampledMasks, detail))
}

/// Masks with values that are not their transmission, or too few masks.
fn altered_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let share = 100.0 * (figures.offset / figures.mean).abs();
    let count = figures.brightness.len();
    let (code, detail) = match figures.alteration? {
        Alteration::GammaEncoded => (
            FindingCode::MaskValues,
            format!(
                "with the gamma curve of sRGB removed from the masks, they explain the {share:.0} % of the light by which \
                 the measurement is too dark: the masks are pictures for display, not values of a camera"
            ),
        ),
        Alteration::GammaDecoded => (
            FindingCode::MaskValues,
            format!(
                "with the gamma curve of sRGB, the masks explain the {share:.0} % of the light that they leave unexplained \
                 without it: the curve was probably removed from values that had none"
            ),
        ),
        Alteration::MadeBinary => (
            FindingCode::MaskValues,
            format!(
                "the masks have only the values 0 and 1, and the measurement has {share:.0} % more light than they explain, \
                 in proportion to the scene. Most likely grey masks were made binary. If the masks are binary, their closed \
                 pixels leak: calibrate again with captures. A missing dark is less likely, because it adds the same light \
                 everywhere"
            ),
        ),
        Alteration::MissingMask => (
            FindingCode::MissingMask,
            format!(
                "the measurement has {share:.0} % more light than its masks explain, about as much as one more mask passes, \
                 and it has the structure of a mask. Most likely a mask is missing: {count} were sent. A wrong dark is less \
                 likely: record the dark again, and if the finding stays, it is the mask"
            ),
        ),
    };
    Some(Finding::new(code, detail))
}

/// Masks that explain the measurement much better when they are shifted.
fn shifted_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let significant = figures.shift != (0, 0)
        // Masks that are shifted copies of each other also explain much of a shifted measurement.
        && figures.explained > 1.03 * figures.explained_unshifted
        && (figures.explained < TOO_MUCH || figures.explained_unshifted < UNSHIFTED)
        && figures.shift_significance > SHIFT_SIGNIFICANCE
        && figures.explained > MIN_EXPLAINED;
    significant.then(|| {
        let (rows, columns) = figures.shift;
        let detail = format!(
            "the masks explain {:.0} % of the fine structure of the measurement when shifted by {rows} rows and \
             {columns} columns, but only {:.0} % without a shift",
            figures.explained.min(1.0) * 100.0,
            figures.explained_unshifted * 100.0
        );
        Finding::new(FindingCode::ShiftedMasks, detail)
    })
}

/// Masks that fit a part of the picture only when they are shifted.
fn partly_moved_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let MovedParts { shift: [rows, columns], share, place: [row, column] } = figures.moved_parts?;
    if figures.explained < MIN_EXPLAINED {
        return None;
    }
    let detail = format!(
        "the masks fit {:.0} % of the picture when shifted by {rows} rows and {columns} columns, for example around row \
         {row:.0} and column {column:.0}, and the rest without a shift. Most likely one of the two was put together \
         from parts, or the sensor is read in parts that don't fit together",
        100.0 * share
    );
    Some(Finding::new(FindingCode::PartlyMovedMasks, detail))
}

/// A measurement that looks like the mosaic of a colour sensor.
fn mosaic(figures: &MeasurementFigures) -> Option<Finding> {
    let global = (figures.mosaic, MOSAIC_AMPLITUDE, MOSAIC_SIGNIFICANCE);
    let local = (figures.local_mosaic, LOCAL_MOSAIC_AMPLITUDE, LOCAL_MOSAIC_SIGNIFICANCE);
    let found = [global, local].into_iter().find(|(difference, amplitude, significance)| {
        difference.amplitude > *amplitude && difference.significance > *significance
    });
    found.map(|(difference, ..)| {
        let detail = format!(
            "pixels of alternate rows and columns differ by {:.0} % of the mean: this looks like the raw mosaic of a \
             colour sensor, but the calibration is for a grey one",
            difference.amplitude * 100.0
        );
        Finding::new(FindingCode::Mosaic, detail)
    })
}

/// A mask that was sent as the measurement.
fn copy_of_a_mask(figures: &MeasurementFigures) -> Option<Finding> {
    let brightness = &figures.brightness;
    let (index, most) =
        brightness.iter().copied().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let others = brightness.iter().enumerate().filter(|(k, _)| *k != index);
    let is_copy = brightness.len() > 1
        && figures.explained_unshifted > COPY
        && others.map(|(_, value)| value.abs()).fold(0.0, f64::max) < (1.0 - COPY) * most;
    is_copy.then(|| {
        let detail = format!(
            "the snapshot has the light of mask {index} (counted from 0) alone, on a uniform scene"
        );
        Finding::new(FindingCode::BinaryMeasurement, detail)
    })
}

/// Masks that are displaced by a fraction of a pixel and so explain less of the light than they should.
fn drifted_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let [rows, columns] = figures.drift;
    let asymmetry = rows.asymmetry.hypot(columns.asymmetry);
    let significant = asymmetry > MIN_DRIFT || rows.excess.max(columns.excess) > MIN_DRIFT_EXCESS;
    significant.then(|| {
        let sign = |drift: Drift| {
            (drift.asymmetry / MIN_DRIFT).max(drift.excess / MIN_DRIFT_EXCESS)
        };
        let along_rows = sign(rows) > sign(columns);
        let (axis, drift) = if along_rows { ("row", rows) } else { ("column", columns) };
        let [before, after] = drift.explained.map(|share| 100.0 * share);
        let detail = format!(
            "displaced by one {axis}, the masks explain {before:.0} % of the fine structure in one direction and \
             {after:.0} % in the other, and {:.0} % without a displacement. Most likely the optics have drifted since the calibration. A \
             missing or wrong dark is less likely: subtract dark frames, and if the finding stays, it is the drift",
            100.0 * figures.explained_unshifted
        );
        Finding::new(FindingCode::DriftedMasks, detail)
    })
}

/// Masks behind which the frames together have negative light: those of the measurement are 1 - C.
fn inverted_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let sum = figures.brightness.iter().sum::<f64>();
    let inverted = figures.explained_unshifted > MIN_INVERTED && sum < -MIN_NEGATIVE * figures.mean;
    inverted.then(|| {
        let detail =
            "the frames together would have negative light: the measurement was recorded with the masks 1 - C";
        Finding::new(FindingCode::InvertedMasks, detail)
    })
}

/// Masks that explain next to nothing of the measurement.
fn foreign_masks(figures: &MeasurementFigures) -> Option<Finding> {
    let (explained, expected) = (figures.explained_unshifted, figures.expected);
    if explained < MIN_EXPLAINED && expected < ENOUGH_EXPECTED && !figures.is_flat {
        let detail = format!(
            "the masks explain {:.1} % of the fine structure of the measurement, and the right masks would explain about \
             {:.1} %: the noise, or the texture of the scene, is much stronger than the pattern of the masks",
            100.0 * explained.max(0.0),
            100.0 * expected
        );
        return Some(Finding::new(FindingCode::UnverifiedMasks, detail));
    }
    (explained < MIN_EXPLAINED).then(|| {
        let detail = if figures.is_flat {
            "all pixels of the snapshot have nearly the same value, so no mask is visible in it".to_owned()
        } else {
            format!(
                "the masks explain only {:.1} % of the fine structure of the measurement: it was probably recorded \
                 with other masks",
                figures.explained_unshifted * 100.0
            )
        };
        Finding::new(FindingCode::ForeignMasks, detail)
    })
}

/// Frames without light. Behind an object that covers most of the picture, the frames before and after are dark too.
fn dark_frames(figures: &MeasurementFigures) -> Vec<usize> {
    let mut sorted = figures.brightness.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let is_dark = |k: &usize| {
        let (value, error) = (figures.brightness[*k], figures.uncertainty[*k]);
        let beside = [k.checked_sub(1), Some(k + 1)].into_iter().flatten();
        let neighbours = beside.filter_map(|k| figures.brightness.get(k)).copied();
        let usual = neighbours.fold(0.0, f64::max).min(median);
        value + 2.0 * error < 0.4 * usual && value < 0.25 * usual
    };
    (0..figures.brightness.len()).filter(is_dark).collect()
}

/// Frames of unequal brightness, apart from those that were `not_shown`: the light of a missing mask goes to the frames
/// behind the masks that resemble it.
fn uneven_brightness(figures: &MeasurementFigures, not_shown: &[usize]) -> Option<Finding> {
    let shown: Vec<usize> =
        (0..figures.brightness.len()).filter(|k| !not_shown.contains(k)).collect();
    let count = shown.len() as f64;
    let mean = shown.iter().map(|k| figures.brightness[*k]).sum::<f64>() / count;
    let errors = shown.iter().map(|k| figures.uncertainty[*k].powi(2)).sum::<f64>();
    let error = (errors / count).sqrt();
    // Objects that enter the picture change the brightness slowly. Second differences ignore a trend. For independent
    // values their mean square is six times the variance.
    let bends = shown.windows(3).map(|k| {
        let [before, at, after] = [k[0], k[1], k[2]].map(|k| figures.brightness[k]);
        before - 2.0 * at + after
    });
    let squares = bends.map(|bend| bend.powi(2)).sum::<f64>();
    let spread = (squares / (6.0 * (count - 2.0))).sqrt();
    let is_uneven = shown.len() > 2
        && mean > 0.0
        && spread > MIN_UNEVEN * mean
        && spread > UNEVEN_SIGNIFICANCE * error;
    is_uneven.then(|| {
        let all = figures.brightness.len();
        let detail = format!(
            "the brightness of the frames jumps by {:.0} % of their mean. Most likely a mask is missing or another one \
             takes its place: {all} were sent. If their number is right, the light or the exposure changed from frame to \
             frame: record a resting scene, and if the finding stays, it is the masks",
            100.0 * spread / mean
        );
        Finding::new(FindingCode::MissingMask, detail)
    })
}

/// Frames without light, which indicate that their patterns were not shown. A lamp that flickers dims frames, too.
fn missing_patterns(figures: &MeasurementFigures, frames: Vec<usize>) -> Option<Finding> {
    if frames.is_empty() {
        return None;
    }
    let brightest = figures.brightness.iter().copied().fold(0.0, f64::max);
    let light = frames.iter().map(|k| figures.brightness[*k]).fold(0.0, f64::max);
    let is_dark = light < NO_LIGHT * brightest;
    let detail = if is_dark {
        format!(
            "frames {frames:?} (counted from 0) have no light: the LCoS did not show their patterns, or the scene was dark"
        )
    } else {
        format!(
            "frames {frames:?} (counted from 0) have {:.0} % of the light of the brightest frame or less: the LCoS showed \
             their patterns too briefly, or the light flickers",
            100.0 * light / brightest
        )
    };
    let finding = Finding::new(FindingCode::MissingPattern, detail).with_frames(frames);
    Some(finding.escalate_if(is_dark))
}

/// An offset that no mask explains, which indicates that the dark frames are missing or wrong.
fn unexplained_light(figures: &MeasurementFigures, dark_subtracted: bool) -> Option<Finding> {
    let share = figures.offset / figures.mean;
    let significant = figures.offset.abs() > 4.0 * figures.offset_uncertainty;
    if figures.mean <= 0.0 || share.abs() < OFFSET_SHARE || !significant {
        return None;
    }
    let difference = if share > 0.0 { "more" } else { "less" };
    let observation = format!(
        "the measurement has {:.0} % {difference} light than its masks explain",
        share.abs() * 100.0
    );
    let (code, cause) = match (dark_subtracted, share > 0.0) {
        (true, _) => (FindingCode::WrongDark, ": the dark frames do not belong to it"),
        (false, true) => (
            FindingCode::NoDark,
            ", and no dark frames were named. Stray light that passes by the masks looks the same, but remains \
             after the dark is subtracted",
        ),
        (false, false) => {
            (FindingCode::NegativeOffset, ": too much was subtracted before the upload")
        }
    };
    Some(Finding::new(code, observation + cause).escalate_if(share.abs() > 0.15))
}

/// Parts of the picture whose light does not follow the masks.
fn unmodulated_area(figures: &MeasurementFigures) -> Option<Finding> {
    let Unmodulated { share, place: [row, column] } = figures.unmodulated?;
    let detail = format!(
        "the masks modulate the light of {:.1} % of the area too weakly, for example around row {row} and column {column}",
        100.0 * share
    );
    Some(Finding::new(FindingCode::UnmodulatedArea, detail))
}

/// A brightness that does not fit the full scale. A dark scene may have one small bright object. Masks on a wrong scale
/// change the brightness, too.
fn implausible_brightness(figures: &MeasurementFigures) -> Option<Finding> {
    if mask_scale(figures.largest_mask).is_some() {
        return None;
    }
    let too_bright = figures.brightest > *PLAUSIBLE_BRIGHTNESS.end();
    let too_dark = figures.brightest_block < *PLAUSIBLE_BRIGHTNESS.start();
    (too_bright || too_dark).then(|| {
        let detail = format!(
            "the brightest parts of the scene have {:.3} of the full scale; {} to {} is plausible",
            if too_bright { figures.brightest } else { figures.brightest_block },
            PLAUSIBLE_BRIGHTNESS.start(),
            PLAUSIBLE_BRIGHTNESS.end()
        );
        Finding::new(FindingCode::Level, detail)
    })
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, s};

    use super::{BitUsage, MeasurementStudy, judge_measurement};
    use crate::masks::turning_circle;
    use crate::{FindingCode, Severity, iid_masks, measure, noisy, random_squares};

    /// A disc that moves over a textured background.
    fn scene(frames: usize, side: usize) -> Array3<f32> {
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let texture = 0.4 + 0.1 * ((i as f32 / 5.0).sin() + (j as f32 / 7.0).cos());
            let at = (i as f32 - 60.0 - 3.0 * k as f32).hypot(j as f32 - 70.0);
            if at < 20.0 { 0.9 } else { texture }
        })
    }

    /// Codes that are reported for a measurement whose dark frames were subtracted.
    fn codes(masks: &Array3<f32>, y: &Array2<f32>) -> Vec<&'static str> {
        judged(masks, y, true)
    }

    /// Codes that are reported for a measurement without dark frames.
    fn codes_without_dark(masks: &Array3<f32>, y: &Array2<f32>) -> Vec<&'static str> {
        judged(masks, y, false)
    }

    fn judged(masks: &Array3<f32>, y: &Array2<f32>, dark_subtracted: bool) -> Vec<&'static str> {
        let mut study = MeasurementStudy::new(masks.dim().0);
        study.add(masks.view(), y.view(), (0, 0));
        let figures = study.finish().unwrap();
        let findings = judge_measurement(&figures, dark_subtracted);
        findings.iter().map(|finding| finding.code.as_str()).collect()
    }

    /// Independent binary masks, which determine an offset best.
    fn fine_masks(frames: usize, side: usize) -> Array3<f32> {
        let mut state = 7u32;
        Array3::from_shape_simple_fn((frames, side, side), || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            if state >> 31 == 1 { 1.0 } else { 0.0 }
        })
    }

    /// Masks whose sum is the same everywhere: each pixel is open in half of the frames.
    fn balanced_masks(frames: usize, side: usize) -> Array3<f32> {
        let half = fine_masks(frames / 2, side);
        ndarray::concatenate![ndarray::Axis(0), half, 1.0 - &half]
    }

    /// Discs on black that cover little of the picture.
    fn cells(frames: usize, side: usize) -> Array3<f32> {
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let is_within = |row: f32, column: f32, radius: f32| {
                (i as f32 - row - k as f32).hypot(j as f32 - column) < radius
            };
            let is_cell = is_within(30.0, 40.0, 8.0) || is_within(90.0, 70.0, 10.0);
            if is_cell { 0.8 } else { 0.0 }
        })
    }

    #[test]
    fn masks_with_a_constant_sum_and_sparse_scenes_are_not_foreign() {
        let (masks, balanced) = (fine_masks(8, 136), balanced_masks(8, 136));
        let mut unpaired = balanced.clone();
        unpaired.index_axis_mut(ndarray::Axis(0), 7).assign(&fine_masks(1, 136).slice(s![
            0,
            ..,
            ..
        ]));
        let still = Array3::from_elem((8, 136, 136), 0.5f32);
        for (name, masks, scene, expected) in [
            ("balanced", &balanced, scene(8, 136), &[][..]),
            ("flat", &balanced, still, &[]),
            ("unpaired", &unpaired, scene(8, 136), &[]),
            ("cells", &masks, cells(8, 136), &[]),
            ("balanced cells", &balanced, cells(8, 136), &["unverified_masks"]),
        ] {
            let y = measure(masks.view(), scene.view()).unwrap();
            let y = noisy(y, 0.01, 1).unwrap();
            let found = codes(masks, &y);
            assert_eq!(found, expected, "{name}");
        }
        // Other masks are noticed where the scene shows them.
        let other = masks.slice(s![.., ..;-1, ..]).to_owned();
        let y = measure(other.view(), scene(8, 136).view()).unwrap();
        assert_eq!(codes(&masks, &y), ["foreign_masks"]);
    }

    #[test]
    fn small_offsets_are_attributed_to_missing_or_wrong_dark_frames() {
        let masks = fine_masks(8, 208);
        let y = noisy(measure(masks.view(), scene(8, 208).view()).unwrap(), 0.02, 1).unwrap();
        let mean = y.mean().unwrap();
        assert!(codes_without_dark(&masks, &y).is_empty(), "{:?}", codes_without_dark(&masks, &y));
        let lifted = &y + 0.07 * mean;
        assert_eq!(codes_without_dark(&masks, &lifted), ["no_dark"]);
        // A drift of 0.4 pixels is no missing dark.
        let shifted =
            y.slice(s![.., 1..]).to_owned() * 0.4 + y.slice(s![.., ..207]).to_owned() * 0.6;
        let window = masks.slice(s![.., .., ..207]).to_owned();
        assert_eq!(codes_without_dark(&window, &shifted), ["drifted_masks"]);
        assert_eq!(codes(&masks, &lifted), ["wrong_dark"]);
        assert_eq!(codes(&masks, &(&y - 0.07 * mean)), ["wrong_dark"]);
        assert_eq!(codes_without_dark(&masks, &(&y - 0.07 * mean)), ["negative_offset"]);
    }

    /// A checkerboard of uniform squares and noise, which the masks explain badly.
    #[test]
    fn offsets_are_detected_behind_partial_texture() {
        let masks = fine_masks(20, 64);
        let noise = noisy(Array2::from_elem((64, 64), 0.5), 0.3, 3).unwrap();
        let scene = Array3::from_shape_fn((20, 64, 64), |(k, i, j)| {
            if (i / 16 + j / 16) % 2 == 0 { noise[[(i + 3 * k) % 64, j]] } else { 0.5 }
        });
        let y = measure(masks.view(), scene.view()).unwrap();
        let lifted = &y + 0.04 * y.mean().unwrap();
        assert!(codes_without_dark(&masks, &y).is_empty(), "{:?}", codes_without_dark(&masks, &y));
        assert_eq!(codes_without_dark(&masks, &lifted), ["no_dark"]);
    }

    /// Texture makes the residuals of neighbouring pixels correlated; the standard error has to account for that.
    #[test]
    fn offset_uncertainty_covers_correlated_residuals() {
        let normalized_error = |seed: u64| {
            let (masks, _) = random_squares(10, 140, 140, seed).unwrap();
            let scene = scene(10, 140);
            let y = measure(masks.view(), scene.view()).unwrap();
            let mut study = MeasurementStudy::new(10);
            study.add(masks.view(), y.view(), (0, 0));
            let figures = study.finish().unwrap();
            (figures.offset / figures.offset_uncertainty).powi(2)
        };
        let square = (0..12).map(normalized_error).sum::<f64>() / 12.0;
        assert!((0.2..3.0).contains(&square), "{square}");
    }

    #[test]
    fn misaligned_12_bit_values_are_reported() {
        let judge = |values: &[f32], full_scale, saturation| {
            let mut bits = BitUsage::default();
            bits.add(values);
            bits.judge(full_scale, saturation).map(|finding| finding.code.as_str())
        };
        let left = [16.0, 4096.0, 65_520.0, 0.0];
        assert_eq!(judge(&left, 65_535.0, 65_535.0), Some("left_aligned"));
        assert_eq!(judge(&left, 65_520.0, 65_520.0), None);
        let right = [0.0, 3.0, 4095.0];
        assert_eq!(judge(&right, 65_535.0, 65_535.0), Some("right_aligned"));
        assert_eq!(judge(&right, 4095.0, 4095.0), None);
        for values in [&[0.0, 0.0][..], &[17.0, 4096.0], &[0.0, 32_768.0]] {
            assert_eq!(judge(values, 65_535.0, 65_535.0), None, "{values:?}");
        }
    }

    #[test]
    fn a_tenfold_wrong_full_scale_is_reported() {
        let masks = fine_masks(8, 208);
        let y = noisy(measure(masks.view(), scene(8, 208).view()).unwrap(), 0.02, 1).unwrap();
        assert_eq!(codes(&masks, &(&y * 10.0)), ["level"]);
        assert_eq!(codes(&masks, &(&y / 10.0)), ["level"]);
    }

    #[test]
    fn raw_colour_mosaics_are_reported() {
        let masks = fine_masks(8, 208);
        let gains = [0.7, 1.0, 1.0, 0.8];
        let coloured = |y: &Array2<f32>| {
            Array2::from_shape_fn(y.dim(), |at| y[at] * gains[at.0 % 2 * 2 + at.1 % 2])
        };
        for seed in 0..3 {
            let y = measure(masks.view(), scene(8, 208).view()).unwrap();
            let y = noisy(y, 0.02, seed).unwrap();
            assert!(codes(&masks, &coloured(&y)).contains(&"mosaic"), "seed {seed}");
            // Complementary colours cancel over the picture.
            let tinted = Array2::from_shape_fn(y.dim(), |(i, j)| {
                let phase = i % 2 * 2 + j % 2;
                y[[i, j]] * [gains[phase], [1.0, 0.85, 0.85, 1.0][phase]][usize::from(j >= 104)]
            });
            assert!(codes(&masks, &tinted).contains(&"mosaic"), "seed {seed}");
            // Stripes with a period of two pixels belong to the scene.
            for rows in [60, 208] {
                let mut striped = y.clone();
                striped.slice_mut(s![..rows;2, ..]).mapv_inplace(|value| value * 0.8);
                assert!(!codes(&masks, &striped).contains(&"mosaic"), "seed {seed}, {rows}");
            }
        }
    }

    #[test]
    fn good_measurements_pass_and_each_fault_is_reported() {
        for seed in 0..3 {
            let (masks, _) = random_squares(10, 140, 140, seed).unwrap();
            let scene = scene(10, 140);
            let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, seed).unwrap();
            assert!(codes(&masks, &y).is_empty(), "seed {seed}: {:?}", codes(&masks, &y));
            assert_eq!(codes(&masks, &(&y + 1.0)), ["wrong_dark"], "seed {seed}");
            assert!(codes(&masks, &(&y - 0.8)).contains(&"wrong_dark"), "seed {seed}");
            let moved = y.slice(s![2.., 1..]).to_owned();
            let window = masks.slice(s![.., ..138, ..139]).to_owned();
            assert_eq!(codes(&window, &moved), ["shifted_masks"], "seed {seed}");
            let mut dark = scene.clone();
            dark.index_axis_mut(ndarray::Axis(0), 4).fill(0.0);
            let y_without_frame = measure(masks.view(), dark.view()).unwrap();
            assert_eq!(codes(&masks, &y_without_frame), ["missing_pattern"], "seed {seed}");
            let (other, _) = random_squares(10, 140, 140, seed + 100).unwrap();
            assert_eq!(codes(&other, &y), ["foreign_masks"], "seed {seed}");
            let inverted = masks.mapv(|mask| 1.0 - mask);
            assert_eq!(codes(&inverted, &y), ["inverted_masks"], "seed {seed}");
            assert_eq!(codes(&masks, &(&y * 4.0)), ["level"], "seed {seed}");
            // Halfway between two pixels, the masks of two displacements fit equally well.
            let half = (&masks.slice(s![.., .., 1..]) + &masks.slice(s![.., .., ..139])) * 0.5;
            let y = y.slice(s![.., 1..]).to_owned();
            assert_eq!(codes(&half, &y), ["drifted_masks"], "seed {seed}");
            let copy = masks.index_axis(ndarray::Axis(0), 3).to_owned();
            assert_eq!(codes(&masks, &copy), ["binary_measurement"], "seed {seed}");
        }
    }

    #[test]
    fn an_object_that_covers_the_picture_is_no_missing_mask() {
        let masks = fine_masks(8, 208);
        let mut passing = scene(8, 208);
        let light = [1.0, 0.95, 0.7, 0.4, 0.25, 0.4, 0.7, 0.95];
        for (mut frame, light) in passing.outer_iter_mut().zip(light) {
            frame.mapv_inplace(|value| value * light);
        }
        let y = noisy(measure(masks.view(), passing.view()).unwrap(), 0.02, 1).unwrap();
        assert_eq!(codes(&masks, &y), [""; 0]);
    }

    #[test]
    fn parts_that_the_masks_do_not_modulate_are_reported() {
        for seed in 0..3 {
            for masks in [
                fine_masks(8, 140),
                random_squares(10, 140, 140, seed).unwrap().0,
                turning_circle(10, 140, seed),
            ] {
                let scene = scene(masks.dim().0, 140);
                let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, seed).unwrap();
                let place = s![24..64, 72..112];
                let mean = y.mean().unwrap();
                let noise = noisy(Array2::from_elem((40, 40), mean), 0.02, seed).unwrap();
                let other = y.slice(s![80..120, 16..56]).to_owned();
                // A reflection of a lamp that does not pass the aperture.
                let glare = &y.slice(place) + 6.0 * mean;
                let stuck = &noise * 0.06;
                // A smooth spot of light that passes by the masks.
                let veil = Array2::from_shape_fn((140, 140), |(i, j)| {
                    let distance = (i as f32 - 70.0).hypot(j as f32 - 70.0);
                    mean * (-0.5 * (distance / 18.0).powi(2)).exp()
                });
                let parts =
                    [("noise", noise), ("stuck", stuck), ("repeated", other), ("glare", glare)];
                let parts = parts.map(|(name, part)| {
                    let mut y = y.clone();
                    y.slice_mut(place).assign(&part);
                    (name, y)
                });
                for (name, y) in parts.into_iter().chain([("veil", &y + &(veil * 1.5))]) {
                    let found = codes(&masks, &y);
                    assert!(found.contains(&"unmodulated_area"), "{name} {seed}: {found:?}");
                }
                assert!(codes(&masks, &y).is_empty(), "{seed}: {:?}", codes(&masks, &y));
            }
        }
    }

    /// Areas of a picture that are not measured.
    fn areas(side: usize) -> Vec<(&'static str, Array2<bool>)> {
        let area = |is_in: &dyn Fn(usize, usize) -> bool| {
            Array2::from_shape_fn((side, side), |(i, j)| is_in(i, j))
        };
        let middle = side / 4..3 * side / 4;
        let random = iid_masks(1, side, side, 9).unwrap();
        vec![
            ("square", area(&|i, j| middle.contains(&i) && middle.contains(&j))),
            ("half", area(&|_, j| j < side / 2)),
            ("frame", area(&|i, j| i.min(j) < side / 5 || i.max(j) >= side - side / 5)),
            ("stripes", area(&|_, j| j / 12 % 2 == 0)),
            ("random", area(&|i, j| random[[0, i, j]] > 0.5 && (i + j) % 3 > 0)),
        ]
    }

    #[test]
    fn areas_that_are_not_measured_cause_no_finding_and_hide_none() {
        let kinds =
            [fine_masks(8, 144), random_squares(8, 144, 144, 2).unwrap().0, fine_masks(3, 144)];
        for masks in kinds {
            let frames = masks.dim().0;
            let y = noisy(measure(masks.view(), scene(frames, 144).view()).unwrap(), 0.02, 1);
            let y = y.unwrap();
            for (name, area) in areas(144) {
                let name = format!("{name} {frames}");
                let hidden = |y: &Array2<f32>| {
                    let mut y = y.clone();
                    y.zip_mut_with(&area, |y, hidden| *y = if *hidden { f32::NAN } else { *y });
                    y
                };
                let mut unknown = masks.clone();
                for mut mask in unknown.outer_iter_mut() {
                    mask.zip_mut_with(&area, |mask, hidden| {
                        *mask = if *hidden { f32::NAN } else { *mask };
                    });
                }
                let none: [&str; 0] = [];
                assert_eq!(codes_without_dark(&masks, &hidden(&y)), none, "{name}");
                assert_eq!(codes_without_dark(&unknown, &y), none, "{name}");
                let lifted = &y + 0.3 * y.mean().unwrap();
                let found = codes_without_dark(&unknown, &hidden(&lifted));
                assert!(found.contains(&"no_dark"), "{name}: {found:?}");
                assert_eq!(codes(&masks, &hidden(&(&y * 10.0))), ["level"], "{name}");
                let inverted = masks.mapv(|mask| 1.0 - mask);
                assert_eq!(codes(&inverted, &hidden(&y)), ["inverted_masks"], "{name}");
                let (other, _) = random_squares(frames, 144, 144, 100).unwrap();
                assert_eq!(codes(&other, &hidden(&y)), ["foreign_masks"], "{name}");
                let moved = hidden(&y).slice(s![2.., 1..]).to_owned();
                let window = masks.slice(s![.., ..142, ..143]).to_owned();
                assert_eq!(codes(&window, &moved), ["shifted_masks"], "{name}");
            }
        }
    }

    #[test]
    fn a_dark_scene_with_bright_parts_has_a_plausible_level() {
        let masks = fine_masks(8, 208);
        let mut scene = scene(8, 208) * 0.05;
        scene.slice_mut(s![.., 100..124, 100..124]).fill(0.6);
        let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.01, 1).unwrap();
        assert!(codes(&masks, &y).is_empty(), "{:?}", codes(&masks, &y));
        assert_eq!(codes(&masks, &(&y / 10.0)), ["level"]);
        assert_eq!(codes(&masks, &(&y * 10.0)), ["level"]);
    }

    #[test]
    fn a_one_pixel_shift_is_detected_behind_correlated_masks() {
        let masks = turning_circle(10, 140, 3);
        let scene = scene(10, 140);
        let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, 3).unwrap();
        assert!(codes(&masks, &y).is_empty(), "{:?}", codes(&masks, &y));
        let moved = y.slice(s![.., 1..]).to_owned();
        let window = masks.slice(s![.., .., ..139]).to_owned();
        assert_eq!(codes(&window, &moved), ["shifted_masks"]);
    }

    #[test]
    fn masks_that_moved_in_one_half_are_reported() {
        for seed in 0..3 {
            for masks in [
                fine_masks(8, 140),
                random_squares(10, 140, 140, seed).unwrap().0,
                turning_circle(16, 140, seed),
            ] {
                let scene = scene(masks.dim().0, 140);
                let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, seed).unwrap();
                let window = masks.slice(s![.., .., ..139]).to_owned();
                let mut y = y.slice(s![.., ..139]).to_owned();
                assert!(codes(&window, &y).is_empty(), "{seed}: {:?}", codes(&window, &y));
                let whole = measure(masks.view(), scene.view()).unwrap();
                y.slice_mut(s![70.., ..]).assign(&whole.slice(s![70.., 1..]));
                assert_eq!(codes(&window, &y), ["partly_moved_masks"], "{seed}");
            }
        }
    }

    #[test]
    fn noise_in_black_areas_is_not_reported_as_negative() {
        let masks = fine_masks(8, 208);
        let mut scene = scene(8, 208);
        scene.slice_mut(s![.., .., ..104]).fill(0.0);
        let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.08, 1).unwrap();
        let negative = y.iter().filter(|value| **value < 0.0).count() as f64 / y.len() as f64;
        assert!(negative > 0.2, "{negative}");
        assert!(codes(&masks, &y).is_empty(), "{:?}", codes(&masks, &y));
        let lowered = codes(&masks, &(&y - 0.15 * y.mean().unwrap()));
        assert!(lowered.contains(&"negative"), "{lowered:?}");
    }

    #[test]
    fn flat_measurements_show_no_mask_and_have_a_level() {
        let (masks, open) = (fine_masks(8, 208), Array3::ones((8, 208, 208)));
        let flat = |value: f32| Array2::from_elem((208, 208), value);
        for (masks, value, expected) in [
            (&masks, u64::MAX as f32, &["foreign_masks", "level"][..]),
            (&masks, 0.1, &["foreign_masks", "level"]),
            (&masks, 2.1, &["foreign_masks"]),
            (&open, 2.1, &[]),
            (&open, u64::MAX as f32, &["level"]),
        ] {
            assert_eq!(codes(masks, &flat(value)), expected, "{value}");
        }
        assert!(codes(&masks, &flat(-2.0)).contains(&"negative"));
        let mut study = MeasurementStudy::new(8);
        study.add(masks.view(), flat(0.0).view(), (0, 0));
        assert_eq!(study.finish(), None);
    }

    /// Objects on black, with as much noise as light.
    #[test]
    fn noise_of_a_dark_scene_is_not_negative() {
        let masks = fine_masks(8, 136);
        let y = measure(masks.view(), cells(8, 136).view()).unwrap();
        for noise in [0.2, 0.4] {
            let y = noisy(y.clone(), noise, 1).unwrap();
            let found = codes_without_dark(&masks, &y);
            assert!(!found.contains(&"negative"), "{noise}: {found:?}");
            let lowered = codes_without_dark(&masks, &(&y - 0.3));
            assert!(lowered.contains(&"negative"), "{noise}: {lowered:?}");
        }
    }

    /// The strips are cut into pieces, whose scatter gives a standard error.
    #[test]
    fn low_pictures_are_no_mosaic() {
        for (seed, rows) in (0..40).zip([16, 20, 23, 24, 31].into_iter().cycle()) {
            let masks = crate::iid_masks(4, rows, 120, seed).unwrap();
            let scene = Array3::from_shape_fn((4, rows, 120), |(k, i, j)| {
                0.5 + 0.4
                    * ((seed as f32 + i as f32 * 0.4 + k as f32).sin() * (j as f32 * 0.3).cos())
            });
            let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, seed).unwrap();
            let found = codes_without_dark(&masks, &y);
            let is_false = |code: &&str| ["mosaic", "no_dark", "negative_offset"].contains(code);
            assert!(!found.iter().any(is_false), "{rows} rows, seed {seed}: {found:?}");
        }
    }

    /// Strong noise hides masks of low contrast.
    #[test]
    fn masks_that_noise_hides_are_not_foreign() {
        let weak = |masks: Array3<f32>| 0.6 + 0.4 * masks;
        let other = crate::iid_masks(8, 136, 136, 5).unwrap();
        let (masks, other) = (weak(fine_masks(8, 136)), weak(other));
        let y = measure(masks.view(), scene(8, 136).view()).unwrap();
        for (noise, expected) in [(0.0, "foreign_masks"), (2.0, "unverified_masks")] {
            let y = noisy(y.clone(), noise, 3).unwrap();
            assert_eq!(codes(&other, &y), [expected], "other masks, noise {noise}");
            let right = codes(&masks, &y);
            assert_eq!(right.contains(&"unverified_masks"), noise > 0.0, "{right:?}");
        }
    }

    /// A lamp that flickers is no pattern that was not shown.
    #[test]
    fn dim_frames_are_no_error() {
        let masks = fine_masks(4, 136);
        for (light, severity) in [(0.02, Severity::Error), (0.2, Severity::Warning)] {
            let mut scene = scene(4, 136);
            scene.index_axis_mut(ndarray::Axis(0), 2).mapv_inplace(|x| x * light);
            let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.01, 1).unwrap();
            let mut study = MeasurementStudy::new(4);
            study.add(masks.view(), y.view(), (0, 0));
            let found = judge_measurement(&study.finish().unwrap(), true);
            let missing = found.iter().find(|one| one.code == FindingCode::MissingPattern).unwrap();
            assert_eq!((missing.severity, &*missing.frames), (severity, &[2][..]), "{light}");
        }
    }

    /// A missing or wrong dark is noticed in pictures with one or two strips of blocks.
    #[test]
    fn the_dark_of_low_pictures_is_checked() {
        for rows in [16, 24] {
            let (masks, scene) = (fine_masks(8, 136), scene(8, 136));
            let low = s![.., ..rows, ..];
            let y = measure(masks.slice(low), scene.slice(low)).unwrap();
            let y = noisy(y, 0.02, 1).unwrap();
            let masks = masks.slice(low).to_owned();
            assert!(codes_without_dark(&masks, &y).is_empty(), "{rows}");
            let lifted = codes_without_dark(&masks, &(&y + 0.4 * y.mean().unwrap()));
            // With few pixels, grey masks that were made binary look the same.
            assert!(["no_dark", "mask_values"].contains(&lifted[0]), "{rows}: {lifted:?}");
        }
    }

    #[test]
    fn windows_smaller_than_a_block_are_ignored() {
        let mut study = MeasurementStudy::new(2);
        study.add(Array3::zeros((2, 9, 9)).view(), Array2::zeros((9, 9)).view(), (0, 0));
        assert_eq!(study.finish(), None);
    }
}
