//! Manifests: the records of snapshots and jobs.
//!
//! Each has a `content` that depends only on inputs, parameters and arithmetic. Repeating a job on the same kind of
//! machine gives the same content, for any number of workers and crashes. Time, machine and identifiers are in `run`.

use std::collections::BTreeMap;

use ndarray::{Array2, Axis};
use schemars::JsonSchema;
use serde::{Serialize, Serializer};
use serde_json::{Map, Value};

use super::assessment::{BLOCK, Expected, TileAssessment, expected};
use super::records::{CostRecord, PilotRecord, RunRecord, SnapshotRecord, TileRecord};
use crate::job::{
    Algorithm, Assessment, CalibrationId, Dispersion, Finding, Grade, Inputs, JobId, JobSpec,
    Label, MeasurementId, ModelId, ModelRecord, Mosaic, Registered, ResultFile, SceneShape,
    Schedule, Sha256, TaskKind, repetition,
};
use formats::exr::Attributes;
use reconstruction::sequence::{RunShare, SequencePlan};
use reconstruction::tile::TilePlan;

/// Version of this program.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Common prefix of the schema names of this program.
pub(super) const SCHEMA_FAMILY: &str = "sci-recon/";
/// Schema name and version of the manifest of a snapshot.
const SNAPSHOT_SCHEMA: &str = "sci-recon/snapshot/1";
/// Schema name and version of the manifest of a job.
pub const JOB_SCHEMA: &str = "sci-recon/job/1";

/// The part that the manifests of a job and of its snapshots share.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Recipe {
    pub program_version: &'static str,
    pub algorithm: Algorithm,
    /// The schedule as the tiles run it, with all defaults. It has no stages for an end-to-end network.
    pub schedule: Schedule,
    /// The decisions of the pilot that led to this schedule.
    pub pilot: Option<PilotRecord>,
    pub inputs: Inputs,
    /// The registration of the masks, unless it is off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration: Option<Registered>,
    /// The networks of the schedule, or the model of the job.
    pub models: Vec<ModelRecord>,
    pub scale: ScaleRecord,
    #[serde(serialize_with = "tile_plan")]
    #[schemars(with = "TilePlanRecord")]
    pub tile_plan: TilePlan,
    /// The planned runs of snapshots. The pilot may have cut some of them.
    #[serde(serialize_with = "runs")]
    #[schemars(with = "Vec<[usize; 2]>")]
    pub runs: SequencePlan,
    /// Findings of the check of the measurement against its calibration.
    pub warnings: Vec<Finding>,
    /// The size, which is not serialised here, and the mosaic with the demosaicking method; null for a grey sensor.
    #[serde(rename = "colour", serialize_with = "colour")]
    #[schemars(with = "Option<ColourRecord>")]
    pub shape: SceneShape,
    /// Displacement of the bands of a spectral camera; null for frames of a video.
    pub dispersion: Option<Dispersion>,
    /// Snapshots per second, and exposure time of a snapshot in seconds, where known.
    #[serde(skip)]
    pub camera: (Option<f64>, Option<f64>),
}

/// The tiles of a job. Behind a mosaic the size counts pixels of a sub-image, and four tiles, one of each sub-image, share a
/// position.
#[derive(Serialize, JsonSchema)]
struct TilePlanRecord {
    size: usize,
    overlap: usize,
    /// Positions of the tiles as \[row, column, height, width\] in the plan's order.
    tiles: Vec<[usize; 4]>,
}

fn tile_plan<S: Serializer>(plan: &TilePlan, serializer: S) -> Result<S::Ok, S::Error> {
    let tiles = plan.tiles().map(|tile| tile.place()).collect();
    TilePlanRecord { size: plan.size(), overlap: plan.overlap(), tiles }.serialize(serializer)
}

/// The mosaic of the sensor and the demosaicking method.
#[derive(Serialize, JsonSchema)]
struct ColourRecord {
    mosaic: Mosaic,
    demosaicking: &'static str,
}

fn colour<S: Serializer>(shape: &SceneShape, serializer: S) -> Result<S::Ok, S::Error> {
    let record = |mosaic| ColourRecord { mosaic, demosaicking: Mosaic::DEMOSAICKING };
    shape.mosaic.map(record).serialize(serializer)
}

/// Serialises the first and the last snapshot of each run.
fn runs<S: Serializer>(plan: &SequencePlan, serializer: S) -> Result<S::Ok, S::Error> {
    let runs = plan.runs().iter().map(|run| [run.start, run.end - 1]);
    runs.collect::<Vec<_>>().serialize(serializer)
}

