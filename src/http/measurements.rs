//! `/v1/measurements`: coded snapshots.

use serde::Serialize;

use super::error::{Problem, Result};
use super::submissions::{ResourceApi, ResourceState, pending};
use engine::job::{
    CalibrationId, Finding, Label, MeasurementId, MeasurementRequest, Reading, Sequence, Sha256,
    Submission, Timestamp,
};
use store::{FoundResource, StoreError};

/// A measurement. Facts about its data are null until they are checked.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Measurement")]
pub(super) struct MeasurementBody {
    id: MeasurementId,
    state: ResourceState,
    /// The failure in words.
    error: Option<String>,
    /// The failure, as an answer to the request would have stated it.
    problem: Option<Problem>,
    created_at: Timestamp,
    name: Option<Label>,
    calibration: CalibrationId,
    data: Sha256,
    #[serde(flatten)]
    facts: MeasurementFacts,
}

#[derive(Debug, Default, Serialize, schemars::JsonSchema)]
struct MeasurementFacts {
    /// Format of the file.
    format: Option<String>,
    /// Type of the samples in the file.
    sample: Option<String>,
    /// Order of the axes of the array; null for pictures.
    axes: Option<String>,
    snapshots: Option<u32>,
    height: Option<usize>,
    width: Option<usize>,
    /// The stored number that means 1.
    full_scale: Option<f32>,
    /// Snapshots per second.
    camera_fps: Option<f64>,
    /// Exposure of a snapshot in seconds.
    exposure_s: Option<f64>,
    sequence: Option<Sequence>,
    dark: Vec<Sha256>,
    /// The stated value from which pixels are saturated; null if the measurement shows it.
    saturation: Option<u32>,
    /// Findings of the check against the calibration. Every job of the measurement repeats them.
    warnings: Vec<Finding>,
    reading: Option<Reading>,
}

impl ResourceApi for MeasurementId {
    const PATH: &'static str = "/v1/measurements";
    const SUBMISSION: fn(MeasurementRequest) -> Submission = Submission::Measurement;
    type Body = MeasurementBody;

    fn body(found: FoundResource<Self>) -> Result<MeasurementBody> {
        let request = match found {
            FoundResource::Pending(request) => *request,
            FoundResource::Ready(measurement) => {
                let facts = measurement.facts;
                return Ok(MeasurementBody {
                    id: measurement.id,
                    state: ResourceState::Ready,
                    error: None,
                    problem: None,
                    created_at: measurement.created_at,
                    name: measurement.name,
                    calibration: facts.calibration,
                    data: facts.data,
                    facts: MeasurementFacts {
                        format: Some(facts.format),
                        sample: Some(facts.sample),
                        axes: facts.axes,
                        snapshots: Some(facts.snapshots),
                        height: Some(facts.height),
                        width: Some(facts.width),
                        full_scale: Some(facts.full_scale),
                        camera_fps: facts.camera_fps,
                        exposure_s: facts.exposure_s,
                        sequence: Some(facts.sequence),
                        dark: facts.dark,
                        saturation: measurement.request.saturation,
                        warnings: facts.warnings,
                        reading: Some(facts.reading),
                    },
                });
            }
        };
        let (state, error, problem) = pending(&request);
        let Submission::Measurement(submission) = request.submission else {
            return Err(
                StoreError::NotFound { what: "measurement", id: request.id.to_string() }.into()
            );
        };
        Ok(MeasurementBody {
            id: request.id.into(),
            state,
            error,
            problem,
            created_at: request.created_at,
            name: request.name,
            calibration: submission.calibration,
            data: submission.data,
            facts: MeasurementFacts {
                camera_fps: submission.camera_fps,
                exposure_s: submission.exposure_s,
                dark: submission.dark,
                saturation: submission.saturation,
                ..MeasurementFacts::default()
            },
        })
    }
}
