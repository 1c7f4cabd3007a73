//! The request that repeats a job.

use serde_json::{Map, Value};

use super::algorithm::Algorithm;
use super::inputs::fields;
use super::request::{JobRequest, JobSpec, SnapshotSelection};
use super::shape::SnapshotRange;

/// The request that repeats a job, without identifiers and without fields that do not change the frames.
pub fn repetition(spec: &JobSpec) -> Map<String, Value> {
    let left_out = ["measurement", "model", "priority", "truth", "label", "webhook"];
    fields(&repeated(spec), &left_out)
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

    use super::repetition;
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
            let again = resolved(Value::Object(repetition(&spec)));
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
        let job = repetition(&spec);
        assert!(["measurement", "label", "priority"].iter().all(|name| !job.contains_key(*name)));
        let hash = Sha256::of(b"file");
        let masks = json!({"masks": hash, "name": "May", "full_scale": 255, "frames": [0, 7]});
        let masks: CalibrationRequest = serde_json::from_value(masks).unwrap();
        let recorded = masks.inputs(hash, None, None).calibration;
        assert_eq!(json!(recorded), json!({"masks": hash, "full_scale": 255.0, "frames": [0, 7]}));
        let data = json!({"calibration": spec.calibration, "data": hash, "dark": [hash], "saturation": 4000});
        let data: MeasurementRequest = serde_json::from_value(data).unwrap();
        let recorded = data.inputs(None).measurement;
        assert_eq!(json!(recorded), json!({"data": hash, "dark": [hash], "saturation": 4000}));
    }
}
