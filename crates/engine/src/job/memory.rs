//! The memory plan of a job: an upper bound of a worker's resident memory, checked at submission.

use super::{JobModel, JobSpec};
use reconstruction::preview;
use reconstruction::priors::WorkingSet;
use reconstruction::priors::nonlocal::NonlocalSpec;
use reconstruction::schedule::Method;

/// The program, its thread stacks and, for schedules with a network, ONNX Runtime and the weights.
const BASE_BYTES: u64 = 128 << 20;
/// Solver arrays per voxel of a tile. Measured: 16 bytes, and 4 more for the frames after the first stage.
const SOLVER_BYTES_PER_VOXEL: u64 = 24;
/// One further array per voxel: the extrapolated point with momentum, or the multiplier of ADMM.
const START_BYTES_PER_VOXEL: u64 = 4;
/// Arrays per voxel of a stage that may run twice: its initial frames, or those of the first run. Schedules with a
/// network need no extra memory for it, because the network's arrays are free by then (320x320, B = 10: 318 MiB with
/// two runs, 316 MiB with one).
const RERUN_BYTES_PER_VOXEL: u64 = 8;
/// Pixels in one batch of a network. A larger tile is one batch per frame.
const NETWORK_PIXELS: u64 = 1 << 17;

/// Previews of the four sub-images of a mosaic, per voxel of one sub-image.
const COARSE_BYTES_PER_VOXEL: u64 = 16;
/// A colour frame during assembly: two raw copies, three colours, and the colours of its PNG.
const COLOUR_BYTES_PER_PIXEL: u64 = 40;
/// The movie encoder with a group of frames, per sample of a frame.
const MOVIE_BYTES_PER_SAMPLE: u64 = 128;
/// The movie encoder and its input rows, independent of the size.
const MOVIE_BYTES: u64 = 48 << 20;

impl JobSpec {
    /// Planned cost of a tile in CPU nanoseconds per voxel, from the schedule or from the trial run of the model.
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

    /// Upper bound, in bytes, of the resident memory of a worker that performs any task of this job.
    pub fn worker_bytes(&self) -> u64 {
        // A preview by blocks takes much less than a tile.
        let (height, width) = self.shape.solved();
        let voxels = height * width * self.shape.frames;
        let whole_voxels = if voxels <= preview::WHOLE { voxels as u64 } else { 0 };
        let preview =
            whole_voxels * (SOLVER_BYTES_PER_VOXEL + self.if_mosaic(COARSE_BYTES_PER_VOXEL));
        let pixels = (self.shape.height * self.shape.width) as u64;
        let colours = pixels * self.if_mosaic(COLOUR_BYTES_PER_PIXEL);
        let movie = MOVIE_BYTES + self.movie_samples() * MOVIE_BYTES_PER_SAMPLE;
        self.tile_bytes().max(BASE_BYTES + preview.max(colours).max(movie))
    }

    /// The bytes for a mosaic, 0 for a grey sensor.
    fn if_mosaic(&self, bytes: u64) -> u64 {
        if self.shape.mosaic.is_some() { bytes } else { 0 }
    }

    fn tile_bytes(&self) -> u64 {
        let side = |length: usize| length.min(self.tile.size) as u64;
        let (height, width) = self.shape.solved();
        let pixels = side(height) * side(width);
        let run = self.run.length.min(self.snapshots.count);
        let voxels = pixels * self.shape.frames as u64 * u64::from(run);
        if let Some(model) = &self.model {
            // The memory of a network grows at most in proportion to the picture.
            let trial = (model.trial.pixels() as u64).max(1);
            let network = model.trial.peak_rss_bytes.saturating_mul(pixels.div_ceil(trial).max(1));
            return BASE_BYTES + voxels * SOLVER_BYTES_PER_VOXEL + network;
        }
        let mut per_voxel = SOLVER_BYTES_PER_VOXEL;
        if self.schedule.method == Method::Admm {
            per_voxel += START_BYTES_PER_VOXEL;
        }
        if self.schedule.stages.iter().any(|stage| stage.momentum > 0.0) {
            per_voxel += START_BYTES_PER_VOXEL;
        }
        let shrinks = |nonlocal: &NonlocalSpec| nonlocal.temporal_shrinkage > 0.0;
        let may_rerun =
            self.schedule.stages.iter().any(|stage| stage.prior.nonlocal().is_some_and(shrinks));
        if may_rerun && !self.schedule.needs_network() {
            per_voxel += RERUN_BYTES_PER_VOXEL;
        }
        // The arrays of a prior are freed after its stage, but networks stay loaded.
        let largest = |with_network: bool| {
            let priors = self.schedule.stages.iter().map(|stage| &stage.prior);
            let needs = priors.filter(|prior| prior.network().is_some() == with_network);
            needs.map(|prior| prior.working_set()).fold(WorkingSet::default(), WorkingSet::max)
        };
        let (plain, network) = (largest(false), largest(true));
        per_voxel += plain.per_voxel + network.per_voxel;
        BASE_BYTES + voxels * per_voxel + network.per_network_pixel * pixels.max(NETWORK_PIXELS)
    }
}

