//! What is wrong with a calibration or a measurement, why it matters, and what to do.

use super::{
    Calibrator, Expected, MaskFigures, RawMask, Reordered, flatness, pattern_likeness, reordered,
};
use ndarray::ArrayView3;
use serde::{Deserialize, Serialize};

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Results will be worse than they could be.
    Warning,
    /// Results will be wrong.
    Error,
}

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// Its name, which never changes, for programs to rely on.
    pub code: &'static str,
    /// How bad it is.
    pub severity: Severity,
    /// What was seen, with its numbers.
    pub detail: String,
    /// What to do.
    pub remedy: &'static str,
    /// The patterns or frames that it is about, counted from 0.
    pub frames: Vec<usize>,
}

impl Finding {
    pub(super) fn new(
        code: &'static str,
        severity: Severity,
        detail: String,
        remedy: &'static str,
    ) -> Self {
        Self { code, severity, detail, remedy, frames: Vec::new() }
    }

    fn about(mut self, frames: Vec<usize>) -> Self {
        self.frames = frames;
        self
    }
}

/// What is known of the captures of one pattern once its mask is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatternFigures {
    /// Mean of the mask before it is divided by the largest value: share of the white.
    pub mean: f64,
    /// Share of good pixels at or below 0.
    pub not_positive: f64,
    /// Share of good pixels that are too far below 0 for noise.
    pub negative: f64,
    /// Standard deviation that noise gives a value; none without repeats.
    pub noise: Option<f64>,
    /// Share of pixels that were full; none if nobody knows when they are.
    pub saturated: Option<f64>,
    /// Change of the light during the repeats.
    pub drift: f64,
}

impl PatternFigures {
    /// Of a mask of `pixels` pixels and the average that it was made of.
    pub fn new(mask: &RawMask, saturated: Option<u64>, drift: f64) -> Self {
        let pixels = mask.values.len().max(1) as f64;
        Self {
            mean: mask.mean,
            not_positive: mask.not_positive as f64 / pixels,
            negative: mask.negative as f64 / pixels,
            noise: mask.noise,
            saturated: saturated.map(|count| count as f64 / pixels),
            drift,
        }
    }
}

/// What the captures of a calibration tell beyond its masks.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureFigures {
    /// Of each pattern.
    pub patterns: Vec<PatternFigures>,
    /// Share of pixels whose white is not above their black.
    pub denominator_not_positive: f64,
    /// Share of further pixels whose white is hardly above their black.
    pub denominator_too_dark: f64,
    /// Share of pixels of the white that were full; none if nobody knows when they are.
    pub white_saturated: Option<f64>,
    /// Mean of the white, the black and the black with mask, as stored.
    pub levels: (f64, f64, Option<f64>),
    /// The illumination's darkest over its brightest part.
    pub flatness: Option<f64>,
}

impl CaptureFigures {
    /// Of reference images and patterns.
    pub fn new(calibrator: &Calibrator, patterns: Vec<PatternFigures>) -> Self {
        let references = calibrator.references();
        let pixels = calibrator.illumination().len().max(1) as f64;
        let mean = |image: &super::Average| {
            image.mean.iter().map(|&value| f64::from(value)).sum::<f64>() / pixels
        };
        Self {
            patterns,
            denominator_not_positive: calibrator.not_positive() as f64 / pixels,
            denominator_too_dark: calibrator.too_dark() as f64 / pixels,
            white_saturated: references.white.saturated.map(|count| count as f64 / pixels),
            levels: (
                mean(&references.white),
                mean(&references.black),
                references.black_with_mask.as_ref().map(mean),
            ),
            flatness: flatness(&calibrator.illumination()),
        }
    }
}

const RESHOOT_DARK: &str = "take black and black_with_mask again: LCoS all black, same exposure and \
                            gain as the patterns, lights as they were";
const RESHOOT_PATTERN: &str = "check the pattern sequence of the LCoS and its trigger, then take the \
                               captures of these patterns again";

