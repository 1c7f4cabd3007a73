//! Registration of the masks of a job: the request, and the outcome.

use std::fmt;

use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{Error, MapAccess, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::report::{Finding, FindingCode};
use super::text::InvalidField;
use reconstruction::registration::{
    Correction, Interpolation, Known, MAX_GROWTH, MAX_ROTATION, REACH, Registration, Similarity,
    Uncertainty,
};

/// Reason where an estimate is not reliable.
const NOT_CONVERGED: &str = "no shift by at most 4 pixels, also with a small rotation or magnification, makes the masks explain the \
     measurement well enough, so they were not moved";

/// Share of the light without a mask from which moved masks are reported as misplaced.
const MISPLACED: f64 = 0.25;

/// Correction of masks that have moved since their calibration.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RegistrationRequest {
    /// Uses the masks as they were calibrated.
    Off,
    /// Estimates the motion from the first snapshot, and corrects the masks if that lowers the hold-out error
    /// significantly.
    #[default]
    Auto,
    /// Moves the masks by a known motion.
    #[serde(untagged)]
    Stated(Similarity),
}

impl<'de> Deserialize<'de> for RegistrationRequest {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RequestVisitor)
    }
}

/// Reads a word or the object of a motion. Unlike those of a derived implementation, its errors name the field.
struct RequestVisitor;

impl<'de> Visitor<'de> for RequestVisitor {
    type Value = RegistrationRequest;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("\"auto\", \"off\", or an object with shift, rotation and scale")
    }

    fn visit_str<E: Error>(self, word: &str) -> Result<Self::Value, E> {
        match word {
            "off" => Ok(RegistrationRequest::Off),
            "auto" => Ok(RegistrationRequest::Auto),
            _ => Err(E::invalid_value(Unexpected::Str(word), &self)),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, fields: A) -> Result<Self::Value, A::Error> {
        let motion = Similarity::deserialize(MapAccessDeserializer::new(fields))?;
        Ok(RegistrationRequest::Stated(motion))
    }
}

/// Findings of a measurement's check on masks that have moved since the calibration.
const DRIFT: [FindingCode; 3] =
    [FindingCode::DriftedMasks, FindingCode::ShiftedMasks, FindingCode::ForeignMasks];
/// The part of [`DRIFT`] that a stated motion answers. Nothing has tested this motion against masks of another camera.
const MOTION: &[FindingCode] = DRIFT.split_at(2).0;

impl RegistrationRequest {
    /// Findings of the measurement's check that a job answers as it moves the masks. They do not count before its end.
    pub fn answers(self) -> &'static [FindingCode] {
        if matches!(self, Self::Stated(_)) { MOTION } else { &[] }
    }

    /// True for the default.
    pub(super) fn is_auto(&self) -> bool {
        *self == Self::Auto
    }

    /// The error of a stated motion that is out of range, or for a colour sensor or a spectral camera.
    pub fn error(self, is_coloured: bool) -> Option<InvalidField> {
        let Self::Stated(Similarity { shift: [rows, columns], rotation, scale }) = self else {
            return None;
        };
        let (field, detail) = if is_coloured {
            ("", "masks of a colour sensor or spectral camera are not moved: omit the field, and calibrate again".to_owned())
        } else if ![rows, columns].iter().all(|pixels| pixels.abs() <= REACH as f64) {
            let detail = format!(
                "the shift is {rows} rows and {columns} columns; each must be from -{REACH} to {REACH} pixels: \
                 calibrate again if the masks have moved farther"
            );
            ("/shift", detail)
        } else if rotation.is_nan() || rotation.abs() > MAX_ROTATION {
            let detail = format!(
                "the rotation is {rotation} degrees; it must be from -{MAX_ROTATION} to {MAX_ROTATION}: calibrate \
                 again if the masks have turned farther"
            );
            ("/rotation", detail)
        } else if scale.is_nan() || (scale - 1.0).abs() > MAX_GROWTH + 1e-9 {
            let (least, most) = (1.0 - MAX_GROWTH, 1.0 + MAX_GROWTH);
            let detail = format!(
                "the scale is {scale}; it must be a factor from {least} to {most}: calibrate again if the \
                 magnification has changed more"
            );
            ("/scale", detail)
        } else {
            return None;
        };
        Some(InvalidField::new(format!("/registration{field}"), detail))
    }
}

/// The outcome of a registration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Registered {
    /// Pixels by which the masks have moved down and to the right at the centre of the sensor. Zeros if nothing was estimated.
    pub shift: [f64; 2],
    /// Degrees by which they have turned clockwise about this centre. 0 if no rotation was found.
    pub rotation: f64,
    /// Factor by which they have grown about this centre. 1 if no growth was found.
    pub scale: f64,
    /// How the moved masks are interpolated: so that the hold-out error is smallest.
    pub interpolation: Interpolation,
    /// Standard errors; null for a stated motion.
    pub uncertainty: Option<Uncertainty>,
    /// Relative squared error at hold-out pixels with the calibrated masks; null if it is unknown.
    pub error_before: Option<f64>,
    /// Relative squared error at these pixels with the moved masks; null if it is unknown.
    pub error_after: Option<f64>,
    /// For a stated motion, whether the masks explain the measurement with it, or at least better than without; null if it is
    /// unknown, and for an estimate. The errors alone do not show it: interpolation lowers the contrast of masks, and so their error.
    #[serde(default)]
    pub explains: Option<bool>,
    /// True if the job uses the moved masks. False if the calibrated masks fit, or if there is a `reason`.
    pub applied: bool,
    /// Why nothing was estimated, or why the estimate is unreliable; null otherwise.
    pub reason: Option<String>,
    /// Share of the first snapshot's light at pixels where the moved masks are all dark or unknown; null if the masks are not
    /// moved.
    pub lost_light: Option<f64>,
}

