//! The prepared arrays of a job, which are read window by window.

use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, Axis, s};

use super::error::{PipelineError, Result};
use super::progress::Monitor;
use super::tile::TileInput;
use crate::job::Sha256;
use formats::planar::Reader;
use formats::{FormatError, Limits};
use reconstruction::registration::{Correction, Interpolated};
use reconstruction::tile::Window;

/// The files of the masks \[B,H,W\] on \[0,1\] and of the snapshots \[S,H,W\], divided by their full scale.
#[derive(Debug, Clone)]
pub struct Arrays {
    /// The file of the masks and its recorded hash.
    pub masks: (PathBuf, Sha256),
    /// The file of the snapshots and its recorded hash.
    pub snapshots: (PathBuf, Sha256),
    /// Correction of masks that have moved since their calibration.
    pub correction: Option<Correction>,
}

impl Arrays {
    /// Checks the hashes of both files.
    ///
    /// Errors: [`PipelineError::Corrupt`] if a file is missing or changed.
    pub fn verify(&self) -> Result<()> {
        for (what, (path, sha256)) in [("masks", &self.masks), ("snapshots", &self.snapshots)] {
            if !is_intact(path, *sha256)? {
                return Err(PipelineError::Corrupt { what, sha256: *sha256 });
            }
        }
        Ok(())
    }

    pub(super) fn masks(&self) -> Result<Reader, FormatError> {
        Reader::open(&self.masks.0, &Limits::default())
    }

    /// The [light] of the masks after their correction. It reads one mask at a time.
    pub fn light(&self, monitor: &Monitor) -> Result<Array2<f32>> {
        let masks = self.masks()?;
        let size = (masks.info().height, masks.info().width);
        let read = |frame| {
            monitor.check()?;
            Ok(plane(&masks, frame)?)
        };
        light((0..masks.info().frames).map(read), size, self.correction)
    }

    /// One snapshot \[H,W\].
    pub fn snapshot(&self, index: u32) -> Result<Array2<f32>, FormatError> {
        let reader = Reader::open(&self.snapshots.0, &Limits::default())?;
        plane(&reader, index as usize)
    }

    /// A window of consecutive snapshots and of the masks, as the input of a tile that solves them as one clip.
    pub fn window(
        &self,
        snapshots: Range<u32>,
        place: &Window,
        white: f32,
    ) -> Result<TileInput, FormatError> {
        let masks = self.masks()?;
        let frames = snapshots.start as usize..snapshots.end as usize;
        let snapshots = Reader::open(&self.snapshots.0, &Limits::default())?;
        let y = snapshot_window(&snapshots, frames, place, self.correction)?;
        let masks = mask_window(&masks, place, self.correction)?;
        let masks = masks.mapv_into(known);
        let all_snapshots = 0..y.dim().0;
        Ok(TileInput { masks, y, white, pieces: vec![all_snapshots] })
    }
}

/// The sum of masks \[H,W\] after a correction, in which pixels that were not measured count as 0. It moves their sum.
///
/// Errors: the first one of `masks`.
pub fn light<E>(
    masks: impl ExactSizeIterator<Item = Result<Array2<f32>, E>>,
    (height, width): (usize, usize),
    correction: Option<Correction>,
) -> Result<Array2<f32>, E> {
    let frames = masks.len() as f32;
    let mut light = Array2::zeros((height, width));
    for mask in masks {
        let mask = mask?;
        light += &(if correction.is_some() { mask } else { mask.mapv_into(known) });
    }
    let Some(correction) = correction else { return Ok(light) };
    // Moved masks are clipped to [0,1], so the sum is moved as a mean.
    let mean = (light / frames).insert_axis(Axis(0));
    let moved = Interpolated::new(mean.view(), correction.interpolation);
    let source = correction.motion.source([height, width], [0; 2]);
    let moved = moved.window(&source, 0..height, 0..width).remove_axis(Axis(0));
    Ok(moved.mapv_into(|mean| frames * known(mean)))
}

