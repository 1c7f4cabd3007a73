//! One row: a clip measured through masks, and reconstructed.

use std::thread;
use std::time::Instant;

use ndarray::{Array2, Array3, ArrayView, ArrayView2, Dimension, s};
use sci_recon::cli::{CliError, MaskArguments, Model, plan};
use sci_recon::job::{Algorithm, TileSpec};
use sci_recon::optics::{illumination, measure, noisy};
use sci_recon::pipeline::blend;
use sci_recon::pipeline::networks::{ModelRecord, NetworkSource};
use sci_recon::pipeline::quality::FrameQuality;
use sci_recon::pipeline::records::{Summary, TileRecord};
use sci_recon::pipeline::scale::white;
use sci_recon::pipeline::snapshot::{SnapshotInput, Solver, solve};
use sci_recon::pipeline::usage::cpu_seconds;
use sci_recon::recon::solver::Outcome;
use sci_recon::recon::tile::TilePlan;
use sha2::{Digest, Sha256};

use super::clips::Clip;
use super::markdown::mean;
use super::record::{Key, Row, Setting, ZoneRecord};

pub fn solve_on_all_cores(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
) -> Result<Vec<Outcome>, CliError> {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    Ok(solve(input, network, cores, &|_, _| ())?.tiles)
}

/// Makes rows.
pub struct Bench {
    network: NetworkSource,
    learned: Option<Model>,
    setting: Setting,
}

/// Masks of one compression ratio and scale.
pub struct Masks {
    /// \[B,H,W\] on \[0,1\].
    masks: Array3<f32>,
    /// What reaches the sensor of an even light \[H,W\].
    light: Array2<f32>,
}