/// What is wrong with masks. `patterns` are the aperture patterns that were meant, if they are known.
pub fn judge_masks(figures: &MaskFigures, patterns: Option<ArrayView3<'_, f32>>) -> Vec<Finding> {
    let mut findings = Vec::new();
    let pixels = figures.gram.len().max(1) as f64;
    let dead = figures.dead as f64 / pixels;
    if dead > 0.001 {
        findings.push(Finding::new(
            "dead_pixels",
            if dead > 0.05 { Severity::Error } else { Severity::Warning },
            format!("{:.2} % of the pixels are dark in all masks: nothing is known there", dead * 100.0),
            "look at the gram map: dust or a mask that is out of place darkens areas, too few repeats \
             single pixels",
        ));
    }
    let stuck = figures.stuck_open as f64 / pixels;
    if stuck > 0.001 && figures.frame_means.len() > 1 {
        findings.push(Finding::new(
            "stuck_pixels",
            Severity::Warning,
            format!(
                "{:.2} % of the pixels are open in all masks and do not follow the patterns",
                stuck * 100.0
            ),
            "look for hot pixels of the sensor and for saturation",
        ));
    }
    findings.extend(one_dimensional(figures));
    findings.extend(dark_patterns(figures));
    findings.extend(alike(figures));
    if let Some((mean, _)) = figures.correlations().filter(|(mean, _)| *mean > 0.75) {
        findings.push(Finding::new(
            "correlated",
            Severity::Warning,
            format!(
                "the masks correlate with {mean:.2} in the mean: they hardly tell frames apart"
            ),
            "use patterns with less in common, more sub-apertures or a sharper projection (mask \
             distance, aberrations)",
        ));
    }
    if figures.largest > 0.0 && figures.largest < 0.5 {
        // Not the optics: whatever they do, the most open pixel is near 1.
        findings.push(Finding::new(
            "mask_scale",
            Severity::Warning,
            format!(
                "the largest mask value is {:.3} of the full scale, and should be near it: the masks may \
                 be numbers of fewer bits than their type has",
                figures.largest
            ),
            "state the full_scale of the masks: 4095 for 12-bit numbers in 16 bits, 16383 for 14-bit ones",
        ));
    } else if figures.mean_deviation() < 0.03 && figures.frame_means.len() > 1 {
        findings.push(Finding::new(
            "weak_modulation",
            Severity::Warning,
            format!(
                "a pixel's masks deviate by {:.3} over the frames (random squares: about 0.13)",
                figures.mean_deviation()
            ),
            "sharpen the projection of the lithography mask; check that the patterns change",
        ));
    }
    let low = figures.percentiles.0;
    if low > 0.15 {
        findings.push(Finding::new(
            "pedestal",
            Severity::Warning,
            format!("99 % of the mask values are above {low:.2}: a closed mask should be near 0"),
            "the dark was darker than the light that really leaks; take it again with the LCoS \
             running and all black",
        ));
    }
    findings.extend(order(figures, patterns));
    findings
}

/// Masks that code one direction of the picture and not the other.
fn one_dimensional(figures: &MaskFigures) -> Option<Finding> {
    let (rows, columns) = figures.along;
    let (share, same) = if rows > columns { (rows, "row") } else { (columns, "column") };
    (share > 0.8).then(|| {
        Finding::new(
            "one_dimensional",
            Severity::Warning,
            format!(
                "{:.0} % of the masks' variance is between {same}s: the pixels of a {same} are nearly the \
                 same, and frames can't be told apart along it",
                share * 100.0
            ),
            "check the axes of the file and that the lithography mask is in place; masks are \
             [frame, row, column] and vary along both",
        )
    })
}

/// Patterns much darker or brighter than the others.
fn dark_patterns(figures: &MaskFigures) -> Vec<Finding> {
    let mut sorted = figures.frame_means.clone();
    sorted.sort_by(f64::total_cmp);
    let typical = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let which = |wrong: &dyn Fn(f64) -> bool| -> Vec<usize> {
        (0..figures.frame_means.len()).filter(|&k| wrong(figures.frame_means[k])).collect()
    };
    let (dark, odd) = (
        which(&|mean| mean < 0.1 * typical),
        which(&|mean| mean >= 0.1 * typical && (mean / typical - 1.0).abs() > 0.3),
    );
    let mut findings = Vec::new();
    if !dark.is_empty() {
        let detail =
            format!("patterns {dark:?} (counted from 0) let no light through: they were not shown");
        findings.push(
            Finding::new("missing_pattern", Severity::Error, detail, RESHOOT_PATTERN).about(dark),
        );
    }
    if !odd.is_empty() {
        let detail = format!(
            "patterns {odd:?} (counted from 0) are brighter or darker than the others by more than 30 %"
        );
        findings.push(
            Finding::new("uneven_patterns", Severity::Warning, detail, RESHOOT_PATTERN).about(odd),
        );
    }
    findings
}