/// The value of a mask that the solver uses: 0 where it is not known.
pub fn known(mask: f32) -> f32 {
    if mask.is_nan() { 0.0 } else { mask }
}

/// Reads a window of some frames of a prepared array.
pub fn window(
    reader: &Reader,
    frames: Range<usize>,
    place: &Window,
) -> Result<Array3<f32>, FormatError> {
    reader.read_lattice(frames, (place.rows.clone(), place.columns.clone()), place.step)
}

/// Reads a window of all masks after a correction. NaN are unknown. It depends on the masks within
/// the margin of the motion only.
pub fn mask_window(
    masks: &Reader,
    place: &Window,
    correction: Option<Correction>,
) -> Result<Array3<f32>, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let Some(correction) = correction else { return window(masks, 0..frames, place) };
    moved_window((height, width), place, correction, |wide| window(masks, 0..frames, wide))
}

/// A window of masks of `height` x `width` pixels after a correction. `read` gets the window of the calibrated masks on
/// which it depends.
pub(super) fn moved_window<E>(
    (height, width): (usize, usize),
    place: &Window,
    Correction { motion, interpolation }: Correction,
    read: impl FnOnce(&Window) -> Result<Array3<f32>, E>,
) -> Result<Array3<f32>, E> {
    let margin = motion.margin([height, width], &place.rows, &place.columns);
    let around = |range: &Range<usize>, length: usize| {
        range.start.saturating_sub(margin)..length.min(range.end + margin)
    };
    let (rows, columns) = (around(&place.rows, height), around(&place.columns, width));
    let within = |range: &Range<usize>, start: usize| range.start - start..range.end - start;
    let inner = (within(&place.rows, rows.start), within(&place.columns, columns.start));
    let source = motion.source([height, width], [rows.start, columns.start]);
    let wide = Window { rows, columns, step: 1 };
    let masks = read(&wide)?;
    let moved = Interpolated::new(masks.view(), interpolation).window(&source, inner.0, inner.1);
    let step = place.step.cast_signed();
    Ok(moved.slice(s![.., ..;step, ..;step]).to_owned())
}

/// Reads a window of snapshots. Pixels without a known mask after a correction are NaN, as if they were not measured.
pub fn snapshot_window(
    snapshots: &Reader,
    range: Range<usize>,
    place: &Window,
    correction: Option<Correction>,
) -> Result<Array3<f32>, FormatError> {
    let mut y = window(snapshots, range, place)?;
    if let Some(correction) = correction {
        hide_uncovered(
            &mut y,
            (snapshots.info().height, snapshots.info().width),
            place,
            correction,
        );
    }
    Ok(y)
}

/// Marks pixels of a window of snapshots \[S,h,w\] with NaN where no mask is known after a correction.
pub fn hide_uncovered(
    y: &mut Array3<f32>,
    (height, width): (usize, usize),
    place: &Window,
    correction: Correction,
) {
    for ((_, row, column), value) in y.indexed_iter_mut() {
        let at = [place.rows.start + row * place.step, place.columns.start + column * place.step];
        if !correction.motion.covers([height, width], at) {
            *value = f32::NAN;
        }
    }
}

/// Reads one frame \[H,W\] of a prepared array.
pub(super) fn plane(reader: &Reader, frame: usize) -> Result<Array2<f32>, FormatError> {
    let (height, width) = (reader.info().height, reader.info().width);
    let window = reader.read_window(frame..frame + 1, 0..height, 0..width)?;
    Ok(window.index_axis_move(Axis(0), 0))
}

/// True if a file exists and has the recorded hash.
pub(super) fn is_intact(path: &Path, sha256: Sha256) -> Result<bool, FormatError> {
    if !path.exists() {
        return Ok(false);
    }
    let failed = |source| FormatError::Io { action: "read a stored file", source };
    let hashed = File::open(path).and_then(|mut file| Sha256::of_reader(&mut file));
    Ok(hashed.map_err(failed)?.0 == sha256)
}
