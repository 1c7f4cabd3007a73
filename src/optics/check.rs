//! Whether a measurement belongs to its masks.
//!
//! Within a small block a scene is nearly even, so a measurement follows its masks there:
//! `y = sum_k x_k C_k + offset`. Least squares over many blocks, each less its own mean, give the
//! mean brightness x_k of each frame; what the means then leave over is an offset, and masks that are
//! moved against the measurement explain it better when they are moved back.

use ndarray::{Array1, Array2, ArrayView2, ArrayView3, s};

use super::findings::{Finding, Severity};

/// Masks are looked for up to so many pixels away.
pub const REACH: usize = 4;
/// Side of the blocks in which the scene is taken to be even.
const BLOCK: usize = 8;

/// Sums over the windows of a measurement.
#[derive(Debug)]
pub struct MeasurementStudy {
    frames: usize,
    /// `sum C_k' C_l'`, each less its block's mean.
    products: Array2<f64>,
    /// `sum C_k'(p + shift) y'(p)`, by shift and frame.
    matches: Vec<Array1<f64>>,
    square: f64,
    mask_sums: Array1<f64>,
    sum: f64,
    pixels: f64,
    values: u64,
    negative: u64,
}

/// What a measurement tells about its masks. Values have the measurement's full scale divided out.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasurementFigures {
    /// Mean of the measurement.
    pub mean: f64,
    /// Share of values below 0.
    pub negative: f64,
    /// Mean brightness of each frame, where the masks are 1.
    pub brightness: Vec<f64>,
    /// Standard errors of those.
    pub uncertainty: Vec<f64>,
    /// What the measurement has more than its masks explain.
    pub offset: f64,
    /// Standard error of that.
    pub offset_uncertainty: f64,
    /// The shift (rows, columns) of the measurement against its masks that explains it best.
    pub shift: (i32, i32),
    /// Share of the measurement's fine structure that the masks explain at that shift.
    pub explained: f64,
    /// The same without a shift.
    pub explained_unmoved: f64,
}

fn shifts() -> impl Iterator<Item = (usize, usize)> {
    (0..=2 * REACH).flat_map(|row| (0..=2 * REACH).map(move |column| (row, column)))
}

impl MeasurementStudy {
    /// A study of a measurement through `frames` masks.
    pub fn new(frames: usize) -> Self {
        Self {
            frames,
            products: Array2::zeros((frames, frames)),
            matches: shifts().map(|_| Array1::zeros(frames)).collect(),
            square: 0.0,
            mask_sums: Array1::zeros(frames),
            sum: 0.0,
            pixels: 0.0,
            values: 0,
            negative: 0,
        }
    }

    /// Looks at a window of the masks \[B,h,w\] and of the measurement \[h,w\], which has a margin of
    /// [`REACH`] pixels on each side that only masks are read from. Windows too small for a block
    /// tell nothing.
    pub fn add(&mut self, masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) {
        self.values += y.len() as u64;
        self.negative += y.iter().filter(|value| **value < 0.0).count() as u64;
        let (frames, height, width) = masks.dim();
        let inner = |length: usize| length.saturating_sub(2 * REACH) / BLOCK * BLOCK;
        let (rows, columns) = (inner(height), inner(width));
        if frames != self.frames || y.dim() != (height, width) || rows == 0 || columns == 0 {
            return;
        }
        let part = |row: usize, column: usize| s![row..row + rows, column..column + columns];
        let y = y.slice(part(REACH, REACH));
        self.pixels += y.len() as f64;
        self.sum += y.iter().map(|&value| f64::from(value)).sum::<f64>();
        let y = less_block_means(y);
        self.square += y.iter().map(|&value| f64::from(value).powi(2)).sum::<f64>();
        let flat = |array: &Array2<f32>| array.iter().copied().collect::<Array1<f32>>();
        let y = flat(&y);
        let mut unmoved = Array2::zeros((frames, rows * columns));
        for (k, mask) in masks.outer_iter().enumerate() {
            let here = mask.slice(part(REACH, REACH));
            self.mask_sums[k] += here.iter().map(|&value| f64::from(value)).sum::<f64>();
            unmoved.row_mut(k).assign(&flat(&less_block_means(here)));
            for ((row, column), matches) in shifts().zip(&mut self.matches) {
                // Only y has to be less its mean for this: it makes a mean of the mask drop out.
                let moved = mask.slice(part(row, column));
                let product: f32 = moved.iter().zip(&y).map(|(mask, y)| mask * y).sum();
                matches[k] += f64::from(product);
            }
        }
        self.products += &unmoved.dot(&unmoved.t()).mapv(f64::from);
    }

