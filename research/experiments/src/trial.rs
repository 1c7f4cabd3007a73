//! The computation of a row: measurement of a clip through masks, and reconstruction.

use std::thread;
use std::time::Instant;

use engine::job::{Algorithm, RunSpec, Sequence};
use engine::pipeline::networks::NetworkSource;
use engine::pipeline::quality::FrameQuality;
use engine::pipeline::records::{PilotRecord, TileRecord};
use engine::pipeline::scale::white;
use engine::pipeline::sequence::{SequenceInput, Solved, Solver, solve};
use engine::pipeline::usage::cpu_seconds;
use formats::Channels;
use ndarray::{Array2, Array3, ArrayView, ArrayView2, Axis, Dimension, s};
use optics::{illumination, measure, noisy};
use reconstruction::sequence::SequencePlan;
use reconstruction::solver::Outcome;
use reconstruction::tile::TilePlan;
use sci_recon::cli::{CliError, MaskArguments, Model, cut};
use sha2::{Digest, Sha256};

use super::clips::Clip;
use super::markdown::mean;
use super::record::{Key, Row, Setting, ZoneRecord};

pub fn solve_on_all_cores(
    input: &SequenceInput<'_>,
    network: &NetworkSource,
) -> Result<Solved, CliError> {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    Ok(solve(input, network, cores, &|_, _| ())?)
}

/// Mode of joint reconstruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Choice {
    /// The default of a job with this kind of sequence.
    Default(Sequence),
    Runs(RunSpec),
}

/// Computes rows.
pub struct Bench {
    network: NetworkSource,
    learned: Option<Model>,
    setting: Setting,
}

/// Masks of one compression ratio and scale.
pub struct Masks {
    /// \[B,H,W\] on \[0,1\].
    masks: Array3<f32>,
    /// Response of the sensor to uniform light \[H,W\].
    light: Array2<f32>,
}

/// A clip, measured.
pub struct Measured<'a> {
    clip: &'a str,
    masks: &'a Array3<f32>,
    /// \[S,H,W\].
    measurement: Array3<f32>,
    /// \[S B,H,W\].
    truth: Array3<f32>,
    sha256: String,
}

/// A tile with its evidence for the quality model.
pub struct FirstTile {
    pub outcome: Outcome,
    pub white: f32,
    pub pilot: Option<PilotRecord>,
}

impl<'a> Measured<'a> {
    /// The true frames \[S B,H,W\] on \[0,1\].
    pub fn truth(&self) -> &Array3<f32> {
        &self.truth
    }

    fn white(&self) -> Result<f32, CliError> {
        white(self.masks.sum_axis(Axis(0)), self.measurement.view())
            .map_err(|error| CliError::Input(format!("clip {}: {error}", self.clip)))
    }

    fn input<'b>(
        &'b self,
        (plan, runs): (&'b TilePlan, &'b SequencePlan),
        solver: Solver<'b>,
        white: f32,
    ) -> SequenceInput<'b> {
        let (masks, measurement) = (self.masks.view(), self.measurement.view());
        SequenceInput { masks, measurement, first: 0, white, solver, plan, runs, mosaic: None }
    }
}

impl Bench {
    /// `network` loads the built-in networks; `learned` is the user's network.
    pub fn new(network: NetworkSource, learned: Option<Model>, setting: Setting) -> Self {
        Self { network, learned, setting }
    }

    /// Reason for which an algorithm cannot run with these frames of `side` x `side` pixels; none
    /// if it can.
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

