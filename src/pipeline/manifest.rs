//! The record that stands beside every result.
//!
//! [`Manifest::content`] depends on inputs, parameters and the arithmetic alone: doing the same
//! work again on the same kind of machine gives the same content, whatever the number of workers
//! and however often they died. What belongs to one run (time, machine, ids) is in
//! [`Manifest::run`].

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

pub use super::camera::CameraRecord;
use super::models::{self, Model};
use super::pilot::PilotRecord;
use super::write::ResultFile;
use crate::formats::exr::Attributes;
use crate::job::{Algorithm, Finding, JobSpec, Label, Schedule, TileSpec};
use crate::recon::tile::TilePlan;

/// Name and version of this form of record.
pub const SCHEMA: &str = "sci-recon/snapshot/1";

/// What the names of all our records begin with.
pub(super) const SCHEMA_FAMILY: &str = "sci-recon/";

/// Everything that is known about the reconstruction of one snapshot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`SCHEMA`].
    pub schema: String,
    /// What follows from inputs and parameters.
    pub content: Content,
    /// What belongs to this run.
    pub run: RunRecord,
}

impl Manifest {
    /// The same with the list of the files that came out.
    pub fn with_files(mut self, files: Vec<ResultFile>) -> Self {
        self.content.files = files;
        self
    }
}

/// What follows from inputs and parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Content {
    /// Version of this program.
    pub program_version: String,
    /// The algorithm.
    pub algorithm: Algorithm,
    /// The schedule of the tiles in full, defaults included; without stages for an end-to-end
    /// network.
    pub schedule: Schedule,
    /// How an adaptive schedule became this one.
    #[serde(default)]
    pub pilot: Option<PilotRecord>,
    /// Frames of the snapshot (B).
    pub frames: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// The snapshot's index in the measurement, from 0.
    pub snapshot: usize,
    /// The files that went in.
    pub inputs: Inputs,
    /// The networks that the schedule names, or that of a job with a model.
    pub models: Vec<ModelRecord>,
    /// Every scale factor.
    pub scale: ScaleRecord,
    /// How the picture was cut.
    pub tile_plan: TilePlanRecord,
    /// What came of each tile, in the plan's order.
    pub tiles: Vec<TileRecord>,
    /// Sum over the snapshot: see [`Summary`].
    pub summary: Summary,
    /// What the check of the measurement against its calibration found.
    #[serde(default)]
    pub warnings: Vec<Finding>,
    /// Times of the camera, if it told them.
    pub camera: Option<CameraRecord>,
    /// The files that came out, without this one.
    pub files: Vec<ResultFile>,
}

/// The files that went in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Inputs {
    /// SHA-256 of the masks' file.
    pub masks_sha256: String,
    /// SHA-256 of the measurement's file.
    pub measurement_sha256: String,
}

/// A network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelRecord {
    /// Its name.
    pub name: String,
    /// SHA-256 of its ONNX files, one after the other.
    pub sha256: String,
}

impl ModelRecord {
    /// Those of a schedule that the program carries, in a fixed order.
    pub fn of(schedule: &Schedule) -> Vec<Self> {
        let record = |network| {
            let model = models::of(network);
            Self::new(&model, model.files.iter().map(|(_, content)| *content))
        };
        schedule.networks().into_iter().map(record).collect()
    }

    /// Those of a job.
    pub fn of_job(spec: &JobSpec) -> Vec<Self> {
        let model = spec.model.as_ref().map(|model| Self {
            name: model.name.as_ref().map_or("learned", Label::as_str).to_owned(),
            sha256: model.sha256.to_string(),
        });
        Self::of(&spec.schedule).into_iter().chain(model).collect()
    }

    /// That of a model with these contents of its files.
    pub(super) fn new<'a>(model: &Model, contents: impl Iterator<Item = &'a [u8]>) -> Self {
        let digest = contents.fold(Sha256::new(), |hash, content| hash.chain_update(content));
        let sha256 = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Self { name: model.name.into(), sha256 }
    }
}

/// A schedule as the tiles run it, with all defaults filled in.
pub fn full_schedule(schedule: &Schedule, pilot: Option<&PilotRecord>) -> Schedule {
    pilot.map_or_else(|| schedule.clone(), |pilot| pilot.decide(schedule)).filled()
}

/// Every factor between the stored numbers and the solver's \[0,1\]. All are undone in the
/// frames but the masks', which defines what a mask is: frames are on the measurement's scale
/// after division by its full scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ScaleRecord {
    /// Value in the masks' file that means 1.
    pub masks_full_scale: f32,
    /// Value in the measurement's file that means 1.
    pub measurement_full_scale: f32,
    /// White level of the scene, estimated once for all tiles: the solver worked on frames
    /// divided by it.
    pub white: f32,
}

/// How the picture was cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TilePlanRecord {
    /// The parameters.
    #[serde(flatten)]
    pub parameters: TileSpec,
    /// Tiles as \[row, column, height, width\], in the plan's order.
    pub tiles: Vec<[usize; 4]>,
}

impl From<&TilePlan> for TilePlanRecord {
    fn from(plan: &TilePlan) -> Self {
        Self {
            parameters: TileSpec { size: plan.size(), overlap: plan.overlap() },
            tiles: plan.tiles().map(|t| [t.row, t.column, t.height, t.width]).collect(),
        }
    }
}

/// What came of a tile.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TileRecord {
    /// Iterations whose prior had a total-variation part.
    pub tv_iterations: usize,
    /// Passes of the learned denoiser.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the tile's frames.
    pub residual: f32,
    /// `converged` or `max-iterations`.
    pub stop_reason: String,
}

