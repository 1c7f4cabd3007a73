//! Registration of the masks of a job, which is decided once before its other tasks.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};

use super::arrays::{Arrays, mask_window, moved_window};
use super::error::Result;
use super::progress::Monitor;
use crate::job::{Registered, RegistrationRequest, SnapshotRange, TaskStage};
use reconstruction::registration;
use reconstruction::tile::Window;

/// Reason for sensors with colours. The planes of a mosaic sample the masks at every second pixel only.
const COLOUR: &str = "masks of colour sensors and spectral cameras are not registered";
const SMALL: &str = "the picture is too small to register the masks";
const DARK: &str = "the piece on which masks are registered has no light or no measured pixels, or its reconstruction \
                    diverges";

/// Side in pixels of the windows in which the light of moved masks is summed.
const WINDOW: usize = 128;

/// Registers the masks of a picture \[H,W\] by one snapshot `y` on the scale on which the scene is on \[0,1\]. `light` gives
/// the sum of the masks, and `masks` a window of them. `None` if it is off.
///
/// Errors: those of [`registration::register`] and of reading.
pub fn register(
    request: RegistrationRequest,
    is_coloured: bool,
    light: impl FnOnce() -> Result<Array2<f32>>,
    y: ArrayView2<'_, f32>,
    masks: impl Fn(&Window) -> Result<Array3<f32>>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Option<Registered>> {
    let mut outcome = match without_estimate(request, is_coloured) {
        Some(outcome) => outcome,
        None => Some(estimate(light()?.view(), y, &masks, proceed)?),
    };
    if let Some(registered) = &mut outcome
        && let Some(shift) = registered.applied_shift()
    {
        registered.lost_light = Some(lost_light(y, shift, masks)?);
    }
    Ok(outcome)
}

fn estimate(
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    masks: impl Fn(&Window) -> Result<Array3<f32>>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Registered> {
    let Some((rows, columns)) = registration::choose(light, y) else {
        return Ok(Registered::skipped(SMALL));
    };
    let piece = masks(&Window { rows: rows.clone(), columns: columns.clone(), step: 1 })?;
    let y = y.slice(s![rows, columns]);
    let found = registration::register(piece.view(), y, proceed)?;
    Ok(found.map_or_else(|| Registered::skipped(DARK), Registered::from))
}

/// Share of the light of `y` \[H,W\] at pixels where the masks, moved by `shift`, are all dark or unknown.
fn lost_light(
    y: ArrayView2<'_, f32>,
    shift: [f64; 2],
    masks: impl Fn(&Window) -> Result<Array3<f32>>,
) -> Result<f64> {
    let (height, width) = y.dim();
    let (mut lost, mut all) = (0.0, 0.0);
    for row in (0..height).step_by(WINDOW) {
        for column in (0..width).step_by(WINDOW) {
            let rows = row..height.min(row + WINDOW);
            let columns = column..width.min(column + WINDOW);
            let place = Window { rows: rows.clone(), columns: columns.clone(), step: 1 };
            let moved = moved_window((height, width), &place, shift, &masks)?;
            for (pixel, &y) in moved.lanes(Axis(0)).into_iter().zip(y.slice(s![rows, columns])) {
                // `max` also replaces NaN, which were not measured.
                let light = f64::from(y.max(0.0));
                all += light;
                // NaN are unknown masks.
                if !pixel.iter().any(|mask| *mask > 0.0) {
                    lost += light;
                }
            }
        }
    }
    Ok(if all > 0.0 { lost / all } else { 0.0 })
}

/// The outcome of a request that needs no estimate.
fn without_estimate(request: RegistrationRequest, is_coloured: bool) -> Option<Option<Registered>> {
    match request {
        RegistrationRequest::Off => Some(None),
        RegistrationRequest::Shift(shift) => Some(Some(Registered::stated(shift))),
        RegistrationRequest::Auto => is_coloured.then(|| Some(Registered::skipped(COLOUR))),
    }
}

/// Registers the masks of a job by its first snapshot. It reads one piece of fixed size of all masks.
///
/// Errors: those of reading and of the solver; a stop by the monitor.
pub fn register_stored(
    (arrays, snapshots): (&Arrays, SnapshotRange),
    (request, is_coloured): (RegistrationRequest, bool),
    white: f32,
    monitor: &Monitor,
) -> Result<Option<Registered>> {
    // Nothing is read if no masks are moved.
    if let Some(outcome) = without_estimate(request, is_coloured)
        && outcome.as_ref().is_none_or(|registered| !registered.applied)
    {
        return Ok(outcome);
    }
    let y = arrays.snapshot(snapshots.first)? / white;
    let masks = |place: &Window| Ok(mask_window(&arrays.masks()?, place, None)?);
    register(request, is_coloured, || arrays.light(monitor), y.view(), masks, &mut |share| {
        monitor.reach(TaskStage::Tv, share);
        !monitor.stopped()
    })
}

/// Masks \[B,H,W\] in memory after they moved by `shift`, with NaN where their value is unknown.
pub fn moved(masks: ArrayView3<'_, f32>, shift: [f64; 2]) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    registration::Interpolated::new(masks).window(shift, 0..height, 0..width)
}
