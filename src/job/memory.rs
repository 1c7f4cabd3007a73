//! How much memory a worker needs for a job: planned when the job is asked for, not hoped for.

use super::schedule::{MethodSpec, PriorSpec};
use super::{JobModel, JobSpec};
use crate::recon::preview;

/// The program, its thread stacks and, with the deep denoiser, ONNX Runtime and the network.
const BASE_BYTES: u64 = 128 << 20;
/// Arrays of the solver for each voxel of a tile (measured: 16 bytes).
const SOLVER_BYTES_PER_VOXEL: u64 = 24;
/// The solver's start of a projection, with momentum or ADMM; and ADMM's multiplier.
const START_BYTES_PER_VOXEL: u64 = 4;
/// Clips and groups of the nonlocal prior for each voxel of a tile: four clips with margins, and 40
/// indices for each 16 pixels.
const NONLOCAL_BYTES_PER_VOXEL: u64 = 30;
/// Arrays around the denoiser for each voxel of a tile: padded input, middle and output.
const DENOISER_BYTES_PER_VOXEL: u64 = 24;
/// Activations of the network for each pixel of the frames that it takes at once (measured).
const NETWORK_BYTES_PER_PIXEL: u64 = 2600;
/// The same for its twin of 8 bits, which stays loaded beside it (measured).
const INT8_BYTES_PER_PIXEL: u64 = 2000;
/// Pixels that the network takes at once, or one frame of the tile if that is larger.
const NETWORK_PIXELS: u64 = 1 << 17;

impl JobSpec {
    /// The planned cost of a tile in CPU-nanoseconds per voxel: of the schedule, or of a network as
    /// its trial took it.
    #[must_use]
    #[allow(clippy::cast_precision_loss)] // counts far below 2^53
    pub fn planned_ns_per_voxel(&self) -> f64 {
        match &self.model {
            None => self.schedule.planned_ns_per_voxel(),
            Some(JobModel { trial, .. }) => {
                let voxels = (trial.pixels() * self.shape.frames).max(1);
                trial.cpu_seconds * 1e9 / voxels as f64
            }
        }
    }

    /// An upper bound of the resident memory, in bytes, of a worker that does any task of this job.
    #[must_use]
    pub fn worker_bytes(&self) -> u64 {
        // A preview by blocks takes far less than a tile.
        let voxels = self.shape.height * self.shape.width * self.shape.frames;
        let whole = if voxels <= preview::WHOLE { voxels as u64 } else { 0 };
        self.tile_bytes().max(BASE_BYTES + whole * SOLVER_BYTES_PER_VOXEL)
    }

    fn tile_bytes(&self) -> u64 {
        let side = |length: usize| length.min(self.tile.size) as u64;
        let pixels = side(self.shape.height) * side(self.shape.width);
        let voxels = pixels * self.shape.frames as u64;
        if let Some(model) = &self.model {
            // What the trial took grows with the picture at most.
            let trial = (model.trial.pixels() as u64).max(1);
            let network = model.trial.peak_rss_bytes.saturating_mul(pixels.div_ceil(trial).max(1));
            return BASE_BYTES + voxels * SOLVER_BYTES_PER_VOXEL + network;
        }
        let mut per_voxel = SOLVER_BYTES_PER_VOXEL;
        if self.schedule.method == MethodSpec::Admm {
            per_voxel += START_BYTES_PER_VOXEL;
        }
        if self.schedule.stages.iter().any(|stage| stage.momentum > 0.0) {
            per_voxel += START_BYTES_PER_VOXEL;
        }
        if self.schedule.stages.iter().any(|stage| stage.prior == PriorSpec::Nonlocal) {
            per_voxel += NONLOCAL_BYTES_PER_VOXEL;
        }
        let solver = BASE_BYTES + voxels * per_voxel;
        if !self.schedule.needs_network() {
            return solver;
        }
        let mut per_pixel = NETWORK_BYTES_PER_PIXEL;
        if self.schedule.stages.iter().any(|stage| stage.prior == PriorSpec::FastDvdNetInt8) {
            per_pixel += INT8_BYTES_PER_PIXEL;
        }
        let network = per_pixel * pixels.max(NETWORK_PIXELS);
        solver + voxels * DENOISER_BYTES_PER_VOXEL + network
    }
}

#[cfg(test)]
mod tests {
    use super::{BASE_BYTES, SOLVER_BYTES_PER_VOXEL};
    use crate::job::{
        Algorithm, CalibrationId, JobSpec, MeasurementId, SceneShape, SnapshotRange, TileSpec,
    };

    fn megabytes(algorithm: Algorithm, side: usize, frames: usize) -> u64 {
        spec(algorithm, side, frames).worker_bytes() >> 20
    }

    fn spec(algorithm: Algorithm, side: usize, frames: usize) -> JobSpec {
        JobSpec {
            calibration: CalibrationId::new(),
            measurement: MeasurementId::new(),
            shape: SceneShape { frames, height: side, width: side, snapshots: 1 },
            snapshots: SnapshotRange { first: 0, count: 1 },
            algorithm,
            model: None,
            schedule: algorithm.default_schedule(),
            tile: TileSpec { size: side, overlap: 0 },
            priority: 0,
            label: None,
            warnings: Vec::new(),
        }
    }

    #[test]
    fn a_preview_of_the_whole_picture_may_need_more_than_a_tile() {
        let small_tiles = TileSpec { size: 64, overlap: 8 };
        let small = JobSpec { tile: small_tiles, ..spec(Algorithm::GapTv, 900, 10) };
        let voxels = 900 * 900 * 10;
        assert_eq!(small.worker_bytes(), BASE_BYTES + voxels * SOLVER_BYTES_PER_VOXEL);
        let large = JobSpec { tile: small_tiles, ..spec(Algorithm::GapTv, 1000, 10) };
        assert!(large.worker_bytes() < small.worker_bytes(), "previews by blocks are small");
    }

    #[test]
    fn the_bound_holds_for_what_was_measured_and_is_near_it() {
        use Algorithm::{GapTv, PnpTvFastDvdNet};
        for (algorithm, side, frames, measured) in [
            (GapTv, 1024, 20, 368),
            (GapTv, 1024, 40, 688),
            (PnpTvFastDvdNet, 256, 10, 620),
            (PnpTvFastDvdNet, 256, 40, 761),
            (PnpTvFastDvdNet, 320, 10, 463),
            (PnpTvFastDvdNet, 512, 10, 1345),
            (PnpTvFastDvdNet, 768, 10, 2891),
        ] {
            let bound = megabytes(algorithm, side, frames);
            assert!(bound >= measured, "{side}x{side}x{frames}: {bound} < {measured}");
            assert!(bound < measured * 2, "{side}x{side}x{frames}: {bound} for {measured}");
        }
    }
}