/// Masks that correlate with more are the same.
const SAME: f64 = 0.98;
/// What masks of neighbouring frames lack to a correlation of 1, in the median, if they turn by little.
const TURNING: f64 = 0.05;
/// A mask that was taken twice lacks less than this share of that.
const TWICE: f64 = 0.3;

/// Masks that are the same. Where patterns turn by little from frame to frame, all neighbours are nearly the same, and
/// one that was taken twice is much more so.
fn alike(figures: &MaskFigures) -> Option<Finding> {
    let correlation = &figures.correlation;
    let count = correlation.nrows();
    let mut apart: Vec<f64> = (1..count).map(|k| 1.0 - correlation[[k - 1, k]]).collect();
    apart.sort_by(f64::total_cmp);
    let step = apart.get(apart.len() / 2).copied().unwrap_or(1.0);
    let turning =
        step < TURNING && figures.correlations().is_some_and(|(mean, _)| mean < 1.0 - TURNING);
    let most = if turning { 1.0 - TWICE * step } else { SAME };
    let same = |((k, l), value): ((usize, usize), &f64)| (k < l && *value > most).then_some((k, l));
    let pairs: Vec<(usize, usize)> = correlation.indexed_iter().filter_map(same).collect();
    let frames: std::collections::BTreeSet<usize> =
        pairs.iter().flat_map(|&(k, l)| [k, l]).collect();
    if pairs.is_empty() {
        return None;
    }
    let detail = format!(
        "masks {pairs:?} (counted from 0) are the same: one pattern was taken twice, and another is \
         missing"
    );
    Some(
        Finding::new("repeated_pattern", Severity::Error, detail, RESHOOT_PATTERN)
            .about(frames.into_iter().collect()),
    )
}

fn order(figures: &MaskFigures, patterns: Option<ArrayView3<'_, f32>>) -> Option<Finding> {
    let correlation = figures.correlation.view();
    let expected = match patterns {
        Some(patterns) => Expected::Likeness(pattern_likeness(patterns)),
        None => Expected::Turning,
    };
    let Reordered { swaps, before, after } = reordered(correlation, &expected)?;
    let detail = format!(
        "masks {swaps:?} (counted from 0) stand in each other's place: with them swapped the masks are \
         as alike as their patterns ({after:.2}), and now less so ({before:.2})"
    );
    let frames = swaps.iter().flat_map(|&(k, l)| [k, l]).collect();
    Some(
        Finding::new(
            "swapped_order",
            Severity::Error,
            detail,
            "name the captures in the order in which the LCoS shows the patterns during a measurement",
        )
        .about(frames),
    )
}

