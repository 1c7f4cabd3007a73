//! Blends tiles into frames of the whole picture, and the frames of overlapping runs into those of a snapshot.

use std::convert::Infallible;
use std::path::PathBuf;

use ndarray::{Array2, ArrayView2, Axis, CowArray, Ix2};

use super::arrays::is_intact;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use super::records::TileTaskRecord;
use crate::job::Sha256;
use formats::planar::Reader;
use formats::{FormatError, Limits};
use reconstruction::sequence::RunShare;
use reconstruction::solver::Outcome;
use reconstruction::tile::{Tile, TilePlan};

/// The stored frames \[S B,h,w\] of a tile of a run of snapshots.
#[derive(Debug, Clone)]
pub struct StoredTile {
    /// Index of the run's first snapshot in the measurement.
    pub run: u32,
    pub tile: u32,
    pub path: PathBuf,
    pub sha256: Sha256,
    pub record: TileTaskRecord,
}

/// Checks that all tiles of a run are present and that their files have the recorded hashes.
///
/// Errors: [`PipelineError::Damaged`] with the tiles to repeat; [`PipelineError::Record`] if tiles are missing.
pub fn verify(plan: &TilePlan, tiles: &[StoredTile], monitor: &Monitor) -> Result<()> {
    let expected = (0..plan.len() as u64).eq(tiles.iter().map(|tile| u64::from(tile.tile)));
    if !expected {
        let problem = format!("{} of {} tiles are stored", tiles.len(), plan.len());
        return Err(PipelineError::Record { what: "tiles", problem });
    }
    let mut damaged = Vec::new();
    for tile in tiles {
        monitor.check()?;
        if !is_intact(&tile.path, tile.sha256)? {
            damaged.push((tile.run, tile.tile));
        }
    }
    if damaged.is_empty() { Ok(()) } else { Err(PipelineError::Damaged(damaged)) }
}

/// Blends frame `k` \[H,W\] of a snapshot from stored tiles, which are read one at a time. `shares` has the runs that
/// contain the snapshot, each with its tiles in the plan's order.
pub fn stored_frame(
    plan: &TilePlan,
    shares: &[(RunShare, Vec<StoredTile>)],
    k: usize,
) -> Result<Array2<f32>, FormatError> {
    let weighted_frame = |(share, tiles): &(RunShare, Vec<StoredTile>)| {
        let index = share.frame(k);
        let frame = blend_tiles(plan, |tile| {
            // Opened for each frame: a large picture has more tiles than a process may have open files.
            let reader = Reader::open(&tiles[tile.index].path, &Limits::default())?;
            let window = reader.read_window(index..index + 1, 0..tile.height, 0..tile.width)?;
            Ok(window.index_axis_move(Axis(0), 0).into())
        })?;
        Ok((share.weights[k], frame))
    };
    blend_runs(plan, shares.iter().map(weighted_frame))
}

/// Blends frame `k` \[H,W\] of a snapshot from the tiles of all runs in memory.
pub fn frame(plan: &TilePlan, shares: &[RunShare], runs: &[Vec<Outcome>], k: usize) -> Array2<f32> {
    let weighted_frame = |share: &RunShare| {
        let part = |tile: &Tile| -> ArrayView2<'_, f32> {
            runs[share.run][tile.index].frames.index_axis(Axis(0), share.frame(k))
        };
        blend_tiles(plan, |tile| Ok::<_, Infallible>(part(tile).into()))
            .map(|frame| (share.weights[k], frame))
    };
    let Ok(frame) = blend_runs(plan, shares.iter().map(weighted_frame));
    frame
}

/// The weighted sum \[H,W\] of the frames of all runs.
fn blend_runs<E>(
    plan: &TilePlan,
    parts: impl Iterator<Item = Result<(f32, Array2<f32>), E>>,
) -> Result<Array2<f32>, E> {
    let mut whole: Option<Array2<f32>> = None;
    for part in parts {
        let (weight, mut frame) = part?;
        // Avoids rounding if there is only one run.
        if weight != 1.0 {
            frame *= weight;
        }
        whole = Some(match whole {
            None => frame,
            Some(sum) => sum + frame,
        });
    }
    Ok(whole.unwrap_or_else(|| Array2::zeros(plan.dim())))
}

/// Blends a frame \[H,W\] from its tiles, in the plan's order.
fn blend_tiles<'a, E>(
    plan: &TilePlan,
    mut part: impl FnMut(&Tile) -> Result<CowArray<'a, f32, Ix2>, E>,
) -> Result<Array2<f32>, E> {
    let mut frame = Array2::zeros(plan.dim());
    for tile in plan.tiles() {
        plan.blend(&tile, part(&tile)?.view(), frame.view_mut());
    }
    Ok(frame)
}
