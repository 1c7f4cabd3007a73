//! `sci-recon reconstruct`: one snapshot, without a server.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Instant;

use clap::Args;
use ndarray::{Array2, Array3};
use serde::Serialize;

use super::CliError;
use super::arguments::{NetworkArguments, ScheduleArguments};
use super::model::{Model, plan};
use super::progress::SnapshotBar;
use crate::cli::error::Result;
use crate::formats::mat::SceneArray;
use crate::intake::{Scaled, Source, read_masks, read_snapshot, read_truth};
use crate::job::{Algorithm, SceneShape, Schedule, Sha256};
use crate::pipeline::blend;
use crate::pipeline::manifest::{Inputs, Manifest, Recipe, ScaleRecord, VERSION};
use crate::pipeline::networks::NetworkSource;
use crate::pipeline::pilot::full_schedule;
use crate::pipeline::quality::Quality;
use crate::pipeline::records::{CostRecord, PilotRecord, RunRecord, TileRecord};
use crate::pipeline::scale::white;
use crate::pipeline::snapshot::{SnapshotInput, Solved, Solver, solve};
use crate::pipeline::usage::{cpu_seconds, peak_rss_bytes};
use crate::pipeline::write::{check_output, replace_result, write_result};
use crate::recon::tile::TilePlan;

/// Reconstruct the frames of one snapshot from files, without a server.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Masks, one frame each: npy, TIFF, PNG, or a scene's `mask`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    masks: Option<PathBuf>,
    /// Measurement, one frame a snapshot: npy, TIFF, PNG, or a scene's `meas`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    measurement: Option<PathBuf>,
    /// True frames, to be compared with: those of the snapshot, or of all snapshots.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// A scene, .mat or HDF5, with `mask`, `meas` and perhaps `orig`, instead of the three files.
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
    #[arg(long, value_name = "FILE", required_if_eq("algorithm", Algorithm::Learned.into_str()))]
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
    model: Option<Model>,
    threads: usize,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let schedule = arguments.schedule.resolve()?;
    let network = arguments.engine.network()?.with_models(arguments.models.clone());
    let input = Input::read(arguments)?;
    if let Some(out) = &arguments.out {
        check_output(out)?;
    }
    let algorithm = arguments.schedule.algorithm;
    let model = model(arguments, &network)?;
    let cut = (arguments.tile, arguments.overlap);
    let plan = plan(algorithm, cut, model.as_ref(), input.masks.array.dim())?;
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let threads = arguments.threads.map_or(cores, usize::from);
    let snapshot = arguments.snapshot;
    let setup = Setup { algorithm, schedule, snapshot, plan, network, model, threads };

    let (started, before) = (Instant::now(), cpu_seconds());
    let (white, solved) = input.solve(&setup)?;
    let seconds = started.elapsed().as_secs_f64();
    let cpu_seconds = cpu_seconds() - before;

    let deep = setup.model.is_some() || setup.schedule.needs_network();
    let cost = CostRecord {
        provider: deep.then(|| setup.network.provider().into()),
        onnxruntime: None,
        cpu_seconds,
        peak_rss_bytes: peak_rss_bytes(),
    };
    let run = RunRecord::ended(None, cost, Some(seconds));
    let tiles = solved.tiles.iter().map(TileRecord::from).collect();
    let mut manifest = input.recipe(&setup, white, &solved)?.snapshot(snapshot, tiles, run);
    let truth = input.truth.as_ref().map(|truth| truth.view());
    let compare = |truth| Quality::of_tiles(&setup.plan, &solved.tiles, truth);
    let quality = truth.map(compare).transpose()?;
    let report = Report::new(&manifest, quality);
    if let Some(out) = &arguments.out {
        manifest.run.cost.onnxruntime = if deep { Some(setup.network.version()?) } else { None };
        write(out, manifest, &setup.plan, &solved)?;
    }
    report.print(arguments)
}

fn model(arguments: &Arguments, network: &NetworkSource) -> Result<Option<Model>> {
    let Some(path) = &arguments.model else { return Ok(None) };
    match arguments.schedule.algorithm {
        Algorithm::Learned => Model::open(path, network).map(Some),
        other => Err(CliError::Input(format!(
            "{} takes no --model; ask for --algorithm learned",
            other.into_str()
        ))),
    }
}

struct Sources<'a> {
    masks: Source<'a>,
    measurement: Source<'a>,
    truth: Option<Source<'a>>,
}

