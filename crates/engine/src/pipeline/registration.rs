//! Registration of the masks of a job, which is decided once before its other tasks.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};

use super::arrays::{Arrays, mask_window, moved_window};
use super::error::Result;
use super::progress::Monitor;
use crate::job::{Registered, RegistrationRequest, SnapshotRange, TaskStage};
use formats::planar::{self, Reader};
use formats::validate::MaskStatistics;
use formats::{FormatError, Limits, StackInfo};
use reconstruction::ReconError;
use reconstruction::registration::{self, Correction, Interpolation, Known, Plan};
use reconstruction::tile::Window;

/// Reason for sensors with colours. The planes of a mosaic sample the masks at every second pixel only.
const COLOUR: &str = "masks of colour sensors and spectral cameras are not registered";
const SMALL: &str = "the picture is too small to register the masks";
const DARK: &str = "the piece on which masks are registered has no light or no measured pixels, or its reconstruction \
                    diverges";

/// Height in rows of the bands in which stored masks are moved.
const BAND: usize = 64;

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
    if let Some(outcome) = without_estimate(request, is_coloured) {
        return Ok(outcome);
    }
    let mut registered = estimate(request, light()?.view(), y, &masks, proceed)?;
    if let Some(correction) = registered.correction() {
        registered.lost_light = Some(lost_light(y, correction, masks, proceed)?);
    }
    Ok(Some(registered))
}

