//! Requests to create a calibration, measurement or model from uploads.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::captures::MAX_REPEATS;
use super::reading::keeps_mosaic;
use super::{
    CalibrationId, Captures, Dispersion, InvalidField, JobId, Label, Mosaic, Sequence, Sha256,
};
use formats::{Axes, Crop, FullScale, Packing};

/// CPU-seconds that a check takes for each byte of its uploads (measured with 8-bit masks), and at least.
const CHECK_S: f64 = 20e-9;
const SHORTEST_CHECK_S: f64 = 0.05;
/// Plausible frame rates of cameras, in snapshots per second.
const FRAME_RATES: RangeInclusive<f64> = 1e-6..=1e9;
/// Plausible exposures of a snapshot, in seconds.
const EXPOSURES_S: RangeInclusive<f64> = 1e-9..=1e6;
/// An exposure may exceed the time between two snapshots by this share, because cameras display rounded numbers.
const EXPOSURE_TOLERANCE: f64 = 1e-3;
/// CPU-seconds of loading a small network and running it once.
const MODEL_S: f64 = 1.0;

/// The body of `POST /v1/calibrations`: masks, the captures from which they are made, or a job that has corrected them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("anyOf" = [{ "required": ["masks"] }, { "required": ["captures"] }, { "required": ["registration_of"] }]))]
pub struct CalibrationRequest {
    pub name: Option<Label>,
    pub masks: Option<Sha256>,
    /// Name of the array in a file of several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub array: Option<Label>,
    /// Order of the array's axes; without it, the only one that fits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<Axes>,
    /// Window of each mask; by default the whole masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crop: Option<Crop>,
    /// First and last mask, both included, counted from 0; by default all masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames: Option<[usize; 2]>,
    /// How the pixels are packed; by default one number per pixel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub packing: Option<Packing>,
    /// The stored number that means 1. By default 255 for uint8, 65535 for uint16, the largest value of TIFF samples with
    /// fewer bits, and 1 for floats and truth values; for the arrays of that name in files of MATLAB and Octave 1 for `mask`
    /// and 255 for `meas`. Other integers need it. Masks of integers that are all 0 or 1 are closed and open in any type.
    #[schemars(range(min = 1.2e-38, max = 3.4e38))]
    pub full_scale: Option<f32>,
    pub captures: Option<Captures>,
    /// A job whose registration has corrected its masks. These become the calibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration_of: Option<JobId>,
    /// Colours of the sensor's pixels; a grey sensor has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mosaic: Option<Mosaic>,
    /// Displacement of the bands of a spectral camera. `masks` is then one mask [row, column], from which the masks of all
    /// bands are made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dispersion: Option<Dispersion>,
    /// A map of the size of the masks that is not 0 at bad pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bad_pixels: Option<Sha256>,
}

/// The body of `POST /v1/measurements`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MeasurementRequest {
    pub name: Option<Label>,
    pub calibration: CalibrationId,
    pub data: Sha256,
    /// Name of the array in a file of several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub array: Option<Label>,
    /// Order of the array's axes; without it, the only one that fits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<Axes>,
    /// Window of each snapshot and dark frame; by default whole snapshots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crop: Option<Crop>,
    /// How the pixels of data and dark frames are packed; by default one number per pixel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub packing: Option<Packing>,
    /// Captures with the coded aperture closed (LCoS all black), at the measurement's exposure. Their average is subtracted.
    #[serde(default)]
    #[schemars(length(max = 2048))]
    pub dark: Vec<Sha256>,
    /// Smallest stored number of a saturated pixel.
    #[schemars(range(min = 1))]
    pub saturation: Option<u32>,
    /// The stored number that means 1. By default 255 for uint8, 65535 for uint16, the largest value of TIFF samples with
    /// fewer bits, and 1 for floats and truth values; for the array `meas` in files of MATLAB and Octave 255. Other integers
    /// need it.
    #[schemars(range(min = 1.2e-38, max = 3.4e38))]
    pub full_scale: Option<f32>,
    /// Snapshots per second.
    #[schemars(range(min = 1e-6, max = 1e9))]
    pub camera_fps: Option<f64>,
    /// Exposure of one snapshot in seconds, at most 1 / `camera_fps`.
    #[schemars(range(min = 1e-9, max = 1e6))]
    pub exposure_s: Option<f64>,
    /// States whether the snapshots follow one another; without it, the times decide.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sequence: Option<Sequence>,
}

/// The body of `POST /v1/models`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelRequest {
    pub name: Option<Label>,
    pub calibration: CalibrationId,
    pub file: Sha256,
}

/// A request that is fulfilled once its uploads have passed a check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Submission {
    Calibration(CalibrationRequest),
    Measurement(MeasurementRequest),
    Model(ModelRequest),
}

/// Limits of a check, as the server sets them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CheckLimits {
    pub max_file_bytes: u64,
    /// Bytes of the disk that stay free.
    pub min_free_bytes: u64,
    /// Seconds that a check may take.
    pub seconds: f64,
}

