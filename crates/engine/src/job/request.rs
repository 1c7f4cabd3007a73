//! Job requests as users write them, and job specifications after all checks.

use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer, Serialize};

use super::algorithm::Algorithm;
use super::ids::{CalibrationId, MeasurementId, ModelId};
use super::model::{JobModel, ModelChoice, ModelRecord};
use super::registration::{Registered, RegistrationRequest};
use super::report::Finding;
use super::shape::{Cut, CutRequest, RunSpec, SceneShape, Sequence, SnapshotRange, TileSpec};
use super::text::{InvalidField, Label, text_schema};
use super::webhook::Webhook;
use super::{Dispersion, Sha256};
use reconstruction::ReconError;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::TilePlan;

/// Largest number of tasks of one job. Larger jobs can be submitted as several ranges of snapshots.
pub const MAX_TASKS: usize = 50_000;

/// Bytes per voxel of a stored tile: one 32-bit float.
const TILE_BYTES: u64 = 4;
/// Bytes per value of the results: the EXR stack (32 bits), from which other files are derived, and PNG (16 bits).
/// Compression is ignored, because noise does not compress.
const RESULT_BYTES: u64 = 4 + 2;
/// Bytes per row of a frame: prefix (12) and table entry (8) of a line of the stack, and the filter of a PNG.
const ROW_BYTES: u64 = 21;
/// Bytes of headers, manifests and database rows per snapshot.
const SNAPSHOT_BYTES: u64 = 1 << 20;

/// The snapshots of a request: `"all"`, one index, or `[first, last]` with both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(
    rename_all = "snake_case",
    expecting = "snapshots must be \"all\", one index, or [first, last] with both ends included"
)]
pub enum SnapshotSelection {
    #[default]
    All,
    /// The snapshot with this index, counted from 0.
    #[serde(untagged)]
    One(u32),
    /// From the first to the last index, both included.
    #[serde(untagged)]
    Range(u32, u32),
}

text_schema!(SnapshotSelection, "Selection", {
    "description": "All snapshots, one by its index from 0, or [first, last] with both ends included.",
    "default": "all",
    "anyOf": [
        { "type": "string", "enum": ["all"] },
        { "type": "integer", "format": "int64", "minimum": 0, "maximum": u32::MAX },
        {
            "type": "array", "minItems": 2, "maxItems": 2,
            "items": { "type": "integer", "format": "int64", "minimum": 0, "maximum": u32::MAX },
        },
    ],
});

/// The body of `POST /v1/jobs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct JobRequest {
    pub measurement: MeasurementId,
    /// If stated, it must be the calibration of the measurement. It is a check, not a choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrationId>,
    /// The snapshots; by default all.
    #[serde(default)]
    pub snapshots: SnapshotSelection,
    /// Temporal relation of the snapshots; by default that of the measurement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sequence: Option<Sequence>,
    pub algorithm: Algorithm,
    /// The model of algorithm `learned`, registered for the calibration of the measurement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelId>,
    /// The schedule; by default that of the algorithm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub schedule: Option<Schedule>,
    /// The tiles; by default those of the algorithm, or the whole picture for a network of fixed size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tile: Option<TileSpec>,
    /// `auto` estimates and corrects a displacement of the masks since the calibration, `{"shift": [rows, columns]}`
    /// states it in pixels, and `off` uses the masks as they were calibrated; by default `auto`.
    #[serde(
        default,
        deserialize_with = "or_default",
        skip_serializing_if = "RegistrationRequest::is_auto"
    )]
    pub registration: RegistrationRequest,
    /// Jobs of higher priority are served first. A priority above 0 needs the role admin.
    #[serde(default)]
    #[schemars(range(min = -100, max = 100))]
    pub priority: i32,
    /// An upload with the true frames of the selected snapshots' measurement, if they are known. PSNR and SSIM are
    /// relative to them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub truth: Option<Sha256>,
    /// A name for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub label: Option<Label>,
    /// The address to notify when the job ends; by default none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub webhook: Option<Webhook>,
}

/// A job after all checks, with all defaults filled in. It is stored and recorded in this form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobSpec {
    pub calibration: CalibrationId,
    pub measurement: MeasurementId,
    /// The size of the measurement.
    pub shape: SceneShape,
    /// Displacement of the bands of a spectral camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dispersion: Option<Dispersion>,
    pub snapshots: SnapshotRange,
    /// Temporal relation of the snapshots.
    pub sequence: Sequence,
    /// The runs of contiguous snapshots that are reconstructed together.
    pub run: RunSpec,
    pub algorithm: Algorithm,
    /// The network of [`Algorithm::Learned`]; `None` for other algorithms.
    pub model: Option<JobModel>,
    /// The networks of the schedule at the submission.
    #[serde(default)]
    pub networks: Vec<ModelRecord>,
    /// The schedule. It has no stages for [`Algorithm::Learned`].
    pub schedule: Schedule,
    pub tile: TileSpec,
    pub registration: RegistrationRequest,
    /// The outcome of the registration; `None` before it, and if it is off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registered: Option<Registered>,
    pub priority: i32,
    /// The upload with the true frames.
    pub truth: Option<Sha256>,
    pub label: Option<Label>,
    pub webhook: Option<Webhook>,
    pub warnings: Vec<Finding>,
}

