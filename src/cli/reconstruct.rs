//! `sci-recon reconstruct`: one snapshot, without a server.

mod report;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Instant;

use clap::Args;
use ndarray::{Array2, Array3, s};

use super::CliError;
use super::arguments::{NetworkArguments, ScheduleArguments};
use super::learned::{Learned, plan};
use super::progress::SnapshotBar;
use crate::formats::mat::SceneArray;
use crate::intake::{Scaled, Source, read_masks, read_snapshot, read_truth};
use crate::job::{Algorithm, Schedule, Timestamp};
use crate::pipeline::manifest::{
    Content, Inputs, Manifest, ModelRecord, RunRecord, SCHEMA, ScaleRecord, Summary, TileRecord,
    frame_attributes, full_schedule,
};
use crate::pipeline::pilot::PilotRecord;
use crate::pipeline::{
    NetworkSource, ResultSpec, SnapshotInput, Solved, Solver, TileOutcome, Usage, blended_frame,
    check_output, peak_rss_bytes, replace_result, sha256_of, solve, write_result,
};
use crate::recon::metrics;
use crate::recon::scale::ScaleEstimator;
use crate::recon::tile::TilePlan;
use report::Report;

/// Reconstruct the frames of one snapshot from files, without a server.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Masks, one frame each: npy, TIFF, PNG, or a .mat scene's `mask`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    masks: Option<PathBuf>,
    /// Measurement, one frame a snapshot: npy, TIFF, PNG, or a .mat scene's `meas`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    measurement: Option<PathBuf>,
    /// True frames, to be compared with: those of the snapshot, or of all snapshots.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// A .mat scene (level 5) with `mask`, `meas` and perhaps `orig`, instead of the three files.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["masks", "measurement", "truth"])]
    scene: Option<PathBuf>,
    /// The snapshot, counted from 0.
    #[arg(long, value_name = "N", default_value_t = 0)]
    snapshot: usize,
    /// Value in the masks' file that means 1 (fully open) [default: 255 for uint8, 65535 for
    /// uint16, 1 for floats and .mat scenes].
    #[arg(long, value_name = "VALUE")]
    masks_full_scale: Option<f32>,
    /// Value in the measurement's file that means 1 [default: 255 for uint8 and .mat scenes,
    /// 65535 for uint16, 1 for floats].
    #[arg(long, value_name = "VALUE")]
    measurement_full_scale: Option<f32>,
    /// Value in the truth's file that means 1 [default: as for the measurement].
    #[arg(long, value_name = "VALUE")]
    truth_full_scale: Option<f32>,
    #[command(flatten)]
    schedule: ScheduleArguments,
    /// The network of --algorithm learned: an ONNX file with inputs `measurement [1,1,H,W]` and
    /// `masks [1,B,H,W]` and output `frames [1,B,H,W]`, all float32. The measurement is sum C x with
    /// frames x from 0 to 1.
    #[arg(long, value_name = "FILE", required_if_eq("algorithm", Algorithm::Learned.name()))]
    model: Option<PathBuf>,
    #[command(flatten)]
    engine: NetworkArguments,
    /// Networks of your own instead of those in the program: a folder with
    /// fastdvdnet-gray/stage1.onnx and stage2.onnx, or ffdnet-gray/model.onnx. The manifest names
    /// them by their hash.
    #[arg(long, value_name = "FOLDER")]
    models: Option<PathBuf>,
    /// Tiles solved at the same time [default: the number of cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Largest side of a tile, in pixels [default: 320, 384 for those of TV alone; for learned 256,
    /// or the whole picture for a network that takes no other].
    #[arg(long, value_name = "PIXELS")]
    tile: Option<usize>,
    /// Least overlap of neighbouring tiles, in pixels [default: 32, 16 for those of TV alone, or 0
    /// for the whole picture].
    #[arg(long, value_name = "PIXELS")]
    overlap: Option<usize>,
    /// Folder for frames/, png/, stack.exr, frames.npy and manifest.json.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// What is to be done with the input.
struct Setup {
    algorithm: Algorithm,
    schedule: Schedule,
    snapshot: usize,
    plan: TilePlan,
    network: NetworkSource,
    model: Option<Learned>,
    threads: usize,
}

impl Setup {
    fn needs_network(&self) -> bool {
        self.model.is_some() || self.schedule.needs_network()
    }

    fn models(&self) -> Result<Vec<ModelRecord>, CliError> {
        let mut models = self.network.records(&self.schedule)?;
        models.extend(self.model.as_ref().map(Learned::record));
        Ok(models)
    }
}

