//! Frames of the whole picture, blended from those of its tiles.

use std::path::PathBuf;

use ndarray::{Array2, ArrayView2, Axis, CowArray, Ix2};

use super::arrays::is_intact;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use super::records::TileTaskRecord;
use crate::formats::planar::Reader;
use crate::formats::{FormatError, Limits};
use crate::job::Sha256;
use crate::recon::solver::Outcome;
use crate::recon::tile::{Tile, TilePlan};

/// The stored frames \[B,h,w\] of a tile.
#[derive(Debug, Clone)]
pub struct StoredTile {
    pub tile: u32,
    pub path: PathBuf,
    pub sha256: Sha256,
    pub record: TileTaskRecord,
}

/// Refuses tiles of which one is missing, or whose bytes are not those that were stored.
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
            damaged.push(tile.tile);
        }
    }
    if damaged.is_empty() { Ok(()) } else { Err(PipelineError::Damaged(damaged)) }
}

/// Frame `k` \[H,W\], of which each stored tile's part is read when it is needed.
pub fn stored_frame(
    plan: &TilePlan,
    tiles: &[StoredTile],
    k: usize,
) -> Result<Array2<f32>, FormatError> {
    blended(plan, |tile| {
        // Opened anew for each frame: a large picture has more tiles than a process may have files.
        let reader = Reader::open(&tiles[tile.index].path, &Limits::default())?;
        let window = reader.read_window(k..k + 1, 0..tile.height, 0..tile.width)?;
        Ok(window.index_axis_move(Axis(0), 0).into())
    })
}

/// Frame `k` \[H,W\] of tiles in memory.
pub fn frame(plan: &TilePlan, tiles: &[Outcome], k: usize) -> Array2<f32> {
    let part =
        |tile: &Tile| -> ArrayView2<'_, f32> { tiles[tile.index].frames.index_axis(Axis(0), k) };
    let Ok(frame) = blended(plan, |tile| Ok::<_, std::convert::Infallible>(part(tile).into()));
    frame
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
