//! The frames of one snapshot, coarsely.

use ndarray::{Array3, Axis};

use super::arrays::Arrays;
use super::error::Result;
use super::progress::Monitor;
use crate::job::{SceneShape, TaskStage};
use crate::recon::preview::{self, Blocks};

/// Coarse frames \[B,h,w\] of a snapshot on the scale of the measurement: as large as the snapshot
/// where it is small, else one pixel a block.
pub fn frames(
    arrays: &Arrays,
    shape: SceneShape,
    snapshot: u32,
    white: f32,
    monitor: &Monitor,
) -> Result<Array3<f32>> {
    let SceneShape { frames, height, width, .. } = shape;
    let side = preview::block(frames, height, width);
    if side == 1 {
        let input = arrays.window(snapshot..snapshot + 1, (0..height, 0..width), white)?;
        monitor.check()?;
        return Ok(match input.on_unit_scale()? {
            None => Array3::zeros((frames, height, width)),
            Some((op, y)) => preview::whole(&op, y.view())? * white,
        });
    }
    let mut blocks = Blocks::new(frames, side);
    let (rows, columns) = (height.div_ceil(side), width.div_ceil(side));
    let mut coarse = Array3::zeros((frames, rows, columns));
    for (index, mut row) in coarse.axis_iter_mut(Axis(1)).enumerate() {
        let place = (index * side..height.min((index + 1) * side), 0..width);
        let input = arrays.window(snapshot..snapshot + 1, place, white)?;
        let y = input.y.index_axis_move(Axis(0), 0) / white;
        row.assign(&blocks.row(input.masks.view(), y.view())?);
        monitor.reach(TaskStage::Tv, (index + 1) as f64 / rows as f64);
        monitor.check()?;
    }
    preview::smooth(&mut coarse);
    Ok(coarse * white)
}
