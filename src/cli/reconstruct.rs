//! `sci-recon reconstruct`: reconstructs snapshots without a server.

use std::fs;
use std::io::BufWriter;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Instant;

use clap::Args;
use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use serde::Serialize;

use super::CliError;
use super::arguments::{
    DispersionArguments, MaskFileArguments, NetworkArguments, ScheduleArguments,
    SnapshotFileArguments, Snapshots, named, registration,
};
use super::fields::Role;
use super::model::{Model, cut};
use super::output::print_line;
use super::progress::SnapshotBar;
use super::verdict;
use crate::cli::error::{Result, open_input};
use engine::intake::{
    self, Exposure, MaskLight, Scaled, Source, expected_size, read_masks, read_snapshots,
    read_truth,
};
use engine::job::{
    Algorithm, Assessment, CalibrationId, CalibrationRequest, Dispersion, Finding, Grade, Inputs,
    MeasurementRequest, Mosaic, Registered, RegistrationRequest, SceneShape, Schedule, Sequence,
    Sha256, keeps_mosaic,
};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::{hide_uncovered, known, light};
use engine::pipeline::manifest::{Manifest, Recipe, ScaleRecord, VERSION};
use engine::pipeline::networks::NetworkSource;
use engine::pipeline::pilot::full_schedule;
use engine::pipeline::quality::{FrameQuality, Quality};
use engine::pipeline::records::{CostRecord, PilotRecord, RunRecord, TileRecord, changes};
use engine::pipeline::registration;
use engine::pipeline::scale::{Histogram, lit, white, white_level};
use engine::pipeline::sequence::{SequenceInput, Solved, Solver, solve};
use engine::pipeline::usage::{cpu_seconds, peak_rss_bytes};
use engine::pipeline::write::{OnDisk, check_output, replace_result, write_result};
use formats::mat::SceneArray;
use formats::{Axes, Channels, Limits, Selection, planar};
use reconstruction::registration::Correction;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::{TilePlan, Window};