pub struct Snapshot<'a> {
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
    pub fn new(network: NetworkSource, learned: Option<Model>, setting: Setting) -> Self {
        Self { network, learned, setting }
    }

    /// Why `algorithm` can't be run with so many frames of `side` x `side` pixels; none if it can.
    pub fn obstacle(&self, algorithm: Algorithm, frames: usize, side: usize) -> Option<CliError> {
        let learned = self.learned.as_ref().filter(|_| algorithm == Algorithm::Learned)?;
        learned.size((frames, side, side)).err()
    }

    /// The masks of `frames` frames of `side` x `side` pixels.
    pub fn masks(
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
    pub fn snapshot<'a>(
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
    pub fn key(&self, snapshot: &Snapshot<'_>, algorithm: Algorithm) -> Result<Key, CliError> {
        let (compression_ratio, scale, _) = snapshot.masks.dim();
        let schedule = algorithm.default_schedule();
        let learned = self.learned.as_ref().filter(|_| algorithm == Algorithm::Learned);
        let plan = plan(algorithm, (None, None), learned, snapshot.masks.dim())?;
        let deep = learned.is_some() || schedule.needs_network();
        let mut models = ModelRecord::of(&schedule);
        models.extend(learned.map(Model::record));
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
    pub fn run(&self, snapshot: &Snapshot<'_>, key: Key) -> Result<Row, CliError> {
        let Snapshot { masks, measurement, .. } = snapshot;
        let plan = TilePlan::new(key.scale, key.scale, key.tile.size, key.tile.overlap)?;
        let white = white(masks.view(), measurement.view())
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
        let (started, before) = (Instant::now(), cpu_seconds());
        let tiles = solve_on_all_cores(&input, &self.network)?;
        let cpu_seconds = cpu_seconds() - before;
        let seconds = started.elapsed().as_secs_f64();
        let quality = Quality::of(&plan, &tiles, &snapshot.truth)?;
        let summary = Summary::of(&tiles.iter().map(TileRecord::from).collect::<Vec<_>>());
        Ok(Row {
            key,
            psnr_db: mean(quality.by_frame.iter().copied()),
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
    fn of(plan: &TilePlan, tiles: &[Outcome], truth: &Array3<f32>) -> Result<Self, CliError> {
        let finite = |value: f64| value.is_finite().then_some(value);
        let (mut by_frame, mut ssim) = (Vec::new(), 0.0);
        let mut by_zone: [Vec<Option<f64>>; ZONES] = Default::default();
        for (k, truth) in truth.outer_iter().enumerate() {
            let frame = blend::frame(plan, tiles, k);
            let quality = FrameQuality::of(k, frame.view(), truth)?;
            by_frame.push(finite(quality.psnr));
            ssim += quality.ssim.unwrap_or_default();
            for (values, error) in by_zone.iter_mut().zip(errors_by_zone(frame.view(), truth)) {
                values.push(finite(-10.0 * error.log10()));
            }
        }
        let record = |(outer_radius, values): (_, Vec<_>)| {
            let psnr_db = mean(values.into_iter());
            ZoneRecord { outer_radius, psnr_db }
        };
        let by_zone = outer_radii(plan.dim()).into_iter().zip(by_zone).map(record).collect();
        let ssim = ssim / by_frame.len() as f64;
        Ok(Self { by_frame, by_zone, ssim })
    }
}

/// Rings from the centre to the edge, and the corners outside the largest circle. Masks of a hybrid
/// aperture are worst at the rim, where fewer sub-apertures reach, so a mean over the whole picture
/// hides where an algorithm fails.
const ZONES: usize = 5;
const RINGS: f64 = (ZONES - 1) as f64;

/// The outer radius of each zone in pixels, from the centre on; none for the corners.
fn outer_radii((height, width): (usize, usize)) -> [Option<f64>; ZONES] {
    let radius = height.min(width) as f64 / 2.0;
    std::array::from_fn(|zone| (zone + 1 < ZONES).then(|| radius * (zone + 1) as f64 / RINGS))
}

/// Mean squared error of a frame \[H,W\] in each zone; NaN for a zone without pixels.
fn errors_by_zone(frame: ArrayView2<'_, f32>, truth: ArrayView2<'_, f32>) -> [f64; ZONES] {
    let (height, width) = frame.dim();
    let middle = |length: usize| (length as f64 - 1.0) / 2.0;
    let radius = height.min(width) as f64 / 2.0;
    let (mut sums, mut counts) = ([0.0; ZONES], [0usize; ZONES]);
    for (((row, column), &value), &true_value) in frame.indexed_iter().zip(truth) {
        let distance = (row as f64 - middle(height)).hypot(column as f64 - middle(width)) / radius;
        let zone = ((distance * RINGS) as usize).min(ZONES - 1);
        sums[zone] += (f64::from(value) - f64::from(true_value)).powi(2);
        counts[zone] += 1;
    }
    std::array::from_fn(|zone| sums[zone] / counts[zone] as f64)
}

fn feed<D: Dimension>(hash: &mut Sha256, values: ArrayView<'_, f32, D>) {
    values.iter().for_each(|value| hash.update(value.to_le_bytes()));
}

#[cfg(test)]
mod tests {
    use super::{errors_by_zone, outer_radii};
    use ndarray::Array2;

    #[test]
    fn an_error_shows_in_its_own_zone() {
        let radii = [Some(8.0), Some(16.0), Some(24.0), Some(32.0), None];
        assert_eq!(outer_radii((64, 64)), radii);
        let truth = Array2::<f32>::zeros((64, 64));
        // (row, column) of a pixel at a known distance from the centre, and its zone.
        for (place, zone) in
            [((32, 32), 0), ((32, 45), 1), ((52, 32), 2), ((1, 32), 3), ((0, 0), 4)]
        {
            let mut frame = truth.clone();
            frame[place] = 1.0;
            let errors = errors_by_zone(frame.view(), truth.view());
            let hit: Vec<usize> = (0..5).filter(|&zone| errors[zone] > 0.0).collect();
            assert_eq!(hit, [zone], "{place:?}");
        }
        let ones = Array2::<f32>::ones((64, 64));
        assert_eq!(errors_by_zone(ones.view(), truth.view()), [1.0; 5]);
    }
}
