//! The prepared arrays of a job, read window by window.

use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, Axis};

use super::error::{PipelineError, Result};
use super::progress::Monitor;
use super::tile::TileInput;
use crate::job::Sha256;
use formats::planar::Reader;
use formats::{FormatError, Limits};
use reconstruction::tile::Window;

/// The files of the masks \[B,H,W\] on \[0,1\] and of the snapshots \[S,H,W\], their full scale
/// divided out.
#[derive(Debug, Clone)]
pub struct Arrays {
    /// The masks and the hash that they should have.
    pub masks: (PathBuf, Sha256),
    /// The snapshots and the hash that they should have.
    pub snapshots: (PathBuf, Sha256),
}

impl Arrays {
    /// Refuses files whose bytes are not those that were stored.
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

    /// The sum \[H,W\] of all masks; memory holds two planes.
    pub fn light(&self, monitor: &Monitor) -> Result<Array2<f32>> {
        let masks = self.masks()?;
        let mut light = Array2::zeros((masks.info().height, masks.info().width));
        for frame in 0..masks.info().frames {
            monitor.check()?;
            light += &plane(&masks, frame)?;
        }
        Ok(light)
    }

    /// One snapshot \[H,W\].
    pub fn snapshot(&self, index: u32) -> Result<Array2<f32>, FormatError> {
        let reader = Reader::open(&self.snapshots.0, &Limits::default())?;
        plane(&reader, index as usize)
    }

    /// A piece of a run of snapshots with its masks, to be solved as one clip.
    pub fn window(
        &self,
        snapshots: Range<u32>,
        place: &Window,
        white: f32,
    ) -> Result<TileInput, FormatError> {
        let masks = self.masks()?;
        let which = snapshots.start as usize..snapshots.end as usize;
        let snapshots = Reader::open(&self.snapshots.0, &Limits::default())?;
        let y = window(&snapshots, which, place)?;
        let masks = window(&masks, 0..masks.info().frames, place)?;
        let whole = 0..y.dim().0;
        Ok(TileInput { masks, y, white, pieces: vec![whole] })
    }
}

/// A window of some frames of a prepared array.
pub fn window(
    reader: &Reader,
    frames: Range<usize>,
    place: &Window,
) -> Result<Array3<f32>, FormatError> {
    reader.read_lattice(frames, (place.rows.clone(), place.columns.clone()), place.step)
}

/// One frame \[H,W\] of a prepared array.
pub(super) fn plane(reader: &Reader, frame: usize) -> Result<Array2<f32>, FormatError> {
    let (height, width) = (reader.info().height, reader.info().width);
    let window = reader.read_window(frame..frame + 1, 0..height, 0..width)?;
    Ok(window.index_axis_move(Axis(0), 0))
}

/// Whether a file is there and has the bytes that were stored.
pub(super) fn is_intact(path: &Path, sha256: Sha256) -> Result<bool, FormatError> {
    if !path.exists() {
        return Ok(false);
    }
    let failed = |source| FormatError::Io { action: "read a stored file", source };
    let hashed = File::open(path).and_then(|mut file| Sha256::of_reader(&mut file));
    Ok(hashed.map_err(failed)?.0 == sha256)
}
