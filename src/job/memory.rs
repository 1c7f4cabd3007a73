//! How much memory a worker needs for a job: planned when the job is asked for, not hoped for.

use super::JobSpec;

/// The program, its thread stacks and, with the deep denoiser, ONNX Runtime and the network.
const BASE_BYTES: u64 = 128 << 20;
/// Arrays of the solver for each voxel of a tile (measured: 16 bytes).
const SOLVER_BYTES_PER_VOXEL: u64 = 24;
/// Arrays around the denoiser for each voxel of a tile: padded input, middle and output.
const DENOISER_BYTES_PER_VOXEL: u64 = 24;
/// Activations of the network for each pixel of the frames that it takes at once (measured).
const NETWORK_BYTES_PER_PIXEL: u64 = 2600;
/// Pixels that the network takes at once, or one frame of the tile if that is larger.
const NETWORK_PIXELS: u64 = 1 << 18;

impl JobSpec {
    /// An upper bound of the resident memory, in bytes, of a worker that does a tile of this job.
    #[must_use]
    pub fn worker_bytes(&self) -> u64 {
        let side = |length: usize| length.min(self.tile.size) as u64;
        let pixels = side(self.shape.height) * side(self.shape.width);
        let voxels = pixels * self.shape.frames as u64;
        let solver = BASE_BYTES + voxels * SOLVER_BYTES_PER_VOXEL;
        if !self.schedule.needs_denoiser() {
            return solver;
        }
        let network = NETWORK_BYTES_PER_PIXEL * pixels.max(NETWORK_PIXELS);
        solver + voxels * DENOISER_BYTES_PER_VOXEL + network
    }
}

#[cfg(test)]
mod tests {
    use crate::job::{
        Algorithm, CalibrationId, JobSpec, MeasurementId, SceneShape, SnapshotRange, TileSpec,
    };

    fn megabytes(algorithm: Algorithm, side: usize, frames: usize) -> u64 {
        let spec = JobSpec {
            calibration: CalibrationId::new(),
            measurement: MeasurementId::new(),
            shape: SceneShape { frames, height: side, width: side, snapshots: 1 },
            snapshots: SnapshotRange { first: 0, count: 1 },
            algorithm,
            schedule: algorithm.default_schedule(),
            tile: TileSpec { size: side, overlap: 0 },
            priority: 0,
            label: None,
            warnings: Vec::new(),
        };
        spec.worker_bytes() >> 20
    }

    #[test]
    fn the_bound_holds_for_what_was_measured_and_is_near_it() {
        use Algorithm::{GapTv, PnpTvFastDvdNet};
        for (algorithm, side, frames, measured) in [
            (GapTv, 1024, 20, 368),
            (GapTv, 1024, 40, 688),
            (PnpTvFastDvdNet, 256, 10, 799),
            (PnpTvFastDvdNet, 256, 40, 853),
            (PnpTvFastDvdNet, 512, 10, 864),
            (PnpTvFastDvdNet, 768, 10, 1832),
        ] {
            let bound = megabytes(algorithm, side, frames);
            assert!(bound >= measured, "{side}x{side}x{frames}: {bound} < {measured}");
            assert!(bound < measured * 2, "{side}x{side}x{frames}: {bound} for {measured}");
        }
    }
}
