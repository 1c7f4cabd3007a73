//! Performs one task of any kind.

use std::collections::BTreeMap;

use ndarray::{Array2, Array3};
use serde::Serialize;
use serde_json::Value;

use super::check::{check, npy_sha256};
use super::model_process::ModelProcesses;
use super::transport::{Done, Output, TaskError, TaskInput, TileTask, Transport, TransportError};
use engine::intake::{self, Calibrated, IntakeError, Report, calibrate};
use engine::job::{Assessment, Sha256, SnapshotRange, TaskProgress, TaskStage};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::Arrays;
use engine::pipeline::assessment::TileAssessment;
use engine::pipeline::blend::{self, StoredTile};
use engine::pipeline::manifest::Recipe;
use engine::pipeline::networks::WarmNetworks;
use engine::pipeline::pilot::{self, Pilot, full_schedule};
use engine::pipeline::progress::Monitor;
use engine::pipeline::records::{
    CostRecord, PilotRecord, PreparedRecord, RunRecord, SnapshotRecord, TileRecord, TileTaskRecord,
    WhiteRecord,
};
use engine::pipeline::scale::Histogram;
use engine::pipeline::tile::{reconstruct_tile, run_network};
use engine::pipeline::usage::{cpu_seconds, peak_rss_bytes};
use engine::pipeline::write::{OnDisk, write_manifest, write_result};
use engine::pipeline::{movie, preview, registration, scale};
use formats::planar::{self, Reader};
use formats::{Limits, StackInfo};
use reconstruction::ReconError;
use reconstruction::sequence::RunShare;
use store::{CalibrationDone, NewCalibration, StagedBlob};

/// The networks in use. They move between the loop of a worker and its computing thread.
pub(super) struct Engines {
    /// Networks that the program carries.
    pub(super) networks: WarmNetworks,
    /// Networks of users.
    pub(super) models: ModelProcesses,
}