    /// The figures; none if the windows were too small or have no structure.
    pub fn finish(self) -> Option<MeasurementFigures> {
        let negative = self.negative as f64 / (self.values as f64).max(1.0);
        if self.pixels == 0.0 || self.square <= 0.0 {
            return None;
        }
        let inverse = inverse(&self.products)?;
        let explained = |matches: &Array1<f64>| matches.dot(&inverse.dot(matches)) / self.square;
        let best = shifts()
            .zip(&self.matches)
            .map(|(shift, matches)| (shift, explained(matches)))
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        let middle = REACH * (2 * REACH + 1) + REACH;
        let matches = &self.matches[middle];
        let brightness = inverse.dot(matches);
        let unmoved = explained(matches);
        let scatter = self.square * (1.0 - unmoved).max(0.0) / self.pixels;
        let errors: Vec<f64> =
            (0..self.frames).map(|k| (scatter * inverse[[k, k]]).max(0.0).sqrt()).collect();
        let means = &self.mask_sums / self.pixels;
        let mean = self.sum / self.pixels;
        let error = (scatter * means.dot(&inverse.dot(&means))).max(0.0).sqrt();
        let place = |index: usize| REACH as i32 - index as i32;
        Some(MeasurementFigures {
            mean,
            negative,
            offset: mean - brightness.dot(&means),
            offset_uncertainty: error,
            brightness: brightness.to_vec(),
            uncertainty: errors,
            shift: (place(best.0.0), place(best.0.1)),
            explained: best.1,
            explained_unmoved: unmoved,
        })
    }
}

/// The array less the mean of each block of [`BLOCK`] x [`BLOCK`].
fn less_block_means(array: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut result = array.to_owned();
    for mut block in result.exact_chunks_mut((BLOCK, BLOCK)) {
        let mean = block.sum() / block.len() as f32;
        block -= mean;
    }
    result
}

/// The inverse of a symmetric matrix that should be positive, by elimination; a millionth of its
/// mean diagonal is added, so that masks that are alike do not stop it. None if it is all 0.
fn inverse(matrix: &Array2<f64>) -> Option<Array2<f64>> {
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

/// What is wrong with a measurement; `saturated` is the share of its pixels that were full, if it is
/// known when they are.
pub fn judge_measurement(figures: &MeasurementFigures, saturated: Option<f64>) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(share) = saturated.filter(|share| *share > 0.001) {
        findings.push(Finding::new(
            "saturated",
            if share > 0.01 { Severity::Error } else { Severity::Warning },
            format!(
                "{:.2} % of the pixels are full: frames come out too dark there",
                share * 100.0
            ),
            "expose more shortly or close the aperture",
        ));
    }
    if figures.negative > 0.01 {
        findings.push(Finding::new(
            "negative",
            if figures.negative > 0.1 { Severity::Error } else { Severity::Warning },
            format!("{:.1} % of the values are below 0", figures.negative * 100.0),
            "the dark was brighter than the measurement: take scene_black at the measurement's exposure",
        ));
    }
    let moved = figures.shift != (0, 0)
        && figures.explained > 1.2 * figures.explained_unmoved
        && figures.explained > 0.02;
    if moved {
        let (rows, columns) = figures.shift;
        findings.push(Finding::new(
            "shifted_masks",
            Severity::Error,
            format!(
                "the masks explain {:.0} % of the fine structure when they are moved by {rows} rows and \
                 {columns} columns, and {:.0} % as they are",
                figures.explained * 100.0,
                figures.explained_unmoved * 100.0
            ),
            "something has moved since the calibration: calibrate again",
        ));
        // What follows from the fit means nothing then.
        return findings;
    }
    if figures.explained_unmoved < 0.02 {
        findings.push(Finding::new(
            "foreign_masks",
            Severity::Error,
            format!(
                "the masks explain {:.1} % of the measurement's fine structure: it was hardly taken \
                 through them",
                figures.explained_unmoved * 100.0
            ),
            "name the calibration that belongs to this measurement, or calibrate again",
        ));
        return findings;
    }
    findings.extend(missing(figures));
    findings.extend(level(figures));
    findings
}

