//! The record that stands beside every result: of a snapshot, and of a whole job.
//!
//! Both have a `content` that depends on inputs, parameters and the arithmetic alone: doing the same
//! work again on the same kind of machine gives the same content, whatever the number of workers
//! and however often they died. What belongs to one run (time, machine, ids) is in `run`.

use std::collections::BTreeMap;

use serde::{Serialize, Serializer};

use super::assessment::{Expected, TileAssessment, expected};
use super::networks::ModelRecord;
use super::records::{CostRecord, PilotRecord, RunRecord, SnapshotRecord, Summary, TileRecord};
use crate::job::{
    Algorithm, Assessment, CalibrationId, Finding, JobId, JobSpec, Label, MeasurementId, Mosaic,
    ResultFile, SceneShape, Schedule, Sha256, TaskKind,
};
use formats::exr::Attributes;
use reconstruction::sequence::{RunShare, SequencePlan};
use reconstruction::tile::TilePlan;

pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// What the names of all our records begin with.
pub(super) const SCHEMA_FAMILY: &str = "sci-recon/";
/// Name and version of the record of a snapshot.
const SNAPSHOT_SCHEMA: &str = "sci-recon/snapshot/1";
/// Name and version of the record of a job.
const JOB_SCHEMA: &str = "sci-recon/job/1";

/// What the manifests of a job and of its snapshots have in common.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recipe {
    pub program_version: &'static str,
    pub algorithm: Algorithm,
    /// As the tiles run it, with all defaults; without stages for an end-to-end network.
    pub schedule: Schedule,
    /// How an adaptive schedule became this one.
    pub pilot: Option<PilotRecord>,
    pub inputs: Inputs,
    /// The networks that the schedule names, or that of a job with a model.
    pub models: Vec<ModelRecord>,
    pub scale: ScaleRecord,
    #[serde(serialize_with = "tile_plan")]
    pub tile_plan: TilePlan,
    /// The snapshots that were reconstructed together, before joints were taken apart.
    #[serde(serialize_with = "runs")]
    pub runs: SequencePlan,
    /// What the check of the measurement against its calibration found.
    pub warnings: Vec<Finding>,
    /// How the frames got their colours; null for a grey sensor. Also tells their size.
    #[serde(rename = "colour", serialize_with = "colour")]
    pub shape: SceneShape,
    /// Snapshots a second, and seconds that one is exposed, where the camera told.
    #[serde(skip)]
    pub camera: (Option<f64>, Option<f64>),
}

/// Size and overlap, and the places of tiles as \[row, column, height, width\] in the plan's order: of a mosaic
/// four tiles, one of each sub-image, have a part in a place. The size is that in the sub-image then.
fn tile_plan<S: Serializer>(plan: &TilePlan, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Record {
        size: usize,
        overlap: usize,
        tiles: Vec<[usize; 4]>,
    }
    let tiles = plan.tiles().map(|tile| tile.place()).collect();
    Record { size: plan.size(), overlap: plan.overlap(), tiles }.serialize(serializer)
}

/// The sensor's mosaic, and how the colours between its pixels were found.
fn colour<S: Serializer>(shape: &SceneShape, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Record {
        mosaic: Mosaic,
        demosaicking: &'static str,
    }
    let record = |mosaic| Record { mosaic, demosaicking: Mosaic::DEMOSAICKING };
    shape.mosaic.map(record).serialize(serializer)
}

/// The first and the last snapshot of each run.
fn runs<S: Serializer>(plan: &SequencePlan, serializer: S) -> Result<S::Ok, S::Error> {
    let runs = plan.runs().iter().map(|run| [run.start, run.end - 1]);
    runs.collect::<Vec<_>>().serialize(serializer)
}

impl Recipe {
    /// What the frames of a snapshot take from the runs that hold it.
    pub fn shares(&self, snapshot: usize) -> Vec<RunShare> {
        let cuts = self.pilot.as_ref().map(PilotRecord::cuts).unwrap_or_default();
        self.runs.shares(snapshot, &cuts, self.shape.frames)
    }