/// The tiles taken together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Most of any tile.
    pub tv_iterations: usize,
    /// Most of any tile.
    pub denoiser_passes: usize,
    /// Largest of any tile.
    pub residual: f32,
    /// `converged` if all tiles converged, else `max-iterations`.
    pub stop_reason: String,
}

impl Summary {
    /// Of the tiles of one snapshot.
    pub fn of(tiles: &[TileRecord]) -> Self {
        let converged = tiles.iter().all(|tile| tile.stop_reason == "converged");
        Self {
            tv_iterations: tiles.iter().map(|tile| tile.tv_iterations).max().unwrap_or(0),
            denoiser_passes: tiles.iter().map(|tile| tile.denoiser_passes).max().unwrap_or(0),
            residual: tiles.iter().map(|tile| tile.residual).fold(0.0, f32::max),
            stop_reason: if converged { "converged" } else { "max-iterations" }.into(),
        }
    }
}

impl From<&super::TileOutcome> for TileRecord {
    fn from(outcome: &super::TileOutcome) -> Self {
        Self {
            tv_iterations: outcome.tv_iterations,
            denoiser_passes: outcome.denoiser_passes,
            residual: outcome.residual,
            stop_reason: outcome.stop_reason.name().into(),
        }
    }
}

/// What belongs to one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// The job; none on the command line.
    pub job: Option<String>,
    /// Execution provider of the network; none without a network.
    pub provider: Option<String>,
    /// Build of ONNX Runtime; none without a network.
    pub onnxruntime: Option<String>,
    /// Wall time of computing; none for a job, whose workers share their time with others'.
    pub seconds: Option<f64>,
    /// Processor seconds of computing: of all tiles together.
    pub cpu_seconds: f64,
    /// Largest resident memory of a process that computed.
    pub peak_rss_bytes: u64,
    /// When it ended, RFC 3339 in UTC.
    pub finished_at: String,
}

/// What each EXR frame says about itself.
pub fn frame_attributes(content: &Content) -> Vec<Attributes> {
    let algorithm = content.algorithm.name();
    let mut shared = vec![
        ("program".to_owned(), format!("sci-recon {}", content.program_version)),
        ("algorithm".to_owned(), algorithm.to_owned()),
        ("snapshot".to_owned(), content.snapshot.to_string()),
        ("masksSha256".to_owned(), content.inputs.masks_sha256.clone()),
        ("measurementSha256".to_owned(), content.inputs.measurement_sha256.clone()),
        ("whiteLevel".to_owned(), content.scale.white.to_string()),
    ];
    for model in &content.models {
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

/// A manifest for tests.
#[cfg(test)]
pub(super) fn sample() -> Manifest {
    use crate::recon::schedule::Schedule;
    let algorithm = Algorithm::GapTv;
    let hash = "0".repeat(64);
    let plan = TilePlan::new(20, 24, 256, 32).unwrap();
    let content = Content {
        program_version: "0.0.0".into(),
        algorithm,
        schedule: Schedule::gap_tv(),
        pilot: None,
        frames: 3,
        height: 20,
        width: 24,
        snapshot: 1,
        inputs: Inputs { masks_sha256: hash.clone(), measurement_sha256: hash },
        models: ModelRecord::of(&crate::job::Algorithm::PnpTvFastDvdNet.default_schedule()),
        scale: ScaleRecord { masks_full_scale: 1.0, measurement_full_scale: 255.0, white: 0.9 },
        tile_plan: (&plan).into(),
        tiles: Vec::new(),
        summary: Summary::of(&[]),
        warnings: Vec::new(),
        camera: CameraRecord::new(Some(50.0), Some(0.012), 1, 3),
        files: Vec::new(),
    };
    let run = RunRecord {
        job: None,
        provider: None,
        onnxruntime: None,
        seconds: None,
        cpu_seconds: 1.0,
        peak_rss_bytes: 1,
        finished_at: "2026-01-01T00:00:00.000Z".into(),
    };
    Manifest { schema: SCHEMA.into(), content, run }
}

#[cfg(test)]
mod tests {
    use super::{Summary, TileRecord};

    fn record(residual: f32, stop_reason: &str, passes: usize) -> TileRecord {
        let stop_reason = stop_reason.to_owned();
        TileRecord { tv_iterations: 40, denoiser_passes: passes, residual, stop_reason }
    }

    #[test]
    fn a_summary_tells_the_worst_of_the_tiles() {
        let tiles = [record(0.01, "converged", 20), record(0.03, "max-iterations", 24)];
        let summary = Summary::of(&tiles);
        assert_eq!((summary.denoiser_passes, summary.residual), (24, 0.03));
        assert_eq!(summary.stop_reason, "max-iterations");
        assert_eq!(Summary::of(&tiles[..1]).stop_reason, "converged");
    }

    #[test]
    fn frames_tell_where_they_come_from() {
        let content = super::sample().content;
        let attributes = super::frame_attributes(&content);
        assert_eq!(attributes.len(), 3);
        let text = |name: &str| {
            let entry = attributes[2].texts.iter().find(|(n, _)| n == name);
            entry.map(|(_, value)| value.as_str())
        };
        assert_eq!(text("frame"), Some("3 of 3"));
        assert_eq!(text("algorithm"), Some("gap-tv"));
        assert_eq!(text("model fastdvdnet-gray").map(str::len), Some(64));
        assert!((attributes[2].frame_time_s.unwrap() - 0.028).abs() < 1e-12);
        assert!((attributes[2].frames_per_second.unwrap() - 250.0).abs() < 1e-9);
        // They must be names that OpenEXR takes.
        let file = tempfile::NamedTempFile::new().unwrap();
        let frame = ndarray::Array2::zeros((2, 2));
        crate::formats::exr::write_frame(file.path(), frame.view(), &attributes[2]).unwrap();
    }
}
