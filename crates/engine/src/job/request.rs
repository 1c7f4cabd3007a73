//! The request for a job as a user writes it, and the job as it is done after all checks.

use serde::{Deserialize, Serialize};

use super::algorithm::Algorithm;
use super::ids::{CalibrationId, MeasurementId, ModelId};
use super::model::{JobModel, ModelChoice};
use super::report::Finding;
use super::shape::{Cut, RunSpec, SceneShape, Sequence, SnapshotRange, TileSpec};
use super::text::{InvalidField, Label};
use reconstruction::ReconError;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::TilePlan;

/// The most tasks of one job; a larger one should be sent as several ranges of snapshots.
pub const MAX_TASKS: usize = 50_000;

/// Bytes of a voxel in a stored tile: one 32-bit float.
const TILE_BYTES: u64 = 4;
/// Bytes of a voxel in the results: EXR frames and stack, NumPy (32 bit each) and PNG (16 bit). EXR
/// and PNG are compressed, but noise is not.
const RESULT_BYTES: u64 = 4 + 4 + 4 + 2;
/// The same of the frames of a mosaic: three colours, and what was seen.
const COLOUR_BYTES: u64 = 3 * RESULT_BYTES + 4;
/// Headers, manifests and rows, for each snapshot.
const SNAPSHOT_BYTES: u64 = 1 << 20;

/// Which snapshots a request means: `"all"`, one index, or `[first, last]` with both ends in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "SelectionJson", into = "SelectionJson")]
pub enum SnapshotSelection {
    #[default]
    All,
    /// The snapshot with this index, from 0.
    One(u32),
    /// From the first to the last index, both included.
    Range(u32, u32),
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum SelectionJson {
    Word(String),
    One(u32),
    Range([u32; 2]),
}

impl TryFrom<SelectionJson> for SnapshotSelection {
    type Error = &'static str;

    fn try_from(json: SelectionJson) -> Result<Self, &'static str> {
        match json {
            SelectionJson::Word(word) if word == "all" => Ok(Self::All),
            SelectionJson::Word(_) => {
                Err("snapshots must be \"all\", one index, or [first, last] with both ends in")
            }
            SelectionJson::One(index) => Ok(Self::One(index)),
            SelectionJson::Range([first, last]) => Ok(Self::Range(first, last)),
        }
    }
}

impl From<SnapshotSelection> for SelectionJson {
    fn from(selection: SnapshotSelection) -> Self {
        match selection {
            SnapshotSelection::All => Self::Word("all".into()),
            SnapshotSelection::One(index) => Self::One(index),
            SnapshotSelection::Range(first, last) => Self::Range([first, last]),
        }
    }
}

/// The body of `POST /v1/jobs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobRequest {
    pub measurement: MeasurementId,
    /// If given, it must be the measurement's own calibration: a check, not a choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrationId>,
    /// The snapshots; all where it is left out.
    #[serde(default)]
    pub snapshots: SnapshotSelection,
    /// Whether the snapshots follow one another; what the measurement says where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sequence: Option<Sequence>,
    pub algorithm: Algorithm,
    /// The network of [`Algorithm::Learned`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelId>,
    /// The schedule; the algorithm's own where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub schedule: Option<Schedule>,
    /// The tiles; [`Algorithm::default_tile`] where it is left out, or the whole picture for a network
    /// that takes no other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tile: Option<TileSpec>,
    /// Jobs of higher priority are served first; from -100 to 100.
    #[serde(default)]
    pub priority: i32,
    /// A name to find the job by.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub label: Option<Label>,
}

/// A job after all checks: nothing is left open, and it is stored and recorded as it stands here.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobSpec {
    pub calibration: CalibrationId,
    pub measurement: MeasurementId,
    pub shape: SceneShape,
    pub snapshots: SnapshotRange,
    /// Whether the snapshots follow one another.
    pub sequence: Sequence,
    /// How they are reconstructed together.
    pub run: RunSpec,
    pub algorithm: Algorithm,
    /// The network of [`Algorithm::Learned`]; none for all others.
    pub model: Option<JobModel>,
    /// The schedule; without stages for [`Algorithm::Learned`].
    pub schedule: Schedule,
    pub tile: TileSpec,
    pub priority: i32,
    pub label: Option<Label>,
    pub warnings: Vec<Finding>,
}

