//! Coarse previews of a snapshot.

use ndarray::{Array3, Axis, s};

use super::arrays::Arrays;
use super::error::Result;
use super::progress::Monitor;
use crate::job::{SceneShape, TaskStage};
use reconstruction::preview::{self, Blocks};
use reconstruction::tile::Window;

/// Coarse frames \[B,h,w\] of a snapshot, on the scale of the measurement. Small snapshots keep their size; large ones
/// have one pixel per block. Frames behind a mosaic are raw mosaics.
///
/// Errors: those of reading and of the solver; a stop by the monitor.
pub fn frames(
    arrays: &Arrays,
    shape: SceneShape,
    snapshot: u32,
    white: f32,
    monitor: &Monitor,
) -> Result<Array3<f32>> {
    let SceneShape { frames, height, width, .. } = shape;
    if shape.mosaic.is_none() {
        let report = |share| monitor.reach(TaskStage::Tv, share);
        let window = Window::whole(height, width);
        return window_frames(arrays, frames, snapshot, white, &window, monitor, report);
    }
    let mut joined = Array3::zeros((0, 0, 0));
    for plane in 0..4 {
        let first = (plane / 2, plane % 2);
        let window = Window::of_plane(0..height / 2, 0..width / 2, first);
        let report = |share| monitor.reach(TaskStage::Tv, (plane as f64 + share) / 4.0);
        let part = window_frames(arrays, frames, snapshot, white, &window, monitor, report)?;
        let (frames, rows, columns) = part.dim();
        if joined.is_empty() {
            joined = Array3::zeros((frames, 2 * rows, 2 * columns));
        }
        joined.slice_mut(s![.., first.0..;2, first.1..;2]).assign(&part);
    }
    Ok(joined)
}

/// Coarse frames \[B,h,w\] of a window of a snapshot.
fn window_frames(
    arrays: &Arrays,
    frames: usize,
    snapshot: u32,
    white: f32,
    place: &Window,
    monitor: &Monitor,
    report: impl Fn(f64),
) -> Result<Array3<f32>> {
    let step = place.step;
    let (height, width) = (place.rows.len().div_ceil(step), place.columns.len().div_ceil(step));
    let side = preview::block(frames, height, width);
    if side == 1 {
        let input = arrays.window(snapshot..snapshot + 1, place, white)?;
        monitor.check()?;
        return Ok(match input.on_unit_scale()? {
            None => Array3::zeros((frames, height, width)),
            Some((op, y)) => preview::whole(&op, y.view())? * white,
        });
    }
    let mut blocks = Blocks::new(frames, side);
    let (block_rows, block_columns) = (height.div_ceil(side), width.div_ceil(side));
    let mut coarse = Array3::zeros((frames, block_rows, block_columns));
    for (index, mut row) in coarse.axis_iter_mut(Axis(1)).enumerate() {
        let sensor_row = |row: usize| place.rows.start + row * step;
        let rows = sensor_row(index * side)..sensor_row((index + 1) * side).min(place.rows.end);
        let strip = Window { rows, ..place.clone() };
        let input = arrays.window(snapshot..snapshot + 1, &strip, white)?;
        let y = input.y.index_axis_move(Axis(0), 0) / white;
        row.assign(&blocks.row(input.masks.view(), y.view())?);
        report((index + 1) as f64 / block_rows as f64);
        monitor.check()?;
    }
    preview::smooth(&mut coarse);
    Ok(coarse * white)
}
