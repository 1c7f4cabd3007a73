//! Checks of a calibration: of its masks, and of the captures they were computed from.

use std::collections::BTreeSet;

use super::{
    Average, Calibrator, Correlations, ExpectedOrder, Finding, FindingCode, MaskFigures, RawMask,
    Reordering, flatness, pattern_overlap, reordering,
};
use ndarray::{ArrayView2, ArrayView3};
use serde::{Deserialize, Serialize};

/// Statistics of the captures of one pattern.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[schemars(rename = "PatternReport")]
pub struct PatternFigures {
    /// Mean share of the light of the white image.
    pub light: f64,
    /// Share of the pixels at or below 0.
    pub not_positive: f64,
    /// Share of the pixels below 0 by more than noise explains.
    pub negative: f64,
    /// Standard deviation of a mask value due to noise; `None` without repeats.
    pub noise: Option<f64>,
    /// Share of saturated pixels; `None` if the saturation level is unknown.
    pub saturated: Option<f64>,
    /// Relative change of the light during the repeats.
    pub drift: f64,
}

impl PatternFigures {
    /// Statistics of a mask. `saturated` is the number of saturated pixels of its averaged capture.
    pub fn new(mask: &RawMask, saturated: Option<u64>, drift: f64) -> Self {
        let pixels = measured(mask.values.view()).count().max(1) as f64;
        Self {
            light: mask.mean,
            not_positive: mask.not_positive as f64 / pixels,
            negative: mask.negative as f64 / pixels,
            noise: mask.noise,
            saturated: saturated.map(|count| count as f64 / pixels),
            drift,
        }
    }
}

/// Values of the pixels that were measured.
fn measured(image: ArrayView2<'_, f32>) -> impl Iterator<Item = &f32> {
    image.into_iter().filter(|value| !value.is_nan())
}

/// Statistics of all captures of a calibration. Levels are stored values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct CaptureFigures {
    /// Mean of the white image.
    pub white_level: f64,
    /// Mean of the black image.
    pub black_level: f64,
    /// Mean of the black image with the lithography mask in place; `None` if Eq. 7 was used.
    pub black_with_mask_level: Option<f64>,
    /// Illumination of the darkest part over that of the brightest.
    pub illumination_flatness: Option<f64>,
    /// Share of saturated pixels of the white image; `None` if the saturation level is unknown.
    pub white_saturated: Option<f64>,
    /// Share of the pixels whose white is not above their black.
    pub denominator_not_positive: f64,
    /// Share of the pixels whose white is above their black, but by too little to divide by.
    pub denominator_too_dark: f64,
    /// Statistics of each pattern, in order.
    pub patterns: Vec<PatternFigures>,
}

impl CaptureFigures {
    /// Statistics of the reference images of a calibrator and of the patterns.
    pub fn new(calibrator: &Calibrator, patterns: Vec<PatternFigures>) -> Self {
        let references = calibrator.references();
        let pixels = measured(calibrator.illumination()).count().max(1) as f64;
        let mean = |image: &Average| {
            measured(image.mean.view()).map(|&value| f64::from(value)).sum::<f64>() / pixels
        };
        Self {
            patterns,
            denominator_not_positive: calibrator.not_positive() as f64 / pixels,
            denominator_too_dark: calibrator.too_dark() as f64 / pixels,
            white_saturated: references.white.saturated.map(|count| count as f64 / pixels),
            white_level: mean(&references.white),
            black_level: mean(&references.black),
            black_with_mask_level: references.black_with_mask.as_ref().map(mean),
            illumination_flatness: flatness(&calibrator.illumination()),
        }
    }

    /// Indices of the patterns for which `condition` holds.
    fn patterns_where(&self, condition: impl Fn(&PatternFigures) -> bool) -> Vec<usize> {
        (0..self.patterns.len()).filter(|&k| condition(&self.patterns[k])).collect()
    }
}