/// Performs a task. Blocks until it ends.
pub(super) fn perform(
    transport: &impl Transport,
    input: TaskInput,
    engines: &mut Engines,
    monitor: &Monitor,
) -> Result<Done, TaskError> {
    let (record, output) = match input {
        TaskInput::Prepare { arrays, snapshots, registration, is_coloured } => {
            arrays.verify()?;
            let mut white = scale::job_white_level(&arrays, snapshots, monitor)?;
            let job = (&arrays, snapshots);
            let registration =
                registration::register_stored(job, registration, is_coloured, white, monitor)?;
            // Behind masks elsewhere, pixels that seem dark have light, and the scene seems too bright.
            if let Some(registered) = registration.as_ref().filter(|it| it.changes_white_level()) {
                let arrays = Arrays { correction: registered.correction(), ..arrays };
                white = scale::job_white_level(&arrays, snapshots, monitor)?;
            }
            monitor.reach(TaskStage::Reading, 1.0);
            (json(&PreparedRecord { white, registration })?, Output::Record)
        }
        TaskInput::Preview { arrays, shape, snapshot, white } => {
            let frames = preview::frames(&arrays, shape, snapshot, white, monitor)?;
            monitor.reach(TaskStage::Tv, 1.0);
            (Value::Null, Output::Stack(frames))
        }
        TaskInput::Pilot { arrays, snapshots, white, schedule, runs, mosaic } => {
            let y = arrays.snapshot(snapshots.first).map_err(PipelineError::from)?;
            let crop = pilot::choose_crop(arrays.light(monitor)?.view(), y.view(), mosaic);
            let first = snapshots.first as usize;
            let task = Pilot { first, crop: &crop, schedule: &schedule, runs: &runs };
            engines.models.only(None, monitor)?;
            let record = with_room(engines, |Engines { networks, .. }| {
                run_pilot(&arrays, white, (snapshots, &task), networks, monitor)
            })?;
            let reduced = full_schedule(&schedule, record.as_ref());
            let share = reduced.planned_ns_per_voxel() / schedule.planned_ns_per_voxel();
            monitor.reach(monitor.progress().stage, 1.0);
            (json(&record)?, Output::TileCost(share))
        }
        TaskInput::Tile(task) => {
            let (record, frames) =
                with_room(engines, |engines| tile(transport, &task, engines, monitor))?;
            (json(&record)?, Output::Stack(frames))
        }
        TaskInput::White { arrays, recipe, snapshots, tiles } => {
            let lit = scale::lit(arrays.light(monitor)?.view());
            let white_level = white_level(&recipe, (snapshots, &tiles), &lit, monitor)?;
            monitor.reach(TaskStage::Reading, 1.0);
            (json(&WhiteRecord { white_level })?, Output::Record)
        }
        TaskInput::Assemble { job, recipe, snapshot, tiles, folder } => {
            let shares = verified_shares(&recipe, snapshot, &tiles, monitor)?;
            let tiles: Vec<&StoredTile> = shares.iter().flat_map(|(_, tiles)| tiles).collect();
            let cost = CostRecord::sum(tiles.iter().map(|tile| &tile.record.cost));
            let run = RunRecord::ended(Some(job.to_string()), cost, None);
            let records = tiles.iter().map(|tile| tile.record.tile.clone()).collect();
            let assessments: Vec<_> = shares
                .iter()
                .map(|(share, tiles)| {
                    let assessments = tiles.iter().map(|tile| tile.record.assessment.clone());
                    (share.clone(), assessments.collect())
                })
                .collect();
            let expected = recipe.expected(snapshot as usize, &assessments);
            let assessment = expected.as_ref().map(|expected| expected.assessment.clone());
            let error = expected.as_ref().map(|expected| expected.error.view());
            let manifest =
                recipe.snapshot(snapshot as usize, records, assessment.clone(), run.clone());
            let summary = manifest.content.summary.clone();
            let files = write_result(folder.path(), manifest, error, OnDisk::Stored, |k| {
                monitor.check()?;
                monitor.reach(TaskStage::Writing, k as f64 / recipe.shape.frames as f64);
                Ok(blend::stored_frame(&recipe.tile_plan, &shares, k)?)
            })?;
            monitor.reach(TaskStage::Writing, 1.0);
            let listed = files.iter().map(|file| file.file.clone()).collect();
            let record = SnapshotRecord { summary, assessment, run, files: listed };
            (json(&record)?, Output::Files(folder, files))
        }
        TaskInput::Manifest { job, spec, recipe, tasks, folder } => {
            let snapshots = tasks.snapshots.iter();
            let assessment =
                Assessment::combined(snapshots.map(|(_, record)| record.assessment.as_ref()));
            let file = write_manifest(folder.path(), &recipe.job(job, &spec, tasks))?;
            monitor.reach(TaskStage::Writing, 1.0);
            (json(&assessment)?, Output::Files(folder, vec![file]))
        }
        TaskInput::Check(task) => {
            let checked = check(&task, engines.models.command(), monitor)?;
            (Value::Null, Output::Checked(Box::new(checked)))
        }
        TaskInput::Captures { files, bad_pixels, scratch, masks } => {
            let open =
                |info: &StackInfo| planar::writer(masks, info.frames, info.height, info.width);
            let limits = Limits::default();
            let bad = bad_pixels.as_deref();
            let (calibrated, masks) =
                calibrate(&files, bad, &limits, scratch.path(), open, &mut |share| {
                    proceed(share, monitor)
                })?;
            let masks = masks.finish().map_err(TransportError::from)?;
            let stored = Reader::open(masks.path(), &limits).map_err(IntakeError::from)?;
            let hash = npy_sha256(masks.path(), stored.info()).map_err(IntakeError::from)?;
            let facts = facts(&calibrated, hash);
            (Value::Null, calibration(Some((facts, masks)), calibrated.report, monitor))
        }
        TaskInput::Movie(task, file) => {
            movie::write(file.path(), &task, monitor)?;
            (json(&task.requested.then_some(task.window))?, Output::File(file))
        }
        TaskInput::Report { masks, spectral } => {
            let masks = Reader::open(&masks, &Limits::default()).map_err(IntakeError::from)?;
            let report = intake::report(&masks, spectral, &mut |share| proceed(share, monitor))?;
            (Value::Null, calibration(None, report, monitor))
        }
    };
    Ok(Done { progress: monitor.progress(), record, output })
}

