//! One row: a clip measured through masks, and reconstructed.

use std::thread;
use std::time::Instant;

use ndarray::{Array2, Array3, ArrayView, Axis, Dimension, s};
use sha2::{Digest, Sha256};

use super::record::{Key, Row, Setting, ZoneRecord};
use super::zones::Zones;
use crate::cli::CliError;
use crate::cli::bench::clips::Clip;
use crate::cli::learned::{Learned, plan};
use crate::cli::masks::MaskArguments;
use crate::job::{Algorithm, TileSpec};
use crate::optics::{illumination, measure, noisy};
use crate::pipeline::manifest::{ModelRecord, Summary, TileRecord};
use crate::pipeline::{
    NetworkSource, SnapshotInput, Solver, TileOutcome, Usage, blended_frame, solve,
};
use crate::recon::metrics;
use crate::recon::scale::ScaleEstimator;
use crate::recon::tile::TilePlan;

/// Makes rows.
pub(super) struct Bench {
    network: NetworkSource,
    /// The network of `learned`.
    learned: Option<Learned>,
    setting: Setting,
}

/// Masks of one compression ratio and scale.
pub(super) struct Masks {
    /// \[B,H,W\] on \[0,1\].
    masks: Array3<f32>,
    /// What reaches the sensor of an even light \[H,W\].
    light: Array2<f32>,
}

/// A clip behind masks.
pub(super) struct Snapshot<'a> {
    clip: &'a str,
    masks: &'a Array3<f32>,
    /// \[H,W\].
    measurement: Array2<f32>,
    /// \[B,H,W\].
    truth: Array3<f32>,
    sha256: String,
}

impl Bench {
    /// With networks from `network`, and one of the user's own.
    pub(super) fn new(network: NetworkSource, learned: Option<Learned>, setting: Setting) -> Self {
        Self { network, learned, setting }
    }

    /// Why `algorithm` can't be run with so many frames of `side` x `side` pixels; none if it can.
    pub(super) fn obstacle(
        &self,
        algorithm: Algorithm,
        frames: usize,
        side: usize,
    ) -> Option<CliError> {
        let learned = self.learned.as_ref().filter(|_| algorithm == Algorithm::Learned)?;
        learned.size((frames, side, side)).err()
    }

    /// The masks of `frames` frames of `side` x `side` pixels.
    pub(super) fn masks(
        &self,
        arguments: &MaskArguments,
        frames: usize,
        side: usize,
    ) -> Result<Masks, CliError> {
        let optics = arguments.optics()?;
        let light = illumination((side, side), optics.vignetting())?;
        let made = arguments.make(&optics, (frames, side, side), self.setting.seed)?;
        Ok(Masks { masks: made.masks, light })
    }