/// Checks masks. `patterns` \[B,h,w\] are the intended aperture patterns, if they are known.
pub fn judge_masks(figures: &MaskFigures, patterns: Option<ArrayView3<'_, f32>>) -> Vec<Finding> {
    let mut findings = Vec::new();
    findings.extend(defective_pixels(figures));
    findings.extend(one_dimensional(figures));
    findings.extend(uneven_patterns(figures));
    findings.extend(repeated_patterns(figures));
    if let Some(Correlations { mean, .. }) =
        figures.correlations().filter(|correlations| correlations.mean > 0.75)
    {
        findings.push(Finding::new(
            FindingCode::Correlated,
            format!(
                "the mean correlation of the masks is {mean:.2}: the frames can hardly be separated"
            ),
        ));
    }
    if let Some(finding) = mask_scale(figures.largest) {
        findings.push(finding);
    } else if figures.mean_deviation() < 0.03 && figures.frame_means.len() > 1 {
        findings.push(Finding::new(
            FindingCode::WeakModulation,
            format!(
                "the mean standard deviation of a pixel over the masks is {:.3}; random squares have about 0.13",
                figures.mean_deviation()
            ),
        ));
    }
    let low = figures.percentile_1;
    if low > 0.15 {
        findings.push(Finding::new(
            FindingCode::Pedestal,
            format!(
                "99 % of the mask values are above {low:.2}, but a closed mask pixel should be near 0: the dark \
                 frames contain too little of the leakage"
            ),
        ));
    }
    findings.extend(swapped_order(figures, patterns));
    findings
}

/// The largest mask value is near 1 in any optics: the most open pixel passes nearly all light.
const MIN_LARGEST_MASK: f32 = 0.5;

/// Masks with values far below their full scale.
pub(super) fn mask_scale(largest: f32) -> Option<Finding> {
    (largest > 0.0 && largest < MIN_LARGEST_MASK).then(|| {
        Finding::new(
            FindingCode::MaskScale,
            format!(
                "the largest mask value is {largest:.4} of the full scale, but should be near 1: the masks probably \
                 have fewer bits than their data type"
            ),
        )
    })
}

/// Share of the pixels from which dark areas are reported.
const MIN_DARK_AREA: f64 = 0.001;

/// Pixels that are dark in every mask, and pixels that are open in every mask, if there are more of them than chance
/// explains. Of independent masks that are half open, one pixel in 2^B is dark in all.
fn defective_pixels(figures: &MaskFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    let pixels = figures.measured_pixels.max(1) as f64;
    let (area, chance) = (figures.dark_area as f64 / pixels, figures.dead_by_chance);
    let dead = figures.dead_pixels as f64 / pixels;
    if chance.is_exceeded_by(dead - area) || area > MIN_DARK_AREA {
        let detail = format!(
            "{:.2} % of the pixels are dark in every mask and can't be reconstructed; {:.2} % are expected by chance, and \
             {:.2} % lie in dark areas",
            dead * 100.0,
            chance.share * 100.0,
            area * 100.0
        );
        // A dark area, for example one that the light of the aperture does not reach, spoils no other pixel.
        let grave = dead - area - chance.share > 0.05;
        findings.push(Finding::new(FindingCode::DeadPixels, detail).escalate_if(grave));
    }
    let (stuck, chance) = (figures.stuck_pixels as f64 / pixels, figures.stuck_by_chance);
    if chance.is_exceeded_by(stuck) && figures.frame_means.len() > 1 {
        findings.push(Finding::new(
            FindingCode::StuckPixels,
            format!(
                "{:.2} % of the pixels are open in every mask and do not follow the patterns; {:.2} % are expected by \
                 chance",
                stuck * 100.0,
                chance.share * 100.0
            ),
        ));
    }
    findings
}

/// Masks that vary along the rows or along the columns, but not along both.
fn one_dimensional(figures: &MaskFigures) -> Option<Finding> {
    let (rows, columns) = (figures.variance_between_rows, figures.variance_between_columns);
    let (share, line) = if rows > columns { (rows, "row") } else { (columns, "column") };
    (share > 0.8).then(|| {
        Finding::new(
            FindingCode::OneDimensional,
            format!(
                "{:.0} % of the masks' variance is between {line}s: the pixels of a {line} are nearly equal, so \
                 frames can't be separated along it",
                share * 100.0
            ),
        )
    })
}

