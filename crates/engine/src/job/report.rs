//! What a check of a calibration or measurement has found, and the report of a calibration, as they
//! are stored and shown.

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;

pub use optics::Severity;
use optics::{self, CaptureFigures, MaskFigures, PatternFigures};

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Its name, which never changes, for programs to rely on.
    pub code: String,
    pub severity: Severity,
    /// What was seen, with its numbers.
    pub detail: String,
    pub remedy: String,
    /// The patterns or frames that it is about, counted from 0.
    pub frames: Vec<usize>,
    /// The snapshot that it is about, counted from 0; none for a calibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub snapshot: Option<u32>,
}

impl From<optics::Finding> for Finding {
    fn from(finding: optics::Finding) -> Self {
        let optics::Finding { code, severity, detail, remedy, frames } = finding;
        Self { code: code.into(), severity, detail, remedy: remedy.into(), frames, snapshot: None }
    }
}

/// A verdict on a calibration.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, IntoStaticStr,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum Grade {
    /// Nothing is wrong with it.
    Good,
    /// It can be used, with what the warnings say.
    Usable,
    /// Results will be wrong.
    Bad,
}

impl Grade {
    /// The grade that findings give.
    pub fn of(findings: &[Finding]) -> Self {
        match findings.iter().map(|finding| finding.severity).max() {
            None => Self::Good,
            Some(Severity::Warning) => Self::Usable,
            Some(Severity::Error) => Self::Bad,
        }
    }
}

/// What is known of the masks of a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationReport {
    /// Name and version of this form.
    pub schema: String,
    pub grade: Grade,
    pub findings: Vec<Finding>,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub masks: MaskReport,
    /// Figures of the captures that they were made of; none for masks that were sent.
    pub captures: Option<CaptureReport>,
    pub maps: Vec<String>,
}

/// Figures of masks on \[0,1\].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaskReport {
    pub mean: f64,
    /// Mean over the pixels of the standard deviation over the frames.
    pub deviation: f64,
    /// 1 % of all values lie below this.
    pub percentile_1: f64,
    /// 99 % of all values lie below this.
    pub percentile_99: f64,
    pub frame_means: Vec<f64>,
    /// Correlation of each mask with each other.
    pub correlation: Vec<Vec<f64>>,
    /// Mean over all pairs; none for one mask.
    pub correlation_mean: Option<f64>,
    /// Largest of all pairs; none for one mask.
    pub correlation_largest: Option<f64>,
    /// Smallest, mean and largest sum of squares of a pixel: the gram diagonal.
    pub gram: [f64; 3],
    pub dead_pixels: u64,
    /// Pixels that are open in all masks.
    pub stuck_pixels: u64,
    /// Values that are 0 (or were below and set to 0).
    pub values_at_zero: u64,
}

/// Figures of captures. Levels are numbers as stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CaptureReport {
    /// Share of the light of the open aperture without a mask that passes, in the mean.
    pub light_throughput: f64,
    /// The share where a mask is 1: masks were divided by it.
    pub mask_scale: f64,
    /// Standard deviation that noise gives a mask value in the mean; none without repeats.
    pub noise: Option<f64>,
    /// Mean deviation over the frames over that noise, in decibels: what is left of the dynamic range.
    pub dynamic_range_db: Option<f64>,
    pub white_level: f64,
    pub black_level: f64,
    /// Mean of the black with mask; none for Eq. 7.
    pub black_with_mask_level: Option<f64>,
    /// Darkest over brightest part of the illumination.
    pub illumination_flatness: Option<f64>,
    /// Share of full pixels of the white.
    pub white_saturated: Option<f64>,
    /// Share of pixels whose white is not above their black.
    pub denominator_not_positive: f64,
    /// Share of further pixels whose white is hardly above their black.
    pub denominator_too_dark: f64,
    pub patterns: Vec<PatternReport>,
}

/// Figures of the captures of one pattern.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PatternReport {
    /// Mean share of the white's light.
    pub light: f64,
    /// Share of pixels at or below 0.
    pub not_positive: f64,
    /// Share of pixels too far below 0 for noise.
    pub negative: f64,
    /// Standard deviation that noise gives a mask value.
    pub noise: Option<f64>,
    pub saturated: Option<f64>,
    /// Change of the light during the repeats, as a share.
    pub drift: f64,
}