impl Recipe {
    /// The runs that contain a snapshot, with their weights for its frames.
    pub fn shares(&self, snapshot: usize) -> Vec<RunShare> {
        let cuts = self.pilot.as_ref().map(PilotRecord::cuts).unwrap_or_default();
        self.runs.shares(snapshot, &cuts, self.shape.frames)
    }

    /// The findings that concern a snapshot, given by its index in the measurement.
    fn warnings_of(&self, snapshot: usize) -> Vec<Finding> {
        let concerns = |warning: &Finding| warning.snapshot.is_none_or(|s| s as usize == snapshot);
        self.warnings.iter().filter(|warning| concerns(warning)).cloned().collect()
    }

    /// A frame of the result from a reconstructed frame \[H,W\]: of a spectral camera, the band in its place.
    pub fn frame(&self, k: usize, solved: Array2<f32>) -> Array2<f32> {
        match &self.dispersion {
            Some(dispersion) => dispersion.unshear(solved.view(), k),
            None => solved,
        }
    }

    /// Predicts the quality of a snapshot, given by its index in the measurement. `shares` has the runs that contain
    /// it, each with the assessments of its tiles in the plan's order. `None` behind a mosaic, for which the model is
    /// not fitted.
    pub fn expected(
        &self,
        snapshot: usize,
        shares: &[(RunShare, Vec<Option<TileAssessment>>)],
    ) -> Option<Expected> {
        if self.shape.mosaic.is_some() {
            return None;
        }
        let scale = (self.shape.frames, self.scale.normalisation, self.scale.white_level);
        let input = (&self.schedule, self.dispersion.as_ref());
        let warnings = self.warnings_of(snapshot);
        let mut expected = expected(&self.tile_plan, shares, input, scale, &warnings)?;
        if let Some(dispersion) = &self.dispersion {
            let sensor = (self.shape.height, self.shape.width);
            let bands = expected.error.outer_iter().enumerate();
            let bands = bands.map(|(k, error)| dispersion.unshear_blocks(error, k, sensor, BLOCK));
            let bands: Vec<_> = bands.collect();
            let views: Vec<_> = bands.iter().map(|band| band.view()).collect();
            expected.error = ndarray::stack(Axis(0), &views).ok()?;
        }
        Some(expected)
    }

    /// The manifest of a snapshot, given by its index in the measurement. Its list of files is empty.
    pub fn snapshot(
        &self,
        snapshot: usize,
        tiles: Vec<TileRecord>,
        assessment: Option<Assessment>,
        run: RunRecord,
    ) -> Manifest {
        let SceneShape { frames, height, width, .. } =
            self.shape.frame_shape(self.dispersion.as_ref());
        // All bands are exposed at the same time.
        let camera = match self.dispersion {
            Some(_) => None,
            None => CameraRecord::new(self.camera, snapshot, frames),
        };
        let recipe = Self { warnings: self.warnings_of(snapshot), ..self.clone() };
        let verdict = Assessment::verdict(&recipe.warnings, assessment.as_ref());
        let content = Content {
            camera,
            recipe,
            frames,
            height,
            width,
            snapshot,
            summary: TileRecord::summary(&tiles),
            verdict,
            assessment,
            tiles,
            files: Vec::new(),
        };
        Manifest { schema: SNAPSHOT_SCHEMA, content, run }
    }

    /// The manifest of a job, from the records of its tasks.
    pub fn job(self, job: JobId, spec: &JobSpec, tasks: JobTasks) -> JobManifest {
        let JobTasks { snapshots, seconds, attempts } = tasks;
        let cost = CostRecord::sum(snapshots.iter().map(|(_, record)| &record.run.cost));
        let mut seconds_by_task = BTreeMap::new();
        for (kind, seconds) in &seconds {
            *seconds_by_task.entry(kind.into_str()).or_insert(0.0) += seconds;
        }
        let entry = |(snapshot, record): (u32, SnapshotRecord)| {
            let SnapshotRecord { summary, assessment, mut files, .. } = record;
            files.retain(|file| file.name != "manifest.json");
            files.sort_by(|a, b| a.name.cmp(&b.name));
            let warnings = self.warnings_of(snapshot as usize);
            let verdict = Assessment::verdict(&warnings, assessment.as_ref());
            SnapshotEntry { snapshot, summary, verdict, assessment, files }
        };
        let snapshots = snapshots.into_iter().map(entry).collect();
        JobManifest {
            schema: JOB_SCHEMA,
            content: JobContent {
                request: repetition(spec),
                shape: self.shape,
                recipe: self,
                snapshots,
            },
            run: JobRun {
                run: RunRecord::ended(Some(job.to_string()), cost, None),
                label: spec.label.clone(),
                truth_sha256: spec.truth,
                calibration: spec.calibration,
                measurement: spec.measurement,
                model: spec.model.as_ref().map(|model| model.id),
                tasks: seconds.len() + 1,
                attempts,
                seconds_by_task,
            },
        }
    }
}