/// Reconstruct the frames of snapshots from files.
///
/// Runs the checks of the service. Ends with 3 if they found errors.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Masks, one frame each: npy, TIFF, PNG, or a scene's `mask`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    masks: Option<PathBuf>,
    /// Measurement, one frame per snapshot: npy, TIFF, PNG, or a scene's `meas`.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    measurement: Option<PathBuf>,
    /// True frames to compare with, of the reconstructed or of all snapshots.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// A scene (npz, .mat or HDF5) with `mask`, `meas` and optionally `orig`, instead of the three files.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["masks", "measurement", "truth"])]
    scene: Option<PathBuf>,
    /// The snapshots, counted from 0: one, a range including both ends, or all.
    #[arg(long, alias = "snapshot", value_name = "N|FIRST-LAST|all", default_value = "0")]
    snapshots: Snapshots,
    /// `contiguous` if the snapshots follow one another without a gap; they are reconstructed together where that helps.
    /// `separate` reconstructs each alone.
    #[arg(long, default_value_t = Sequence::Contiguous, value_parser = named::<Sequence>())]
    sequence: Sequence,
    /// Value in the masks' file that means 1 (fully open) [default: 255 for uint8, 65535 for
    /// uint16, 1 for floats and .mat scenes].
    #[arg(long, value_name = "VALUE")]
    masks_full_scale: Option<f32>,
    /// Value in the measurement's file that means 1 [default: 255 for uint8 and .mat scenes,
    /// 65535 for uint16, 1 for floats].
    #[arg(long, alias = "measurement-full-scale", value_name = "VALUE")]
    full_scale: Option<f32>,
    /// Value in the truth's file that means 1 [default: as for the measurement].
    #[arg(long, value_name = "VALUE")]
    truth_full_scale: Option<f32>,
    /// The colours of the sensor's pixels, row by row of a 2x2 cell. The frames then have colours; the truth may have
    /// colours ([frame, row, column, 3]) or be a mosaic [default: a grey sensor].
    #[arg(long, value_name = "NAME", value_parser = named::<Mosaic>())]
    mosaic: Option<Mosaic>,
    #[command(flatten)]
    mask_file: MaskFileArguments,
    #[command(flatten)]
    snapshot_file: SnapshotFileArguments,
    #[command(flatten)]
    dispersion: DispersionArguments,
    /// The order of the axes in the truth's file.
    #[arg(long, value_name = "ORDER", value_parser = named::<Axes>())]
    truth_axes: Option<Axes>,
    /// Masks that have moved since the calibration: off, auto to estimate and correct the motion, or
    /// ROWS,COLUMNS or ROWS,COLUMNS,DEGREES,SCALE to state a shift in pixels, a clockwise rotation and a factor.
    #[arg(long, value_name = "WHICH", default_value = "auto", value_parser = registration, allow_hyphen_values = true)]
    registration: RegistrationRequest,
    #[command(flatten)]
    schedule: ScheduleArguments,
    /// The network of --algorithm learned: an ONNX file with inputs `measurement [1,1,H,W]` and
    /// `masks [1,B,H,W]` and output `frames [1,B,H,W]`, all float32. The measurement is sum C x with
    /// frames x from 0 to 1.
    #[arg(long, value_name = "FILE", required_if_eq("algorithm", Algorithm::Learned.into_str()))]
    model: Option<PathBuf>,
    #[command(flatten)]
    engine: NetworkArguments,
    /// Folder with networks that replace the built-in ones: fastdvdnet-gray/stage1.onnx and stage2.onnx, or
    /// ffdnet-gray/model.onnx. The manifest has their hashes.
    #[arg(long, value_name = "FOLDER")]
    models: Option<PathBuf>,
    /// Cores to use [default: all]. Each tile has one, and the tiles at work share those that are left.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Largest side of a tile in pixels (with --mosaic, of a sub-image) [default: 320; 384 for TV alone; 240 where
    /// that allows longer runs of snapshots; for learned 256, or the whole picture if the network needs it].
    #[arg(long, value_name = "PIXELS")]
    tile: Option<usize>,
    /// Least overlap of neighbouring tiles in pixels [default: 32; 16 for TV alone; 0 for the whole picture].
    #[arg(long, value_name = "PIXELS")]
    overlap: Option<usize>,
    /// Folder for frames/, png/, stack.exr, frames.npy (and mosaic.npy) and manifest.json. Several snapshots have a
    /// subfolder each, snapshot_0000 and so on. Without it, the result is only measured.
    #[arg(long, value_name = "FOLDER", required_unless_present_any = ["truth", "scene", "json"])]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// The algorithm and the plan for the input.
struct Setup {
    algorithm: Algorithm,
    schedule: Schedule,
    plan: TilePlan,
    runs: SequencePlan,
    network: NetworkSource,
    model: Option<Model>,
    threads: usize,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let schedule = arguments.schedule.resolve()?;
    let models = arguments.models.as_deref();
    let network = arguments.engine.network()?.with_models(models);
    let network = network.map_err(|error| CliError::Input(error.to_string()))?;
    let schedule = network.suited(schedule);
    if let Some(folder) = models.filter(|_| !network.replaces(&schedule)) {
        let detail = "has no network of this algorithm; name another algorithm, or omit --models";
        return Err(CliError::Input(format!("the folder {} {detail}", folder.display())));
    }
    let mut input = Input::read(arguments)?;
    let folders = folders(arguments.out.as_deref(), &input.snapshots());
    for (_, folder) in &folders {
        check_output(folder)?;
        // A folder that can't be written to ends the command before the work.
        draft(folder)?;
    }
    let algorithm = arguments.schedule.algorithm();
    let model = model(arguments, &network)?;
    let snapshots = input.snapshots();
    let shape = input.shape();
    let (height, width) = shape.solved();
    let dim = (shape.frames, height, width);
    let cut = cut(
        algorithm,
        &schedule,
        arguments.tile,
        arguments.overlap,
        model.as_ref(),
        (input.sequence(arguments.sequence), snapshots.len() as u32),
        dim,
    )?;
    let (plan, runs) = (shape.tile_plan(cut.tile)?, cut.run.plan(snapshots.clone())?);
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let threads = arguments.threads.map_or(cores, usize::from);
    let setup = Setup { algorithm, schedule, plan, runs, network, model, threads };