impl JobRequest {
    /// Checks the request against its measurement and model, and fills in the defaults. `calibration`, `shape` and
    /// `sequence` are those of the measurement.
    ///
    /// Errors: every violation, each with its JSON pointer in the request.
    pub fn resolve(
        self,
        calibration: CalibrationId,
        shape: SceneShape,
        sequence: Sequence,
        model: Option<JobModel>,
    ) -> Result<JobSpec, Vec<InvalidField>> {
        let mut errors = Vec::new();
        if self.calibration.is_some_and(|stated| stated != calibration) {
            let detail = format!(
                "the measurement belongs to calibration {calibration}: state that one, or omit the field"
            );
            errors.push(InvalidField::new("/calibration", detail));
        }
        let snapshots = self.snapshots.within(shape.snapshots).unwrap_or_else(|error| {
            errors.push(error);
            SnapshotRange { first: 0, count: 1 }
        });
        let choice = ModelChoice {
            algorithm: self.algorithm,
            model: model.as_ref(),
            schedule: self.schedule.as_ref(),
            tile: self.tile,
        };
        errors.extend(choice.errors(calibration, shape));
        let tile = choice.tile(shape);
        let schedule = self.schedule.unwrap_or_else(|| self.algorithm.default_schedule());
        if self.algorithm != Algorithm::Learned {
            let faults = InvalidField::schedule_errors(&schedule);
            if faults.is_empty() {
                let misfit = self.algorithm.misfit(&schedule);
                errors.extend(misfit.map(|detail| InvalidField::new("/algorithm", detail)));
            }
            errors.extend(faults.into_iter().map(|fault| fault.under("/schedule")));
        }
        let sequence = self.sequence.unwrap_or(sequence);
        let (height, width) = shape.solved();
        let request = CutRequest {
            sequence,
            snapshots: snapshots.count,
            size: (shape.frames, height, width),
            tile,
            tile_is_fixed: self.tile.is_some(),
        };
        let Cut { tile, run } = Cut::new(request, &schedule).unwrap_or_else(|error| {
            errors.push(InvalidField::new("/tile", error.to_string()));
            Cut { tile, run: RunSpec::ALONE }
        });
        errors.extend(self.registration.error(shape.mosaic.is_some()));
        errors.extend(priority_error(self.priority));
        if !errors.is_empty() {
            return Err(errors);
        }
        let (measurement, algorithm) = (self.measurement, self.algorithm);
        let (priority, truth) = (self.priority, self.truth);
        let (label, webhook) = (self.label, self.webhook);
        let spec = JobSpec {
            calibration,
            measurement,
            shape,
            dispersion: None,
            snapshots,
            sequence,
            run,
            algorithm,
            model,
            networks: Vec::new(),
            schedule,
            tile,
            registration: self.registration,
            registered: None,
            priority,
            truth,
            label,
            webhook,
            warnings: Vec::new(),
        };
        match excess_tasks(&spec) {
            Some(error) => Err(vec![error]),
            None => Ok(spec),
        }
    }
}

/// Checks a priority.
pub fn priority_error(priority: i32) -> Option<InvalidField> {
    (!(-100..=100).contains(&priority)).then(|| {
        let detail = format!("priority is {priority}; it must be from -100 to 100");
        InvalidField::new("/priority", detail)
    })
}

/// The error of a job with more than [`MAX_TASKS`] tasks.
fn excess_tasks(spec: &JobSpec) -> Option<InvalidField> {
    let tiles = spec.tile_plan().ok()?.len() as u64;
    let (runs, snapshots) = (spec.sequence_plan().ok()?.runs().len() as u64, spec.snapshots.count);
    // Each snapshot has a preview and an assembly; the job has prepare, pilot and manifest.
    let tasks = tiles * runs + 2 * u64::from(snapshots) + 3;
    (tasks > MAX_TASKS as u64).then(|| {
        let detail = format!(
            "the job would have {tasks} tasks ({tiles} tiles in each of {runs} runs, {snapshots} snapshots), but at \
             most {MAX_TASKS} are accepted: use larger tiles or fewer snapshots"
        );
        InvalidField::new("/tile", detail)
    })
}