/// Runs the command.
///
/// # Errors
/// Input that can't be used, or a failure on the way.
pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    let schedule = arguments.schedule.resolve()?;
    let network = arguments.engine.network()?.with_models(arguments.models.clone());
    let input = Input::read(arguments)?;
    if let Some(out) = &arguments.out {
        check_output(out)?;
    }
    let model = learned(arguments, &network)?;
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let setup = Setup {
        algorithm: arguments.schedule.algorithm,
        schedule,
        snapshot: arguments.snapshot,
        plan: plan(
            arguments.schedule.algorithm,
            (arguments.tile, arguments.overlap),
            model.as_ref(),
            input.masks.array.dim(),
        )?,
        network,
        model,
        threads: arguments.threads.map_or(cores, usize::from),
    };

    let (started, before) = (Instant::now(), Usage::now());
    let solution = input.solve(&setup)?;
    let spent = Spent {
        seconds: started.elapsed().as_secs_f64(),
        cpu_seconds: (Usage::now() - before).cpu_seconds,
    };

    if let Some(out) = &arguments.out {
        let manifest = solution.manifest(&input, &setup, spent)?;
        solution.write(out, &setup, manifest)?;
    }
    solution.report(&input, &setup, spent)?.print(arguments)
}

/// The network of `--model`.
fn learned(arguments: &Arguments, network: &NetworkSource) -> Result<Option<Learned>, CliError> {
    let Some(path) = &arguments.model else { return Ok(None) };
    match arguments.schedule.algorithm {
        Algorithm::Learned => Learned::open(path, network).map(Some),
        other => Err(CliError::Input(format!(
            "{} takes no --model; ask for --algorithm learned",
            other.name()
        ))),
    }
}

/// What the computing took.
#[derive(Debug, Clone, Copy)]
struct Spent {
    seconds: f64,
    cpu_seconds: f64,
}

struct Sources<'a> {
    masks: Source<'a>,
    measurement: Source<'a>,
    truth: Option<Source<'a>>,
}

impl<'a> Sources<'a> {
    fn new(arguments: &'a Arguments) -> Result<Self, CliError> {
        let scene = arguments.scene.as_deref();
        let named = |file: &'a Option<PathBuf>| file.as_deref().or(scene);
        let missing = || CliError::Input("name --masks and --measurement, or a --scene".into());
        Ok(Self {
            masks: Source::file(
                named(&arguments.masks).ok_or_else(missing)?,
                SceneArray::Masks,
                arguments.masks_full_scale,
            ),
            measurement: Source::file(
                named(&arguments.measurement).ok_or_else(missing)?,
                SceneArray::Measurements,
                arguments.measurement_full_scale,
            ),
            truth: named(&arguments.truth)
                .map(|path| Source::file(path, SceneArray::Truth, arguments.truth_full_scale)),
        })
    }
}

fn sha256(path: &Path) -> Result<String, CliError> {
    let hashed = File::open(path).and_then(|mut file| sha256_of(&mut file));
    hashed.map_err(|error| CliError::file("read", path, &error))
}

/// The files' content.
struct Input<'a> {
    sources: Sources<'a>,
    masks: Scaled<Array3<f32>>,
    measurement: Scaled<Array2<f32>>,
    truth: Option<Array3<f32>>,
}

impl<'a> Input<'a> {
    fn read(arguments: &'a Arguments) -> Result<Self, CliError> {
        let sources = Sources::new(arguments)?;
        let masks = read_masks(&sources.masks)?;
        let (measurement, snapshots) = read_snapshot(&sources.measurement, arguments.snapshot)?;
        let (frames, height, width) = masks.array.dim();
        if measurement.array.dim() != (height, width) {
            let (rows, columns) = measurement.array.dim();
            return Err(CliError::Input(format!(
                "measurement {} is {rows}x{columns}, but the masks {} are {frames} frames of \
                 {height}x{width}; both must have the same height and width",
                sources.measurement.path.display(),
                sources.masks.path.display(),
            )));
        }
        let truth = match &sources.truth {
            Some(source) => read_truth(source, masks.array.dim(), arguments.snapshot, snapshots)?,
            None => None,
        };
        Ok(Self { sources, masks, measurement, truth })
    }

    fn solve(&self, setup: &Setup) -> Result<Solution, CliError> {
        let (height, width) = setup.plan.dim();
        let mut estimator = ScaleEstimator::new(height, width);
        self.masks.array.outer_iter().try_for_each(|mask| estimator.add_mask(mask))?;
        let white = estimator.white(self.measurement.array.view())?;
        let solver = match &setup.model {
            Some(model) => Solver::Network(&model.file),
            None => Solver::Schedule(&setup.schedule),
        };
        let input = SnapshotInput {
            snapshot: setup.snapshot,
            masks: self.masks.array.view(),
            measurement: self.measurement.array.view(),
            white,
            solver,
            plan: &setup.plan,
        };
        let bar = SnapshotBar::new(&setup.schedule, setup.plan.len());
        let Solved { tiles, pilot } = solve(&input, &setup.network, setup.threads, &bar)?;
        Ok(Solution { white, tiles, pilot })
    }
}

