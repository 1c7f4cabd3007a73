//! Sizes of a scene, and how it is cut in space and in time.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use formats::Channels;
use optics::{Dispersion, Mosaic};
use reconstruction::ReconError;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::TilePlan;

/// A range of consecutive snapshots of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct SnapshotRange {
    /// Index of the first snapshot, counted from 0.
    pub first: u32,
    /// Number of snapshots, at least 1.
    pub count: u32,
}

impl SnapshotRange {
    /// The indices of all snapshots in the range.
    pub fn indices(self) -> impl Iterator<Item = u32> {
        self.first..self.first + self.count
    }

    /// True if the snapshot with this index is in the range.
    pub fn contains(self, index: u32) -> bool {
        index >= self.first && index - self.first < self.count
    }
}

/// Size and overlap of tiles in pixels; see [`reconstruction::tile::TilePlan::new`]. Behind a mosaic they count pixels
/// of a sub-image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Tile")]
pub struct TileSpec {
    /// Side of a tile.
    #[schemars(range(min = 16, max = 8192))]
    pub size: usize,
    /// Smallest overlap between neighbours.
    #[schemars(range(max = 4096))]
    pub overlap: usize,
}

impl TileSpec {
    /// One tile for the whole picture.
    pub fn whole(height: usize, width: usize) -> Self {
        Self { size: height.max(width).max(16), overlap: 0 }
    }
}

/// The temporal relation of the snapshots of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Sequence {
    /// There is no pause between snapshots, so they may be reconstructed together.
    Contiguous,
    /// Each is reconstructed alone.
    Separate,
}

impl Sequence {
    /// The default for snapshots of `frames` frames, from the frame rate and the exposure time of the camera: separate
    /// if the pause between two exposures is longer than a frame.
    pub fn from_camera(camera_fps: Option<f64>, exposure_s: Option<f64>, frames: usize) -> Self {
        match (camera_fps, exposure_s) {
            (Some(fps), Some(exposure)) if 1.0 / fps - exposure > exposure / frames as f64 => {
                Self::Separate
            }
            _ => Self::Contiguous,
        }
    }
}

/// How contiguous snapshots are reconstructed together: in runs of at most `length` snapshots that share at least
/// `overlap` with their neighbours. See [`reconstruction::sequence::SequencePlan::new`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[schemars(rename = "Runs")]
pub struct RunSpec {
    /// Largest number of snapshots in a run; 1 reconstructs each alone.
    pub length: u32,
    /// Smallest number of snapshots that neighbouring runs share.
    pub overlap: u32,
}

impl RunSpec {
    /// Each snapshot is reconstructed alone.
    pub const ALONE: Self = Self { length: 1, overlap: 0 };
    /// Largest length. Longer runs hardly improve the results.
    pub const LONGEST: u32 = 5;

    /// The longest runs with at most [`RUN_VOXELS`] voxels per tile. `voxels` is the size of the largest tile of one
    /// snapshot.
    fn fitting(voxels: usize) -> Self {
        let fit = u32::try_from(RUN_VOXELS / voxels.max(1)).unwrap_or(u32::MAX);
        match fit.min(Self::LONGEST) {
            0 | 1 => Self::ALONE,
            // An overlap of one in two would double the work.
            2 => Self { length: 2, overlap: 0 },
            length => Self { length, overlap: 1 },
        }
    }

    /// The runs of these snapshots of the measurement.
    pub fn plan(self, snapshots: Range<usize>) -> Result<SequencePlan, ReconError> {
        SequencePlan::new(snapshots, self.length as usize, self.overlap as usize)
    }
}

/// Largest number of voxels in a tile of a run: that of a snapshot of 30 frames with the default size. Sequences
/// therefore take as much memory as large snapshots at most.
const RUN_VOXELS: usize = 30 * 320 * 320;
/// Runs of at least this length do not need smaller tiles.
const SUFFICIENT_LENGTH: u32 = 4;
/// Size of the tiles of a sequence if runs would be too short with the default size. Overlaps in space cost less than
/// overlaps of short runs in time.
const SEQUENCE_TILE: usize = 240;

/// The input of [`Cut::new`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CutRequest {
    pub sequence: Sequence,
    /// Number of snapshots.
    pub snapshots: u32,
    /// (frames, height, width) of a reconstructed snapshot; behind a mosaic, of a sub-image.
    pub size: (usize, usize, usize),
    pub tile: TileSpec,
    /// True if the user stated `tile`; otherwise sequences may use smaller tiles.
    pub tile_is_fixed: bool,
}

/// The cut of a job in space and in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cut {
    pub tile: TileSpec,
    pub run: RunSpec,
}

impl Cut {
    /// Chooses tiles and runs. A schedule without a temporal prior gains nothing from runs, so each snapshot is
    /// reconstructed alone.
    ///
    /// Errors: [`ReconError::Parameter`] for an impossible tile size or overlap.
    pub fn new(request: CutRequest, schedule: &Schedule) -> Result<Self, ReconError> {
        let CutRequest { sequence, snapshots, size, tile, tile_is_fixed } = request;
        let (frames, height, width) = size;
        let largest = |tile: TileSpec| {
            let plan = TilePlan::new(height, width, tile.size, tile.overlap)?;
            Ok::<_, ReconError>(plan.largest() * frames)
        };
        let voxels = largest(tile)?;
        let separate = sequence == Sequence::Separate || snapshots < 2;
        if separate || !schedule.looks_along_time() {
            return Ok(Self { tile, run: RunSpec::ALONE });
        }
        let run = RunSpec::fitting(voxels);
        let smaller = TileSpec { size: tile.size.min(SEQUENCE_TILE), ..tile };
        if !tile_is_fixed && run.length < SUFFICIENT_LENGTH.min(snapshots) {
            let longer = RunSpec::fitting(largest(smaller)?);
            if longer.length > run.length {
                return Ok(Self { tile: smaller, run: longer });
            }
        }
        Ok(Self { tile, run })
    }