    /// Measures the first frames of a clip, of which the middle is taken.
    pub(super) fn snapshot<'a>(
        &self,
        Masks { masks, light }: &'a Masks,
        clip: &'a Clip,
    ) -> Result<Snapshot<'a>, CliError> {
        let (frames, height, width) = masks.dim();
        let (_, rows, columns) = clip.frames.dim();
        let (top, left) = ((rows - height) / 2, (columns - width) / 2);
        let window = s![..frames, top..top + height, left..left + width];
        let truth = &clip.frames.slice(window) * light;
        let clean = measure(masks.view(), truth.view())?;
        let measurement = noisy(clean, self.setting.noise_sigma / 255.0, self.setting.seed)?;
        let mut hash = Sha256::new();
        feed(&mut hash, masks.view());
        feed(&mut hash, measurement.view());
        feed(&mut hash, truth.view());
        let sha256 = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Snapshot { clip: &clip.name, masks, measurement, truth, sha256 })
    }

    /// All that the row of this algorithm depends on.
    ///
    /// # Errors
    /// A network that does not take the snapshot.
    pub(super) fn key(
        &self,
        snapshot: &Snapshot<'_>,
        algorithm: Algorithm,
    ) -> Result<Key, CliError> {
        let (compression_ratio, scale, _) = snapshot.masks.dim();
        let schedule = algorithm.default_schedule();
        let learned = self.learned.as_ref().filter(|_| algorithm == Algorithm::Learned);
        let plan = plan(algorithm, (None, None), learned, snapshot.masks.dim())?;
        let deep = learned.is_some() || schedule.needs_network();
        let mut models = ModelRecord::of(&schedule);
        models.extend(learned.map(Learned::record));
        Ok(Key {
            program_version: env!("CARGO_PKG_VERSION").into(),
            clip: snapshot.clip.into(),
            algorithm,
            scale,
            compression_ratio,
            setting: self.setting.clone(),
            inputs_sha256: snapshot.sha256.clone(),
            tile: TileSpec { size: plan.size(), overlap: plan.overlap() },
            models,
            provider: deep.then(|| self.network.provider().into()),
            schedule,
        })
    }

    /// Reconstructs the snapshot as `key` says.
    pub(super) fn run(&self, snapshot: &Snapshot<'_>, key: Key) -> Result<Row, CliError> {
        let Snapshot { masks, measurement, .. } = snapshot;
        let plan = TilePlan::new(key.scale, key.scale, key.tile.size, key.tile.overlap)?;
        let mut estimator = ScaleEstimator::new(key.scale, key.scale);
        masks.outer_iter().try_for_each(|mask| estimator.add_mask(mask))?;
        let white = estimator
            .white(measurement.view())
            .map_err(|error| CliError::Input(format!("clip {}: {error}", snapshot.clip)))?;
        let solver = match &self.learned {
            Some(learned) if key.algorithm == Algorithm::Learned => Solver::Network(&learned.file),
            _ => Solver::Schedule(&key.schedule),
        };
        let input = SnapshotInput {
            snapshot: 0,
            masks: masks.view(),
            measurement: measurement.view(),
            white,
            solver,
            plan: &plan,
        };
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let (started, before) = (Instant::now(), Usage::now());
        let tiles = solve(&input, &self.network, cores, &())?.tiles;
        let cpu_seconds = (Usage::now() - before).cpu_seconds;
        let seconds = started.elapsed().as_secs_f64();
        let quality = Quality::of(&plan, &tiles, &snapshot.truth)?;
        let summary = Summary::of(&tiles.iter().map(TileRecord::from).collect::<Vec<_>>());
        Ok(Row {
            key,
            psnr_db: mean(&quality.by_frame),
            ssim: quality.ssim,
            psnr_db_by_frame: quality.by_frame,
            psnr_db_by_zone: quality.by_zone,
            cpu_seconds,
            seconds,
            denoiser_passes: summary.denoiser_passes,
            white,
            stop_reason: summary.stop_reason,
        })
    }
}

struct Quality {
    by_frame: Vec<Option<f64>>,
    by_zone: Vec<ZoneRecord>,
    ssim: f64,
}

impl Quality {
    /// Frame by frame, so that memory holds one blended frame.
    fn of(plan: &TilePlan, tiles: &[TileOutcome], truth: &Array3<f32>) -> Result<Self, CliError> {
        let (frames, height, width) = truth.dim();
        let zones = Zones::new(height, width);
        let (mut by_frame, mut ssim) = (Vec::with_capacity(frames), 0.0);
        let mut by_zone = zones.radii().map(|_| Vec::with_capacity(frames));
        for (k, truth) in truth.axis_chunks_iter(Axis(0), 1).enumerate() {
            let frame = blended_frame(plan, tiles, k);
            let stack = frame.view().insert_axis(Axis(0));
            by_frame.push(finite(metrics::psnr(stack, truth)?));
            ssim += metrics::ssim(stack, truth)?;
            let errors = zones.errors(frame.view(), truth.index_axis(Axis(0), 0));
            for (values, error) in by_zone.iter_mut().zip(errors) {
                values.push(finite(-10.0 * error.log10()));
            }
        }
        let record = |(outer_radius, values): (_, Vec<_>)| ZoneRecord {
            outer_radius,
            psnr_db: mean(&values),
        };
        let by_zone = zones.radii().into_iter().zip(by_zone).map(record).collect();
        Ok(Self { by_frame, by_zone, ssim: ssim / frames as f64 })
    }
}

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// None if one of the values is none, or there are none.
pub(super) fn mean(values: &[Option<f64>]) -> Option<f64> {
    let sum = values.iter().copied().sum::<Option<f64>>()?;
    finite(sum / values.len() as f64)
}

fn feed<D: Dimension>(hash: &mut Sha256, values: ArrayView<'_, f32, D>) {
    values.iter().for_each(|value| hash.update(value.to_le_bytes()));
}