/// What is wrong with captures.
pub fn judge_captures(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = saturation(figures);
    let lost = figures.denominator_not_positive + figures.denominator_too_dark;
    if lost > 0.001 {
        findings.push(Finding::new(
            "dark_illumination",
            if lost > 0.05 { Severity::Error } else { Severity::Warning },
            format!(
                "in {:.2} % of the pixels the white is not above the black ({:.2} %) or hardly so \
                 ({:.2} %)",
                lost * 100.0,
                figures.denominator_not_positive * 100.0,
                figures.denominator_too_dark * 100.0
            ),
            "light the white board evenly up to the corners and check that white and black are not \
             confused",
        ));
    }
    findings.extend(wrong_dark(figures));
    if let Some(flat) = figures.flatness.filter(|flat| *flat < 0.5) {
        findings.push(Finding::new(
            "uneven_illumination",
            Severity::Warning,
            format!(
                "the darkest part of the picture gets {:.0} % of the brightest part's light",
                flat * 100.0
            ),
            "light the white board evenly; check the aperture for vignetting",
        ));
    }
    let noise: Vec<f64> = figures.patterns.iter().filter_map(|pattern| pattern.noise).collect();
    let mean = figures.patterns.iter().map(|pattern| pattern.mean).sum::<f64>()
        / figures.patterns.len().max(1) as f64;
    let typical = noise.iter().sum::<f64>() / noise.len().max(1) as f64;
    if noise.is_empty() {
        findings.push(Finding::new(
            "no_repeats",
            Severity::Warning,
            "some captures have no repeats, so that the masks' noise is not known".into(),
            "take each capture several times (50 in the paper)",
        ));
    } else if typical > 0.05 * mean {
        findings.push(Finding::new(
            "noisy_masks",
            Severity::Warning,
            format!("noise is {:.1} % of the masks' mean", typical / mean * 100.0),
            "take more repeats, or expose longer",
        ));
    }
    let drifting: Vec<usize> =
        (0..figures.patterns.len()).filter(|&k| figures.patterns[k].drift > 0.02).collect();
    if !drifting.is_empty() {
        let detail = format!("the light changed by more than 2 % during patterns {drifting:?}");
        let remedy = "let the lamp and the LCoS warm up; fix exposure and gain";
        findings
            .push(Finding::new("light_drift", Severity::Warning, detail, remedy).about(drifting));
    }
    findings
}

fn saturation(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(share) = figures.white_saturated.filter(|share| *share > 0.001) {
        findings.push(Finding::new(
            "saturated_white",
            if share > 0.01 { Severity::Error } else { Severity::Warning },
            format!(
                "{:.2} % of the white's pixels are full: masks come out too bright there",
                share * 100.0
            ),
            "expose the whole calibration more shortly and take it again",
        ));
    }
    let full = |pattern: &PatternFigures| pattern.saturated.is_some_and(|share| share > 0.001);
    let frames: Vec<usize> =
        (0..figures.patterns.len()).filter(|&k| full(&figures.patterns[k])).collect();
    if !frames.is_empty() {
        let detail = format!("more than 0.1 % of the pixels are full in patterns {frames:?}");
        let remedy = "expose the whole calibration more shortly and take it again";
        findings.push(
            Finding::new("saturated_patterns", Severity::Error, detail, remedy).about(frames),
        );
    }
    findings
}

/// Signs of a dark that does not belong to the captures.
fn wrong_dark(figures: &CaptureFigures) -> Vec<Finding> {
    let mut findings = Vec::new();
    let negative = |pattern: &PatternFigures| pattern.negative > 0.01;
    let frames: Vec<usize> =
        (0..figures.patterns.len()).filter(|&k| negative(&figures.patterns[k])).collect();
    if !frames.is_empty() {
        let most = figures.patterns.iter().map(|pattern| pattern.negative).fold(0.0, f64::max);
        let detail = format!(
            "the dark is brighter than the captures of patterns {frames:?}, by more than noise and in up \
             to {:.1} % of the pixels",
            most * 100.0
        );
        findings
            .push(Finding::new("wrong_dark", Severity::Error, detail, RESHOOT_DARK).about(frames));
    }
    if let (white, black, Some(with_mask)) = figures.levels
        && with_mask > black + 0.02 * (white - black).abs()
    {
        findings.push(Finding::new(
            "wrong_dark",
            Severity::Error,
            format!(
                "black_with_mask ({with_mask:.1}) is brighter than black ({black:.1}), but a mask only \
                 takes light away (white: {white:.1})"
            ),
            RESHOOT_DARK,
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Axis, concatenate, s};

    use super::judge_masks;
    use crate::MaskStudy;
    use crate::masks::turning_circle;

    fn repeated(masks: &Array3<f32>) -> Option<Vec<usize>> {
        let (frames, height, width) = masks.dim();
        let mut study = MaskStudy::new(frames, height, width);
        study.add(masks.view()).unwrap();
        let found = judge_masks(&study.finish().unwrap(), None);
        found
            .into_iter()
            .find(|finding| finding.code == "repeated_pattern")
            .map(|found| found.frames)
    }

    /// In 24 frames each pattern of a turning circle is nearly the one before it.
    #[test]
    fn a_pattern_that_was_taken_twice_is_told_from_one_that_turns_by_little() {
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
}
