//! Does one task, whatever its kind.

use std::collections::BTreeMap;

use ndarray::Array3;
use serde::Serialize;
use serde_json::Value;

use super::check::check;
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
use engine::pipeline::write::{write_manifest, write_result};
use engine::pipeline::{movie, preview, scale};
use formats::planar::{self, Reader};
use formats::{Limits, StackInfo};
use reconstruction::sequence::RunShare;
use store::{CalibrationDone, NewCalibration, StagedBlob};

/// What computes, on its way between the loop of a worker and its computing thread.
pub(super) struct Engines {
    /// The networks of the program.
    pub(super) networks: WarmNetworks,
    /// Those of users.
    pub(super) models: ModelProcesses,
}

/// Does a task. Blocks for as long as it takes.
pub(super) fn perform(
    transport: &impl Transport,
    input: TaskInput,
    engines: &mut Engines,
    monitor: &Monitor,
) -> Result<Done, TaskError> {
    let (record, output) = match input {
        TaskInput::Prepare { arrays, snapshots } => {
            arrays.verify()?;
            let white = scale::job_white_level(&arrays, snapshots, monitor)?;
            monitor.reach(TaskStage::Reading, 1.0);
            (json(&PreparedRecord { white })?, Output::Record)
        }
        TaskInput::Preview { arrays, shape, snapshot, white } => {
            let frames = preview::frames(&arrays, shape, snapshot, white, monitor)?;
            monitor.reach(TaskStage::Tv, 1.0);
            (Value::Null, Output::Stack(frames))
        }
        TaskInput::Pilot { arrays, snapshots, white, schedule, runs, mosaic } => {
            let y = arrays.snapshot(snapshots.first).map_err(PipelineError::from)?;
            let place = pilot::place(arrays.light(monitor)?.view(), y.view(), mosaic);
            let first = snapshots.first as usize;
            let task = Pilot { first, place: &place, schedule: &schedule, runs: &runs };
            engines.models.only(None, monitor)?;
            let networks = &mut engines.networks;
            let record = run_pilot(&arrays, white, (snapshots, &task), networks, monitor)?;
            let decided = full_schedule(&schedule, record.as_ref());
            let share = decided.planned_ns_per_voxel() / schedule.planned_ns_per_voxel();
            monitor.reach(monitor.progress().stage, 1.0);
            (json(&record)?, Output::TileCost(share))
        }
        TaskInput::Tile(task) => {
            let (record, frames) = tile(transport, &task, engines, monitor)?;
            (json(&record)?, Output::Stack(frames))
        }
        TaskInput::White { recipe, snapshots, tiles } => {
            let white_level = white_level(&recipe, snapshots, &tiles, monitor)?;
            monitor.reach(TaskStage::Reading, 1.0);
            (json(&WhiteRecord { white_level })?, Output::Record)
        }
        TaskInput::Assemble { job, recipe, snapshot, tiles, folder } => {
            let shares = of_shares(&recipe, snapshot, &tiles, monitor)?;
            let tiles: Vec<&StoredTile> = shares.iter().flat_map(|(_, tiles)| tiles).collect();
            let cost = CostRecord::sum(tiles.iter().map(|tile| &tile.record.cost));
            let run = RunRecord::ended(Some(job.to_string()), cost, None);
            let records = tiles.iter().map(|tile| tile.record.tile.clone()).collect();
            let told: Vec<_> = shares
                .iter()
                .map(|(share, tiles)| {
                    let told = tiles.iter().map(|tile| tile.record.assessment.clone());
                    (share.clone(), told.collect())
                })
                .collect();
            let expected = recipe.expected(snapshot as usize, &told);
            let assessment = expected.as_ref().map(|expected| expected.assessment.clone());
            let error = expected.as_ref().map(|expected| expected.error.view());
            let manifest =
                recipe.snapshot(snapshot as usize, records, assessment.clone(), run.clone());
            let summary = manifest.content.summary.clone();
            let files = write_result(folder.path(), manifest, error, |k| {
                monitor.check()?;
                monitor.reach(TaskStage::Writing, k as f64 / recipe.shape.frames as f64);
                Ok(blend::stored_frame(&recipe.tile_plan, &shares, k)?)
            })?;
            monitor.reach(TaskStage::Writing, 1.0);
            let record = SnapshotRecord { summary, assessment, run, files: files.clone() };
            (json(&record)?, Output::Files(folder, files))
        }
        TaskInput::Manifest { job, spec, recipe, tasks, folder } => {
            let snapshots = tasks.snapshots.iter();
            let of_all =
                Assessment::combined(snapshots.map(|(_, record)| record.assessment.as_ref()));
            let file = write_manifest(folder.path(), &recipe.job(job, &spec, tasks))?;
            monitor.reach(TaskStage::Writing, 1.0);
            (json(&of_all)?, Output::Files(folder, vec![file]))
        }
        TaskInput::Check(task) => {
            let checked = check(&task, engines.models.command(), monitor)?;
            (Value::Null, Output::Checked(Box::new(checked)))
        }
        TaskInput::Captures { files, bad_pixels, scratch, masks } => {
            let open =
                |info: &StackInfo| planar::writer(masks, info.frames, info.height, info.width);
            let limits = Limits::default();
            let files = (&files, bad_pixels.as_deref());
            let (made, masks) =
                calibrate(files, &limits, scratch.path(), open, &mut |share| tell(share, monitor))?;
            let masks = masks.finish().map_err(TransportError::from)?;
            let facts = facts(&made, masks.sha256());
            (Value::Null, calibration(Some((facts, masks)), made.report, monitor))
        }
        TaskInput::Movie(task, file) => {
            movie::write(file.path(), &task, monitor)?;
            (json(&task.requested.then_some(task.window))?, Output::File(file))
        }
        TaskInput::Report(masks) => {
            let masks = Reader::open(&masks, &Limits::default()).map_err(IntakeError::from)?;
            let report = intake::report(&masks, &mut |share| tell(share, monitor))?;
            (Value::Null, calibration(None, report, monitor))
        }
    };
    Ok(Done { progress: monitor.progress(), record, output })
}

