//! Registration of the masks of a job: the request, and the outcome.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::report::{Finding, FindingCode};
use super::text::InvalidField;
use reconstruction::registration::{Correction, Interpolation, REACH, Registration};

/// Reason where an estimate is not reliable.
const NOT_CONVERGED: &str = "no shift by at most 4 pixels makes the masks explain the measurement well enough, so they were not moved";

/// Share of the light without a mask from which moved masks are reported as misplaced.
const MISPLACED: f64 = 0.25;

/// Correction of masks that have moved since their calibration.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RegistrationRequest {
    /// Uses the masks as they were calibrated.
    Off,
    /// Estimates the displacement from the first snapshot, and corrects the masks if that lowers the hold-out error
    /// significantly.
    #[default]
    Auto,
    /// Moves the masks down and to the right by these pixels, at most 4 along each axis.
    Shift([f64; 2]),
}

impl RegistrationRequest {
    /// True for the default.
    pub(super) fn is_auto(&self) -> bool {
        *self == Self::Auto
    }

    /// The error of a stated shift that is out of range, or for a colour sensor or a spectral camera.
    pub fn error(self, is_coloured: bool) -> Option<InvalidField> {
        let Self::Shift(shift) = self else { return None };
        let detail = if is_coloured {
            "masks of a colour sensor or spectral camera are not moved: omit the field, and calibrate again".to_owned()
        } else if shift.iter().all(|pixels| pixels.abs() <= REACH as f64) {
            return None;
        } else {
            let [rows, columns] = shift;
            format!(
                "the shift is {rows} rows and {columns} columns; each must be from -{REACH} to {REACH} pixels: \
                 calibrate again if the masks have moved farther"
            )
        };
        Some(InvalidField::new("/registration/shift", detail))
    }
}

/// The outcome of a registration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Registered {
    /// Pixels by which the masks have moved down and to the right. Zeros if nothing was estimated.
    pub shift: [f64; 2],
    /// How the moved masks are interpolated: so that the hold-out error is smallest.
    pub interpolation: Interpolation,
    /// Standard error of each; null for a stated shift.
    pub uncertainty: Option<[f64; 2]>,
    /// Relative squared error at hold-out pixels with the calibrated masks; null for a stated shift.
    pub error_before: Option<f64>,
    /// Relative squared error at these pixels with the moved masks; null for a stated shift.
    pub error_after: Option<f64>,
    /// True if the job uses the moved masks. False if the calibrated masks fit, or if there is a `reason`.
    pub applied: bool,
    /// Why nothing was estimated, or why the estimate is unreliable; null otherwise.
    pub reason: Option<String>,
    /// Share of the first snapshot's light at pixels where the moved masks are all dark or unknown; null if the masks are not
    /// moved.
    pub lost_light: Option<f64>,
}

impl Registered {
    /// The outcome of a shift that the request states.
    pub fn stated(Correction { shift, interpolation }: Correction) -> Self {
        let applied = shift != [0.0; 2];
        Self { shift, interpolation, applied, ..Self::skipped("the shift was stated") }
    }

    /// The outcome where nothing was estimated.
    pub fn skipped(reason: &str) -> Self {
        Self {
            shift: [0.0; 2],
            interpolation: Interpolation::default(),
            uncertainty: None,
            error_before: None,
            error_after: None,
            applied: false,
            reason: Some(reason.to_owned()),
            lost_light: None,
        }
    }

    /// The correction that is applied to the masks.
    pub fn correction(&self) -> Option<Correction> {
        let Self { shift, interpolation, applied, .. } = *self;
        applied.then_some(Correction { shift, interpolation })
    }

    /// Findings of the measurement's check that do not apply to masks that the job has moved. If these still do not fit, the
    /// frames do not explain the hold-out pixels.
    pub fn superseded(&self) -> &'static [FindingCode] {
        const DRIFT: [FindingCode; 3] =
            [FindingCode::DriftedMasks, FindingCode::ShiftedMasks, FindingCode::ForeignMasks];
        match (self.applied, self.error_after) {
            (false, _) => &[],
            (true, Some(_)) => &DRIFT,
            // Nothing has tested a stated shift against masks of another camera.
            (true, None) => &DRIFT[..2],
        }
    }

    /// True if the white level follows the moved masks. Masks that see too little of the light give no white level, so that
    /// of the calibrated masks is kept.
    pub fn changes_white_level(&self) -> bool {
        self.applied && self.lost_light.is_none_or(|lost| lost <= MISPLACED)
    }

    /// The findings on masks that the job has moved.
    pub fn findings(&self) -> Vec<Finding> {
        let Some(Correction { shift: [rows, columns], .. }) = self.correction() else {
            return Vec::new();
        };
        let detail = match (self.error_before, self.error_after) {
            (Some(before), Some(after)) => format!(
                "the masks have moved by ({rows:.2}, {columns:.2}) pixels (rows, columns) since the calibration; the \
                 job has corrected them, which lowers the hold-out error from {:.2} to {:.2} %",
                100.0 * before.sqrt(),
                100.0 * after.sqrt()
            ),
            _ => format!(
                "the job has moved the masks by ({rows}, {columns}) pixels (rows, columns), as its request states"
            ),
        };
        let mut findings = vec![Finding::new(FindingCode::MovedMasks, detail)];
        if let Some(lost) = self.lost_light.filter(|lost| *lost > MISPLACED) {
            let detail = format!(
                "{:.0} % of the light of the first snapshot is at pixels where the masks are dark after they moved by \
                 ({rows}, {columns}) pixels (rows, columns); the frames do not explain this light",
                100.0 * lost
            );
            findings.push(Finding::new(FindingCode::MisplacedMasks, detail));
        }
        findings
    }
}

impl From<Registration> for Registered {
    fn from(found: Registration) -> Self {
        let Registration {
            correction: Correction { shift, interpolation },
            uncertainty,
            error_before,
            error_after,
            applied,
            converged,
        } = found;
        Self {
            shift,
            interpolation,
            uncertainty: Some(uncertainty),
            error_before: Some(error_before),
            error_after: Some(error_after),
            applied,
            reason: (!converged).then(|| NOT_CONVERGED.to_owned()),
            lost_light: None,
        }
    }
}
