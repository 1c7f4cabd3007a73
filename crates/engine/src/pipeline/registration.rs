//! Registration of the masks of a job, which is decided once before its other tasks.

use ndarray::{Array3, ArrayView2, ArrayView3, s};

use super::arrays::{Arrays, mask_window};
use super::error::Result;
use super::progress::Monitor;
use crate::job::{Registered, RegistrationRequest, SnapshotRange, TaskStage};
use reconstruction::registration::{self, Correction, Interpolation};
use reconstruction::tile::Window;

/// Reason for sensors with colours. The planes of a mosaic sample the masks at every second pixel only.
const COLOUR: &str = "masks of colour sensors and spectral cameras are not registered";
const SMALL: &str = "the picture is too small to register the masks";
const DARK: &str = "the piece on which masks are registered has no light or no measured pixels, or its reconstruction \
                    diverges";

/// Registers masks in memory: all of them \[B,H,W\], and one snapshot \[H,W\] on the scale on which the scene is on
/// \[0,1\]. `None` if it is off.
///
/// Errors: those of [`registration::register`].
pub fn register(
    request: RegistrationRequest,
    is_coloured: bool,
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    piece: impl FnOnce(&Window) -> Result<Array3<f32>>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Option<Registered>> {
    if let Some(outcome) = without_estimate(request, is_coloured) {
        return Ok(outcome);
    }
    let Some((rows, columns)) = registration::choose(light, y) else {
        return Ok(Some(match request {
            RegistrationRequest::Shift(shift) => {
                let interpolation = Interpolation::default();
                Registered::stated(Correction { shift, interpolation })
            }
            _ => Registered::skipped(SMALL),
        }));
    };
    let place = Window { rows: rows.clone(), columns: columns.clone(), step: 1 };
    let masks = piece(&place)?;
    let y = y.slice(s![rows, columns]);
    if let RegistrationRequest::Shift(shift) = request {
        let interpolation = registration::interpolation(masks.view(), y, shift, proceed)?;
        return Ok(Some(Registered::stated(Correction { shift, interpolation })));
    }
    let found = registration::register(masks.view(), y, proceed)?;
    Ok(Some(found.map_or_else(|| Registered::skipped(DARK), Registered::from)))
}

/// The outcome of a request that needs no estimate.
fn without_estimate(request: RegistrationRequest, is_coloured: bool) -> Option<Option<Registered>> {
    match request {
        RegistrationRequest::Off => Some(None),
        _ => is_coloured.then(|| Some(Registered::skipped(COLOUR))),
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
    // Without an estimate nothing is read.
    if let Some(outcome) = without_estimate(request, is_coloured) {
        return Ok(outcome);
    }
    let first = snapshots.first;
    let y = arrays.snapshot(first)? / white;
    let light = arrays.light(monitor)?;
    let piece = |place: &Window| Ok(mask_window(&arrays.masks()?, place, None)?);
    register(request, is_coloured, light.view(), y.view(), piece, &mut |share| {
        monitor.reach(TaskStage::Tv, share);
        !monitor.stopped()
    })
}

/// Masks \[B,H,W\] in memory after a correction, with NaN where their value is unknown.
pub fn moved(masks: ArrayView3<'_, f32>, correction: Correction) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    registration::Interpolated::new(masks, correction.interpolation).window(
        correction.shift,
        0..height,
        0..width,
    )
}
