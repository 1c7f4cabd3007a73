//! The task of a preview: the frames of one snapshot, coarsely.

use ndarray::{Array3, Axis};

use super::prepare::{Prepared, to_record};
use super::task::{Shared, TaskError};
use super::tile::{window, write};
use crate::job::{TaskProgress, TaskStage};
use crate::pipeline::TileInput;
use crate::recon::preview::{self, Blocks};
use crate::store::{Completion, JobTask, Product, Store};

/// Makes the preview and writes it as a prepared array \[B,h,w\], on the scale of the measurement.
pub(super) fn run(
    store: &Store,
    task: &JobTask,
    snapshot: u32,
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let shape = task.spec.shape;
    let side = preview::block(shape.frames, shape.height, shape.width);
    let frames = match side {
        1 => whole(task, snapshot, shared)?,
        side => by_blocks(task, snapshot, side, shared)?,
    };
    let blob = write(store, frames.view())?;
    let progress = TaskProgress { stage: TaskStage::Tv, fraction: 1.0, ..shared.progress() };
    Ok(Completion { progress, record: to_record(&())?, product: Product::Tile(blob) })
}

fn whole(task: &JobTask, snapshot: u32, shared: &Shared) -> Result<Array3<f32>, TaskError> {
    let (shape, white) = (task.spec.shape, Prepared::of(task)?.white);
    let place = (0..shape.height, 0..shape.width);
    let input: TileInput = window(task, snapshot as usize, place, white)?;
    shared.check()?;
    let Some((op, y)) = input.on_unit_scale()? else {
        return Ok(Array3::zeros((shape.frames, shape.height, shape.width)));
    };
    Ok(preview::whole(&op, y.view())? * white)
}

fn by_blocks(
    task: &JobTask,
    snapshot: u32,
    side: usize,
    shared: &Shared,
) -> Result<Array3<f32>, TaskError> {
    let (shape, white) = (task.spec.shape, Prepared::of(task)?.white);
    let mut blocks = Blocks::new(shape.frames, side);
    let (rows, columns) = (shape.height.div_ceil(side), shape.width.div_ceil(side));
    let mut frames = Array3::zeros((shape.frames, rows, columns));
    for (index, mut row) in frames.axis_iter_mut(Axis(1)).enumerate() {
        let place = (index * side..shape.height.min((index + 1) * side), 0..shape.width);
        let input = window(task, snapshot as usize, place, white)?;
        let y = input.measurement / white;
        row.assign(&blocks.row(input.masks.view(), y.view())?);
        let fraction = (index + 1) as f64 / rows as f64;
        shared.set_progress(TaskProgress { stage: TaskStage::Tv, fraction, ..shared.progress() });
        shared.check()?;
    }
    preview::smooth(&mut frames);
    Ok(frames * white)
}
