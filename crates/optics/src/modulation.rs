//! Finds parts of a picture whose light does not follow the masks, as behind glare or where a sensor repeats old values.
//!
//! The brightness x_k of the frames predicts the modulation `m = sum_k x_k C_k'` of each block and, with the light of its
//! neighbourhood, the size of that modulation. The measured size is the projection of `y'` on `m`. Their ratio is 1 where the
//! masks modulate all light and 0 where they modulate none.

use std::ops::Range;

use ndarray::Array1;

use super::measurement_fit::{BLOCK, Strip};

/// Neighbourhoods that are reported if the masks modulate too little of the light in too many of them.
struct Rule {
    /// Side of a neighbourhood, in blocks.
    side: usize,
    /// The ratio with its standard errors is below this limit.
    limit: f64,
    /// The light that the masks do not modulate is at least this share of the mean light. An offset of 3 % is not reported.
    light: f64,
}

/// The smaller neighbourhoods show parts of the sensor without modulation, also dark ones, the larger ones light that passes by
/// the masks. Of 84 scenes, each with seven contrasts from natural to a few bright spots, one behind right masks is reported.
/// Swept in `research/NOTEBOOK.md`, "Stray light".
const RULES: [Rule; 2] =
    [Rule { side: 3, limit: 0.6, light: 0.04 }, Rule { side: 5, limit: 0.85, light: 0.15 }];
/// Smallest share of the judged neighbourhoods that is reported.
const MIN_SHARE: f64 = 0.005;
/// Standard errors that are added to the ratio of a neighbourhood.
const ERRORS: f64 = 4.0;
/// Neighbourhoods whose masks have less modulation than this share of the mean are not judged.
const MIN_MODULATION: f64 = 0.1;
/// Blocks with a smaller share of measured pixels are left out.
const MIN_MEASURED: f64 = 0.5;

/// Consecutive strips of a window.
#[derive(Debug)]
pub(super) struct Run {
    /// The indices of these strips in the study.
    pub(super) strips: Range<usize>,
    /// Row and column of its first pixel.
    pub(super) place: [usize; 2],
}

/// Parts of the picture whose light the masks hardly modulate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unmodulated {
    /// Their share of the area that was judged.
    pub share: f64,
    /// Row and column of the middle of the one with the least modulation, in pixels.
    pub place: [usize; 2],
}

/// Sums over the blocks of a neighbourhood.
#[derive(Clone, Copy, Default)]
struct Sums {
    light: f64,
    /// The light that the masks predict.
    predicted: f64,
    /// `sum m^2`, `sum m y'` and `sum y'^2` over the pixels.
    modulation: f64,
    product: f64,
    energy: f64,
    /// `sum a^2`, `sum a b` and `sum b^2` over the blocks, where a and b are their `sum m y'` and `sum m^2`.
    products: [f64; 3],
    blocks: f64,
}

impl Sums {
    fn add(&mut self, block: &Self) {
        self.light += block.light;
        self.predicted += block.predicted;
        self.modulation += block.modulation;
        self.product += block.product;
        self.energy += block.energy;
        let [a, b] = [block.product, block.modulation];
        for (sum, product) in self.products.iter_mut().zip([a * a, a * b, b * b]) {
            *sum += product;
        }
        self.blocks += block.blocks;
    }

    /// The measured modulation relative to that of the light, and its standard error: the larger of those from the pixels
    /// and from the scatter between blocks, in which the texture of a scene is correlated.
    fn ratio(&self) -> (f64, f64) {
        let full = self.light / self.predicted * self.modulation;
        let slope = self.product / self.modulation;
        let pixels = self.blocks * (BLOCK * BLOCK) as f64;
        let variance = (self.energy - slope * self.product).max(0.0) / pixels;
        let [aa, ab, bb] = self.products;
        let scatter = (aa - 2.0 * slope * ab + slope * slope * bb).max(0.0);
        let error = (variance * self.modulation).max(scatter * self.blocks / (self.blocks - 1.0));
        (self.product / full, error.sqrt() / full)
    }
}