    /// Measures the first frames of a clip, cropped at the centre, as consecutive snapshots.
    pub fn measure<'a>(
        &self,
        Masks { masks, light }: &'a Masks,
        clip: &'a Clip,
        snapshots: usize,
    ) -> Result<Measured<'a>, CliError> {
        let (frames, height, width) = masks.dim();
        let (_, rows, columns) = clip.frames.dim();
        let (top, left) = ((rows - height) / 2, (columns - width) / 2);
        let window = s![..snapshots * frames, top..top + height, left..left + width];
        let truth = &clip.frames.slice(window) * light;
        let mut measurement = Array3::zeros((snapshots, height, width));
        let blocks = truth.axis_chunks_iter(Axis(0), frames);
        for ((seed, block), mut y) in
            (self.setting.seed..).zip(blocks).zip(measurement.outer_iter_mut())
        {
            let clean = measure(masks.view(), block)?;
            y.assign(&noisy(clean, self.setting.noise_sigma / 255.0, seed)?);
        }
        let mut hash = Sha256::new();
        feed(&mut hash, masks.view());
        feed(&mut hash, measurement.view());
        feed(&mut hash, truth.view());
        let sha256 = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Measured { clip: &clip.name, masks, measurement, truth, sha256 })
    }

    /// Everything that the row of this algorithm depends on, with this mode of joint
    /// reconstruction.
    pub fn key(
        &self,
        measured: &Measured<'_>,
        algorithm: Algorithm,
        sequence: Choice,
    ) -> Result<Key, CliError> {
        let (compression_ratio, scale, _) = measured.masks.dim();
        let schedule = self.network.suited(algorithm.default_schedule());
        let learned = self.learned.as_ref().filter(|_| algorithm == Algorithm::Learned);
        let snapshots = measured.measurement.dim().0;
        let kind = match sequence {
            Choice::Default(kind) => kind,
            Choice::Runs(_) => Sequence::Separate,
        };
        let count = (kind, snapshots as u32);
        let mut cut = cut(algorithm, &schedule, None, None, learned, count, measured.masks.dim())?;
        if let Choice::Runs(run) = sequence {
            cut.run = run;
        }
        let deep = learned.is_some() || schedule.needs_network();
        let mut models = self.network.records(&schedule);
        models.extend(learned.map(Model::record));
        Ok(Key {
            program_version: env!("CARGO_PKG_VERSION").into(),
            clip: measured.clip.into(),
            snapshots,
            run: cut.run,
            algorithm,
            scale,
            compression_ratio,
            setting: self.setting.clone(),
            inputs_sha256: measured.sha256.clone(),
            tile: cut.tile,
            models,
            provider: deep.then(|| self.network.provider(&schedule).into()),
            schedule,
        })
    }

    /// Reconstructs the first tile of a clip with the settings of `key`, and returns the features
    /// of the quality model.
    pub fn first_tile(&self, measured: &Measured<'_>, key: &Key) -> Result<FirstTile, CliError> {
        let plan = TilePlan::new(key.scale, key.scale, key.tile.size, key.tile.overlap)?;
        let runs = key.run.plan(0..key.snapshots)?;
        let white = measured.white()?;
        let input = measured.input((&plan, &runs), Solver::Schedule(&key.schedule), white);
        let mut solved = solve_on_all_cores(&input, &self.network)?;
        let outcome = solved.runs.swap_remove(0).swap_remove(0);
        Ok(FirstTile { outcome, white, pilot: solved.pilot })
    }

    /// Reconstructs the clip with the settings of `key`.
    pub fn run(&self, measured: &Measured<'_>, key: Key) -> Result<Row, CliError> {
        let masks = measured.masks;
        let plan = TilePlan::new(key.scale, key.scale, key.tile.size, key.tile.overlap)?;
        let runs = key.run.plan(0..key.snapshots)?;
        let white = measured.white()?;
        let solver = match &self.learned {
            Some(learned) if key.algorithm == Algorithm::Learned => Solver::Network(&learned.file),
            _ => Solver::Schedule(&key.schedule),
        };
        let input = measured.input((&plan, &runs), solver, white);
        let (started, before) = (Instant::now(), cpu_seconds());
        let solved = solve_on_all_cores(&input, &self.network)?;
        let cpu_seconds = cpu_seconds() - before;
        let seconds = started.elapsed().as_secs_f64();
        let frames = masks.dim().0;
        let frame = |k| solved.frame(&input, k / frames, k % frames);
        let quality = Quality::of(&plan, frame, &measured.truth)?;
        let tiles = solved.runs.iter().flatten().map(TileRecord::from).collect::<Vec<_>>();
        let summary = TileRecord::summary(&tiles);
        let joints = solved.pilot.map(|pilot| pilot.joints).unwrap_or_default();
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
            joints,
        })
    }
}

struct Quality {
    by_frame: Vec<Option<f64>>,
    by_zone: Vec<ZoneRecord>,
    ssim: f64,
}

impl Quality {
    fn of(
        plan: &TilePlan,
        frame: impl Fn(usize) -> Array2<f32>,
        truth: &Array3<f32>,
    ) -> Result<Self, CliError> {
        let finite = |value: f64| value.is_finite().then_some(value);
        let (mut by_frame, mut ssim) = (Vec::new(), 0.0);
        let mut by_zone: [Vec<Option<f64>>; ZONES] = Default::default();
        for (k, truth) in truth.outer_iter().enumerate() {
            let frame = frame(k);
            let quality = FrameQuality::of(k, frame.view(), truth, Channels::Grey)?;
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
/// aperture are worst at the rim, where fewer sub-apertures reach, so a mean over the whole image
/// hides where an algorithm fails.
const ZONES: usize = 5;
const RINGS: f64 = (ZONES - 1) as f64;

/// Outer radius of each zone in pixels, from the centre; none for the corners.
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
    fn an_error_is_assigned_to_its_zone() {
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