impl SnapshotSelection {
    /// The selected range out of `available` snapshots.
    fn within(self, available: u32) -> Result<SnapshotRange, InvalidField> {
        let (first, last) = match self {
            Self::All => (0, available.saturating_sub(1)),
            Self::One(index) => (index, index),
            Self::Range(first, last) => (first, last),
        };
        let detail = if last < first {
            format!("the range ends at snapshot {last}, before its start at {first}: swap the two")
        } else if last >= available {
            format!("there is no snapshot {last}: the measurement has {available}, counted from 0")
        } else {
            return Ok(SnapshotRange { first, count: last - first + 1 });
        };
        Err(InvalidField::new("/snapshots", detail))
    }
}

impl JobSpec {
    /// The size of the frames: that of the measurement, or of a band of a spectral camera.
    pub fn frame_shape(&self) -> SceneShape {
        self.shape.frame_shape(self.dispersion.as_ref())
    }

    /// The job for a spectral camera, if there is a dispersion.
    ///
    /// Errors: a stated shift of the masks, or snapshots that are to be reconstructed together.
    pub fn with_dispersion(
        self,
        dispersion: Option<Dispersion>,
    ) -> Result<Self, Vec<InvalidField>> {
        if let Some(error) = self.registration.error(dispersion.is_some()) {
            return Err(vec![error]);
        }
        if dispersion.is_some() && self.sequence == Sequence::Contiguous {
            let detail = "the bands of two spectral snapshots do not continue one another: leave the sequence out";
            return Err(vec![InvalidField::new("/sequence", detail)]);
        }
        Ok(Self { dispersion, ..self })
    }

    /// The tile plan, the same for all snapshots.
    ///
    /// Errors: none for a spec from [`JobRequest::resolve`].
    pub fn tile_plan(&self) -> Result<TilePlan, ReconError> {
        self.shape.tile_plan(self.tile)
    }

    /// The runs of snapshots that are reconstructed together.
    ///
    /// Errors: none for a spec from [`JobRequest::resolve`].
    pub fn sequence_plan(&self) -> Result<SequencePlan, ReconError> {
        let SnapshotRange { first, count } = self.snapshots;
        self.run.plan(first as usize..first as usize + count as usize)
    }

    /// Number of computed snapshots. Snapshots that two runs share count twice.
    pub(super) fn snapshots_computed(&self) -> u64 {
        let total = |plan: SequencePlan| plan.runs().iter().map(|run| run.len() as u64).sum();
        self.sequence_plan().map_or(u64::from(self.snapshots.count), total)
    }

    /// Upper bound of the bytes that the job writes to disk. Tiles are kept until the job has succeeded, so tiles and
    /// results both count.
    pub fn disk_bytes(&self) -> u64 {
        let frames = self.shape.frames as u64;
        let voxels = (self.shape.height * self.shape.width) as u64 * frames;
        let area = |plan: TilePlan| {
            plan.tiles().map(|tile| (tile.height * tile.width) as u64).sum::<u64>()
        };
        let tiles = self.tile_plan().map_or(0, area) * frames;
        let values = voxels * self.shape.channels().count() as u64;
        let rows = self.shape.height as u64 * frames;
        // The map of expected errors has a value of 4 bytes for 16x16 pixels of a frame.
        let results = values * RESULT_BYTES + values / 32 + rows * ROW_BYTES + SNAPSHOT_BYTES;
        u64::from(self.snapshots.count) * results + self.snapshots_computed() * tiles * TILE_BYTES
    }
}

/// Reads a field whose null means the default. Another type is an error of this field: the JSON itself is sound.
fn or_default<'de, T, D>(deserializer: D) -> Result<T, D::Error>
where
    T: Default + DeserializeOwned,
    D: Deserializer<'de>,
{
    let value = Option::<serde_json::Value>::deserialize(deserializer)?;
    value.map_or(Ok(T::default()), |value| serde_json::from_value(value).map_err(D::Error::custom))
}

#[cfg(test)]
mod tests {
    use super::{JobRequest, SceneShape, Sequence, SnapshotRange};
    use crate::job::{Algorithm, CalibrationId, MeasurementId};
    use serde_json::{Value, json};

    const SHAPE: SceneShape =
        SceneShape { frames: 8, height: 256, width: 300, snapshots: 6, mosaic: None };

    fn request(mut fields: Value) -> Result<JobRequest, serde_json::Error> {
        fields["measurement"] = json!(MeasurementId::new());
        fields["algorithm"] = fields.get("algorithm").cloned().unwrap_or(json!("gap-tv"));
        serde_json::from_value(fields)
    }