impl<'a> Sources<'a> {
    fn new(arguments: &'a Arguments) -> Result<Self> {
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

fn sha256(path: &Path) -> Result<Sha256> {
    let hashed = File::open(path).and_then(|mut file| Sha256::of_reader(&mut file));
    Ok(hashed.map_err(|error| CliError::file("read", path, &error))?.0)
}

struct Input<'a> {
    sources: Sources<'a>,
    masks: Scaled<Array3<f32>>,
    measurement: Scaled<Array2<f32>>,
    truth: Option<Array3<f32>>,
}

impl<'a> Input<'a> {
    fn read(arguments: &'a Arguments) -> Result<Self> {
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

    /// White level and tiles.
    fn solve(&self, setup: &Setup) -> Result<(f32, Solved)> {
        let (masks, measurement) = (self.masks.array.view(), self.measurement.array.view());
        let white = white(masks, measurement)?;
        let solver = match &setup.model {
            Some(model) => Solver::Network(&model.file),
            None => Solver::Schedule(&setup.schedule),
        };
        let (snapshot, plan) = (setup.snapshot, &setup.plan);
        let input = SnapshotInput { snapshot, masks, measurement, white, solver, plan };
        let bar = SnapshotBar::new(plan.len());
        let tell = |tile, share| bar.update(tile, share);
        Ok((white, solve(&input, &setup.network, setup.threads, &tell)?))
    }

    fn recipe(&self, setup: &Setup, white: f32, solved: &Solved) -> Result<Recipe> {
        let (frames, height, width) = self.masks.array.dim();
        let pilot = solved.pilot.clone();
        let mut models = setup.network.records(&setup.schedule)?;
        models.extend(setup.model.as_ref().map(Model::record));
        Ok(Recipe {
            program_version: VERSION,
            algorithm: setup.algorithm,
            schedule: full_schedule(&setup.schedule, pilot.as_ref()),
            pilot,
            shape: SceneShape { frames, height, width, snapshots: 1 },
            inputs: Inputs {
                masks_sha256: sha256(self.sources.masks.path)?,
                measurement_sha256: sha256(self.sources.measurement.path)?,
            },
            models,
            scale: ScaleRecord {
                masks_full_scale: self.masks.full_scale,
                measurement_full_scale: self.measurement.full_scale,
                white,
            },
            tile_plan: setup.plan.clone(),
            warnings: Vec::new(),
            camera: (None, None),
        })
    }
}

fn write(out: &Path, manifest: Manifest, plan: &TilePlan, solved: &Solved) -> Result<()> {
    let failed = |error| CliError::file("write", out, &error);
    fs::create_dir_all(out).map_err(failed)?;
    // A failure on the way leaves an earlier result as it was.
    let made = tempfile::Builder::new().prefix(".making-").tempdir_in(out).map_err(failed)?;
    write_result(made.path(), manifest, |k| Ok(blend::frame(plan, &solved.tiles, k)))?;
    Ok(replace_result(made.path(), out)?)
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report {
    algorithm: &'static str,
    frames: usize,
    height: usize,
    width: usize,
    psnr_db: Option<f64>,
    ssim: Option<f64>,
    seconds: f64,
    denoiser_passes: usize,
    tv_iterations: usize,
    cpu_seconds: f64,
    peak_rss_bytes: u64,
    /// None for a schedule without a network.
    provider: Option<String>,
    stop_reason: String,
    /// How an adaptive schedule was decided.
    pilot: Option<PilotRecord>,
}

impl Report {
    /// Of a snapshot, and of its frames if the truth is known.
    fn new(manifest: &Manifest, quality: Option<Quality>) -> Self {
        let (content, run) = (&manifest.content, &manifest.run);
        Self {
            algorithm: content.recipe.algorithm.into_str(),
            frames: content.frames,
            height: content.height,
            width: content.width,
            psnr_db: quality.as_ref().map(|quality| quality.psnr),
            ssim: quality.and_then(|quality| quality.ssim),
            seconds: run.seconds.unwrap_or_default(),
            denoiser_passes: content.summary.denoiser_passes,
            tv_iterations: content.summary.tv_iterations,
            cpu_seconds: run.cost.cpu_seconds,
            peak_rss_bytes: run.cost.peak_rss_bytes,
            provider: run.cost.provider.clone(),
            stop_reason: content.summary.stop_reason.clone(),
            pilot: content.recipe.pilot.clone(),
        }
    }

    fn print(&self, arguments: &Arguments) -> Result<()> {
        if arguments.json {
            let text = serde_json::to_string(self)
                .map_err(|error| CliError::Failure(format!("the report: {error}")))?;
            println!("{text}");
            return Ok(());
        }
        println!(
            "{}: {} frames of {}x{} in {:.1} s ({:.1} CPU-seconds), {} TV iterations, {} denoiser \
             passes, {}",
            self.algorithm,
            self.frames,
            self.height,
            self.width,
            self.seconds,
            self.cpu_seconds,
            self.tv_iterations,
            self.denoiser_passes,
            self.stop_reason
        );
        for stage in self.pilot.iter().flat_map(|pilot| &pilot.stages) {
            println!(
                "{}: {} of {} iterations ({}), error at held-out pixels {:.4} to {:.4}{}",
                stage.prior.name(),
                stage.iterations,
                stage.planned,
                stage.end,
                stage.error_before,
                stage.error_after,
                stage.along_time().map_or_else(String::new, |fate| format!(
                    ", total variation along time {fate}"
                ))
            );
        }
        if let Some(psnr) = self.psnr_db {
            let ssim = self.ssim.map_or_else(String::new, |ssim| format!(", SSIM {ssim:.4}"));
            println!("PSNR {psnr:.2} dB{ssim}");
        }
        if let Some(out) = &arguments.out {
            println!("frames are in {}", out.display());
        }
        Ok(())
    }
}