    /// What the checks found of a snapshot, by its index in the measurement.
    fn warnings_of(&self, snapshot: usize) -> Vec<Finding> {
        let concerns = |warning: &Finding| warning.snapshot.is_none_or(|s| s as usize == snapshot);
        self.warnings.iter().filter(|warning| concerns(warning)).cloned().collect()
    }

    /// What the tiles of a snapshot, by its index in the measurement, let expect of its frames: of each run that
    /// has a share in it those of its tiles, in the plan's order. None of a mosaic, whose colours no prediction was
    /// fitted to.
    pub fn expected(
        &self,
        snapshot: usize,
        shares: &[(RunShare, Vec<Option<TileAssessment>>)],
    ) -> Option<Expected> {
        if self.shape.mosaic.is_some() {
            return None;
        }
        let scale = (self.shape.frames, self.scale.white);
        expected(&self.tile_plan, shares, &self.schedule, scale, &self.warnings_of(snapshot))
    }

    /// The manifest of a snapshot, by its index in the measurement, but for its files.
    pub fn snapshot(
        &self,
        snapshot: usize,
        tiles: Vec<TileRecord>,
        assessment: Option<Assessment>,
        run: RunRecord,
    ) -> Manifest {
        let SceneShape { frames, height, width, .. } = self.shape;
        let recipe = Self { warnings: self.warnings_of(snapshot), ..self.clone() };
        let content = Content {
            camera: CameraRecord::new(self.camera, snapshot, frames),
            recipe,
            frames,
            height,
            width,
            snapshot,
            summary: Summary::of(&tiles),
            assessment,
            tiles,
            files: Vec::new(),
        };
        Manifest { schema: SNAPSHOT_SCHEMA, content, run }
    }

    /// The manifest of a job from what its tasks have left.
    pub fn job(self, job: JobId, spec: &JobSpec, tasks: JobTasks) -> JobManifest {
        let JobTasks { snapshots, seconds, attempts } = tasks;
        let cost = CostRecord::sum(snapshots.iter().map(|(_, record)| &record.run.cost));
        let mut seconds_by_task = BTreeMap::new();
        for (kind, seconds) in &seconds {
            *seconds_by_task.entry(kind.into_str()).or_insert(0.0) += seconds;
        }
        let entry = |(snapshot, record): (u32, SnapshotRecord)| {
            let files = record.files.into_iter().filter(|file| file.name != "manifest.json");
            let SnapshotRecord { summary, assessment, .. } = record;
            SnapshotEntry { snapshot, summary, assessment, files: files.collect() }
        };
        let snapshots = snapshots.into_iter().map(entry).collect();
        JobManifest {
            schema: JOB_SCHEMA,
            content: JobContent { shape: self.shape, recipe: self, snapshots },
            run: JobRun {
                run: RunRecord::ended(Some(job.to_string()), cost, None),
                label: spec.label.clone(),
                calibration: spec.calibration,
                measurement: spec.measurement,
                tasks: seconds.len() + 1,
                attempts,
                seconds_by_task,
            },
        }
    }
}

/// What the tasks of a job have left when only its manifest is to be written.
#[derive(Debug, Clone)]
pub struct JobTasks {
    /// The assembled snapshots by their index in the measurement.
    pub snapshots: Vec<(u32, SnapshotRecord)>,
    pub seconds: Vec<(TaskKind, f64)>,
    /// How often workers took one up, that of the manifest among them.
    pub attempts: u64,
}

/// `manifest.json` of a snapshot.
#[derive(Debug, Serialize)]
pub struct Manifest {
    schema: &'static str,
    pub content: Content,
    pub run: RunRecord,
}

/// What follows from inputs and parameters.
#[derive(Debug, Serialize)]
pub struct Content {
    #[serde(flatten)]
    pub recipe: Recipe,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    /// The snapshot's index in the measurement, from 0.
    snapshot: usize,
    /// What came of each tile that has a part in the snapshot: run by run, in the plan's order.
    tiles: Vec<TileRecord>,
    pub summary: Summary,
    /// How good the frames are, as far as that can be told without a truth; null where it can't.
    pub assessment: Option<Assessment>,
    camera: Option<CameraRecord>,
    /// The files that came out, without this one.
    pub files: Vec<ResultFile>,
}