/// Patterns that are much darker or brighter than the median pattern.
fn uneven_patterns(figures: &MaskFigures) -> Vec<Finding> {
    let mut sorted = figures.frame_means.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let patterns_where = |condition: &dyn Fn(f64) -> bool| -> Vec<usize> {
        (0..figures.frame_means.len()).filter(|&k| condition(figures.frame_means[k])).collect()
    };
    let dark = patterns_where(&|mean| mean < 0.1 * median);
    let uneven = patterns_where(&|mean| mean >= 0.1 * median && (mean / median - 1.0).abs() > 0.3);
    let mut findings = Vec::new();
    if !dark.is_empty() {
        let detail = format!(
            "patterns {dark:?} (counted from 0) let no light through: they were probably not shown"
        );
        let finding = Finding::new(FindingCode::MissingPattern, detail).with_frames(dark);
        findings.push(finding.escalate_if(true));
    }
    if !uneven.is_empty() {
        let detail = format!(
            "patterns {uneven:?} (counted from 0) are more than 30 % brighter or darker than the median pattern"
        );
        findings.push(Finding::new(FindingCode::UnevenPatterns, detail).with_frames(uneven));
    }
    findings
}

/// Two masks with a correlation above this value show the same pattern.
const SAME_PATTERN: f64 = 0.98;
/// Patterns change slowly if the median of `1 - correlation` of neighbouring masks is below this value.
const SLOW_CHANGE: f64 = 0.05;
/// Among slowly changing patterns, two masks show the same one if their `1 - correlation` is below this share of the
/// median between neighbours.
const REPEATED_SHARE: f64 = 0.3;

/// Masks that show the same pattern. A pattern that turns by little from frame to frame makes all neighbours similar,
/// so the threshold adapts to the median step between neighbours.
fn repeated_patterns(figures: &MaskFigures) -> Option<Finding> {
    let correlation = &figures.correlation;
    let count = correlation.nrows();
    let mut steps: Vec<f64> = (1..count).map(|k| 1.0 - correlation[[k - 1, k]]).collect();
    steps.sort_by(f64::total_cmp);
    let step = steps.get(steps.len() / 2).copied().unwrap_or(1.0);
    let slow = step < SLOW_CHANGE
        && figures.correlations().is_some_and(|correlations| correlations.mean < 1.0 - SLOW_CHANGE);
    let limit = if slow { 1.0 - REPEATED_SHARE * step } else { SAME_PATTERN };
    let repeated =
        |((k, l), value): ((usize, usize), &f64)| (k < l && *value > limit).then_some((k, l));
    let pairs: Vec<(usize, usize)> = correlation.indexed_iter().filter_map(repeated).collect();
    if pairs.is_empty() {
        return None;
    }
    let frames: BTreeSet<usize> = pairs.iter().flat_map(|&(k, l)| [k, l]).collect();
    let detail = format!(
        "masks {pairs:?} (counted from 0) are identical: one pattern was recorded twice, and another is missing"
    );
    Some(
        Finding::new(FindingCode::RepeatedPattern, detail)
            .with_frames(frames.into_iter().collect()),
    )
}

/// Masks whose order contradicts the known patterns, or a pattern that turns evenly.
fn swapped_order(figures: &MaskFigures, patterns: Option<ArrayView3<'_, f32>>) -> Option<Finding> {
    let expected = match patterns {
        Some(patterns) => ExpectedOrder::Overlap(pattern_overlap(patterns)),
        None => ExpectedOrder::Turning,
    };
    let Reordering { swaps, before, after } = reordering(figures.correlation.view(), &expected)?;
    let detail = format!(
        "masks {swaps:?} (counted from 0) are interchanged: swapping them raises the agreement between mask \
         correlations and patterns from {before:.2} to {after:.2}"
    );
    let frames = swaps.iter().flat_map(|&(k, l)| [k, l]).collect();
    Some(Finding::new(FindingCode::SwappedOrder, detail).with_frames(frames))
}

