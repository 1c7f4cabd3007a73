//! The frames of one snapshot, coarsely.

use ndarray::{Array3, Axis, s};

use super::arrays::Arrays;
use super::error::Result;
use super::progress::Monitor;
use crate::job::{SceneShape, TaskStage};
use reconstruction::preview::{self, Blocks};
use reconstruction::tile::Window;

/// Coarse frames \[B,h,w\] of a snapshot on the scale of the measurement: as large as the snapshot
/// where it is small, else one pixel a block. Those of a mosaic are mosaics, too.
pub fn frames(
    arrays: &Arrays,
    shape: SceneShape,
    snapshot: u32,
    white: f32,
    monitor: &Monitor,
) -> Result<Array3<f32>> {
    let SceneShape { frames, height, width, .. } = shape;
    if shape.mosaic.is_none() {
        let tell = |share| monitor.reach(TaskStage::Tv, share);
        let place = Window::whole(height, width);
        return of_window(arrays, (frames, snapshot, white), &place, monitor, tell);
    }
    let mut whole = Array3::zeros((0, 0, 0));
    for plane in 0..4 {
        let first = (plane / 2, plane % 2);
        let place = Window::of_plane(0..height / 2, 0..width / 2, first);
        let tell = |share| monitor.reach(TaskStage::Tv, (plane as f64 + share) / 4.0);
        let part = of_window(arrays, (frames, snapshot, white), &place, monitor, tell)?;
        let (frames, rows, columns) = part.dim();
        if whole.is_empty() {
            whole = Array3::zeros((frames, 2 * rows, 2 * columns));
        }
        whole.slice_mut(s![.., first.0..;2, first.1..;2]).assign(&part);
    }
    Ok(whole)
}

/// The same of a window.
fn of_window(
    arrays: &Arrays,
    (frames, snapshot, white): (usize, u32, f32),
    place: &Window,
    monitor: &Monitor,
    tell: impl Fn(f64),
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
    let (rows, columns) = (height.div_ceil(side), width.div_ceil(side));
    let mut coarse = Array3::zeros((frames, rows, columns));
    for (index, mut row) in coarse.axis_iter_mut(Axis(1)).enumerate() {
        let at = |row: usize| place.rows.start + row * step;
        let lines = at(index * side)..at((index + 1) * side).min(place.rows.end);
        let blocks_place = Window { rows: lines, ..place.clone() };
        let input = arrays.window(snapshot..snapshot + 1, &blocks_place, white)?;
        let y = input.y.index_axis_move(Axis(0), 0) / white;
        row.assign(&blocks.row(input.masks.view(), y.view())?);
        tell((index + 1) as f64 / rows as f64);
        monitor.check()?;
    }
    preview::smooth(&mut coarse);
    Ok(coarse * white)
}