/// The files that went in.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inputs {
    pub masks_sha256: Sha256,
    /// How the axes of the array were read; none for pictures.
    pub masks_axes: Option<String>,
    pub measurement_sha256: Sha256,
    pub measurement_axes: Option<String>,
}

/// Every factor between the stored numbers and the solver's \[0,1\]. All are undone in the
/// frames but the masks', which defines what a mask is: frames are on the measurement's scale
/// after division by its full scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ScaleRecord {
    /// Value in the masks' file that means 1.
    pub masks_full_scale: f32,
    /// Value in the measurement's file that means 1.
    pub measurement_full_scale: f32,
    /// White level of the scene, estimated once for all tiles: the solver worked on frames
    /// divided by it.
    pub white: f32,
}

/// What the camera told about time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraRecord {
    /// Snapshots a second.
    pub fps: Option<f64>,
    /// Seconds that one snapshot is exposed.
    pub exposure_s: Option<f64>,
    /// Start of each frame in seconds after the start of snapshot 0; none where it does not
    /// follow from the two.
    pub frame_times_s: Option<Vec<f64>>,
}

impl CameraRecord {
    /// The times of the `frames` frames of a snapshot.
    ///
    /// The masks share the exposure evenly; an unknown exposure is taken to fill the camera's
    /// whole period. Without a frame rate only snapshot 0 has times. None if neither is known.
    pub fn new(
        (fps, exposure_s): (Option<f64>, Option<f64>),
        snapshot: usize,
        frames: usize,
    ) -> Option<Self> {
        let exposure = exposure_s.or_else(|| fps.map(|fps| 1.0 / fps))?;
        let start = match (fps, snapshot) {
            (Some(fps), _) => Some(snapshot as f64 / fps),
            (None, 0) => Some(0.0),
            (None, _) => None,
        };
        let time =
            |start: f64| (0..frames).map(move |k| start + exposure * k as f64 / frames as f64);
        Some(Self { fps, exposure_s, frame_times_s: start.map(|start| time(start).collect()) })
    }

    /// Seconds that each of `frames` frames lasts.
    pub fn frame_exposure_s(&self, frames: usize) -> Option<f64> {
        let exposure = self.exposure_s.or_else(|| self.fps.map(|fps| 1.0 / fps))?;
        Some(exposure / frames as f64)
    }
}

#[derive(Debug, Serialize)]
pub struct JobManifest {
    schema: &'static str,
    content: JobContent,
    run: JobRun,
}

#[derive(Debug, Serialize)]
struct JobContent {
    #[serde(flatten)]
    recipe: Recipe,
    shape: SceneShape,
    snapshots: Vec<SnapshotEntry>,
}

#[derive(Debug, Serialize)]
struct SnapshotEntry {
    snapshot: u32,
    summary: Summary,
    assessment: Option<Assessment>,
    /// Without the snapshot's own manifest, whose times differ from run to run.
    files: Vec<ResultFile>,
}

#[derive(Debug, Serialize)]
struct JobRun {
    #[serde(flatten)]
    run: RunRecord,
    label: Option<Label>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    /// Tasks of the job, and how often workers took one up.
    tasks: usize,
    attempts: u64,
    /// Seconds that each kind of task took, over all tasks.
    seconds_by_task: BTreeMap<&'static str, f64>,
}