/// Frames without light: their patterns were not shown.
fn missing(figures: &MeasurementFigures) -> Option<Finding> {
    let mut sorted = figures.brightness.clone();
    sorted.sort_by(f64::total_cmp);
    let typical = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let dark = |k: &usize| {
        let (value, error) = (figures.brightness[*k], figures.uncertainty[*k]);
        value + 2.0 * error < 0.4 * typical && value < 0.25 * typical
    };
    let frames: Vec<usize> = (0..figures.brightness.len()).filter(dark).collect();
    if frames.is_empty() {
        return None;
    }
    let detail = format!(
        "frames {frames:?} (counted from 0) have no light: the LCoS did not show their patterns, or \
         the scene was dark then"
    );
    let remedy = "check the pattern sequence of the LCoS and its trigger";
    Some(Finding { frames, ..Finding::new("missing_pattern", Severity::Error, detail, remedy) })
}

fn level(figures: &MeasurementFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    let level = figures.brightness.iter().sum::<f64>() / figures.brightness.len().max(1) as f64;
    let share = figures.offset / figures.mean;
    if figures.mean > 0.0
        && share.abs() > 0.15
        && figures.offset.abs() > 4.0 * figures.offset_uncertainty
    {
        let what = if share > 0.0 { "more" } else { "less" };
        findings.push(Finding::new(
            "wrong_dark",
            Severity::Error,
            format!(
                "the measurement has {:.0} % {what} light than its masks explain: the dark that was \
                 subtracted is not its own",
                share.abs() * 100.0
            ),
            "take scene_black at the measurement's exposure, the LCoS all black, and subtract that",
        ));
    }
    if !(0.005..=1.5).contains(&level) {
        findings.push(Finding::new(
            "level",
            Severity::Warning,
            format!("the scene's mean brightness is {level:.3} times the full scale"),
            "state the measurement's full_scale for its exposure; a scene lies between 0 and 1",
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, s};

    use super::{MeasurementStudy, judge_measurement};
    use crate::optics::{measure, noisy, random_squares};

    /// A scene with a moving disc on a textured ground.
    fn scene(frames: usize, side: usize) -> Array3<f32> {
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let texture = 0.4 + 0.1 * ((i as f32 / 5.0).sin() + (j as f32 / 7.0).cos());
            let at = (i as f32 - 60.0 - 3.0 * k as f32).hypot(j as f32 - 70.0);
            if at < 20.0 { 0.9 } else { texture }
        })
    }

    fn codes(masks: &Array3<f32>, y: &Array2<f32>) -> Vec<&'static str> {
        let mut study = MeasurementStudy::new(masks.dim().0);
        study.add(masks.view(), y.view());
        let figures = study.finish().unwrap();
        judge_measurement(&figures, Some(0.0)).iter().map(|finding| finding.code).collect()
    }

    #[test]
    fn a_good_measurement_passes_and_each_fault_is_named() {
        for seed in 0..3 {
            let (masks, _) = random_squares(10, 140, 140, seed).unwrap();
            let scene = scene(10, 140);
            let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, seed).unwrap();
            assert!(codes(&masks, &y).is_empty(), "seed {seed}: {:?}", codes(&masks, &y));
            assert_eq!(codes(&masks, &(&y + 1.0)), ["wrong_dark"], "seed {seed}");
            assert!(codes(&masks, &(&y - 0.8)).contains(&"wrong_dark"), "seed {seed}");
            let moved = y.slice(s![2.., 1..]).to_owned();
            let seen = codes(&masks.slice(s![.., ..138, ..139]).to_owned(), &moved);
            assert_eq!(seen, ["shifted_masks"], "seed {seed}");
            let mut dark = scene.clone();
            dark.index_axis_mut(ndarray::Axis(0), 4).fill(0.0);
            let lost = measure(masks.view(), dark.view()).unwrap();
            assert_eq!(codes(&masks, &lost), ["missing_pattern"], "seed {seed}");
            let (other, _) = random_squares(10, 140, 140, seed + 100).unwrap();
            assert_eq!(codes(&other, &y), ["foreign_masks"], "seed {seed}");
            assert_eq!(codes(&masks, &(&y * 4.0)), ["level"], "seed {seed}");
        }
    }

    #[test]
    fn small_windows_tell_nothing() {
        let mut study = MeasurementStudy::new(2);
        study.add(Array3::zeros((2, 9, 9)).view(), Array2::zeros((9, 9)).view());
        assert_eq!(study.finish(), None);
    }
}
