//! The sizes of a scene and its parts.

use serde::{Deserialize, Serialize};

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

/// How pictures are cut: side and overlap in pixels (see [`crate::recon::tile::TilePlan::new`]).
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

/// The sizes of a measurement and its calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneShape {
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub snapshots: u32,
}