/// What each EXR frame says about itself.
pub fn frame_attributes(content: &Content) -> Vec<Attributes> {
    let recipe = &content.recipe;
    let mut shared = vec![
        ("program".to_owned(), format!("sci-recon {}", recipe.program_version)),
        ("algorithm".to_owned(), recipe.algorithm.into_str().to_owned()),
        ("snapshot".to_owned(), content.snapshot.to_string()),
        ("masksSha256".to_owned(), recipe.inputs.masks_sha256.to_string()),
        ("measurementSha256".to_owned(), recipe.inputs.measurement_sha256.to_string()),
        ("whiteLevel".to_owned(), recipe.scale.white.to_string()),
    ];
    if let Some(mosaic) = recipe.shape.mosaic {
        shared.push(("mosaic".to_owned(), mosaic.to_string()));
        shared.push(("demosaicking".to_owned(), Mosaic::DEMOSAICKING.to_owned()));
    }
    for model in &recipe.models {
        shared.push((format!("model {}", model.name), model.sha256.clone()));
    }
    let camera = content.camera.as_ref();
    let times = camera.and_then(|camera| camera.frame_times_s.as_deref());
    let exposure = camera.and_then(|camera| camera.frame_exposure_s(content.frames));
    let frame = |k: usize| {
        let mut texts = shared.clone();
        texts.push(("frame".to_owned(), format!("{} of {}", k + 1, content.frames)));
        Attributes {
            texts,
            frame_time_s: times.and_then(|times| times.get(k).copied()),
            frames_per_second: exposure.map(|seconds| 1.0 / seconds),
            exposure_s: exposure.map(|seconds| seconds as f32),
        }
    };
    (0..content.frames).map(frame).collect()
}

#[cfg(test)]
pub(super) fn sample(frames: usize) -> Manifest {
    let hash = Sha256::of(b"");
    let recipe = Recipe {
        program_version: VERSION,
        algorithm: Algorithm::GapTv,
        schedule: Schedule::gap_tv(),
        pilot: None,
        shape: SceneShape { frames, height: 20, width: 24, snapshots: 2, mosaic: None },
        inputs: Inputs {
            masks_sha256: hash,
            masks_axes: None,
            measurement_sha256: hash,
            measurement_axes: Some("frame-row-column".to_owned()),
        },
        models: ModelRecord::of(&Algorithm::PnpTvFastdvdnet.default_schedule()),
        scale: ScaleRecord { masks_full_scale: 1.0, measurement_full_scale: 255.0, white: 0.9 },
        tile_plan: TilePlan::new(20, 24, 256, 32).unwrap(),
        runs: SequencePlan::separate(0..2),
        warnings: Vec::new(),
        camera: (Some(50.0), Some(0.012)),
    };
    recipe.snapshot(1, Vec::new(), None, RunRecord::ended(None, CostRecord::default(), None))
}

#[cfg(test)]
mod tests {
    use super::CameraRecord;
    use formats::{Channels, exr};

    #[test]
    fn frames_tell_where_they_come_from() {
        let content = super::sample(3).content;
        let attributes = super::frame_attributes(&content);
        assert_eq!(attributes.len(), 3);
        let text = |name: &str| {
            let entry = attributes[2].texts.iter().find(|(n, _)| n == name);
            entry.map(|(_, value)| value.as_str())
        };
        assert_eq!(text("frame"), Some("3 of 3"));
        assert_eq!(text("algorithm"), Some("gap-tv"));
        assert_eq!(text("model fastdvdnet-gray-int8").map(str::len), Some(64));
        assert!((attributes[2].frame_time_s.unwrap() - 0.028).abs() < 1e-12);
        assert!((attributes[2].frames_per_second.unwrap() - 250.0).abs() < 1e-9);
        // They must be names that OpenEXR takes.
        let file = tempfile::NamedTempFile::new().unwrap();
        let frame = ndarray::Array2::zeros((2, 2));
        exr::write_frame(file.path(), frame.view(), Channels::Grey, &attributes[2]).unwrap();
    }

    #[test]
    fn frame_times_share_the_exposure() {
        let camera = CameraRecord::new((Some(50.0), Some(0.016)), 2, 4).unwrap();
        let times = camera.frame_times_s.clone().unwrap();
        let expected = [0.040, 0.044, 0.048, 0.052];
        assert!(times.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{times:?}");
        assert_eq!(camera.frame_exposure_s(4), Some(0.004));
        let full = CameraRecord::new((Some(50.0), None), 0, 4).unwrap();
        assert_eq!(full.frame_times_s.unwrap()[1], 0.005);
        assert_eq!(CameraRecord::new((None, Some(0.01)), 1, 4).unwrap().frame_times_s, None);
        assert!(CameraRecord::new((None, None), 0, 4).is_none());
    }
}
