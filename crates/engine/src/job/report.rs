//! Findings and calibration reports in the form that is stored and shown.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

use super::ids::JobId;
use optics::{CaptureFigures, Doubt, MaskFigures};
pub use optics::{FindingCode, Severity};

/// A problem that a check has found. [`FindingCode`] is the registry of all codes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Finding {
    /// Stable identifier; a text, because stored findings may have codes of other versions.
    #[schemars(extend("x-extensible-enum" = codes()))]
    pub code: String,
    pub severity: Severity,
    /// The observation with its numbers, for people.
    pub detail: String,
    /// Recommended action for the user.
    pub remedy: String,
    /// The affected patterns or frames, counted from 0.
    pub frames: Vec<usize>,
    /// The affected snapshot, counted from 0; `None` if the finding is not about one snapshot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub snapshot: Option<u32>,
}

impl Finding {
    /// A finding of the usual severity that concerns no particular frame or snapshot.
    pub fn new(code: FindingCode, detail: impl Into<String>) -> Self {
        optics::Finding::new(code, detail).into()
    }

    /// True if this finding has the code.
    pub fn is(&self, code: FindingCode) -> bool {
        self.code == code.as_str()
    }
}

impl From<optics::Finding> for Finding {
    fn from(finding: optics::Finding) -> Self {
        let optics::Finding { code, severity, detail, frames } = finding;
        let remedy = code.entry().remedy.to_owned();
        Self { code: code.to_string(), severity, detail, remedy, frames, snapshot: None }
    }
}

/// Names of all findings.
fn codes() -> Vec<&'static str> {
    optics::FindingCode::VARIANTS.iter().map(|code| code.as_str()).collect()
}

/// The grade of a calibration or a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[derive(Serialize, Deserialize, IntoStaticStr, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum Grade {
    /// No findings.
    Good,
    /// Usable, with the limitations that the warnings state.
    Usable,
    /// A finding questions the scale, the dark or the masks. Reports on calibrations have no such grade.
    Doubtful,
    /// Results are wrong.
    Bad,
}

impl Grade {
    /// The verdict that findings on a result decide alone: bad after an error, doubtful if the scale, the dark or the masks
    /// are questioned. `None` if its quality decides.
    pub fn by_doubts(findings: &[Finding]) -> Option<Self> {
        if findings.iter().any(|finding| finding.severity == Severity::Error) {
            return Some(Self::Bad);
        }
        let is_scale_questioned = findings.iter().any(|finding| {
            finding.code.parse::<FindingCode>().is_ok_and(|code| code.doubt() == Some(Doubt::Scale))
        });
        (withholds_quality(findings) || is_scale_questioned).then_some(Self::Doubtful)
    }

    /// The grade that follows from the worst finding.
    pub fn of(findings: &[Finding]) -> Self {
        match findings.iter().map(|finding| finding.severity).max() {
            None => Self::Good,
            Some(Severity::Warning) => Self::Usable,
            Some(Severity::Error) => Self::Bad,
        }
    }
}

/// True if a finding questions the masks, their scale or the dark. The quality model knows only results with the right
/// ones.
pub fn withholds_quality(findings: &[Finding]) -> bool {
    findings.iter().any(|finding| match finding.code.parse() {
        // The quality model does not count pixels that were not measured.
        Ok(FindingCode::Saturated | FindingCode::BadPixels) => finding.severity == Severity::Error,
        Ok(code) => code.doubt() == Some(Doubt::Inputs),
        Err(_) => false,
    })
}

/// The report on a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct CalibrationReport {
    /// Name and version of this schema.
    pub schema: String,
    pub grade: Grade,
    pub findings: Vec<Finding>,
    /// The job whose registration has corrected the masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration_of: Option<JobId>,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub masks: MaskReport,
    /// Statistics of the captures; `None` if masks were uploaded.
    pub captures: Option<CaptureReport>,
    /// Names of the maps that accompany the report.
    pub maps: Vec<String>,
}