    let (started, before) = (Instant::now(), cpu_seconds());
    let lit = lit(input.light(None)?.view());
    let white = input.register(arguments.registration)?;
    let solver = match &setup.model {
        Some(model) => Solver::Network(&model.file),
        None => Solver::Schedule(&setup.schedule),
    };
    let sequence = SequenceInput {
        masks: input.masks.array.view(),
        measurement: input.measurement.array.view(),
        first: input.first,
        white,
        solver,
        plan: &setup.plan,
        runs: &setup.runs,
        mosaic: arguments.mosaic,
    };
    let bar = SnapshotBar::new(setup.plan.len() * setup.runs.runs().len());
    let report_progress = |tile, share| bar.update(tile, share);
    let solved = solve(&sequence, &setup.network, setup.threads, &report_progress)?;
    drop(bar);
    let seconds = started.elapsed().as_secs_f64();
    let cpu_seconds = cpu_seconds() - before;

    let uses_network = setup.model.is_some() || setup.schedule.needs_network();
    let records_version = uses_network && arguments.out.is_some();
    let cost = CostRecord {
        provider: uses_network.then(|| setup.network.provider(&setup.schedule).into()),
        onnxruntime: if records_version { Some(setup.network.version()?) } else { None },
        gpu: setup.model.is_none().then(|| setup.network.gpu_name()).flatten(),
        cpu_seconds,
        peak_rss_bytes: peak_rss_bytes(),
    };
    let run = RunRecord::ended(None, cost, Some(seconds));
    let frames = sequence.masks.dim().0;
    let solved_frame =
        |index| solved.frame(&sequence, input.first + index / frames, index % frames);
    let dispersion = input.sources.masks.dispersion.as_ref();
    let in_place = |index: usize, solved: Array2<f32>| match dispersion {
        Some(bands) => bands.unshear(solved.view(), index % frames),
        None => solved,
    };
    let frame = |index| in_place(index, solved_frame(index));
    let compare = |(truth, channels): &(Array3<f32>, Channels)| {
        let frame = |index| match (arguments.mosaic, channels) {
            (Some(mosaic), Channels::Rgb) => mosaic.demosaick(solved_frame(index).view(), (0, 0)),
            _ => frame(index),
        };
        Quality::compare(frame, truth.view(), *channels)
    };
    let quality = input.truth.as_ref().map(compare).transpose()?;
    let mut histogram = Histogram::default();
    (0..frames * snapshots.len()).for_each(|index| {
        histogram.add(frame(index).view(), in_place(index, lit.clone()).view());
    });
    let white_level = white_level(&histogram, white);
    let recipe = input.recipe(&setup, white, white_level, &solved, arguments)?;
    let expected = |snapshot| {
        let assessments = solved.assessments(&sequence, snapshot, &recipe.schedule);
        // The quality model is fitted to the embedded networks.
        let fits = !setup.network.replaces(&recipe.schedule);
        fits.then(|| recipe.expected(snapshot, &assessments)).flatten()
    };
    let expected: Vec<_> = input.snapshots().map(expected).collect();
    let mut report = Report::new(&recipe, &sequence, &solved, &run, quality);
    let assessments = expected.iter().map(|expected| Some(&expected.as_ref()?.assessment));
    report.assessment = Assessment::combined(assessments);
    report.findings = Assessment::findings(&input.findings, report.assessment.as_ref());
    report.verdict = Assessment::verdict(&report.findings, report.assessment.as_ref());
    for (snapshot, folder) in folders {
        let tiles = solved.records(&sequence, snapshot);
        let expected = expected.get(snapshot - input.first).cloned().flatten();
        let (assessment, error) =
            expected.map(|expected| (expected.assessment, expected.error)).unzip();
        let manifest = recipe.snapshot(snapshot, tiles, assessment, run.clone());
        let frame = |k| solved.frame(&sequence, snapshot, k);
        write(&folder, manifest, error.as_ref().map(|error| error.view()), frame)?;
    }
    report.print(arguments)?;
    verdict::refuse_bad([(&*report.findings, report.verdict)])
}

