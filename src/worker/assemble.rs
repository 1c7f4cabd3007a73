//! The task that makes a snapshot's frames of its tiles.

use std::path::{Path, PathBuf};

use ndarray::{Array2, Axis};
use serde::{Deserialize, Serialize};

use super::prepare::{Prepared, to_record};
use super::task::{Shared, TaskError};
use super::tile::TileTaskRecord;
use crate::formats::Limits;
use crate::formats::planar::Reader;
use crate::job::{Finding, TaskProgress, TaskStage, Timestamp};
use crate::pipeline::manifest::{
    CameraRecord, Content, Inputs, Manifest, ModelRecord, RunRecord, SCHEMA, ScaleRecord, Summary,
    frame_attributes,
};
use crate::pipeline::{ResultFile, ResultSpec, write_result};
use crate::recon::tile::TilePlan;
use crate::store::{Completion, JobTask, Product, Store, TileResult, hash_file};

/// What is remembered of a snapshot.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct SnapshotRecord {
    pub(super) summary: Summary,
    pub(super) run: RunRecord,
    pub(super) files: Vec<ResultFile>,
}

/// Checks the tiles, blends them frame by frame, and writes the snapshot's folder.
pub(super) fn run(
    store: &Store,
    task: &JobTask,
    snapshot: u32,
    tiles: &[TileResult],
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let plan = task.spec.tile_plan()?;
    check(&plan, tiles, shared)?;
    let records = tiles.iter().map(record).collect::<Result<Vec<_>, _>>()?;
    let paths: Vec<PathBuf> = tiles.iter().map(|tile| tile.path.clone()).collect();
    let manifest = manifest(task, snapshot, &plan, &records)?;
    let (height, width) = plan.dim();
    let spec = ResultSpec {
        height,
        width,
        attributes: frame_attributes(&manifest.content),
        white: manifest.content.scale.white,
    };
    let frames = task.spec.shape.frames;
    let progress = shared.progress();
    let staged = store.staged_dir()?;
    let frame = |k: usize| {
        shared.check()?;
        let fraction = k as f64 / frames as f64;
        shared.set_progress(TaskProgress { stage: TaskStage::Writing, fraction, ..progress });
        blend(&plan, &paths, k)
    };
    let (summary, run) = (manifest.content.summary.clone(), manifest.run.clone());
    let files = write_result(staged.path(), &spec, frame, |files| manifest.with_files(files))?;
    let record = SnapshotRecord { summary, run, files };
    Ok(Completion {
        progress: TaskProgress { stage: TaskStage::Writing, fraction: 1.0, ..progress },
        record: to_record(&record)?,
        product: Product::Files(staged),
    })
}

/// Refuses to blend tiles that are missing or whose bytes are not those that were stored.
fn check(plan: &TilePlan, tiles: &[TileResult], shared: &Shared) -> Result<(), TaskError> {
    let expected = (0..plan.len() as u64).eq(tiles.iter().map(|tile| u64::from(tile.tile)));
    if !expected {
        let problem = format!("{} tiles are stored of {}", tiles.len(), plan.len());
        return Err(TaskError::Record { what: "tiles", problem });
    }
    let mut damaged = Vec::new();
    for tile in tiles {
        shared.check()?;
        match hash_file(&tile.path) {
            Ok(hash) if hash == tile.sha256 => {}
            Ok(_) => damaged.push(tile.tile),
            Err(_) if !tile.path.exists() => damaged.push(tile.tile),
            Err(error) => return Err(error.into()),
        }
    }
    if damaged.is_empty() { Ok(()) } else { Err(TaskError::Damaged(damaged)) }
}

fn record(tile: &TileResult) -> Result<TileTaskRecord, TaskError> {
    serde_json::from_value(tile.record.clone())
        .map_err(|error| TaskError::Record { what: "tile", problem: error.to_string() })
}

/// Frame `k` \[H,W\], of which each tile's part is read when it is needed.
fn blend(plan: &TilePlan, paths: &[PathBuf], k: usize) -> Result<Array2<f32>, TaskError> {
    let mut whole = Array2::zeros(plan.dim());
    for (tile, path) in plan.tiles().zip(paths) {
        let part = part(path, k, tile.height, tile.width)?;
        plan.blend(&tile, part.view(), whole.view_mut());
    }
    Ok(whole)
}

fn part(path: &Path, k: usize, height: usize, width: usize) -> Result<Array2<f32>, TaskError> {
    // Opened anew for each frame: a large picture has more tiles than a process may have files.
    let reader = Reader::open(path, &Limits::default())?;
    let window = reader.read_window(k..k + 1, 0..height, 0..width)?;
    Ok(window.index_axis_move(Axis(0), 0))
}

fn manifest(
    task: &JobTask,
    snapshot: u32,
    plan: &TilePlan,
    records: &[TileTaskRecord],
) -> Result<Manifest, TaskError> {
    let (spec, calibration, measurement) =
        (&task.spec, &task.calibration.facts, &task.measurement.facts);
    let tiles: Vec<_> = records.iter().map(|record| record.tile.clone()).collect();
    let (frames, snapshot) = (spec.shape.frames, snapshot as usize);
    let prepared = Prepared::of(task)?;
    let content = Content {
        program_version: env!("CARGO_PKG_VERSION").into(),
        algorithm: spec.algorithm,
        schedule: prepared.schedule(spec),
        pilot: prepared.pilot,
        frames,
        height: spec.shape.height,
        width: spec.shape.width,
        snapshot,
        inputs: Inputs {
            masks_sha256: calibration.masks.to_string(),
            measurement_sha256: measurement.data.to_string(),
        },
        models: ModelRecord::of_job(spec),
        scale: ScaleRecord {
            masks_full_scale: calibration.full_scale,
            measurement_full_scale: measurement.full_scale,
            white: prepared.white,
        },
        tile_plan: plan.into(),
        summary: Summary::of(&tiles),
        tiles,
        warnings: warnings(&spec.warnings, snapshot),
        camera: CameraRecord::new(measurement.camera_fps, measurement.exposure_s, snapshot, frames),
        files: Vec::new(),
    };
    let cpu_seconds = records.iter().map(|record| record.cpu_seconds).sum();
    let run = RunRecord {
        job: Some(task.job.to_string()),
        provider: records.iter().find_map(|record| record.provider.clone()),
        onnxruntime: records.iter().find_map(|record| record.onnxruntime.clone()),
        seconds: None,
        cpu_seconds,
        peak_rss_bytes: records.iter().map(|record| record.peak_rss_bytes).max().unwrap_or(0),
        finished_at: Timestamp::now().to_string(),
    };
    Ok(Manifest { schema: SCHEMA.into(), content, run })
}

/// The warnings about a snapshot.
fn warnings(all: &[Finding], snapshot: usize) -> Vec<Finding> {
    let concerns =
        |warning: &&Finding| warning.snapshot.is_none_or(|number| number as usize == snapshot);
    all.iter().filter(concerns).cloned().collect()
}