/// Sums of each block of a strip; `None` for blocks that were hardly measured.
fn blocks(strip: &Strip, brightness: &Array1<f64>, offset: f64) -> Vec<Option<Sums>> {
    let predicted = brightness.dot(&strip.mask_means);
    let mut sums: Vec<_> = (0..predicted.len())
        .map(|block| Sums {
            light: strip.y_means[block] - offset,
            predicted: predicted[block],
            blocks: 1.0,
            ..Sums::default()
        })
        .collect();
    let modulation = brightness.mapv(|value| value as f32).dot(&strip.masks);
    for ((block, m), y) in strip.blocks().zip(&modulation).zip(&strip.y) {
        let [m, y] = [f64::from(*m), f64::from(*y)];
        sums[block].modulation += m * m;
        sums[block].product += m * y;
        sums[block].energy += y * y;
    }
    let measured = strip.measured.iter().zip(sums);
    measured.map(|(measured, sums)| (*measured > MIN_MEASURED).then_some(sums)).collect()
}

/// The sums and the middle of each neighbourhood of blocks that were measured.
fn neighbourhoods(run: &Run, rows: &[Vec<Option<Sums>>], side: usize) -> Vec<([usize; 2], Sums)> {
    let mut found = Vec::new();
    for (row, rows) in rows.windows(side).enumerate() {
        for column in 0..(rows[0].len() + 1).saturating_sub(side) {
            let mut sums = Sums::default();
            let all = rows.iter().flat_map(|row| &row[column..column + side]);
            all.flatten().for_each(|block| sums.add(block));
            if sums.blocks == (side * side) as f64 {
                let middle = |first: usize, at: usize| first + (2 * at + side) * BLOCK / 2;
                let place = [middle(run.place[0], row), middle(run.place[1], column)];
                found.push((place, sums));
            }
        }
    }
    found
}

/// The parts of the picture that the masks hardly modulate; `None` if there are none.
///
/// `brightness` is fitted with equal weights: others favour dark blocks, which show none in a scene of few bright spots.
pub(super) fn unmodulated(
    strips: &[Strip],
    runs: &[Run],
    brightness: &Array1<f64>,
    offset: f64,
) -> Option<Unmodulated> {
    let sums: Vec<Vec<_>> = runs
        .iter()
        .map(|run| {
            let strips = strips[run.strips.clone()].iter();
            strips.map(|strip| blocks(strip, brightness, offset)).collect()
        })
        .collect();
    let reported = |rule: Rule| {
        let runs = runs.iter().zip(&sums);
        let places: Vec<_> =
            runs.flat_map(|(run, rows)| neighbourhoods(run, rows, rule.side)).collect();
        let mean = |value: fn(&Sums) -> f64| {
            places.iter().map(|(_, sums)| value(sums)).sum::<f64>() / places.len() as f64
        };
        let [light, modulation] = [mean(|sums| sums.light), mean(|sums| sums.modulation)];
        let is_judged = |sums: &Sums| {
            sums.light > 0.0
                && sums.modulation > MIN_MODULATION * modulation
                && sums.predicted > 0.0
        };
        let judged = || places.iter().filter(|(_, sums)| is_judged(sums));
        let low = judged().filter_map(|(place, sums)| {
            let (ratio, error) = sums.ratio();
            let ratio = ratio + ERRORS * error;
            let is_low =
                ratio < rule.limit && sums.light * (1.0 - ratio) > rule.light * light.max(0.0);
            is_low.then_some((*place, ratio))
        });
        let low: Vec<_> = low.collect();
        let (place, _) = low.iter().copied().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let share = low.len() as f64 / judged().count() as f64;
        (share > MIN_SHARE).then_some(Unmodulated { share, place })
    };
    RULES.into_iter().find_map(reported)
}