/// Largest mean brightness of a pattern relative to the white image.
const MAX_PATTERN_LIGHT: f64 = 1.5;

/// Checks the captures of a calibration.
pub fn judge_captures(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = saturation(figures);
    let lost = figures.denominator_not_positive + figures.denominator_too_dark;
    if lost > 0.001 {
        let detail = format!(
            "in {:.2} % of the pixels the white image is too dark: not above the black one in {:.2} %, hardly above \
             it in {:.2} %",
            lost * 100.0,
            figures.denominator_not_positive * 100.0,
            figures.denominator_too_dark * 100.0
        );
        findings.push(Finding::new(FindingCode::DarkIllumination, detail).escalate_if(lost > 0.05));
    }
    let brightest = figures.patterns.iter().map(|pattern| pattern.light).fold(0.0, f64::max);
    if brightest > MAX_PATTERN_LIGHT {
        let detail = format!(
            "a pattern is {brightest:.1} times as bright as the white image, which has all patterns' light: the exposures \
             differ, or white and black are interchanged"
        );
        findings.push(Finding::new(FindingCode::DarkIllumination, detail));
    }
    findings.extend(wrong_dark(figures));
    if let Some(flatness) = figures.illumination_flatness.filter(|flatness| *flatness < 0.5) {
        findings.push(Finding::new(
            FindingCode::UnevenIllumination,
            format!(
                "the darkest part of the image receives {:.0} % of the light of the brightest part",
                flatness * 100.0
            ),
        ));
    }
    let noise: Vec<f64> = figures.patterns.iter().filter_map(|pattern| pattern.noise).collect();
    let mean = figures.patterns.iter().map(|pattern| pattern.light).sum::<f64>()
        / figures.patterns.len().max(1) as f64;
    let mean_noise = noise.iter().sum::<f64>() / noise.len().max(1) as f64;
    if noise.is_empty() {
        let detail = "some captures have no repeats, so the noise of the masks is unknown";
        findings.push(Finding::new(FindingCode::NoRepeats, detail));
    } else if mean_noise > 0.05 * mean {
        let detail =
            format!("the noise is {:.1} % of the mean mask value", mean_noise / mean * 100.0);
        findings.push(Finding::new(FindingCode::NoisyMasks, detail));
    }
    let drifting = figures.patterns_where(|pattern| pattern.drift > 0.02);
    if !drifting.is_empty() {
        let detail = format!(
            "the light changed by more than 2 % during the repeats of patterns {drifting:?} (counted from 0)"
        );
        findings.push(Finding::new(FindingCode::LightDrift, detail).with_frames(drifting));
    }
    findings
}

fn saturation(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(share) = figures.white_saturated.filter(|share| *share > 0.001) {
        let detail = format!(
            "{:.2} % of the pixels of the white image are saturated: masks are too bright there",
            share * 100.0
        );
        findings.push(Finding::new(FindingCode::SaturatedWhite, detail).escalate_if(share > 0.01));
    }
    let frames =
        figures.patterns_where(|pattern| pattern.saturated.is_some_and(|share| share > 0.001));
    if !frames.is_empty() {
        let detail = format!(
            "more than 0.1 % of the pixels are saturated in patterns {frames:?} (counted from 0)"
        );
        findings.push(Finding::new(FindingCode::SaturatedPatterns, detail).with_frames(frames));
    }
    findings
}