/// Tells which share of a calibration is done; false asks to stop.
fn tell(fraction: f64, monitor: &Monitor) -> bool {
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

fn facts(made: &Calibrated, masks: Sha256) -> NewCalibration {
    let report = &made.report.report;
    NewCalibration {
        // The request has its name and colours.
        name: None,
        masks,
        format: "captures".into(),
        sample: made.sample.to_string(),
        axes: None,
        frames: report.frames,
        height: report.height,
        width: report.width,
        full_scale: 1.0,
        mask_mean: report.masks.mean,
        dead_pixels: report.masks.dead_pixels,
        clipped_negatives: made.clipped_negatives,
        mosaic: None,
    }
}

/// What is to be remembered of a task.
fn json(record: &impl Serialize) -> Result<Value, PipelineError> {
    serde_json::to_value(record).map_err(PipelineError::record("task"))
}

fn run_pilot(
    arrays: &Arrays,
    white: f32,
    (snapshots, task): (SnapshotRange, &Pilot<'_>),
    networks: &mut WarmNetworks,
    monitor: &Monitor,
) -> Result<Option<PilotRecord>, PipelineError> {
    let SnapshotRange { first, count } = snapshots;
    let input = arrays.window(first..first + count, task.place, white)?;
    Ok(pilot::decide(input, task, networks, &mut monitor.observe(task.schedule.clone()))?)
}

/// The white level of all frames of a job. All tiles must be there.
fn white_level(
    recipe: &Recipe,
    snapshots: SnapshotRange,
    tiles: &[StoredTile],
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
            histogram.add(&blend::stored_frame(&recipe.tile_plan, &shares, k)?);
        }
        monitor.reach(TaskStage::Reading, (index + 1) as f64 / f64::from(snapshots.count));
    }
    Ok(scale::white_level(&histogram, recipe.scale.normalisation))
}

/// What a snapshot takes from the runs that hold it, with the tiles of each. All tiles must be there.
fn of_shares(
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
    let before = cpu_seconds();
    // Brings all files of the task here, the network's too.
    let input = transport.window(task)?;
    let spent = cpu_seconds() - before;
    let file = task.model.map(|sha256| transport.model(sha256));
    let mut process = models.only(file.as_ref(), monitor)?;
    // A process that ended just now was counted when it worked.
    let before = cpu_seconds() - spent;
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
    let deep = task.model.is_some() || task.schedule.needs_network();
    let source = networks.source();
    let (of_process, peak) = process.map_or((0.0, 0), |process| process.bill());
    let cost = CostRecord {
        provider: deep.then(|| source.provider().into()),
        onnxruntime: if deep { Some(source.version()?) } else { None },
        cpu_seconds: cpu_seconds() - before + of_process,
        peak_rss_bytes: peak_rss_bytes() + peak,
    };
    let solved = task.pieces.iter().flat_map(Clone::clone).collect();
    let assessment = match task.model {
        Some(_) => None,
        None => TileAssessment::of(&outcome, (&task.schedule, task.evidence.as_ref(), task.white)),
    };
    let tile = TileRecord::from(&outcome);
    Ok((TileTaskRecord { tile, solved, assessment, cost }, outcome.frames))
}
