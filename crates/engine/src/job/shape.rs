//! The sizes of a scene and its parts.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use formats::Channels;
use optics::Mosaic;
use reconstruction::ReconError;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::TilePlan;

/// Snapshots that stand side by side in a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SnapshotRange {
    /// Index of the first, from 0.
    pub first: u32,
    /// How many, at least 1.
    pub count: u32,
}

impl SnapshotRange {
    pub fn indices(self) -> impl Iterator<Item = u32> {
        self.first..self.first + self.count
    }

    /// True if the snapshot with this index is among them.
    pub fn contains(self, index: u32) -> bool {
        index >= self.first && index - self.first < self.count
    }
}

/// How pictures are cut: side and overlap in pixels, which are those of a sub-image where the sensor has a mosaic
/// (see [`reconstruction::tile::TilePlan::new`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TileSpec {
    pub size: usize,
    /// The least that neighbours share.
    pub overlap: usize,
}

impl TileSpec {
    /// One tile for the whole of a picture.
    pub fn whole(height: usize, width: usize) -> Self {
        Self { size: height.max(width).max(16), overlap: 0 }
    }
}

/// Whether the snapshots of a measurement follow one another without a gap.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Display, EnumString, VariantNames,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Sequence {
    /// One after the other: they are reconstructed together, where that pays.
    Contiguous,
    /// Each is reconstructed alone.
    Separate,
}

impl Sequence {
    /// What the camera's times say of snapshots of `frames` frames, where the user says nothing: separate
    /// if it pauses between two exposures for longer than a frame lasts.
    pub fn told_by(camera_fps: Option<f64>, exposure_s: Option<f64>, frames: usize) -> Self {
        match (camera_fps, exposure_s) {
            (Some(fps), Some(exposure)) if 1.0 / fps - exposure > exposure / frames as f64 => {
                Self::Separate
            }
            _ => Self::Contiguous,
        }
    }
}

/// How snapshots that follow one another are reconstructed together: runs of at most `length`, which share
/// at least `overlap` snapshots with their neighbours (see [`reconstruction::sequence::SequencePlan::new`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunSpec {
    /// 1 for each snapshot alone.
    pub length: u32,
    pub overlap: u32,
}

impl RunSpec {
    /// Each snapshot alone.
    pub const ALONE: Self = Self { length: 1, overlap: 0 };
    /// The longest run: longer ones gain little more.
    pub const LONGEST: u32 = 5;

    /// The longest runs whose tiles have no more voxels than [`RUN_VOXELS`]; `voxels` are those of the
    /// largest tile, of one snapshot.
    fn fitting(voxels: usize) -> Self {
        let fit = u32::try_from(RUN_VOXELS / voxels.max(1)).unwrap_or(u32::MAX);
        match fit.min(Self::LONGEST) {
            0 | 1 => Self::ALONE,
            // To share one of two would be to do all twice.
            2 => Self { length: 2, overlap: 0 },
            length => Self { length, overlap: 1 },
        }
    }

    /// The runs of these snapshots, given by their indices in the measurement.
    pub fn plan(self, snapshots: Range<usize>) -> Result<SequencePlan, ReconError> {
        SequencePlan::new(snapshots, self.length as usize, self.overlap as usize)
    }
}

/// The most voxels of a run's tile: those of a snapshot of 30 frames at the usual size. So a sequence takes
/// no more memory.
const RUN_VOXELS: usize = 30 * 320 * 320;
/// A run of so many snapshots is long enough.
const ENOUGH: u32 = 4;
/// Side of the tiles of a sequence whose runs would be too short with the usual ones: what is shared in
/// space costs less than what short runs share in time.
const SEQUENCE_TILE: usize = 240;

/// How a job is cut in space and in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cut {
    pub tile: TileSpec,
    pub run: RunSpec,
}

impl Cut {
    /// The cut of so many snapshots of (frames, height, width), where the tiles are these; if they were not
    /// `asked` for, a sequence may have smaller ones. A schedule that never looks along time gains nothing
    /// from sequences.
    /// Errors: tiles that can't be.
    pub fn new(
        (sequence, snapshots): (Sequence, u32),
        schedule: &Schedule,
        (tile, asked): (TileSpec, bool),
        (frames, height, width): (usize, usize, usize),
    ) -> Result<Self, ReconError> {
        let largest = |tile: TileSpec| {
            let plan = TilePlan::new(height, width, tile.size, tile.overlap)?;
            Ok::<_, ReconError>(plan.largest() * frames)
        };
        let voxels = largest(tile)?;
        let apart = sequence == Sequence::Separate || snapshots < 2;
        if apart || !schedule.looks_along_time() {
            return Ok(Self { tile, run: RunSpec::ALONE });
        }
        let run = RunSpec::fitting(voxels);
        let smaller = TileSpec { size: tile.size.min(SEQUENCE_TILE), ..tile };
        if !asked && run.length < ENOUGH.min(snapshots) {
            let longer = RunSpec::fitting(largest(smaller)?);
            if longer.length > run.length {
                return Ok(Self { tile: smaller, run: longer });
            }
        }
        Ok(Self { tile, run })
    }

