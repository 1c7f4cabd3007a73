//! The requests and the files that determine a result, as manifests record them and as jobs are repeated from them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{CalibrationRequest, JobId, MeasurementRequest, Sha256};
use reconstruction::registration::Correction;

/// The origin of masks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MaskInputs {
    /// The file of the masks: the upload, or the npy file of masks that the service has made.
    pub masks_sha256: Sha256,
    /// Order of the axes in which the masks were read; null for pictures.
    pub masks_axes: Option<String>,
    /// The request that repeats the masks. It has neither `masks` nor `captures` if a job has corrected them.
    #[serde(default)]
    pub calibration: Map<String, Value>,
    /// The registration that has corrected the masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration_of: Option<Box<CorrectedMasks>>,
}

/// Masks that the registration of a job has corrected.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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

/// The origin of snapshots.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct MeasurementInputs {
    /// Order of the axes in which the measurement was read; null for pictures.
    pub measurement_axes: Option<String>,
    /// The request that repeats the measurement, without its calibration.
    pub measurement: Map<String, Value>,
}

/// The inputs of a job.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
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
            calibration: fields(self, &["name", "registration_of"]),
            registration_of: corrected.map(Box::new),
        }
    }
}

impl MeasurementRequest {
    /// The origin of the snapshots that this request has made.
    pub fn inputs(&self, axes: Option<String>) -> MeasurementInputs {
        let measurement = fields(self, &["name", "calibration"]);
        MeasurementInputs { measurement_axes: axes, measurement }
    }
}

/// The fields of a request, without those in `names` and without empty ones.
pub fn fields(request: &impl Serialize, names: &[&str]) -> Map<String, Value> {
    // Requests are objects, which serialize without an error.
    let Ok(Value::Object(fields)) = serde_json::to_value(request) else { return Map::new() };
    let is_empty = |value: &Value| value.is_null() || value.as_array().is_some_and(Vec::is_empty);
    let kept =
        |(name, value): &(String, Value)| !names.contains(&name.as_str()) && !is_empty(value);
    fields.into_iter().filter(kept).collect()
}