impl Registered {
    /// The outcome of a motion that the request states.
    pub fn stated(motion: Similarity, Known { interpolation, outcome }: Known) -> Self {
        let (error_before, error_after) =
            (outcome.map(|(errors, _)| errors[0]), outcome.map(|(errors, _)| errors[1]));
        let explains = outcome.map(|(_, explains)| explains);
        let Similarity { shift, rotation, scale } = motion;
        let applied = motion != Similarity::default();
        let skipped = Self::skipped("the motion was stated");
        Self {
            shift,
            rotation,
            scale,
            interpolation,
            applied,
            error_before,
            error_after,
            explains,
            ..skipped
        }
    }

    /// The outcome where nothing was estimated.
    pub fn skipped(reason: &str) -> Self {
        let Similarity { shift, rotation, scale } = Similarity::default();
        Self {
            shift,
            rotation,
            scale,
            interpolation: Interpolation::default(),
            uncertainty: None,
            error_before: None,
            error_after: None,
            explains: None,
            applied: false,
            reason: Some(reason.to_owned()),
            lost_light: None,
        }
    }

    /// The correction that is applied to the masks.
    pub fn correction(&self) -> Option<Correction> {
        let Self { shift, rotation, scale, interpolation, applied, .. } = *self;
        let motion = Similarity { shift, rotation, scale };
        applied.then_some(Correction { motion, interpolation })
    }

    /// Findings of the measurement's check that do not apply to masks that the job has moved. If these still do not fit, the
    /// frames do not explain the hold-out pixels.
    pub fn superseded(&self) -> &'static [FindingCode] {
        match (self.applied, self.uncertainty.is_some(), self.explains) {
            (true, true, _) => &DRIFT,
            (true, false, Some(true) | None) => MOTION,
            (false, ..) | (true, false, Some(false)) => &[],
        }
    }

    /// True if the white level follows the moved masks. Masks that see too little of the light give no white level, so that
    /// of the calibrated masks is kept.
    pub fn changes_white_level(&self) -> bool {
        self.applied && self.lost_light.is_none_or(|lost| lost <= MISPLACED)
    }

    /// The findings on masks that the job has moved.
    pub fn findings(&self) -> Vec<Finding> {
        let Some(Correction { motion, .. }) = self.correction() else { return Vec::new() };
        let errors = self.error_before.zip(self.error_after);
        let detail = match errors.filter(|_| self.uncertainty.is_some()) {
            Some((before, after)) => format!(
                "the job uses masks that are displaced by {}, which lowers the error at hold-out pixels from {:.2} to \
                 {:.2} % of the brightness",
                described(motion, true),
                100.0 * before.sqrt(),
                100.0 * after.sqrt()
            ),
            None => format!(
                "the job has moved the masks by {}, as its request states",
                described(motion, false)
            ),
        };
        let mut findings = vec![Finding::new(FindingCode::MovedMasks, detail)];
        if self.explains == Some(false) {
            let detail = "the masks explain the measurement no better with the stated motion than without it; check its signs \
                          (rows downwards, columns to the right), or let the job estimate it with auto";
            findings.push(Finding::new(FindingCode::MisplacedMasks, detail.to_owned()));
        }
        if let Some(lost) = self.lost_light.filter(|lost| *lost > MISPLACED) {
            let detail = format!(
                "{:.0} % of the light of the first snapshot is at pixels where the masks are dark after they moved by \
                 {}; the frames do not explain this light",
                100.0 * lost,
                described(motion, false)
            );
            findings.push(Finding::new(FindingCode::MisplacedMasks, detail));
        }
        findings
    }
}

/// A motion in words. An estimate is rounded.
fn described(
    Similarity { shift: [rows, columns], rotation, scale }: Similarity,
    is_estimate: bool,
) -> String {
    let number = |value: f64, digits: usize| {
        if is_estimate { format!("{value:.digits$}") } else { value.to_string() }
    };
    let mut text = format!("({}, {}) pixels (rows, columns)", number(rows, 2), number(columns, 2));
    if rotation != 0.0 {
        text += &format!(" and {} degrees (clockwise)", number(rotation, 3));
    }
    if scale != 1.0 {
        text += &format!(" with a scale of {}", number(scale, 5));
    }
    text
}

impl From<Registration> for Registered {
    fn from(found: Registration) -> Self {
        let Registration {
            correction: Correction { motion, interpolation },
            uncertainty,
            error_before,
            error_after,
            applied,
            converged,
        } = found;
        let Similarity { shift, rotation, scale } = motion;
        Self {
            shift,
            rotation,
            scale,
            interpolation,
            uncertainty: Some(uncertainty),
            error_before: Some(error_before),
            error_after: Some(error_after),
            explains: None,
            applied,
            reason: (!converged).then(|| NOT_CONVERGED.to_owned()),
            lost_light: None,
        }
    }
}
