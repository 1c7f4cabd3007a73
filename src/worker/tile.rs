//! The task of one tile.

use std::io::BufWriter;
use std::ops::Range;

use ndarray::{ArrayView3, Axis};
use serde::{Deserialize, Serialize};

use super::prepare::{Prepared, to_record};
use super::task::{Shared, TaskError};
use crate::formats::planar::{self, Reader};
use crate::formats::{FormatError, Limits};
use crate::job::{Schedule, TaskProgress, TaskStage};
use crate::pipeline::manifest::TileRecord;
use crate::pipeline::{
    ModelFile, ShareDone, TileInput, TileOutcome, Usage, WarmNetworks, peak_rss_bytes,
    reconstruct_tile, run_network,
};
use crate::recon::solver::{Control, Observer, Progress};
use crate::store::{Completion, JobTask, Product, StagedBlob, Store};

/// What is remembered of a tile's task.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct TileTaskRecord {
    #[serde(flatten)]
    pub(super) tile: TileRecord,
    /// Processor seconds from reading the window to storing the frames.
    pub(super) cpu_seconds: f64,
    /// Peak memory of the worker so far.
    pub(super) peak_rss_bytes: u64,
    /// Execution provider of the network; none without a network.
    pub(super) provider: Option<String>,
    /// Build of ONNX Runtime; none without a network.
    pub(super) onnxruntime: Option<String>,
}

/// Reads a tile's window, reconstructs it, and writes its frames as a prepared array.
pub(super) fn run(
    store: &Store,
    task: &JobTask,
    (snapshot, index): (u32, u32),
    engine: &mut WarmNetworks,
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let before = Usage::now();
    let plan = task.spec.tile_plan()?;
    let tile = plan.tile(index as usize).ok_or_else(|| TaskError::Record {
        what: "task",
        problem: format!("tile {index} of a plan of {}", plan.len()),
    })?;
    let prepared = Prepared::of(task)?;
    let place = (tile.row..tile.row + tile.height, tile.column..tile.column + tile.width);
    let input = window(task, snapshot as usize, place, prepared.white)?;
    let (outcome, deep) = match (&task.spec.model, &task.model) {
        (Some(model), Some(path)) => {
            let file = ModelFile::new(path.clone(), model.sha256);
            (by_network(input, &file, engine, shared)?, true)
        }
        _ => {
            let schedule = prepared.schedule(&task.spec);
            let mut observer = TaskObserver::new(shared, schedule.clone());
            let outcome = reconstruct_tile(input, &schedule, engine, &mut observer)?;
            (outcome, schedule.needs_network())
        }
    };
    let progress = shared.progress();
    shared.set_progress(TaskProgress { stage: TaskStage::Writing, ..progress });
    let record = TileTaskRecord {
        tile: TileRecord::from(&outcome),
        provider: deep.then(|| engine.source().provider().into()),
        onnxruntime: if deep { Some(engine.source().version()?) } else { None },
        cpu_seconds: (Usage::now() - before).cpu_seconds,
        peak_rss_bytes: peak_rss_bytes(),
    };
    let blob = write(store, outcome.frames.view())?;
    Ok(Completion { progress, record: to_record(&record)?, product: Product::Tile(blob) })
}

/// One run of an end-to-end network, which can't be stopped on its way.
fn by_network(
    input: TileInput,
    file: &ModelFile,
    engine: &mut WarmNetworks,
    shared: &Shared,
) -> Result<TileOutcome, TaskError> {
    shared.set_progress(TaskProgress { stage: TaskStage::Deep, ..TaskProgress::START });
    let network = engine.end_to_end(file)?;
    shared.check()?;
    let outcome = run_network(input, network)?;
    shared.check()?;
    shared.set_progress(TaskProgress { passes: 1, fraction: 1.0, ..shared.progress() });
    Ok(outcome)
}

/// A piece of a snapshot, by rows and columns.
pub(super) fn window(
    task: &JobTask,
    snapshot: usize,
    (rows, columns): (Range<usize>, Range<usize>),
    white: f32,
) -> Result<TileInput, TaskError> {
    let limits = Limits::default();
    let masks = Reader::open(&task.masks, &limits)?;
    let frames = 0..masks.info().frames;
    let measurement = Reader::open(&task.snapshots, &limits)?.read_window(
        snapshot..snapshot + 1,
        rows.clone(),
        columns.clone(),
    )?;
    Ok(TileInput {
        masks: masks.read_window(frames, rows, columns)?,
        measurement: measurement.index_axis_move(Axis(0), 0),
        white,
    })
}

/// Writes frames \[B,h,w\] as a prepared array.
pub(super) fn write(store: &Store, frames: ArrayView3<'_, f32>) -> Result<StagedBlob, TaskError> {
    let (count, height, width) = frames.dim();
    let blob = BufWriter::new(store.blob_writer()?);
    let mut writer = planar::writer(blob, count, height, width)?;
    frames.outer_iter().try_for_each(|frame| writer.write_frame(frame))?;
    let blob = writer.finish()?.into_inner();
    let blob = blob.map_err(|error| FormatError::Io {
        action: "write the tile",
        source: error.into_error(),
    })?;
    Ok(blob.finish()?)
}

/// Tells the heartbeat about iterations, and the solver when to stop.
pub(super) struct TaskObserver<'a> {
    shared: &'a Shared,
    share: ShareDone,
    passes: u32,
}

impl<'a> TaskObserver<'a> {
    /// For one run of a schedule.
    pub(super) fn new(shared: &'a Shared, schedule: Schedule) -> Self {
        Self { shared, share: ShareDone::new(schedule), passes: 0 }
    }
}

impl Observer for TaskObserver<'_> {
    fn iteration(&mut self, progress: &Progress) -> Control {
        self.passes += u32::from(progress.deep);
        self.shared.note(progress);
        self.shared.set_progress(TaskProgress {
            stage: stage(progress),
            iterations: u32::try_from(progress.done).unwrap_or(u32::MAX),
            passes: self.passes,
            fraction: self.share.after(progress),
        });
        if self.shared.stopped() { Control::Cancel } else { Control::Continue }
    }
}

fn stage(progress: &Progress) -> TaskStage {
    match (progress.deep, progress.sigma) {
        (true, _) => TaskStage::Deep,
        (false, Some(_)) => TaskStage::Nonlocal,
        (false, None) => TaskStage::Tv,
    }
}

#[cfg(test)]
mod tests {
    use super::stage;
    use crate::recon::prior::SIGMA;
    use crate::recon::prior::registry::PRIORS;
    use crate::recon::solver::Progress;

    #[test]
    fn a_job_tells_which_prior_is_at_work() {
        for prior in PRIORS {
            let (deep, sigma) = (prior.network().is_some(), prior.takes(&SIGMA).then_some(0.1));
            let (residual, change) = (0.1, 0.1);
            let progress =
                Progress { stage: 0, done: 1, planned: 2, residual, change, sigma, deep };
            let expected = if deep { "deep" } else { prior.name() };
            assert_eq!(stage(&progress).name(), expected);
        }
    }
}