struct Solution {
    white: f32,
    tiles: Vec<TileOutcome>,
    pilot: Option<PilotRecord>,
}

impl Solution {
    fn records(&self) -> Vec<TileRecord> {
        self.tiles.iter().map(TileRecord::from).collect()
    }

    fn report(&self, input: &Input<'_>, setup: &Setup, spent: Spent) -> Result<Report, CliError> {
        let (frames, height, width) = input.masks.array.dim();
        let (psnr_db, ssim) = match &input.truth {
            Some(truth) => self.compare(&setup.plan, truth)?,
            None => (None, None),
        };
        let summary = Summary::of(&self.records());
        Ok(Report {
            algorithm: setup.algorithm.name(),
            frames,
            height,
            width,
            psnr_db,
            ssim,
            seconds: spent.seconds,
            denoiser_passes: summary.denoiser_passes,
            tv_iterations: summary.tv_iterations,
            cpu_seconds: spent.cpu_seconds,
            peak_rss_bytes: peak_rss_bytes(),
            provider: setup.needs_network().then(|| setup.network.provider()),
            stop_reason: summary.stop_reason,
            pilot: self.pilot.clone(),
        })
    }

    /// PSNR and SSIM, frame by frame, so that memory holds one blended frame. None for SSIM of
    /// frames that are smaller than its window.
    fn compare(
        &self,
        plan: &TilePlan,
        truth: &Array3<f32>,
    ) -> Result<(Option<f64>, Option<f64>), CliError> {
        let (mut psnr, mut ssim) = (0.0, 0.0);
        let (frames, height, width) = truth.dim();
        let windows = height >= metrics::WINDOW && width >= metrics::WINDOW;
        for k in 0..frames {
            let frame = blended_frame(plan, &self.tiles, k);
            let frame = frame.view().insert_axis(ndarray::Axis(0));
            let truth = truth.slice(s![k..=k, .., ..]);
            psnr += metrics::psnr(frame, truth)?;
            if windows {
                ssim += metrics::ssim(frame, truth)?;
            }
        }
        let count = frames as f64;
        Ok((Some(psnr / count), windows.then_some(ssim / count)))
    }

    fn manifest(
        &self,
        input: &Input<'_>,
        setup: &Setup,
        spent: Spent,
    ) -> Result<Manifest, CliError> {
        let (frames, height, width) = input.masks.array.dim();
        let deep = setup.needs_network();
        let tiles = self.records();
        let content = Content {
            program_version: env!("CARGO_PKG_VERSION").into(),
            algorithm: setup.algorithm,
            schedule: full_schedule(&setup.schedule, self.pilot.as_ref()),
            pilot: self.pilot.clone(),
            frames,
            height,
            width,
            snapshot: setup.snapshot,
            inputs: Inputs {
                masks_sha256: sha256(input.sources.masks.path)?,
                measurement_sha256: sha256(input.sources.measurement.path)?,
            },
            models: setup.models()?,
            scale: ScaleRecord {
                masks_full_scale: input.masks.full_scale,
                measurement_full_scale: input.measurement.full_scale,
                white: self.white,
            },
            tile_plan: (&setup.plan).into(),
            summary: Summary::of(&tiles),
            tiles,
            warnings: Vec::new(),
            camera: None,
            files: Vec::new(),
        };
        let run = RunRecord {
            job: None,
            provider: deep.then(|| setup.network.provider().into()),
            onnxruntime: if deep { Some(setup.network.version()?) } else { None },
            seconds: Some(spent.seconds),
            cpu_seconds: spent.cpu_seconds,
            peak_rss_bytes: peak_rss_bytes(),
            finished_at: Timestamp::now().to_string(),
        };
        Ok(Manifest { schema: SCHEMA.into(), content, run })
    }

    fn write(&self, out: &Path, setup: &Setup, manifest: Manifest) -> Result<(), CliError> {
        let failed = |error| CliError::file("write", out, &error);
        fs::create_dir_all(out).map_err(failed)?;
        // A failure on the way leaves an earlier result as it was.
        let made = tempfile::Builder::new().prefix(".making-").tempdir_in(out).map_err(failed)?;
        let Setup { plan, .. } = setup;
        let (height, width) = plan.dim();
        let attributes = frame_attributes(&manifest.content);
        let spec = ResultSpec { height, width, attributes, white: self.white };
        let frame = |k| Ok::<_, CliError>(blended_frame(plan, &self.tiles, k));
        write_result(made.path(), &spec, frame, |files| manifest.with_files(files))?;
        Ok(replace_result(made.path(), out)?)
    }
}