/// The records of all tasks of a job except that of the manifest.
#[derive(Debug, Clone)]
pub struct JobTasks {
    /// The assembled snapshots, each with its index in the measurement.
    pub snapshots: Vec<(u32, SnapshotRecord)>,
    /// Seconds that each task took.
    pub seconds: Vec<(TaskKind, f64)>,
    /// Number of times that workers have claimed a task, that of the manifest included.
    pub attempts: u64,
}

/// The manifest of a snapshot, `manifest.json`.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "SnapshotManifest")]
pub struct Manifest {
    schema: &'static str,
    pub content: Content,
    pub run: RunRecord,
}

/// The part of a manifest that depends only on inputs, parameters and arithmetic.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "SnapshotContent")]
pub struct Content {
    #[serde(flatten)]
    pub recipe: Recipe,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    /// Index of the snapshot in the measurement, counted from 0.
    snapshot: usize,
    /// The records of all tiles of the snapshot, run by run, in the plan's order.
    tiles: Vec<TileRecord>,
    pub summary: TileRecord,
    /// The verdict on the frames; null if nothing was found and there is no prediction.
    pub verdict: Option<Grade>,
    /// The predicted quality of the frames; null where there is no prediction.
    pub assessment: Option<Assessment>,
    camera: Option<CameraRecord>,
    /// The files of the result, except the manifest.
    pub files: Vec<ResultFile>,
}

/// All factors between stored values and the unit scale of the solver. Frames are on the scale of the measurement
/// divided by its full scale: the normalisation is undone. The full scale of the masks defines a mask value of 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct ScaleRecord {
    /// Stored mask value that means 1.
    pub masks_full_scale: f32,
    /// Stored measurement value that means 1.
    pub measurement_full_scale: f32,
    /// Brightness that the solver takes for 1, estimated once per job from the measurement.
    pub normalisation: f32,
    /// The 99.9th percentile of all frames of the job, without pixels that get less than a quarter of the mean light: the
    /// peak of the expected PSNR, and the value that pictures show as white.
    pub white_level: f32,
}

/// The timing of the camera.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct CameraRecord {
    /// Snapshots per second.
    pub fps: Option<f64>,
    /// Exposure time of a snapshot in seconds.
    pub exposure_s: Option<f64>,
    /// Start of each frame in seconds after the start of snapshot 0; null where it is unknown.
    pub frame_times_s: Option<Vec<f64>>,
}

impl CameraRecord {
    /// The timing of the `frames` frames of a snapshot; `None` if neither frame rate nor exposure time is known.
    ///
    /// The masks divide the exposure evenly. An unknown exposure time is assumed to fill the period of the camera.
    /// Without a frame rate only the frames of snapshot 0 have times.
    pub fn new(
        (fps, exposure_s): (Option<f64>, Option<f64>),
        snapshot: usize,
        frames: usize,
    ) -> Option<Self> {
        let period = fps.map(|fps| 1.0 / fps);
        // A rounded exposure may exceed the period, and the times must not run backwards.
        let exposure = exposure_s.map(|exposure| exposure.min(period.unwrap_or(f64::INFINITY)));
        let exposure = exposure.or(period)?;
        let start = match (fps, snapshot) {
            (Some(fps), _) => Some(snapshot as f64 / fps),
            (None, 0) => Some(0.0),
            (None, _) => None,
        };
        let time =
            |start: f64| (0..frames).map(move |k| start + exposure * k as f64 / frames as f64);
        Some(Self { fps, exposure_s, frame_times_s: start.map(|start| time(start).collect()) })
    }

    /// Exposure time of each of `frames` frames in seconds.
    pub fn frame_exposure_s(&self, frames: usize) -> Option<f64> {
        let exposure = self.exposure_s.or_else(|| self.fps.map(|fps| 1.0 / fps))?;
        Some(exposure / frames as f64)
    }
}