/// Signs that the dark frames were recorded under other conditions than the captures.
fn wrong_dark(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    let frames = figures.patterns_where(|pattern| pattern.negative > 0.01);
    if !frames.is_empty() {
        let largest = figures.patterns.iter().map(|pattern| pattern.negative).fold(0.0, f64::max);
        let detail = format!(
            "the dark frames are brighter than the captures of patterns {frames:?} (counted from 0), by more than \
             noise, in up to {:.1} % of the pixels",
            largest * 100.0
        );
        findings.push(
            Finding::new(FindingCode::WrongDark, detail).with_frames(frames).escalate_if(true),
        );
    }
    let (white, black) = (figures.white_level, figures.black_level);
    if let Some(with_mask) = figures.black_with_mask_level
        && with_mask > black + 0.02 * (white - black).abs()
    {
        let detail = format!(
            "`black_with_mask` (mean {with_mask:.1}) is brighter than `black` (mean {black:.1}), although a mask only \
             removes light; the mean of `white` is {white:.1}"
        );
        findings.push(Finding::new(FindingCode::WrongDark, detail).escalate_if(true));
    }
    findings
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Axis, concatenate, s};

    use super::judge_masks;
    use crate::iid::iid_masks;
    use crate::masks::turning_circle;
    use crate::{FindingCode, MaskStudy};

    /// The frames that are reported as repeated, if any.
    fn repeated(masks: &Array3<f32>) -> Option<Vec<usize>> {
        let (frames, height, width) = masks.dim();
        let mut study = MaskStudy::new(frames, height, width);
        study.add(masks.view()).unwrap();
        let findings = judge_masks(&study.finish().unwrap(), None);
        findings
            .into_iter()
            .find(|finding| finding.code == FindingCode::RepeatedPattern)
            .map(|finding| finding.frames)
    }

    /// With 24 frames or more, neighbouring patterns of a turning circle are nearly equal.
    #[test]
    fn repeated_patterns_are_distinguished_from_slowly_turning_ones() {
        for count in [6, 24, 48] {
            let masks = turning_circle(count, 96, 3);
            assert_eq!(repeated(&masks), None, "{count}");
            let mut twice = masks.clone();
            twice.slice_mut(s![3, .., ..]).assign(&masks.slice(s![2, .., ..]));
            assert_eq!(repeated(&twice), Some(vec![2, 3]), "{count}");
            let first = masks.slice(s![..1, .., ..]);
            let all = concatenate(Axis(0), &[first; 4]).unwrap();
            assert_eq!(repeated(&all), Some(vec![0, 1, 2, 3]), "{count}");
        }
    }

    /// The findings on masks [B,H,W].
    fn codes(masks: &Array3<f32>) -> Vec<FindingCode> {
        let (frames, height, width) = masks.dim();
        let mut study = MaskStudy::new(frames, height, width);
        study.add(masks.view()).unwrap();
        let findings = judge_masks(&study.finish().unwrap(), None);
        findings.into_iter().map(|finding| finding.code).collect()
    }

    /// Squares of `side` pixels, each open in each mask with the probability 1/2.
    fn random_squares(frames: usize, size: usize, side: usize, seed: u64) -> Array3<f32> {
        let cells = iid_masks(frames, size / side, size / side, seed).unwrap();
        Array3::from_shape_fn((frames, size, size), |(k, i, j)| cells[[k, i / side, j / side]])
    }

    #[test]
    fn independent_masks_have_no_defective_pixels() {
        use FindingCode::{DeadPixels, StuckPixels};
        let defective = |masks: &Array3<f32>| -> Vec<FindingCode> {
            let mut found = codes(masks);
            found.retain(|code| [DeadPixels, StuckPixels].contains(code));
            found
        };
        for (frames, side) in [(4, 1), (8, 1), (8, 4), (16, 1), (6, 8)] {
            for seed in 0..10 {
                let masks = random_squares(frames, 128, side, seed);
                assert_eq!(defective(&masks), [], "{frames} {side} {seed}");
            }
        }
        // Dust of 2 % of the area, and hot pixels, are more than chance.
        for (frames, side) in [(8, 1), (8, 4), (16, 1)] {
            let mut masks = random_squares(frames, 128, side, 1);
            masks.slice_mut(s![.., 40..60, 40..58]).fill(0.0);
            assert_eq!(defective(&masks), [DeadPixels], "{frames} {side}");
            masks.slice_mut(s![.., 70..90, 40..58]).fill(1.0);
            assert_eq!(defective(&masks), [DeadPixels, StuckPixels], "{frames} {side}");
        }
    }
}