/// Statistics of masks on \[0,1\].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct MaskReport {
    pub mean: f64,
    /// Standard deviation over the masks, averaged over all pixels.
    pub deviation: f64,
    /// 1st percentile of all values.
    pub percentile_1: f64,
    /// 99th percentile of all values.
    pub percentile_99: f64,
    pub frame_means: Vec<f64>,
    /// Correlation between the masks \[B\]\[B\].
    pub correlation: Vec<Vec<f64>>,
    /// Mean correlation over all pairs; `None` for a single mask.
    pub correlation_mean: Option<f64>,
    /// Largest correlation of all pairs; `None` for a single mask.
    pub correlation_largest: Option<f64>,
    /// Smallest, mean and largest value of the Gram diagonal, the sum of squares of a pixel over the masks.
    pub gram: [f64; 3],
    /// Number of pixels that are dark in every mask.
    pub dead_pixels: u64,
    /// Number of pixels that are open in every mask.
    pub stuck_pixels: u64,
    /// Number of values that are 0, or were below 0 and set to 0.
    pub values_at_zero: u64,
}

/// Statistics of captures. Levels are stored values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct CaptureReport {
    /// Mean share of the light of the open aperture that the masks transmit.
    pub light_throughput: f64,
    /// Share of that light where a mask is 1: the divisor of the normalisation.
    pub mask_scale: f64,
    /// Mean standard deviation of a mask value due to noise; `None` without repeats.
    pub noise: Option<f64>,
    /// Dynamic range in dB: `deviation` of the masks over `noise`.
    pub dynamic_range_db: Option<f64>,
    /// Statistics of the captures. The noise of a pattern is that of its normalised mask.
    #[serde(flatten)]
    pub figures: CaptureFigures,
}

/// Name and version of the schema of [`CalibrationReport`].
const SCHEMA: &str = "sci-recon/calibration-report/1";

impl CalibrationReport {
    /// The finding that jobs of a bad calibration carry.
    pub fn warning(&self) -> Option<Finding> {
        let errors = self.findings.iter().filter(|finding| finding.severity == Severity::Error);
        let codes: Vec<&str> = errors.map(|finding| finding.code.as_str()).collect();
        (self.grade == Grade::Bad).then(|| {
            let detail = format!("the calibration is graded bad because of {}", codes.join(", "));
            Finding::new(FindingCode::BadCalibration, detail)
        })
    }

    /// A report on statistics and the findings in them. `captures` includes the divisor of the masks' normalisation.
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
            registration_of: None,
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
        let measured = || figures.gram.iter().filter(|value| !value.is_nan());
        let gram = || measured().map(|&value| f64::from(value));
        let pixels = figures.measured_pixels.max(1) as f64;
        Self {
            mean: figures.overall_mean(),
            deviation: figures.mean_deviation(),
            percentile_1: figures.percentile_1.into(),
            percentile_99: figures.percentile_99.into(),
            frame_means: figures.frame_means.clone(),
            correlation: figures.correlation.outer_iter().map(|row| row.to_vec()).collect(),
            correlation_mean: correlations.map(|correlations| correlations.mean),
            correlation_largest: correlations.map(|correlations| correlations.largest),
            gram: [
                gram().fold(f64::INFINITY, f64::min),
                gram().sum::<f64>() / pixels,
                gram().fold(0.0, f64::max),
            ],
            dead_pixels: figures.dead_pixels,
            stuck_pixels: figures.stuck_pixels,
            values_at_zero: figures.values_at_zero,
        }
    }
}

impl CaptureReport {
    fn new(figures: &CaptureFigures, scale: f64, masks: &MaskReport) -> Self {
        let noise: Option<Vec<f64>> =
            figures.patterns.iter().map(|pattern| pattern.noise).collect();
        let count = figures.patterns.len().max(1) as f64;
        // The noise of the normalised masks.
        let noise = noise.map(|noise| noise.iter().sum::<f64>() / count / scale);
        let range = noise.filter(|noise| *noise > 0.0 && masks.deviation > 0.0);
        let light_throughput = figures.patterns.iter().map(|p| p.light).sum::<f64>() / count;
        let dynamic_range_db = range.map(|noise| 20.0 * (masks.deviation / noise).log10());
        let mut figures = figures.clone();
        for pattern in &mut figures.patterns {
            pattern.noise = pattern.noise.map(|noise| noise / scale);
        }
        Self { light_throughput, mask_scale: scale, noise, dynamic_range_db, figures }
    }
}