impl Submission {
    pub fn name(&self) -> Option<&Label> {
        match self {
            Self::Calibration(request) => request.name.as_ref(),
            Self::Measurement(request) => request.name.as_ref(),
            Self::Model(request) => request.name.as_ref(),
        }
    }

    /// The calibration that the request needs.
    pub fn calibration(&self) -> Option<CalibrationId> {
        match self {
            Self::Calibration(_) => None,
            Self::Measurement(request) => Some(request.calibration),
            Self::Model(request) => Some(request.calibration),
        }
    }

    /// The job that has corrected the masks of the calibration.
    pub fn registration_of(&self) -> Option<JobId> {
        match self {
            Self::Calibration(request) => request.registration_of,
            Self::Measurement(_) | Self::Model(_) => None,
        }
    }

    /// Each upload with its place in the request.
    pub fn uploads(&self) -> Vec<(String, Sha256)> {
        match self {
            Self::Calibration(CalibrationRequest { masks, captures, bad_pixels, .. }) => {
                let masks = masks.map(|masks| ("/masks".to_owned(), masks));
                let bad = bad_pixels.map(|map| ("/bad_pixels".to_owned(), map));
                let captures = captures.iter().flat_map(Captures::uploads);
                masks.into_iter().chain(captures).chain(bad).collect()
            }
            Self::Measurement(MeasurementRequest { data, dark, .. }) => {
                let dark = dark.iter().enumerate();
                let dark = dark.map(|(index, upload)| (format!("/dark/{index}"), *upload));
                std::iter::once(("/data".to_owned(), *data)).chain(dark).collect()
            }
            Self::Model(ModelRequest { file, .. }) => vec![("/file".to_owned(), *file)],
        }
    }

    /// The uploads that stay in use once the request is fulfilled. Captures do not: they may have many times the bytes of
    /// their masks.
    pub fn kept_uploads(&self) -> Vec<Sha256> {
        match self {
            Self::Calibration(CalibrationRequest { masks, bad_pixels, .. }) => {
                masks.iter().chain(bad_pixels).copied().collect()
            }
            Self::Measurement(_) | Self::Model(_) => {
                self.uploads().into_iter().map(|(_, upload)| upload).collect()
            }
        }
    }

    /// Planned CPU-seconds of a check that reads `bytes`.
    #[allow(clippy::cast_precision_loss)] // a plan
    pub fn check_cost(&self, bytes: u64) -> f64 {
        let read = (bytes as f64 * CHECK_S).max(SHORTEST_CHECK_S);
        match self {
            // Only headers are read.
            Self::Calibration(CalibrationRequest { captures: Some(_), .. }) => SHORTEST_CHECK_S,
            Self::Calibration(_) | Self::Measurement(_) => read,
            Self::Model(_) => read + MODEL_S,
        }
    }

    /// Refuses fields that contradict each other.
    /// Errors: all violations, each with its place.
    pub fn check(&self) -> Result<(), Vec<InvalidField>> {
        match self {
            Self::Calibration(request) => {
                request.check()?;
                check_full_scale(request.full_scale)
            }
            Self::Measurement(request) => {
                request.check_numbers()?;
                check_full_scale(request.full_scale)
            }
            Self::Model(_) => Ok(()),
        }
    }
}

/// Refuses an invalid full scale. Requests are stored as JSON, which would turn an infinity into null.
fn check_full_scale(full_scale: Option<f32>) -> Result<(), Vec<InvalidField>> {
    let error = full_scale.and_then(|value| FullScale::new(value).err());
    error.map_or(Ok(()), |error| Err(vec![InvalidField::new("/full_scale", error.to_string())]))
}

impl CalibrationRequest {
    fn check(&self) -> Result<(), Vec<InvalidField>> {
        let wrong = |pointer: &str, detail: &str| Err(vec![InvalidField::new(pointer, detail)]);
        if self.registration_of.is_some() {
            let (name, registration_of) = (self.name.clone(), self.registration_of);
            return if *self == (Self { name, registration_of, ..Self::default() }) {
                Ok(())
            } else {
                wrong(
                    "/registration_of",
                    "the masks come from the job: state no other field than the name",
                )
            };
        }
        if let Some(dispersion) = &self.dispersion {
            if self.captures.is_some() {
                return wrong(
                    "/dispersion",
                    "a dispersion needs a mask: make it from the captures with `sci-recon calibrate`, and name it as \
                     `masks`",
                );
            }
            if self.mosaic.is_some() {
                return wrong(
                    "/dispersion",
                    "a spectral camera has a grey sensor: leave the mosaic out",
                );
            }
            if let Err(error) = dispersion.check() {
                return wrong(&format!("/dispersion{}", error.pointer), &error.detail);
            }
        }
        let not_with_captures = [
            (self.array.is_some(), "/array", "captures are pictures, not named arrays"),
            (self.axes.is_some(), "/axes", "captures are [frame, row, column]: leave axes out"),
            (self.crop.is_some(), "/crop", "captures are used as a whole: crop the files"),
            (
                self.frames.is_some(),
                "/frames",
                "captures are used as a whole: list the files that are needed",
            ),
            (self.packing.is_some(), "/packing", "captures have one number per pixel"),
            (
                self.full_scale.is_some(),
                "/full_scale",
                "captures have no full scale: white and black give their masks' scale",
            ),
        ];
        let mut not_with_captures = not_with_captures.iter().filter(|(is_given, ..)| *is_given);
        match (&self.masks, &self.captures) {
            (Some(_), None) if self.mosaic.is_some() && !keeps_mosaic(self.crop) => {
                wrong("/crop", "the window of a mosaic starts at an even row and an even column")
            }
            (Some(_), None) => Ok(()),
            (None, Some(captures)) => match not_with_captures.next() {
                Some((_, pointer, detail)) => wrong(pointer, detail),
                None => captures.check(),
            },
            _ => wrong("", "name either masks, captures or registration_of, one of them"),
        }
    }
}