/// Records the finished share of a calibration. Returns false if the task should stop.
fn proceed(fraction: f64, monitor: &Monitor) -> bool {
    monitor.reach(TaskStage::Reading, fraction);
    !monitor.stopped()
}

fn calibration(
    masks: Option<(NewCalibration, StagedBlob)>,
    Report { report, maps }: Report,
    monitor: &Monitor,
) -> Output {
    monitor.reach(TaskStage::Reading, 1.0);
    Output::Calibration(Box::new(CalibrationDone { masks, report, maps }))
}

fn facts(calibrated: &Calibrated, masks: Sha256) -> NewCalibration {
    let report = &calibrated.report.report;
    NewCalibration {
        masks,
        format: "captures".into(),
        sample: calibrated.sample.to_string(),
        axes: None,
        frames: report.frames,
        height: report.height,
        width: report.width,
        full_scale: 1.0,
        mask_mean: report.masks.mean,
        dead_pixels: report.masks.dead_pixels,
        clipped_negatives: calibrated.clipped_negatives,
        // The store takes it from the request.
        mosaic: None,
        reading: None,
        dispersion: None,
        corrected: None,
    }
}

/// Converts a task's record into JSON.
fn json(record: &impl Serialize) -> Result<Value, PipelineError> {
    serde_json::to_value(record).map_err(PipelineError::record("task"))
}

/// Runs a computation, and repeats it without cached networks if the memory of the GPU was full.
fn with_room<T>(
    engines: &mut Engines,
    mut compute: impl FnMut(&mut Engines) -> Result<T, PipelineError>,
) -> Result<T, PipelineError> {
    match compute(engines) {
        Err(PipelineError::Recon(ReconError::DeviceFull(reason))) => {
            tracing::warn!(
                reason,
                "the memory of the GPU is full; the task runs again without cached networks"
            );
            engines.networks.clear();
            compute(engines)
        }
        outcome => outcome,
    }
}