/// Name and version of this form of report.
const SCHEMA: &str = "sci-recon/calibration-report/1";

impl CalibrationReport {
    /// What jobs are to be told of a calibration that is bad.
    pub fn warning(&self) -> Option<Finding> {
        let grave = self.findings.iter().filter(|finding| finding.severity == Severity::Error);
        let reasons: Vec<&str> = grave.map(|finding| finding.code.as_str()).collect();
        (self.grade == Grade::Bad).then(|| Finding {
            code: "bad_calibration".into(),
            severity: Severity::Error,
            detail: format!("the calibration is bad: {}", reasons.join(", ")),
            remedy: "read its report, mend what it names, and calibrate again".into(),
            frames: Vec::new(),
            snapshot: None,
        })
    }

    /// Of figures and what was found in them. `captures` come with the scale of the masks.
    pub fn new(
        figures: &MaskFigures,
        captures: Option<(&CaptureFigures, f32)>,
        findings: Vec<Finding>,
        maps: Vec<String>,
    ) -> Self {
        let (height, width) = figures.gram.dim();
        let masks = MaskReport::new(figures);
        Self {
            schema: SCHEMA.into(),
            grade: Grade::of(&findings),
            findings,
            frames: masks.frame_means.len(),
            height,
            width,
            captures: captures
                .map(|(captures, scale)| CaptureReport::new(captures, scale.into(), &masks)),
            masks,
            maps,
        }
    }
}

impl MaskReport {
    fn new(figures: &MaskFigures) -> Self {
        let correlations = figures.correlations();
        let gram = || figures.gram.iter().map(|&value| f64::from(value));
        let pixels = figures.gram.len().max(1) as f64;
        Self {
            mean: figures.overall_mean(),
            deviation: figures.mean_deviation(),
            percentile_1: figures.percentiles.0.into(),
            percentile_99: figures.percentiles.1.into(),
            frame_means: figures.frame_means.clone(),
            correlation: figures.correlation.outer_iter().map(|row| row.to_vec()).collect(),
            correlation_mean: correlations.map(|(mean, _)| mean),
            correlation_largest: correlations.map(|(_, largest)| largest),
            gram: [
                gram().fold(f64::INFINITY, f64::min),
                gram().sum::<f64>() / pixels,
                gram().fold(0.0, f64::max),
            ],
            dead_pixels: figures.dead,
            stuck_pixels: figures.stuck_open,
            values_at_zero: figures.zeros,
        }
    }
}

impl CaptureReport {
    fn new(figures: &CaptureFigures, scale: f64, masks: &MaskReport) -> Self {
        let noise: Option<Vec<f64>> =
            figures.patterns.iter().map(|pattern| pattern.noise).collect();
        let count = figures.patterns.len().max(1) as f64;
        // Of the masks as they are: divided by their scale.
        let noise = noise.map(|noise| noise.iter().sum::<f64>() / count / scale);
        let range = noise.filter(|noise| *noise > 0.0 && masks.deviation > 0.0);
        Self {
            light_throughput: figures.patterns.iter().map(|p| p.mean).sum::<f64>() / count,
            mask_scale: scale,
            noise,
            dynamic_range_db: range.map(|noise| 20.0 * (masks.deviation / noise).log10()),
            white_level: figures.levels.0,
            black_level: figures.levels.1,
            black_with_mask_level: figures.levels.2,
            illumination_flatness: figures.flatness,
            white_saturated: figures.white_saturated,
            denominator_not_positive: figures.denominator_not_positive,
            denominator_too_dark: figures.denominator_too_dark,
            patterns: figures.patterns.iter().map(|p| PatternReport::new(p, scale)).collect(),
        }
    }
}

impl PatternReport {
    fn new(figures: &PatternFigures, scale: f64) -> Self {
        Self {
            light: figures.mean,
            not_positive: figures.not_positive,
            negative: figures.negative,
            noise: figures.noise.map(|noise| noise / scale),
            saturated: figures.saturated,
            drift: figures.drift,
        }
    }
}