    fn pointers(fields: Value) -> Vec<String> {
        let errors = request(fields)
            .unwrap()
            .resolve(CalibrationId::new(), SHAPE, Sequence::Separate, None)
            .unwrap_err();
        errors.into_iter().map(|error| error.pointer).collect()
    }

    #[test]
    fn defaults_are_filled_in() {
        let calibration = CalibrationId::new();
        let spec = request(json!({}))
            .unwrap()
            .resolve(calibration, SHAPE, Sequence::Separate, None)
            .unwrap();
        assert_eq!(spec.snapshots, SnapshotRange { first: 0, count: 6 });
        assert_eq!(spec.calibration, calibration);
        assert_eq!(
            (spec.tile_plan().unwrap().len(), spec.tile),
            (1, Algorithm::GapTv.default_tile())
        );
        assert!(!spec.schedule.needs_network());
    }

    #[test]
    fn snapshots_are_selected_by_index_range_or_all() {
        for (json, first, count) in [(json!(2), 2, 1), (json!([1, 3]), 1, 3), (json!("all"), 0, 6)]
        {
            let request = request(json!({ "snapshots": json })).unwrap();
            let spec =
                request.resolve(CalibrationId::new(), SHAPE, Sequence::Separate, None).unwrap();
            assert_eq!(spec.snapshots, SnapshotRange { first, count });
        }
        assert!(request(json!({"snapshots": "some"})).is_err());
        assert!(request(json!({"snapshots": -1})).is_err());
    }

    #[test]
    fn jobs_may_override_the_sequence_of_the_measurement() {
        let sequence_and_run = |fields: Value, measured| {
            let request = request(fields).unwrap();
            let spec = request.resolve(CalibrationId::new(), SHAPE, measured, None).unwrap();
            (spec.sequence, spec.run.length)
        };
        let deep = json!({"algorithm": "pnp-tv-fastdvdnet"});
        assert_eq!(sequence_and_run(deep.clone(), Sequence::Contiguous), (Sequence::Contiguous, 5));
        assert_eq!(sequence_and_run(deep, Sequence::Separate), (Sequence::Separate, 1));
        let mut stated = json!({"algorithm": "pnp-tv-fastdvdnet", "sequence": "separate"});
        assert_eq!(sequence_and_run(stated.clone(), Sequence::Contiguous), (Sequence::Separate, 1));
        stated["sequence"] = json!("contiguous");
        assert_eq!(sequence_and_run(stated, Sequence::Separate), (Sequence::Contiguous, 5));
        // Spatial total variation gains nothing from neighbouring snapshots.
        assert_eq!(sequence_and_run(json!({}), Sequence::Contiguous), (Sequence::Contiguous, 1));
    }

    #[test]
    fn shared_snapshots_of_runs_count_twice_on_disk() {
        let spec = |sequence: &str| {
            let fields = json!({"algorithm": "pnp-tv-fastdvdnet", "sequence": sequence,
                "tile": {"size": 304, "overlap": 0}});
            let request = request(fields).unwrap();
            request.resolve(CalibrationId::new(), SHAPE, Sequence::Separate, None).unwrap()
        };
        let (separate, contiguous) = (spec("separate"), spec("contiguous"));
        let frames = (8 * 256 * 300 * 4) as u64;
        // Six snapshots in two runs of four.
        assert_eq!(contiguous.sequence_plan().unwrap().runs(), [0..4, 2..6]);
        assert_eq!(contiguous.disk_bytes() - separate.disk_bytes(), 2 * frames);
        let tiles = |spec: &super::JobSpec| {
            let tasks = spec.tasks().unwrap();
            tasks.into_iter().filter(|(kind, _)| kind.tile().is_some()).collect::<Vec<_>>()
        };
        assert_eq!((tiles(&separate).len(), tiles(&contiguous).len()), (6, 2));
        assert!((tiles(&contiguous)[0].1 / tiles(&separate)[0].1 - 4.0).abs() < 1e-9, "the cost");
    }

    #[test]
    fn all_errors_are_reported_at_once_with_their_pointers() {
        let wrong = json!({
            "snapshots": [4, 6],
            "priority": 101,
            "calibration": CalibrationId::new(),
            "tile": {"size": 64, "overlap": 40},
            "schedule": {"stages": [{"prior": "tv", "iterations": 0, "tv_weight": 0.1}]},
        });
        let expected =
            ["/calibration", "/snapshots", "/schedule/stages/0/iterations", "/tile", "/priority"];
        assert_eq!(pointers(wrong), expected);
        assert_eq!(pointers(json!({"snapshots": [3, 2]})), ["/snapshots"]);
        let deep = json!({"prior": "fastdvdnet", "iterations": 2, "sigma": [0.1, 0.1]});
        assert_eq!(pointers(json!({"schedule": {"stages": [deep]}})), ["/algorithm"]);
    }
}
