//! How much memory a worker needs for a job: planned when the job is asked for, not hoped for.

use super::{JobModel, JobSpec};
use reconstruction::preview;
use reconstruction::priors::WorkingSet;
use reconstruction::priors::nonlocal::NonlocalSpec;
use reconstruction::schedule::Method;

/// The program, its thread stacks and, with the deep denoiser, ONNX Runtime and the network.
const BASE_BYTES: u64 = 128 << 20;
/// Arrays of the solver for each voxel of a tile (measured: 16 bytes; 4 more hold the frames after its first stage).
const SOLVER_BYTES_PER_VOXEL: u64 = 24;
/// The solver's start of a projection, with momentum or ADMM; and ADMM's multiplier.
const START_BYTES_PER_VOXEL: u64 = 4;
/// Where a stage may be run twice: what it starts from, or the frames of its first run. In schedules with a network
/// the bound has that already: a network's arrays are gone by then (320x320, Cr 10: 318 MiB, and 316 with one run).
const TWICE_BYTES_PER_VOXEL: u64 = 8;
/// Pixels that the network takes at once, or one frame of the tile if that is larger.
const NETWORK_PIXELS: u64 = 1 << 17;

/// Previews of the four sub-images of a mosaic, for each voxel of one.
const COARSE_BYTES_PER_VOXEL: u64 = 16;
/// A frame of a mosaic as it is assembled: twice, its three colours, and those of its PNG.
const COLOUR_BYTES_PER_PIXEL: u64 = 40;
/// The encoder of a movie, for each sample of a frame of it, with the frames of a group; and the rows that are
/// read at a time.
const MOVIE_BYTES_PER_SAMPLE: u64 = 128;
const MOVIE_BYTES: u64 = 48 << 20;

impl JobSpec {
    /// The planned cost of a tile in CPU-nanoseconds per voxel: of the schedule, or of a network as
    /// its trial took it.
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
    pub fn worker_bytes(&self) -> u64 {
        // A preview by blocks takes far less than a tile.
        let (height, width) = self.shape.solved();
        let voxels = height * width * self.shape.frames;
        let whole = if voxels <= preview::WHOLE { voxels as u64 } else { 0 };
        let preview = whole * (SOLVER_BYTES_PER_VOXEL + self.mosaic(COARSE_BYTES_PER_VOXEL));
        let pixels = (self.shape.height * self.shape.width) as u64;
        let colours = pixels * self.mosaic(COLOUR_BYTES_PER_PIXEL);
        let movie = MOVIE_BYTES + self.movie_samples() * MOVIE_BYTES_PER_SAMPLE;
        self.tile_bytes().max(BASE_BYTES + preview.max(colours).max(movie))
    }

    /// What a mosaic alone takes.
    fn mosaic(&self, bytes: u64) -> u64 {
        if self.shape.mosaic.is_some() { bytes } else { 0 }
    }

    fn tile_bytes(&self) -> u64 {
        let side = |length: usize| length.min(self.tile.size) as u64;
        let (height, width) = self.shape.solved();
        let pixels = side(height) * side(width);
        let run = self.run.length.min(self.snapshots.count);
        let voxels = pixels * self.shape.frames as u64 * u64::from(run);
        if let Some(model) = &self.model {
            // What the trial took grows with the picture at most.
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
        let twice =
            self.schedule.stages.iter().any(|stage| stage.prior.nonlocal().is_some_and(shrinks));
        if twice && !self.schedule.needs_network() {
            per_voxel += TWICE_BYTES_PER_VOXEL;
        }
        // A prior's arrays go with its stage, but networks stay loaded.
        let most = |with_network: bool| {
            let priors = self.schedule.stages.iter().map(|stage| &stage.prior);
            let needs = priors.filter(|prior| prior.network().is_some() == with_network);
            needs.map(|prior| prior.working_set()).fold(WorkingSet::default(), WorkingSet::max)
        };
        let (plain, network) = (most(false), most(true));
        per_voxel += plain.per_voxel + network.per_voxel;
        BASE_BYTES + voxels * per_voxel + network.per_network_pixel * pixels.max(NETWORK_PIXELS)
    }
}

#[cfg(test)]
mod tests {
    use super::{BASE_BYTES, SOLVER_BYTES_PER_VOXEL};
    use crate::job::{
        Algorithm, CalibrationId, Cut, JobSpec, MeasurementId, RunSpec, SceneShape, Sequence,
        SnapshotRange, TileSpec,
    };

    fn megabytes(algorithm: Algorithm, side: usize, frames: usize) -> u64 {
        spec(algorithm, side, frames).worker_bytes() >> 20
    }

    fn spec(algorithm: Algorithm, side: usize, frames: usize) -> JobSpec {
        JobSpec {
            calibration: CalibrationId::new(),
            measurement: MeasurementId::new(),
            shape: SceneShape { frames, height: side, width: side, snapshots: 1, mosaic: None },
            snapshots: SnapshotRange { first: 0, count: 1 },
            sequence: Sequence::Separate,
            run: RunSpec::ALONE,
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
    fn a_sequence_takes_no_more_than_a_long_snapshot() {
        for algorithm in [Algorithm::GapTv, Algorithm::GapTv3d, Algorithm::PnpTvFastdvdnet] {
            let large = |frames, snapshots: u32| {
                let tile = (algorithm.default_tile(), false);
                let schedule = algorithm.default_schedule();
                let sequence = (Sequence::Contiguous, snapshots);
                let cut = Cut::new(sequence, &schedule, tile, (frames, 3200, 3200)).unwrap();
                let spec = spec(algorithm, 3200, frames);
                let snapshots = SnapshotRange { first: 0, count: snapshots };
                JobSpec { snapshots, tile: cut.tile, run: cut.run, ..spec }
            };
            let (sequence, single) = (large(10, 10), large(30, 1));
            let (needed, today) = (sequence.worker_bytes() >> 20, single.worker_bytes() >> 20);
            assert!(needed <= today, "{algorithm:?}: {needed} MiB, {today} MiB at Cr 30");
        }
    }

    #[test]
    fn the_bound_holds_for_what_was_measured_and_is_near_it() {
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
