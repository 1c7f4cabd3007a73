//! How much of the disk a job may need: reserved when it is accepted.

use super::JobSpec;

/// Bytes of a voxel in a stored tile: one 32-bit float.
const TILE_BYTES: u64 = 4;
/// Bytes of a voxel in the results: EXR frames and stack, NumPy (32 bit each) and PNG (16 bit). EXR
/// and PNG are compressed, but noise is not.
const RESULT_BYTES: u64 = 4 + 4 + 4 + 2;
/// Headers, manifests and rows, for each snapshot.
const SNAPSHOT_BYTES: u64 = 1 << 20;

impl JobSpec {
    /// An upper bound of the bytes that the job writes to the disk. Tiles are kept until it has
    /// succeeded, so both count.
    #[must_use]
    pub fn disk_bytes(&self) -> u64 {
        let frames = self.shape.frames as u64;
        let voxels = (self.shape.height * self.shape.width) as u64 * frames;
        let area = |plan: crate::recon::tile::TilePlan| {
            plan.tiles().map(|tile| (tile.height * tile.width) as u64).sum::<u64>()
        };
        // A spec is checked before it is stored: its tiles can be planned.
        let tiles = self.tile_plan().map_or(0, area) * frames;
        let snapshot = voxels * RESULT_BYTES + tiles * TILE_BYTES + SNAPSHOT_BYTES;
        u64::from(self.snapshots.count) * snapshot
    }
}