fn run_pilot(
    arrays: &Arrays,
    white: f32,
    (snapshots, task): (SnapshotRange, &Pilot<'_>),
    networks: &mut WarmNetworks,
    monitor: &Monitor,
) -> Result<Option<PilotRecord>, PipelineError> {
    let SnapshotRange { first, count } = snapshots;
    let input = arrays.window(first..first + count, task.crop, white)?;
    Ok(pilot::decide(input, task, networks, &mut monitor.observe(task.schedule.clone()))?)
}

/// The white level of all frames of a job where they are `lit` \[H,W\]. All tiles must be there.
fn white_level(
    recipe: &Recipe,
    (snapshots, tiles): (SnapshotRange, &[StoredTile]),
    lit: &Array2<f32>,
    monitor: &Monitor,
) -> Result<f32, PipelineError> {
    let mut histogram = Histogram::default();
    let runs = tiles.chunk_by(|one, next| one.run == next.run);
    runs.clone().try_for_each(|run| blend::verify(&recipe.tile_plan, run, monitor))?;
    let runs: BTreeMap<u32, &[StoredTile]> = runs.map(|run| (run[0].run, run)).collect();
    for (index, snapshot) in snapshots.indices().enumerate() {
        let shares = recipe.shares(snapshot as usize).into_iter().map(|share| {
            let run = snapshot - share.place as u32;
            let tiles = runs.get(&run).map(|tiles| tiles.to_vec()).ok_or_else(|| {
                let problem = format!("the run from snapshot {run} has no tiles");
                PipelineError::Record { what: "tiles", problem }
            })?;
            Ok::<_, PipelineError>((share, tiles))
        });
        let shares = shares.collect::<Result<Vec<_>, _>>()?;
        for k in 0..recipe.shape.frames {
            monitor.check()?;
            let frame = blend::stored_frame(&recipe.tile_plan, &shares, k)?;
            histogram.add(recipe.frame(k, frame).view(), recipe.frame(k, lit.clone()).view());
        }
        monitor.reach(TaskStage::Reading, (index + 1) as f64 / f64::from(snapshots.count));
    }
    Ok(scale::white_level(&histogram, recipe.scale.normalisation))
}

/// Lists the runs that contribute to a snapshot, each with its tiles. Fails if a tile is missing or damaged.
fn verified_shares(
    recipe: &Recipe,
    snapshot: u32,
    tiles: &[StoredTile],
    monitor: &Monitor,
) -> Result<Vec<(RunShare, Vec<StoredTile>)>, PipelineError> {
    let shares = recipe.shares(snapshot as usize).into_iter().map(|share| {
        let run = snapshot - share.place as u32;
        let tiles: Vec<_> = tiles.iter().filter(|tile| tile.run == run).cloned().collect();
        blend::verify(&recipe.tile_plan, &tiles, monitor)?;
        Ok((share, tiles))
    });
    shares.collect()
}

fn tile(
    transport: &impl Transport,
    task: &TileTask,
    engines: &mut Engines,
    monitor: &Monitor,
) -> Result<(TileTaskRecord, Array3<f32>), PipelineError> {
    let Engines { networks, models } = engines;
    networks.source().check(&task.schedule, &task.networks)?;
    let model_provider = models.command().provider;
    let before_fetch = cpu_seconds();
    // Fetches all files of the task, including the network's.
    let input = transport.window(task)?;
    let fetch_seconds = cpu_seconds() - before_fetch;
    let file = task.model.map(|sha256| transport.model(sha256));
    let mut process = models.only(file.as_ref(), monitor)?;
    // Ending a child process adds its time to this one's. That time was already counted when the child worked.
    let before = cpu_seconds() - fetch_seconds;
    let outcome = match &mut process {
        Some(process) => {
            monitor.reach(TaskStage::Deep, 0.0);
            let outcome = run_network(input, &mut process.watched(monitor))?;
            let passes = TaskProgress { passes: 1, fraction: 1.0, ..monitor.progress() };
            monitor.set_progress(passes);
            outcome
        }
        None => {
            let mut observer = monitor.observe(task.schedule.clone());
            reconstruct_tile(input, &task.schedule, networks, &mut observer)?
        }
    };
    monitor.reach(TaskStage::Writing, monitor.progress().fraction);
    let uses_network = task.model.is_some() || task.schedule.needs_network();
    let source = networks.source();
    let (process_seconds, process_peak) = process.map_or((0.0, 0), |process| process.bill());
    let cost = CostRecord {
        provider: uses_network.then(|| match task.model {
            Some(_) => model_provider.into(),
            None => source.provider(&task.schedule).into(),
        }),
        onnxruntime: if uses_network { Some(source.version()?) } else { None },
        gpu: task.model.is_none().then(|| source.gpu_name()).flatten(),
        cpu_seconds: cpu_seconds() - before + process_seconds,
        peak_rss_bytes: peak_rss_bytes() + process_peak,
    };
    let solved = task.pieces.iter().flat_map(Clone::clone).collect();
    // The quality model is fitted to the embedded networks.
    let assessment = match task.model {
        Some(_) => None,
        None if source.replaces(&task.schedule) => None,
        None => TileAssessment::of(&outcome, (&task.schedule, task.evidence.as_ref(), task.white)),
    };
    let tile = TileRecord::from(&outcome);
    Ok((TileTaskRecord { tile, solved, assessment, cost }, outcome.frames))
}
