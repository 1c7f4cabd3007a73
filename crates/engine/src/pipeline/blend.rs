//! Frames of the whole picture, blended from those of its tiles, and of the runs that have a part in them.

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
    /// The index of the run's first snapshot in the measurement.
    pub run: u32,
    pub tile: u32,
    pub path: PathBuf,
    pub sha256: Sha256,
    pub record: TileTaskRecord,
}

/// Refuses tiles of a run of which one is missing, or whose bytes are not those that were stored.
/// Errors: [`PipelineError::Damaged`] with the tiles that should be done again.
pub fn verify(plan: &TilePlan, tiles: &[StoredTile], monitor: &Monitor) -> Result<()> {
    let expected = (0..plan.len() as u64).eq(tiles.iter().map(|tile| u64::from(tile.tile)));
    if !expected {
        let problem = format!("{} tiles are stored of {}", tiles.len(), plan.len());
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

/// Frame `k` \[H,W\] of a snapshot, of which each stored tile's part is read when it is needed. Of each
/// run that has a share in the snapshot `tiles` tells the tiles, in the plan's order.
pub fn stored_frame(
    plan: &TilePlan,
    shares: &[(RunShare, Vec<StoredTile>)],
    k: usize,
) -> Result<Array2<f32>, FormatError> {
    let of_run = |(share, tiles): &(RunShare, Vec<StoredTile>)| {
        let index = share.frame(k);
        let frame = blended(plan, |tile| {
            // Opened anew for each frame: a large picture has more tiles than a process may have files.
            let reader = Reader::open(&tiles[tile.index].path, &Limits::default())?;
            let window = reader.read_window(index..index + 1, 0..tile.height, 0..tile.width)?;
            Ok(window.index_axis_move(Axis(0), 0).into())
        })?;
        Ok((share.weights[k], frame))
    };
    in_time(plan, shares.iter().map(of_run))
}

/// Frame `k` \[H,W\] of a snapshot from the tiles of all runs in memory.
pub fn frame(plan: &TilePlan, shares: &[RunShare], runs: &[Vec<Outcome>], k: usize) -> Array2<f32> {
    let of_run = |share: &RunShare| {
        let part = |tile: &Tile| -> ArrayView2<'_, f32> {
            runs[share.run][tile.index].frames.index_axis(Axis(0), share.frame(k))
        };
        blended(plan, |tile| Ok::<_, Infallible>(part(tile).into()))
            .map(|frame| (share.weights[k], frame))
    };
    let Ok(frame) = in_time(plan, shares.iter().map(of_run));
    frame
}

/// A frame \[H,W\] from those of the runs, with their weights.
fn in_time<E>(
    plan: &TilePlan,
    parts: impl Iterator<Item = Result<(f32, Array2<f32>), E>>,
) -> Result<Array2<f32>, E> {
    let mut whole: Option<Array2<f32>> = None;
    for part in parts {
        let (weight, mut frame) = part?;
        // A run alone is taken as it is.
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

/// A frame \[H,W\] from the parts of its tiles, in the plan's order.
fn blended<'a, E>(
    plan: &TilePlan,
    mut part: impl FnMut(&Tile) -> Result<CowArray<'a, f32, Ix2>, E>,
) -> Result<Array2<f32>, E> {
    let mut whole = Array2::zeros(plan.dim());
    for tile in plan.tiles() {
        plan.blend(&tile, part(&tile)?.view(), whole.view_mut());
    }
    Ok(whole)
}