impl MeasurementRequest {
    /// A request that states nothing but its data and their calibration.
    pub fn new(name: Option<Label>, calibration: CalibrationId, data: Sha256) -> Self {
        Self {
            name,
            calibration,
            data,
            array: None,
            axes: None,
            crop: None,
            packing: None,
            dark: Vec::new(),
            saturation: None,
            full_scale: None,
            camera_fps: None,
            exposure_s: None,
            sequence: None,
        }
    }

    /// Refuses numbers that are out of range, and exposures that overlap: they become the times of frames.
    fn check_numbers(&self) -> Result<(), Vec<InvalidField>> {
        let times = [
            ("/camera_fps", self.camera_fps, FRAME_RATES, "snapshots in a second"),
            ("/exposure_s", self.exposure_s, EXPOSURES_S, "seconds"),
        ];
        let mut errors = Vec::new();
        for (pointer, value, range, unit) in times {
            if let Some(value) = value
                && !range.contains(&value)
            {
                let (least, most) = range.into_inner();
                let detail = format!("{value:?} {unit} are outside {least:e} to {most:e}");
                errors.push(InvalidField::new(pointer, detail));
            }
        }
        if let (true, Some(fps), Some(exposure)) =
            (errors.is_empty(), self.camera_fps, self.exposure_s)
            && exposure * fps > 1.0 + EXPOSURE_TOLERANCE
        {
            let detail = format!(
                "an exposure of {exposure} s is longer than the {:.6} s between two snapshots at a camera_fps of {fps}: \
                 correct one of them",
                1.0 / fps
            );
            errors.push(InvalidField::new("/exposure_s", detail));
        }
        if self.saturation == Some(0) {
            let detail = "the smallest number of a saturated pixel is at least 1; leave saturation out for the default";
            errors.push(InvalidField::new("/saturation", detail));
        }
        if self.dark.len() > MAX_REPEATS {
            let detail = format!(
                "{} dark frames; at most {MAX_REPEATS} files are averaged",
                self.dark.len()
            );
            errors.push(InvalidField::new("/dark", detail));
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }
}

#[cfg(test)]
mod tests {
    use super::{CalibrationId, MAX_REPEATS, MeasurementRequest, Sha256};

    #[test]
    fn numbers_that_no_camera_has_are_refused() {
        let request = MeasurementRequest::new(None, CalibrationId::new(), Sha256::of(b"data"));
        let refused = |fps: Option<f64>, exposure: Option<f64>| {
            let timed =
                MeasurementRequest { camera_fps: fps, exposure_s: exposure, ..request.clone() };
            let errors = timed.check_numbers().err().unwrap_or_default();
            errors.into_iter().map(|error| error.pointer).collect::<Vec<_>>()
        };
        for (fps, exposure, pointers) in [
            (Some(50.0), Some(0.02), &[][..]),
            // Rounded in a camera's menu.
            (Some(30.0), Some(0.033_34), &[]),
            (Some(1e-6), Some(1e6), &[]),
            (Some(1e9), Some(1e-9), &[]),
            (Some(1000.0), Some(1.0), &["/exposure_s"]),
            (Some(50.0), Some(0.021), &["/exposure_s"]),
            (Some(5e-324), Some(1e5), &["/camera_fps"]),
            (Some(f64::NAN), Some(1e-300), &["/camera_fps", "/exposure_s"]),
            (Some(1.1e9), None, &["/camera_fps"]),
            (None, Some(1.1e6), &["/exposure_s"]),
        ] {
            assert_eq!(refused(fps, exposure), pointers, "{fps:?} {exposure:?}");
        }
        for (wrong, pointer) in [
            (MeasurementRequest { saturation: Some(0), ..request.clone() }, "/saturation"),
            (
                MeasurementRequest { dark: vec![request.data; MAX_REPEATS + 1], ..request.clone() },
                "/dark",
            ),
        ] {
            assert_eq!(wrong.check_numbers().unwrap_err()[0].pointer, pointer);
        }
        let most = MeasurementRequest { dark: vec![request.data; MAX_REPEATS], ..request };
        most.check_numbers().unwrap();
        assert!(serde_json::to_string_pretty(&most).unwrap().len() < 256 * 1024);
    }
}
