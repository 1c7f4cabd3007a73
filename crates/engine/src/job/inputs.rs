//! The files and the settings of their reading that determine a result, as manifests record them.

use serde::{Deserialize, Serialize};

use super::{CalibrationRequest, Captures, JobId, MeasurementRequest, Sha256};
use formats::{Crop, Packing};
use reconstruction::registration::Correction;

/// The origin of masks. Settings that are not used are left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaskInputs {
    /// The file of the masks: the upload, or the npy file of masks that the service has made.
    pub masks_sha256: Sha256,
    /// Order of the axes in which the masks were read; null for pictures.
    pub masks_axes: Option<String>,
    /// Name of the array in a file of several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masks_array: Option<String>,
    /// Window of each mask.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masks_crop: Option<Crop>,
    /// First and last mask in the file, both included.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masks_frames: Option<[usize; 2]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masks_packing: Option<Packing>,
    /// The map of bad pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bad_pixels_sha256: Option<Sha256>,
    /// The captures from which the masks were made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub captures: Option<Captures>,
    /// The registration that has corrected the masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration_of: Option<Box<CorrectedMasks>>,
}

/// Masks that the registration of a job has corrected.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CorrectedMasks {
    pub job: JobId,
    #[serde(flatten)]
    pub correction: Correction,
    /// Stored value of the calibrated masks that means 1.
    pub masks_full_scale: f32,
    /// The origin of the calibrated masks.
    #[serde(flatten)]
    pub masks: MaskInputs,
}

/// The origin of snapshots. Settings that are not used are left out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasurementInputs {
    pub measurement_sha256: Sha256,
    /// Order of the axes in which the measurement was read; null for pictures.
    pub measurement_axes: Option<String>,
    /// Name of the array in a file of several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub measurement_array: Option<String>,
    /// Window of each snapshot and dark frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub measurement_crop: Option<Crop>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub measurement_packing: Option<Packing>,
    /// The dark frames; the average of all was subtracted.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub dark_sha256: Vec<Sha256>,
    /// Smallest stored number of a saturated pixel.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saturation: Option<u32>,
}

/// The inputs of a job.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inputs {
    #[serde(flatten)]
    pub masks: MaskInputs,
    #[serde(flatten)]
    pub measurement: MeasurementInputs,
}

impl CalibrationRequest {
    /// The origin of the masks that this request has made.
    pub fn inputs(
        &self,
        masks: Sha256,
        axes: Option<String>,
        corrected: Option<CorrectedMasks>,
    ) -> MaskInputs {
        MaskInputs {
            masks_sha256: masks,
            masks_axes: axes,
            masks_array: self.array.as_ref().map(ToString::to_string),
            masks_crop: self.crop,
            masks_frames: self.frames,
            masks_packing: self.packing,
            bad_pixels_sha256: self.bad_pixels,
            captures: self.captures.clone(),
            registration_of: corrected.map(Box::new),
        }
    }
}

impl MeasurementRequest {
    /// The origin of the snapshots that this request has made.
    pub fn inputs(&self, axes: Option<String>) -> MeasurementInputs {
        MeasurementInputs {
            measurement_sha256: self.data,
            measurement_axes: axes,
            measurement_array: self.array.as_ref().map(ToString::to_string),
            measurement_crop: self.crop,
            measurement_packing: self.packing,
            dark_sha256: self.dark.clone(),
            saturation: self.saturation,
        }
    }
}
