//! The requests that repeat a job.

use serde::Serialize;
use serde_json::{Map, Value};

use super::algorithm::Algorithm;
use super::request::{JobRequest, JobSpec, SnapshotSelection};
use super::shape::SnapshotRange;
use super::submission::{CalibrationRequest, MeasurementRequest};

/// The requests that repeat a job, without identifiers and without fields that do not change the frames. Uploads are
/// named by their hashes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Repetition {
    /// Neither `masks` nor `captures` if another job has made the masks.
    calibration: Map<String, Value>,
    measurement: Map<String, Value>,
    job: Map<String, Value>,
}

impl Repetition {
    /// The requests for a job of this measurement.
    ///
    /// Errors: none for requests that were read from JSON.
    pub fn new(
        calibration: &CalibrationRequest,
        measurement: &MeasurementRequest,
        spec: &JobSpec,
    ) -> Result<Self, serde_json::Error> {
        Ok(Self {
            calibration: without(calibration, &["name", "registration_of"])?,
            measurement: without(measurement, &["name", "calibration"])?,
            job: without(
                &repeated(spec),
                &["measurement", "model", "priority", "truth", "label", "webhook"],
            )?,
        })
    }
}

/// The fields of a request, without those in `names` and without empty ones.
fn without(request: &impl Serialize, names: &[&str]) -> serde_json::Result<Map<String, Value>> {
    let Value::Object(fields) = serde_json::to_value(request)? else { return Ok(Map::new()) };
    let is_empty = |value: &Value| value.is_null() || value.as_array().is_some_and(Vec::is_empty);
    let kept =
        |(name, value): &(String, Value)| !names.contains(&name.as_str()) && !is_empty(value);
    Ok(fields.into_iter().filter(kept).collect())
}

/// A request that resolves to the same job. It states every default, so that a version with other defaults repeats the
/// job, too.
fn repeated(spec: &JobSpec) -> JobRequest {
    let SnapshotRange { first, count } = spec.snapshots;
    let request = JobRequest {
        measurement: spec.measurement,
        calibration: None,
        snapshots: SnapshotSelection::Range(first, first + count.saturating_sub(1)),
        sequence: Some(spec.sequence),
        algorithm: spec.algorithm,
        model: None,
        schedule: (spec.algorithm != Algorithm::Learned).then(|| spec.schedule.clone()),
        tile: Some(spec.tile),
        registration: spec.registration,
        priority: 0,
        truth: None,
        label: None,
        webhook: None,
    };
    // A stated tile may allow fewer snapshots in a run than the same tile as a default.
    let (calibration, model) = (spec.calibration, spec.model.clone());
    let resolved = request.clone().resolve(calibration, spec.shape, spec.sequence, model);
    match resolved {
        Ok(same) if (same.tile, same.run) == (spec.tile, spec.run) => request,
        _ => JobRequest { tile: None, ..request },
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::Repetition;
    use crate::job::{
        CalibrationId, CalibrationRequest, JobRequest, JobSpec, MeasurementId, MeasurementRequest,
        SceneShape, Sequence, Sha256,
    };

    const SHAPE: SceneShape =
        SceneShape { frames: 8, height: 256, width: 300, snapshots: 6, mosaic: None };

    fn resolved(mut fields: Value) -> JobSpec {
        fields["measurement"] = json!(MeasurementId::new());
        let request: JobRequest = serde_json::from_value(fields).unwrap();
        request.resolve(CalibrationId::new(), SHAPE, Sequence::Contiguous, None).unwrap()
    }

    fn repetition(spec: &JobSpec) -> Value {
        let upload = json!(Sha256::of(b"file"));
        let masks = json!({"masks": upload, "name": "May", "full_scale": 255, "frames": [0, 7]});
        let masks: CalibrationRequest = serde_json::from_value(masks).unwrap();
        let data = json!({"calibration": spec.calibration, "data": upload, "dark": [upload], "saturation": 4000});
        let data: MeasurementRequest = serde_json::from_value(data).unwrap();
        json!(Repetition::new(&masks, &data, spec).unwrap())
    }

    #[test]
    fn the_repeated_request_resolves_to_the_same_job() {
        let tile = json!({"size": 128, "overlap": 16});
        let stages = json!({"stages": [{"prior": "tv", "iterations": 9, "tv_weight": 0.1}]});
        for fields in [
            json!({"algorithm": "pnp-tv-fastdvdnet", "label": "milk", "priority": -3}),
            json!({"algorithm": "pnp-tv-fastdvdnet", "sequence": "separate", "snapshots": 2}),
            json!({"algorithm": "gap-tv", "tile": tile, "schedule": stages, "snapshots": [1, 3]}),
            json!({"algorithm": "gap-tv3d", "registration": {"shift": [0.5, -1.0]}}),
        ] {
            let spec = resolved(fields.clone());
            let again = resolved(repetition(&spec)["job"].clone());
            let frames = |spec: &JobSpec| {
                let JobSpec { snapshots, sequence, run, schedule, tile, registration, .. } =
                    spec.clone();
                (snapshots, sequence, run, schedule, tile, registration)
            };
            assert_eq!(frames(&again), frames(&spec), "{fields}");
        }
    }

    #[test]
    fn identifiers_and_names_are_left_out() {
        let spec = resolved(json!({"algorithm": "gap-tv", "label": "milk", "priority": -3}));
        let hash = json!(Sha256::of(b"file"));
        let repetition = repetition(&spec);
        let masks = json!({"masks": hash, "full_scale": 255.0, "frames": [0, 7]});
        assert_eq!(repetition["calibration"], masks);
        let data = json!({"data": hash, "dark": [hash], "saturation": 4000});
        assert_eq!(repetition["measurement"], data);
        let job = repetition["job"].as_object().unwrap();
        assert!(["measurement", "label", "priority"].iter().all(|name| !job.contains_key(*name)));
    }
}