fn estimate(
    request: RegistrationRequest,
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    masks: impl Fn(&Window) -> Result<Array3<f32>>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Registered> {
    let plan = Plan::choose(light, y);
    if let RegistrationRequest::Stated(motion) = request {
        let known = match plan {
            Some(plan) => registration::known(&plan, y, motion, masks, proceed)?,
            None => Known { interpolation: Interpolation::default(), outcome: None },
        };
        return Ok(Registered::stated(motion, known));
    }
    let Some(plan) = plan else { return Ok(Registered::skipped(SMALL)) };
    let found = registration::register(&plan, y, masks, proceed)?;
    Ok(found.map_or_else(|| Registered::skipped(DARK), Registered::from))
}

/// Share of the light of `y` \[H,W\] at pixels where the masks, corrected, are all dark or unknown.
fn lost_light(
    y: ArrayView2<'_, f32>,
    correction: Correction,
    masks: impl Fn(&Window) -> Result<Array3<f32>>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<f64> {
    let (height, width) = y.dim();
    let (mut lost, mut all) = (0.0, 0.0);
    for row in (0..height).step_by(WINDOW) {
        if !proceed(1.0) {
            return Err(ReconError::Cancelled.into());
        }
        for column in (0..width).step_by(WINDOW) {
            let rows = row..height.min(row + WINDOW);
            let columns = column..width.min(column + WINDOW);
            let place = Window { rows: rows.clone(), columns: columns.clone(), step: 1 };
            let moved = moved_window((height, width), &place, correction, &masks)?;
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
        _ => is_coloured.then(|| Some(Registered::skipped(COLOUR))),
    }
}

/// Registers the masks of a job by its first snapshot. It reads a few pieces of fixed size of all masks.
///
/// Errors: those of reading and of the solver; a stop by the monitor.
pub fn register_stored(
    (arrays, snapshots): (&Arrays, SnapshotRange),
    request: RegistrationRequest,
    is_coloured: bool,
    white: f32,
    monitor: &Monitor,
) -> Result<Option<Registered>> {
    // Without an estimate nothing is read.
    if let Some(outcome) = without_estimate(request, is_coloured) {
        return Ok(outcome);
    }
    let y = arrays.snapshot(snapshots.first)? / white;
    let masks = |place: &Window| Ok(mask_window(&arrays.masks()?, place, None)?);
    register(request, is_coloured, || arrays.light(monitor), y.view(), masks, &mut |share| {
        monitor.reach(TaskStage::Tv, share);
        !monitor.stopped()
    })
}

/// Masks \[B,H,W\] in memory after a correction, with NaN where their value is unknown.
pub fn moved(masks: ArrayView3<'_, f32>, correction: Correction) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    let source = correction.motion.source([height, width], [0; 2]);
    registration::Interpolated::new(masks, correction.interpolation).window(
        &source,
        0..height,
        0..width,
    )
}

/// Moves stored masks in bands of rows, which go to `scratch`, an existing file. `step` gets the finished share, and then
/// each moved mask \[H,W\], with NaN where its value is unknown.
///
/// Errors: those of reading, of writing and of `step`.
pub fn correct(
    masks: &Reader,
    correction: Correction,
    scratch: &Path,
    mut step: impl FnMut(f64, Option<ArrayView2<'_, f32>>) -> Result<(), FormatError>,
) -> Result<MaskStatistics, FormatError> {
    let StackInfo { frames, height, width, .. } = *masks.info();
    let bands: Vec<_> =
        (0..height).step_by(BAND).map(|start| start..height.min(start + BAND)).collect();
    let file = File::options().write(true).open(scratch).map_err(FormatError::io("open a file"))?;
    // A frame of this file is a band of all masks.
    let mut writer = planar::writer(BufWriter::new(file), bands.len(), frames * BAND, width)?;
    for (index, rows) in bands.iter().enumerate() {
        step(0.9 * index as f64 / bands.len() as f64, None)?;
        let place = Window { rows: rows.clone(), columns: 0..width, step: 1 };
        let mut moved = mask_window(masks, &place, Some(correction))?;
        // Pixels of the sensor that are not measured do not move with the masks.
        moved.zip_mut_with(&mask_window(masks, &place, None)?, |moved, mask| {
            if mask.is_nan() {
                *moved = f32::NAN;
            }
        });
        let mut band = Array2::zeros((frames * BAND, width));
        for (mut part, mask) in band.axis_chunks_iter_mut(Axis(0), BAND).zip(moved.outer_iter()) {
            part.slice_mut(s![..rows.len(), ..]).assign(&mask);
        }
        writer.write_frame(band.view())?;
    }
    writer.finish()?;
    let moved = Reader::open(scratch, &Limits::default())?;
    let (mut mask, mut light) =
        (Array2::zeros((height, width)), Array2::<f64>::zeros((height, width)));
    for frame in 0..frames {
        for (index, rows) in bands.iter().enumerate() {
            let part = frame * BAND..frame * BAND + rows.len();
            let part = moved.read_window(index..index + 1, part, 0..width)?;
            mask.slice_mut(s![rows.clone(), ..]).assign(&part.index_axis(Axis(0), 0));
        }
        light.zip_mut_with(&mask, |light, mask| *light += f64::from(*mask));
        step(0.9 + 0.1 * frame as f64 / frames as f64, Some(mask.view()))?;
    }
    let known = || light.iter().filter(|light| !light.is_nan());
    Ok(MaskStatistics {
        dead_pixels: light.iter().filter(|light| **light == 0.0).count() as u64,
        clipped_negative: 0,
        mean: known().sum::<f64>() / (frames * known().count()).max(1) as f64,
    })
}

#[cfg(test)]
mod tests {
    use super::correct;
    use formats::Limits;
    use formats::planar::{self, Reader};
    use ndarray::{Array3, s};
    use optics::iid_masks;
    use reconstruction::registration::{Correction, Interpolation, Similarity};

    #[test]
    fn bad_pixels_of_the_sensor_stay_where_they_are() {
        let (frames, height, width) = (2, 90, 40);
        let mut masks = iid_masks(frames, height, width, 5).unwrap();
        masks.slice_mut(s![.., 60..66, 20..26]).fill(f32::NAN);
        let folder = tempfile::tempdir().unwrap();
        let (stored, scratch) = (folder.path().join("masks"), folder.path().join("scratch"));
        let file = std::fs::File::create(&stored).unwrap();
        let mut writer = planar::writer(file, frames, height, width).unwrap();
        masks.outer_iter().for_each(|mask| writer.write_frame(mask).unwrap());
        writer.finish().unwrap();
        std::fs::File::create(&scratch).unwrap();
        let reader = Reader::open(&stored, &Limits::default()).unwrap();
        let correction = Correction {
            motion: Similarity::shifted([4.0, -3.0]),
            interpolation: Interpolation::default(),
        };
        let mut moved = Array3::zeros(masks.dim());
        let mut frame = 0;
        correct(&reader, correction, &scratch, |_, mask| {
            if let Some(mask) = mask {
                moved.slice_mut(s![frame, .., ..]).assign(&mask);
                frame += 1;
            }
            Ok(())
        })
        .unwrap();
        for ((k, i, j), value) in moved.indexed_iter() {
            let is_bad = (60..66).contains(&i) && (20..26).contains(&j);
            // Masks that have moved out of the bad pixels are unknown, and so are those from outside.
            let is_unknown = (63..71).contains(&i) && (16..24).contains(&j);
            let is_outside = i < 4 || j >= 37;
            if is_bad {
                assert!(value.is_nan(), "{k} {i} {j}: {value}");
            } else if !is_outside && !is_unknown {
                assert!((value - masks[(k, i - 4, j + 3)]).abs() < 1e-5, "{k} {i} {j}: {value}");
            }
        }
    }
}