    /// The tiles of a picture.
    pub fn tiles(&self, height: usize, width: usize) -> Result<TilePlan, ReconError> {
        TilePlan::new(height, width, self.tile.size, self.tile.overlap)
    }
}

/// The sizes of a measurement and its calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneShape {
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub snapshots: u32,
    /// The colours of the sensor's pixels; none for a grey one.
    pub mosaic: Option<Mosaic>,
}

impl SceneShape {
    /// Rows and columns of what is reconstructed by itself: of the picture, or of each of the four sub-images
    /// of a mosaic.
    pub fn solved(self) -> (usize, usize) {
        match self.mosaic {
            None => (self.height, self.width),
            Some(_) => (self.height / 2, self.width / 2),
        }
    }

    /// How it is cut.
    /// Errors: tiles that can't be; a mosaic with an odd side.
    pub fn tile_plan(self, tile: TileSpec) -> Result<TilePlan, ReconError> {
        let plan = if self.mosaic.is_some() { TilePlan::of_mosaic } else { TilePlan::new };
        plan(self.height, self.width, tile.size, tile.overlap)
    }

    /// What a pixel of its frames has.
    pub fn channels(self) -> Channels {
        if self.mosaic.is_some() { Channels::Rgb } else { Channels::Grey }
    }
}

#[cfg(test)]
mod tests {
    use super::{Cut, RUN_VOXELS, RunSpec, Sequence, TileSpec};
    use crate::job::{Algorithm, Schedule};

    #[test]
    fn a_pause_of_more_than_a_frame_makes_snapshots_separate() {
        use Sequence::{Contiguous, Separate};
        // 10 frames in 20 ms: each lasts 2 ms.
        for (fps, exposure, told) in [
            (None, None, Contiguous),
            (Some(30.0), None, Contiguous),
            (None, Some(0.02), Contiguous),
            (Some(45.0), Some(0.02), Separate),
            (Some(46.0), Some(0.02), Contiguous),
            (Some(50.0), Some(0.02), Contiguous),
        ] {
            assert_eq!(Sequence::told_by(fps, exposure, 10), told, "{fps:?} {exposure:?}");
        }
    }

    fn cut(algorithm: Algorithm, frames: usize, side: usize, asked: Option<usize>) -> Cut {
        let schedule = algorithm.default_schedule();
        let tile = algorithm.default_tile();
        let tile = (TileSpec { size: asked.unwrap_or(tile.size), ..tile }, asked.is_some());
        Cut::new((Sequence::Contiguous, 10), &schedule, tile, (frames, side, side)).unwrap()
    }

    #[test]
    fn runs_are_as_long_as_the_memory_of_a_large_snapshot_allows() {
        use Algorithm::{GapTv, PnpFastdvdnet, PnpTvFastdvdnet};
        for (algorithm, frames, side, asked, tile, length, overlap) in [
            // The picture fits into one tile.
            (PnpTvFastdvdnet, 8, 256, None, 320, 5, 1),
            (PnpTvFastdvdnet, 10, 256, None, 320, 4, 1),
            // Smaller tiles, longer runs.
            (PnpTvFastdvdnet, 10, 3200, None, 240, 5, 1),
            (PnpTvFastdvdnet, 20, 3200, None, 240, 2, 0),
            // Not where tiles were asked for.
            (PnpFastdvdnet, 10, 3200, Some(320), 320, 3, 1),
            // There is no room, or nothing to gain.
            (PnpTvFastdvdnet, 30, 3200, None, 320, 1, 0),
            (GapTv, 8, 256, None, 384, 1, 0),
        ] {
            let cut = cut(algorithm, frames, side, asked);
            let text = format!("{algorithm:?} Cr {frames} {side}");
            assert_eq!(cut.tile.size, tile, "{text}");
            assert_eq!(cut.run, RunSpec { length, overlap }, "{text}");
            let voxels = cut.tiles(side, side).unwrap().largest() * frames * length as usize;
            assert!(voxels <= RUN_VOXELS, "{text}: {voxels}");
        }
        let schedule = Schedule::pnp_tv_fastdvdnet();
        for (sequence, snapshots) in [(Sequence::Separate, 10), (Sequence::Contiguous, 1)] {
            let tile = (Algorithm::PnpTvFastdvdnet.default_tile(), false);
            let cut = Cut::new((sequence, snapshots), &schedule, tile, (10, 3200, 3200)).unwrap();
            assert_eq!(cut, Cut { tile: tile.0, run: RunSpec::ALONE });
        }
    }
}