/// The manifest of a job.
#[derive(Debug, Serialize, JsonSchema)]
pub struct JobManifest {
    schema: &'static str,
    content: JobContent,
    run: JobRun,
}

#[derive(Debug, Serialize, JsonSchema)]
struct JobContent {
    #[serde(flatten)]
    recipe: Recipe,
    /// The request that repeats the job. The recipe has the requests for its inputs.
    request: Map<String, Value>,
    shape: SceneShape,
    snapshots: Vec<SnapshotEntry>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct SnapshotEntry {
    snapshot: u32,
    summary: TileRecord,
    verdict: Option<Grade>,
    assessment: Option<Assessment>,
    /// The files of the snapshot except its manifest, which has times that differ from run to run.
    files: Vec<ResultFile>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct JobRun {
    #[serde(flatten)]
    run: RunRecord,
    label: Option<Label>,
    /// The upload with the true frames; null if they are unknown.
    truth_sha256: Option<Sha256>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    /// The model of algorithm `learned`; null for others.
    model: Option<ModelId>,
    /// Number of tasks.
    tasks: usize,
    /// Number of times that workers have claimed a task.
    attempts: u64,
    /// Total seconds of each kind of task.
    seconds_by_task: BTreeMap<&'static str, f64>,
}

/// The attributes of each EXR frame.
pub fn frame_attributes(content: &Content) -> Vec<Attributes> {
    let recipe = &content.recipe;
    let mut shared = vec![
        ("program".to_owned(), format!("sci-recon {}", recipe.program_version)),
        ("algorithm".to_owned(), recipe.algorithm.into_str().to_owned()),
        ("snapshot".to_owned(), content.snapshot.to_string()),
        ("masksSha256".to_owned(), recipe.inputs.masks.masks_sha256.to_string()),
        (
            "measurementSha256".to_owned(),
            recipe.inputs.measurement.measurement["data"].as_str().unwrap_or_default().to_owned(),
        ),
        ("whiteLevel".to_owned(), recipe.scale.white_level.to_string()),
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
        let part = if recipe.dispersion.is_some() { "band" } else { "frame" };
        texts.push((part.to_owned(), format!("{} of {}", k + 1, content.frames)));
        Attributes {
            texts,
            wavelength_nm: recipe.dispersion.as_ref().and_then(|bands| bands.wavelength(k)),
            frame_time_s: times.and_then(|times| times.get(k).copied()),
            frames_per_second: exposure.map(|seconds| 1.0 / seconds),
            exposure_s: exposure.map(|seconds| seconds as f32),
        }
    };
    (0..content.frames).map(frame).collect()
}

#[cfg(test)]
use crate::job::{CalibrationRequest, MeasurementRequest};

#[cfg(test)]
pub(super) fn sample(frames: usize) -> Manifest {
    let hash = Sha256::of(b"");
    let recipe = Recipe {
        program_version: VERSION,
        algorithm: Algorithm::GapTv,
        schedule: Schedule::gap_tv(),
        pilot: None,
        registration: None,
        shape: SceneShape { frames, height: 20, width: 24, snapshots: 2, mosaic: None },
        inputs: Inputs {
            masks: CalibrationRequest::default().inputs(hash, None, None),
            measurement: MeasurementRequest::new(None, CalibrationId::new(), hash)
                .inputs(Some("frame-row-column".to_owned())),
        },
        models: vec![ModelRecord { name: "fastdvdnet-gray-int8".into(), sha256: hash.to_string() }],
        scale: ScaleRecord {
            masks_full_scale: 1.0,
            measurement_full_scale: 255.0,
            normalisation: 0.8,
            white_level: 0.9,
        },
        tile_plan: TilePlan::new(20, 24, 256, 32).unwrap(),
        runs: SequencePlan::separate(0..2),
        warnings: Vec::new(),
        dispersion: None,
        camera: (Some(50.0), Some(0.012)),
    };
    recipe.snapshot(1, Vec::new(), None, RunRecord::ended(None, CostRecord::default(), None))
}

#[cfg(test)]
mod tests {
    use super::CameraRecord;
    use formats::{Channels, exr};

    #[test]
    fn exr_attributes_record_the_provenance() {
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
        // OpenEXR must accept all attribute names.
        exr::Stack::new((2, 2), Channels::Grey, &attributes).unwrap();
    }

    #[test]
    fn frame_times_divide_the_exposure_evenly() {
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