impl JobRequest {
    /// Checks the request against the measurement and the model that it names, and fills in the
    /// defaults. `sequence` is what is known of the measurement.
    /// Errors: all that is wrong, each with its place in the request.
    pub fn resolve(
        self,
        calibration: CalibrationId,
        shape: SceneShape,
        sequence: Sequence,
        model: Option<JobModel>,
    ) -> Result<JobSpec, Vec<InvalidField>> {
        let mut errors = Vec::new();
        if self.calibration.is_some_and(|given| given != calibration) {
            let detail = format!("the measurement was taken with calibration {calibration}");
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
            let faults = InvalidField::of_schedule(&schedule);
            if faults.is_empty() {
                let misfit = self.algorithm.misfit(&schedule);
                errors.extend(misfit.map(|detail| InvalidField::new("/algorithm", detail)));
            }
            errors.extend(faults.into_iter().map(|fault| fault.under("/schedule")));
        }
        let sequence = self.sequence.unwrap_or(sequence);
        let (height, width) = shape.solved();
        let size = (shape.frames, height, width);
        let tile = (tile, self.tile.is_some());
        let cut = Cut::new((sequence, snapshots.count), &schedule, tile, size);
        let Cut { tile, run } = cut.unwrap_or_else(|error| {
            errors.push(InvalidField::new("/tile", error.to_string()));
            Cut { tile: tile.0, run: RunSpec::ALONE }
        });
        errors.extend(priority_error(self.priority));
        if !errors.is_empty() {
            return Err(errors);
        }
        let (measurement, algorithm) = (self.measurement, self.algorithm);
        let (priority, label) = (self.priority, self.label);
        let spec = JobSpec {
            calibration,
            measurement,
            shape,
            snapshots,
            sequence,
            run,
            algorithm,
            model,
            schedule,
            tile,
            priority,
            label,
            warnings: Vec::new(),
        };
        match too_many(&spec) {
            Some(error) => Err(vec![error]),
            None => Ok(spec),
        }
    }
}

/// What is wrong with a priority.
pub fn priority_error(priority: i32) -> Option<InvalidField> {
    (!(-100..=100).contains(&priority)).then(|| {
        let detail = format!("priority is {priority}; it must be from -100 to 100");
        InvalidField::new("/priority", detail)
    })
}

/// A job of more tasks than are taken.
fn too_many(spec: &JobSpec) -> Option<InvalidField> {
    let tiles = spec.tile_plan().ok()?.len() as u64;
    let (runs, snapshots) = (spec.sequence_plan().ok()?.runs().len() as u64, spec.snapshots.count);
    // Besides tiles a preview and an assembly of each snapshot, and three of the job.
    let tasks = tiles * runs + 2 * u64::from(snapshots) + 3;
    (tasks > MAX_TASKS as u64).then(|| {
        let detail = format!(
            "{tiles} tiles in each of {runs} runs of {snapshots} snapshots make {tasks} tasks; at \
             most {MAX_TASKS} fit into one job: use larger tiles or fewer snapshots"
        );
        InvalidField::new("/tile", detail)
    })
}

impl SnapshotSelection {
    /// The snapshots meant, of `available` in the measurement.
    fn within(self, available: u32) -> Result<SnapshotRange, InvalidField> {
        let (first, last) = match self {
            Self::All => (0, available.saturating_sub(1)),
            Self::One(index) => (index, index),
            Self::Range(first, last) => (first, last),
        };
        let detail = if last < first {
            format!("the range ends at {last} before it starts at {first}")
        } else if last >= available {
            format!("snapshot {last} is asked for, but the measurement has {available}, from 0")
        } else {
            return Ok(SnapshotRange { first, count: last - first + 1 });
        };
        Err(InvalidField::new("/snapshots", detail))
    }
}

impl JobSpec {
    /// The tile plan of every snapshot of the job; an error only if the spec was changed by hand.
    pub fn tile_plan(&self) -> Result<TilePlan, ReconError> {
        self.shape.tile_plan(self.tile)
    }

    /// The runs of snapshots that are reconstructed together; an error only if the spec was changed by
    /// hand.
    pub fn sequence_plan(&self) -> Result<SequencePlan, ReconError> {
        let SnapshotRange { first, count } = self.snapshots;
        self.run.plan(first as usize..first as usize + count as usize)
    }