#[cfg(test)]
mod tests {
    use super::{BASE_BYTES, SOLVER_BYTES_PER_VOXEL};
    use crate::job::{
        Algorithm, CalibrationId, Cut, CutRequest, JobSpec, MeasurementId, RunSpec, SceneShape,
        Sequence, SnapshotRange, TileSpec,
    };

    fn megabytes(algorithm: Algorithm, side: usize, frames: usize) -> u64 {
        spec(algorithm, side, frames).worker_bytes() >> 20
    }

    fn spec(algorithm: Algorithm, side: usize, frames: usize) -> JobSpec {
        JobSpec {
            calibration: CalibrationId::new(),
            measurement: MeasurementId::new(),
            shape: SceneShape { frames, height: side, width: side, snapshots: 1, mosaic: None },
            dispersion: None,
            snapshots: SnapshotRange { first: 0, count: 1 },
            sequence: Sequence::Separate,
            run: RunSpec::ALONE,
            algorithm,
            model: None,
            networks: Vec::new(),
            schedule: algorithm.default_schedule(),
            tile: TileSpec { size: side, overlap: 0 },
            registration: crate::job::RegistrationRequest::Off,
            registered: None,
            priority: 0,
            truth: None,
            label: None,
            webhook: None,
            warnings: Vec::new(),
        }
    }

    #[test]
    fn whole_previews_may_need_more_memory_than_small_tiles() {
        let small_tiles = TileSpec { size: 64, overlap: 8 };
        let small = JobSpec { tile: small_tiles, ..spec(Algorithm::GapTv, 900, 10) };
        let voxels = 900 * 900 * 10;
        assert_eq!(small.worker_bytes(), BASE_BYTES + voxels * SOLVER_BYTES_PER_VOXEL);
        let large = JobSpec { tile: small_tiles, ..spec(Algorithm::GapTv, 1000, 10) };
        assert!(large.worker_bytes() < small.worker_bytes(), "previews by blocks take less memory");
    }

    #[test]
    fn sequences_take_no_more_memory_than_long_snapshots() {
        for algorithm in [Algorithm::GapTv, Algorithm::GapTv3d, Algorithm::PnpTvFastdvdnet] {
            let large = |frames, snapshots: u32| {
                let request = CutRequest {
                    sequence: Sequence::Contiguous,
                    snapshots,
                    size: (frames, 3200, 3200),
                    tile: algorithm.default_tile(),
                    tile_is_fixed: false,
                };
                let cut = Cut::new(request, &algorithm.default_schedule()).unwrap();
                let spec = spec(algorithm, 3200, frames);
                let snapshots = SnapshotRange { first: 0, count: snapshots };
                JobSpec { snapshots, tile: cut.tile, run: cut.run, ..spec }
            };
            let (sequence, single) = (large(10, 10), large(30, 1));
            let [sequence, single] = [sequence, single].map(|spec| spec.worker_bytes() >> 20);
            assert!(sequence <= single, "{algorithm:?}: {sequence} MiB, {single} MiB at B = 30");
        }
    }

    #[test]
    fn the_bound_is_between_one_and_two_times_the_measured_memory() {
        use Algorithm::{GapTv, PnpTvFastdvdnet};
        for (algorithm, side, frames, measured) in [
            (GapTv, 1024, 20, 368),
            (GapTv, 1024, 40, 688),
            (PnpTvFastdvdnet, 256, 10, 620),
            (PnpTvFastdvdnet, 256, 40, 761),
            (PnpTvFastdvdnet, 320, 10, 463),
            (PnpTvFastdvdnet, 512, 10, 1345),
            (PnpTvFastdvdnet, 768, 10, 2891),
        ] {
            let bound = megabytes(algorithm, side, frames);
            assert!(bound >= measured, "{side}x{side}x{frames}: {bound} < {measured}");
            assert!(bound < measured * 2, "{side}x{side}x{frames}: {bound} for {measured}");
        }
    }
}