    /// The tile plan of a picture.
    pub fn tiles(&self, height: usize, width: usize) -> Result<TilePlan, ReconError> {
        TilePlan::new(height, width, self.tile.size, self.tile.overlap)
    }
}

/// The size of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct SceneShape {
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub snapshots: u32,
    /// The mosaic of a colour sensor; `None` for a grey sensor.
    pub mosaic: Option<Mosaic>,
}

impl SceneShape {
    /// The shape of the frames: the bands of a spectral camera are smaller than the measurement.
    pub fn frame_shape(self, dispersion: Option<&Dispersion>) -> Self {
        let sensor = (self.height, self.width);
        let (height, width) = dispersion.map_or(sensor, |bands| bands.frame_size(sensor));
        Self { height, width, ..self }
    }

    /// Rows and columns of the images that the solver reconstructs: the picture, or each of the four sub-images of a
    /// mosaic.
    pub fn solved(self) -> (usize, usize) {
        match self.mosaic {
            None => (self.height, self.width),
            Some(_) => (self.height / 2, self.width / 2),
        }
    }

    /// The tile plan of a picture.
    ///
    /// Errors: [`ReconError::Parameter`] for an impossible tile size or overlap, and for a mosaic with an odd side.
    pub fn tile_plan(self, tile: TileSpec) -> Result<TilePlan, ReconError> {
        let plan = if self.mosaic.is_some() { TilePlan::of_mosaic } else { TilePlan::new };
        plan(self.height, self.width, tile.size, tile.overlap)
    }

    /// The channels of the reconstructed frames.
    pub fn channels(self) -> Channels {
        if self.mosaic.is_some() { Channels::Rgb } else { Channels::Grey }
    }
}

#[cfg(test)]
mod tests {
    use super::{Cut, CutRequest, RUN_VOXELS, RunSpec, Sequence, TileSpec};
    use crate::job::{Algorithm, Schedule};

    #[test]
    fn snapshots_are_separate_if_the_pause_exceeds_a_frame() {
        use Sequence::{Contiguous, Separate};
        // 10 frames in 20 ms: each lasts 2 ms.
        for (fps, exposure, expected) in [
            (None, None, Contiguous),
            (Some(30.0), None, Contiguous),
            (None, Some(0.02), Contiguous),
            (Some(45.0), Some(0.02), Separate),
            (Some(46.0), Some(0.02), Contiguous),
            (Some(50.0), Some(0.02), Contiguous),
        ] {
            assert_eq!(Sequence::from_camera(fps, exposure, 10), expected, "{fps:?} {exposure:?}");
        }
    }

    fn cut(algorithm: Algorithm, frames: usize, side: usize, stated: Option<usize>) -> Cut {
        let default = algorithm.default_tile();
        let request = CutRequest {
            sequence: Sequence::Contiguous,
            snapshots: 10,
            size: (frames, side, side),
            tile: TileSpec { size: stated.unwrap_or(default.size), ..default },
            tile_is_fixed: stated.is_some(),
        };
        Cut::new(request, &algorithm.default_schedule()).unwrap()
    }

    #[test]
    fn run_length_is_limited_by_the_memory_of_a_large_snapshot() {
        use Algorithm::{GapTv, PnpFastdvdnet, PnpTvFastdvdnet};
        for (algorithm, frames, side, stated, tile, length, overlap) in [
            // The picture fits into one tile.
            (PnpTvFastdvdnet, 8, 256, None, 320, 5, 1),
            (PnpTvFastdvdnet, 10, 256, None, 320, 4, 1),
            // Smaller tiles allow longer runs.
            (PnpTvFastdvdnet, 10, 3200, None, 240, 5, 1),
            (PnpTvFastdvdnet, 20, 3200, None, 240, 2, 0),
            // Stated tiles are kept.
            (PnpFastdvdnet, 10, 3200, Some(320), 320, 3, 1),
            // Either the memory does not suffice, or the prior is not temporal.
            (PnpTvFastdvdnet, 30, 3200, None, 320, 1, 0),
            (GapTv, 8, 256, None, 384, 1, 0),
        ] {
            let cut = cut(algorithm, frames, side, stated);
            let text = format!("{algorithm:?} Cr {frames} {side}");
            assert_eq!(cut.tile.size, tile, "{text}");
            assert_eq!(cut.run, RunSpec { length, overlap }, "{text}");
            let voxels = cut.tiles(side, side).unwrap().largest() * frames * length as usize;
            assert!(voxels <= RUN_VOXELS, "{text}: {voxels}");
        }
        let schedule = Schedule::pnp_tv_fastdvdnet();
        for (sequence, snapshots) in [(Sequence::Separate, 10), (Sequence::Contiguous, 1)] {
            let tile = Algorithm::PnpTvFastdvdnet.default_tile();
            let size = (10, 3200, 3200);
            let request = CutRequest { sequence, snapshots, size, tile, tile_is_fixed: false };
            let cut = Cut::new(request, &schedule).unwrap();
            assert_eq!(cut, Cut { tile, run: RunSpec::ALONE });
        }
    }
}