/// The output folder of each snapshot.
fn folders(out: Option<&Path>, snapshots: &Range<usize>) -> Vec<(usize, PathBuf)> {
    let Some(out) = out else { return Vec::new() };
    let folder = |snapshot| match snapshots.len() {
        1 => out.to_owned(),
        _ => out.join(format!("snapshot_{snapshot:04}")),
    };
    snapshots.clone().map(|snapshot| (snapshot, folder(snapshot))).collect()
}

fn model(arguments: &Arguments, network: &NetworkSource) -> Result<Option<Model>> {
    let Some(path) = &arguments.model else { return Ok(None) };
    match arguments.schedule.algorithm() {
        Algorithm::Learned => Model::open(path, network).map(Some),
        other => Err(CliError::Input(format!(
            "{} takes no --model; use --algorithm learned",
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
        let missing = || CliError::Input("give --masks and --measurement, or --scene".into());
        let dispersion = arguments.dispersion.resolve()?;
        if dispersion.is_some() && arguments.mosaic.is_some() {
            let text =
                "a spectral camera has a grey sensor: leave out --mosaic or --dispersion-offsets";
            return Err(CliError::Input(text.into()));
        }
        Ok(Self {
            masks: Source::file(
                named(&arguments.masks).ok_or_else(missing)?,
                SceneArray::Masks,
                arguments.masks_full_scale,
            )
            .named(arguments.mask_file.masks_array.as_ref().map(ToString::to_string))
            .arranged(arguments.mask_file.masks_axes, None)
            .part(
                Selection {
                    crop: arguments.mask_file.masks_crop,
                    frames: arguments.mask_file.masks_frames,
                },
                arguments.mask_file.masks_packing,
            )
            .dispersed(dispersion),
            measurement: Source::file(
                named(&arguments.measurement).ok_or_else(missing)?,
                SceneArray::Measurements,
                arguments.full_scale,
            )
            .named(arguments.snapshot_file.array.as_ref().map(ToString::to_string))
            .arranged(arguments.snapshot_file.axes, None)
            .part(
                Selection { crop: arguments.snapshot_file.crop, frames: None },
                arguments.snapshot_file.packing,
            ),
            truth: named(&arguments.truth).map(|path| {
                Source::file(path, SceneArray::Truth, arguments.truth_full_scale)
                    .arranged(arguments.truth_axes, None)
            }),
        })
    }
}

fn sha256(path: &Path) -> Result<Sha256> {
    let hashed = Sha256::of_reader(&mut open_input(path)?);
    Ok(hashed.map_err(|error| CliError::file("read", path, &error))?.0)
}

struct Input<'a> {
    sources: Sources<'a>,
    masks: Scaled<Array3<f32>>,
    /// \[S,H,W\].
    measurement: Scaled<Array3<f32>>,
    /// Index of the first snapshot in the file.
    first: usize,
    truth: Option<(Array3<f32>, Channels)>,
    mosaic: Option<Mosaic>,
    findings: Vec<Finding>,
    /// The registration of the masks, unless it is off.
    registration: Option<Registered>,
}

impl<'a> Input<'a> {
    fn read(arguments: &'a Arguments) -> Result<Self> {
        let mut sources = Sources::new(arguments)?;
        let masks = read_masks(&sources.masks, arguments.mask_file.bad_pixels.as_deref())
            .map_err(|error| CliError::from(error).about(Role::Masks))?;
        let (frames, height, width) = masks.array.dim();
        sources.measurement.size = Some((height, width));
        let dispersion = sources.masks.dispersion.clone();
        let sensor = (height, width);
        let frame_size = dispersion.as_ref().map_or(sensor, |bands| bands.frame_size(sensor));
        if let Some(truth) = &mut sources.truth {
            truth.size = Some(frame_size);
        }
        let Snapshots { first, last } = arguments.snapshots;
        let SnapshotFileArguments { dark, saturation, .. } = &arguments.snapshot_file;
        let exposure = Exposure { dark: dark.clone(), saturation: *saturation };
        let mask_frames = masks.array.outer_iter().map(|mask| Ok(mask.to_owned()));
        let behind = MaskLight::of(mask_frames, sensor, arguments.mosaic)?;
        let read = read_snapshots(&sources.measurement, &exposure, &behind, (first, last))
            .map_err(|error| CliError::from(error).about(Role::Measurement))?;
        let (measurement, snapshots) = (read.measurement, read.count);
        let (count, rows, columns) = measurement.array.dim();
        if let Some(dispersion) = &dispersion
            && (rows, columns) != (height, width)
        {
            return Err(CliError::Input(format!(
                "measurement {} is {rows}x{columns} (rows x columns): {}",
                sources.measurement.path.display(),
                expected_size(dispersion, (height, width))
            )));
        }
        if (rows, columns) != (height, width) {
            return Err(CliError::Input(format!(
                "measurement {} is {rows}x{columns}, but the masks {} are {frames} frames of \
                 {height}x{width}; both must have the same height and width: {}",
                sources.measurement.path.display(),
                sources.masks.path.display(),
                intake::size_remedy(
                    (height, width),
                    (rows, columns),
                    "state the window that they have in common as --masks-crop or --crop",
                ),
            )));
        }
        let mosaic = arguments.mosaic;
        let crops = [arguments.mask_file.masks_crop, arguments.snapshot_file.crop];
        if mosaic.is_some() && !crops.into_iter().all(keeps_mosaic) {
            let text = "--mosaic: the window of a mosaic starts at an even row and an even column";
            return Err(CliError::Input(text.into()));
        }
        if mosaic.is_some() && !(height.is_multiple_of(2) && width.is_multiple_of(2)) {
            return Err(CliError::Input(format!(
                "--mosaic: the pictures are {height}x{width} (rows x columns); a mosaic has an even number of \
                 both: crop them so that they begin with the first pixel of a cell"
            )));
        }
        let dim = (frames, frame_size.0, frame_size.1);
        let truth = match &sources.truth {
            Some(source) => {
                read_truth(source, dim, mosaic.is_some(), first..first + count, snapshots)?
            }
            None => None,
        };
        let has_dark = !dark.is_empty();
        let (masks_view, y) = (masks.array.view(), measurement.array.view());
        let (calibration, judged) = judge(masks_view, y, mosaic, dispersion.as_ref(), has_dark)?;
        let judged = judged.into_iter().map(|finding| {
            // Findings count from the first snapshot of the file.
            let snapshot = finding.snapshot.map(|index| index + first as u32);
            Finding { snapshot, ..finding }
        });
        let mut findings: Vec<Finding> = calibration.into_iter().collect();
        findings.extend(intake::combined(read.findings, judged.collect()));
        intake::causes_first(&mut findings);
        Ok(Self { sources, masks, measurement, first, truth, mosaic, findings, registration: None })
    }

    fn shape(&self) -> SceneShape {
        let (frames, height, width) = self.masks.array.dim();
        let snapshots = self.measurement.array.dim().0 as u32;
        SceneShape { frames, height, width, snapshots, mosaic: self.mosaic }
    }

    /// Snapshots of a spectral camera are reconstructed one by one: their bands do not continue one another.
    fn sequence(&self, stated: Sequence) -> Sequence {
        if self.sources.masks.dispersion.is_some() { Sequence::Separate } else { stated }
    }

    /// Indices of the snapshots in the file.
    fn snapshots(&self) -> Range<usize> {
        self.first..self.first + self.measurement.array.dim().0
    }

    /// The light of the masks after a correction, as in a job.
    fn light(&self, correction: Option<Correction>) -> Result<Array2<f32>, PipelineError> {
        let (_, height, width) = self.masks.array.dim();
        let masks = self.masks.array.outer_iter().map(|mask| Ok(mask.to_owned()));
        light(masks, (height, width), correction)
    }

    /// The solver's common scale of all snapshots, as in a job.
    fn white(&self, correction: Option<Correction>) -> Result<f32> {
        Ok(white(self.light(correction)?, self.measurement.array.view())?)
    }

    /// Registers the masks by the first snapshot, as a job does, and moves them. Snapshots become NaN where no mask is
    /// known, and unknown masks 0. Returns the white level.
    fn register(&mut self, request: RegistrationRequest) -> Result<f32> {
        let mut white = self.white(None)?;
        let masks = self.masks.array.view();
        let is_coloured = self.mosaic.is_some() || self.sources.masks.dispersion.is_some();
        if request.error(is_coloured).is_some() {
            let text = "--registration: masks of a colour sensor or spectral camera are not moved; calibrate again";
            return Err(CliError::Input(text.into()));
        }
        let light = || self.light(None);
        let y = &self.measurement.array.index_axis(Axis(0), 0) / white;
        let piece = |place: &Window| {
            Ok(masks.slice(s![.., place.rows.clone(), place.columns.clone()]).to_owned())
        };
        let registered =
            registration::register(request, is_coloured, light, y.view(), piece, &mut |_| true)?;
        if let Some(registered) = &registered {
            let superseded = registered.superseded();
            self.findings.retain(|finding| !superseded.iter().any(|code| finding.is(*code)));
            self.findings.extend(registered.findings());
        }
        let correction = registered.as_ref().and_then(Registered::correction);
        if registered.as_ref().is_some_and(Registered::changes_white_level) {
            white = self.white(correction)?;
        }
        if let Some(correction) = correction {
            let (_, height, width) = self.masks.array.dim();
            let place = Window { rows: 0..height, columns: 0..width, step: 1 };
            let moved = registration::moved(self.masks.array.view(), correction);
            hide_uncovered(&mut self.measurement.array, (height, width), &place, correction);
            self.masks.array = moved;
        }
        self.masks.array.mapv_inplace(known);
        self.registration = registered;
        Ok(white)
    }

    /// The origin of masks and snapshots, as a job records it.
    fn inputs(&self, arguments: &Arguments) -> Result<Inputs> {
        let (masks, snapshots) = (&arguments.mask_file, &arguments.snapshot_file);
        let file = sha256(self.sources.masks.path)?;
        let calibration = CalibrationRequest {
            full_scale: arguments.masks_full_scale,
            mosaic: arguments.mosaic,
            dispersion: self.sources.masks.dispersion.clone(),
            bad_pixels: masks.bad_pixels.as_deref().map(sha256).transpose()?,
            ..masks.request(file)
        };
        let dark: Result<Vec<Sha256>> = snapshots.dark.iter().map(|file| sha256(file)).collect();
        let measurement = MeasurementRequest {
            full_scale: arguments.full_scale,
            ..snapshots.request(CalibrationId::new(), sha256(self.sources.measurement.path)?, dark?)
        };
        let axes = |axes: Option<Axes>| axes.map(|axes| axes.to_string());
        Ok(Inputs {
            masks: calibration.inputs(file, axes(self.masks.axes), None),
            measurement: measurement.inputs(axes(self.measurement.axes)),
        })
    }

    fn recipe(
        &self,
        setup: &Setup,
        normalisation: f32,
        white_level: f32,
        solved: &Solved,
        arguments: &Arguments,
    ) -> Result<Recipe> {
        let pilot = solved.pilot.clone();
        let mut models = setup.network.records(&setup.schedule);
        models.extend(setup.model.as_ref().map(Model::record));
        Ok(Recipe {
            program_version: VERSION,
            algorithm: setup.algorithm,
            schedule: full_schedule(&setup.schedule, pilot.as_ref()),
            pilot,
            registration: self.registration.clone(),
            shape: self.shape(),
            dispersion: self.sources.masks.dispersion.clone(),
            inputs: self.inputs(arguments)?,
            models,
            scale: ScaleRecord {
                masks_full_scale: self.masks.full_scale,
                measurement_full_scale: self.measurement.full_scale,
                normalisation,
                white_level,
            },
            tile_plan: setup.plan.clone(),
            runs: setup.runs.clone(),
            warnings: self.findings.clone(),
            camera: (None, None),
        })
    }
}

/// Runs the checks of the service on masks \[B,H,W\] and snapshots \[S,H,W\], and returns the warning of the masks and the
/// findings on the snapshots. The checks read prepared files, so the arrays are written to temporary ones.
fn judge(
    masks: ArrayView3<'_, f32>,
    snapshots: ArrayView3<'_, f32>,
    mosaic: Option<Mosaic>,
    dispersion: Option<&Dispersion>,
    has_dark: bool,
) -> Result<(Option<Finding>, Vec<Finding>)> {
    let limits = Limits::default();
    let (masks, snapshots) = (prepare(masks)?, prepare(snapshots)?);
    let reader = planar::Reader::open(masks.path(), &limits)?;
    let report = intake::report(&reader, dispersion.is_some(), &mut |_| true)?;
    let judged =
        intake::judge(masks.path(), snapshots.path(), mosaic, dispersion, has_dark, &limits)?;
    Ok((report.report.warning(), judged))
}

fn prepare(frames: ArrayView3<'_, f32>) -> Result<tempfile::NamedTempFile> {
    let failed = |error| CliError::Failure(format!("cannot write a temporary file: {error}"));
    let file = tempfile::NamedTempFile::new().map_err(failed)?;
    let (count, height, width) = frames.dim();
    let mut writer = planar::writer(BufWriter::new(file), count, height, width)?;
    for frame in frames.outer_iter() {
        writer.write_frame(frame)?;
    }
    writer.finish()?.into_inner().map_err(|error| failed(error.into_error()))
}

fn write(
    out: &Path,
    manifest: Manifest,
    error: Option<ArrayView3<'_, f32>>,
    frame: impl Fn(usize) -> Array2<f32>,
) -> Result<()> {
    // If writing fails, an earlier result remains.
    let draft = draft(out)?;
    write_result(draft.path(), manifest, error, OnDisk::All, |k| Ok(frame(k)))?;
    Ok(replace_result(draft.path(), out)?)
}

/// A folder in `out` for a result that is not complete; it creates `out`.
fn draft(out: &Path) -> Result<tempfile::TempDir> {
    let failed = |error| CliError::file("write", out, &error);
    fs::create_dir_all(out).map_err(failed)?;
    tempfile::Builder::new().prefix(".making-").tempdir_in(out).map_err(failed)
}

/// The object that `--json` prints.
#[derive(Debug, Serialize)]
struct Report {
    algorithm: &'static str,
    snapshots: usize,
    /// Number of frames of all snapshots.
    frames: usize,
    height: usize,
    width: usize,
    /// PSNR relative to the white level, as the expected one.
    psnr_db: Option<f64>,
    /// PSNR for a data range of 1, as benchmarks state it.
    psnr_unit_db: Option<f64>,
    /// The 99.9th percentile of all frames.
    white_level: f32,
    /// The verdict on the frames; `None` if nothing was found and there is no prediction.
    verdict: Option<Grade>,
    /// The predicted quality of the frames, as a mean over the snapshots.
    assessment: Option<Assessment>,
    /// PSNR of each snapshot. Empty if the truth is unknown.
    psnr_db_by_snapshot: Vec<f64>,
    ssim: Option<f64>,
    seconds: f64,
    iterations: usize,
    denoiser_passes: usize,
    tv_iterations: usize,
    cpu_seconds: f64,
    peak_rss_bytes: u64,
    /// `None` for a schedule without a network.
    provider: Option<String>,
    stop_reason: String,
    /// The first and the last snapshot of each run that was reconstructed together.
    runs: Vec<[usize; 2]>,
    /// The pilot's decisions on an adaptive schedule and on the cuts between snapshots.
    pilot: Option<PilotRecord>,
    /// Findings of the checks, and further reasons of the assessment.
    findings: Vec<Finding>,
}

impl Report {
    /// Summarizes the results. `quality` is `None` if the truth is unknown.
    fn new(
        recipe: &Recipe,
        input: &SequenceInput<'_>,
        solved: &Solved,
        run: &RunRecord,
        quality: Option<Quality>,
    ) -> Self {
        let frames = input.masks.dim().0;
        let SceneShape { height, width, .. } = recipe.shape.frame_shape(recipe.dispersion.as_ref());
        let snapshots = input.measurement.dim().0;
        let tiles = solved.runs.iter().flatten().map(TileRecord::from).collect::<Vec<_>>();
        let summary = TileRecord::summary(&tiles);
        let white_level = recipe.scale.white_level;
        let psnr_unit_db = quality.as_ref().map(|quality| quality.psnr);
        let quality = quality.map(|quality| quality.relative_to(white_level));
        let by_frame = quality.as_ref().map_or(&[][..], |quality| &quality.frames);
        let mean = |frames: &[FrameQuality]| {
            frames.iter().map(|frame| frame.psnr).sum::<f64>() / frames.len() as f64
        };
        Self {
            algorithm: recipe.algorithm.into_str(),
            snapshots,
            frames: snapshots * frames,
            height,
            width,
            psnr_db: quality.as_ref().map(|quality| quality.psnr),
            psnr_unit_db,
            white_level,
            verdict: None,
            assessment: None,
            psnr_db_by_snapshot: by_frame.chunks(frames).map(mean).collect(),
            ssim: quality.as_ref().and_then(|quality| quality.ssim),
            seconds: run.seconds.unwrap_or_default(),
            iterations: summary.iterations,
            denoiser_passes: summary.denoiser_passes,
            tv_iterations: summary.tv_iterations,
            cpu_seconds: run.cost.cpu_seconds,
            peak_rss_bytes: run.cost.peak_rss_bytes,
            provider: run.cost.provider.clone(),
            stop_reason: summary.stop_reason,
            runs: input.runs.runs().iter().map(|run| [run.start, run.end - 1]).collect(),
            pilot: recipe.pilot.clone(),
            findings: Vec::new(),
        }
    }

    fn print(&self, arguments: &Arguments) -> Result<()> {
        if arguments.json {
            let text = serde_json::to_string(self)
                .map_err(|error| CliError::Failure(format!("the report: {error}")))?;
            print_line(text)?;
            return Ok(());
        }
        print_line(format!(
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
        ))?;
        print_line(Assessment::verdict_text(self.verdict, self.assessment.as_ref()))?;
        verdict::lines(&self.findings).iter().try_for_each(print_line)?;
        for decided in self.pilot.iter().flat_map(|pilot| &pilot.stages) {
            print_line(format!(
                "{}: {} of {} iterations ({}), error at held-out pixels {:.4} to {:.4}{}",
                decided.stage.prior.name(),
                decided.stage.iterations,
                decided.planned.iterations,
                decided.end,
                decided.error_before,
                decided.error_after,
                changes(decided)
            ))?;
        }
        if let Some(ratio) = self.pilot.as_ref().and_then(PilotRecord::hold_out_ratio) {
            print_line(format!(
                "error at held-out pixels: {ratio:.2} times that of a guess from their neighbours (right masks usually have \
                 up to 0.5; from 1 on the masks explain nothing)"
            ))?;
        }
        for joint in self.pilot.iter().flat_map(|pilot| &pilot.joints) {
            let error =
                |error: Option<f64>| error.map_or("none".into(), |error| format!("{error:.4}"));
            print_line(format!(
                "snapshots {} and {}: {}, error at held-out pixels {} alone, {} together",
                joint.after,
                joint.after + 1,
                if joint.together { "together" } else { "separate" },
                error(joint.error_alone),
                error(joint.error_together),
            ))?;
        }
        if let (Some(psnr), Some(unit)) = (self.psnr_db, self.psnr_unit_db) {
            let ssim = self.ssim.map_or_else(String::new, |ssim| format!(", SSIM {ssim:.4}"));
            print_line(format!(
                "PSNR {psnr:.2} dB relative to the white level {:.4} ({unit:.2} dB for a data range of 1){ssim}",
                self.white_level
            ))?;
        }
        if let Some(out) = &arguments.out {
            print_line(format!("frames are in {}", out.display()))?;
        }
        Ok(())
    }
}