    /// Snapshots that are computed, those that two runs share counted twice.
    pub(super) fn snapshots_computed(&self) -> u64 {
        // A spec is checked before it is stored: its runs can be planned.
        let of = |plan: SequencePlan| plan.runs().iter().map(|run| run.len() as u64).sum();
        self.sequence_plan().map_or(u64::from(self.snapshots.count), of)
    }

    /// An upper bound of the bytes that the job writes to the disk. Tiles are kept until it has
    /// succeeded, so both count.
    pub fn disk_bytes(&self) -> u64 {
        let frames = self.shape.frames as u64;
        let voxels = (self.shape.height * self.shape.width) as u64 * frames;
        let area = |plan: TilePlan| {
            plan.tiles().map(|tile| (tile.height * tile.width) as u64).sum::<u64>()
        };
        // A spec is checked before it is stored: its tiles can be planned.
        let tiles = self.tile_plan().map_or(0, area) * frames;
        let bytes = if self.shape.mosaic.is_some() { COLOUR_BYTES } else { RESULT_BYTES };
        let results = voxels * bytes + SNAPSHOT_BYTES;
        u64::from(self.snapshots.count) * results + self.snapshots_computed() * tiles * TILE_BYTES
    }
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
    fn selections_are_one_index_or_both_ends() {
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
    fn a_job_may_override_what_the_measurement_says() {
        let run = |fields: Value, measured| {
            let request = request(fields).unwrap();
            let spec = request.resolve(CalibrationId::new(), SHAPE, measured, None).unwrap();
            (spec.sequence, spec.run.length)
        };
        let deep = json!({"algorithm": "pnp-tv-fastdvdnet"});
        assert_eq!(run(deep.clone(), Sequence::Contiguous), (Sequence::Contiguous, 5));
        assert_eq!(run(deep, Sequence::Separate), (Sequence::Separate, 1));
        let mut asked = json!({"algorithm": "pnp-tv-fastdvdnet", "sequence": "separate"});
        assert_eq!(run(asked.clone(), Sequence::Contiguous), (Sequence::Separate, 1));
        asked["sequence"] = json!("contiguous");
        assert_eq!(run(asked, Sequence::Separate), (Sequence::Contiguous, 5));
        // Total variation of each frame alone gains nothing.
        assert_eq!(run(json!({}), Sequence::Contiguous), (Sequence::Contiguous, 1));
    }

    #[test]
    fn runs_that_overlap_count_twice_on_the_disk() {
        let spec = |sequence: &str| {
            let fields = json!({"algorithm": "pnp-tv-fastdvdnet", "sequence": sequence,
                "tile": {"size": 304, "overlap": 0}});
            let request = request(fields).unwrap();
            request.resolve(CalibrationId::new(), SHAPE, Sequence::Separate, None).unwrap()
        };
        let (separate, together) = (spec("separate"), spec("contiguous"));
        let frames = (8 * 256 * 300 * 4) as u64;
        // Six snapshots in two runs of four.
        assert_eq!(together.sequence_plan().unwrap().runs(), [0..4, 2..6]);
        assert_eq!(together.disk_bytes() - separate.disk_bytes(), 2 * frames);
        let tiles = |spec: &super::JobSpec| {
            let tasks = spec.tasks().unwrap();
            tasks.into_iter().filter(|(kind, _)| kind.tile().is_some()).collect::<Vec<_>>()
        };
        assert_eq!((tiles(&separate).len(), tiles(&together).len()), (6, 2));
        assert!((tiles(&together)[0].1 / tiles(&separate)[0].1 - 4.0).abs() < 1e-9, "the cost");
    }

    #[test]
    fn all_errors_are_told_at_once_with_their_places() {
        let wrong = json!({
            "snapshots": [4, 6],
            "priority": 101,
            "calibration": CalibrationId::new(),
            "tile": {"size": 64, "overlap": 40},
            "schedule": {"stages": [{"prior": "tv", "iterations": 0, "tv_weight": 0.1}]},
        });
        let places =
            ["/calibration", "/snapshots", "/schedule/stages/0/iterations", "/tile", "/priority"];
        assert_eq!(pointers(wrong), places);
        assert_eq!(pointers(json!({"snapshots": [3, 2]})), ["/snapshots"]);
        let deep = json!({"prior": "fastdvdnet", "iterations": 2, "sigma": [0.1, 0.1]});
        assert_eq!(pointers(json!({"schedule": {"stages": [deep]}})), ["/algorithm"]);
    }
}
