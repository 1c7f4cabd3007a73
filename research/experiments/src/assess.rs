//! Fits of the quality model need the features of each block and its true error, which `assess`
//! writes.

use std::fs;
use std::path::PathBuf;

use clap::Args;
use engine::job::{Algorithm, Sequence};
use engine::pipeline::PipelineError;
use formats::{Channels, npy};
use ndarray::{Array3, ArrayView2, Axis, s};
use reconstruction::assessment::{BLOCK, FEATURES, Model, blocks};
use reconstruction::metrics;
use sci_recon::cli::{CliError, MaskArguments, NetworkArguments, algorithms};
use serde_json::json;

use super::clips::read_clips;
use super::record::Setting;
use super::trial::{Bench, Choice, Masks};

/// Writes the features of the quality model and the true error, for each clip of a folder.
#[derive(Debug, Args)]
pub struct Arguments {
    /// A folder of clips: folders of PNGs, .npy, .npz, .mat or TIFF files. A folder of PNGs is one clip.
    #[arg(long, value_name = "FOLDER")]
    clips: PathBuf,
    #[command(flatten)]
    masks: MaskArguments,
    /// Frames in one snapshot: the first N of each clip are used.
    #[arg(long, value_name = "N", default_value_t = 10,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    cr: u16,
    /// Side of the square that is cropped from the centre of each frame.
    #[arg(long, value_name = "PIXELS", default_value_t = 128)]
    scale: usize,
    /// Noise: the standard deviation added to y = sum C x with x from 0 to 255.
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    noise_sigma: f32,
    /// The algorithm.
    #[arg(long, value_name = "NAME", default_value = Algorithm::PnpTvFastdvdnet.into_str(),
          value_parser = algorithms())]
    algorithm: Algorithm,
    #[command(flatten)]
    engine: NetworkArguments,
    /// Seed of masks and noise.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for NAME.npy and NAME.json. The array is [row, frame, block]. Its rows are the
    /// features, the encoder's channels (if a network took part), both for the first run and the
    /// distance of the results (if a stage was run twice), and the true error.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
}

pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    let (frames, side) = (usize::from(arguments.cr), arguments.scale);
    let clips = read_clips(&arguments.clips, frames, Some(side))?;
    let setting = Setting {
        pattern: arguments.masks.described(),
        noise_sigma: arguments.noise_sigma,
        seed: arguments.seed,
    };
    let bench = Bench::new(arguments.engine.network()?, None, setting.clone());
    let masks: Masks = bench.masks(&arguments.masks, frames, side)?;
    let out = &arguments.out;
    fs::create_dir_all(out).map_err(|error| CliError::file("write", out, &error))?;
    for clip in &clips {
        let measured = bench.measure(&masks, clip, 1)?;
        let key = bench.key(&measured, arguments.algorithm, Choice::Default(Sequence::Separate))?;
        let tile = bench.first_tile(&measured, &key)?;
        let (found, truth) = (&tile.outcome.frames, measured.truth());
        let (rows, columns) = blocks(side, side);
        let Some(seen_of_tile) = &tile.outcome.features else {
            let name = arguments.algorithm.into_str();
            return Err(CliError::Input(format!(
                "{name}: there is no quality model for its results"
            )));
        };
        let count = seen_of_tile.len_of(Axis(0));
        let features = seen_of_tile.to_shape((count, frames, rows * columns));
        let features = features.map_err(|error| CliError::Failure(error.to_string()))?;
        let mut seen = Array3::zeros((count + 1, frames, rows * columns));
        seen.slice_mut(s![..count, .., ..]).assign(&features);
        let psnr = metrics::psnr(found.view(), truth.view()).map_err(PipelineError::from)?;
        for (k, (found, truth)) in found.outer_iter().zip(truth.outer_iter()).enumerate() {
            let squares = (&found - &truth).mapv(|error| (error / tile.white).powi(2));
            for (at, block) in squares.exact_chunks((BLOCK, BLOCK)).into_iter().enumerate() {
                seen[[count, k, at]] = block.mean().unwrap_or(0.0);
            }
        }
        let array = out.join(format!("{}.npy", clip.name));
        let failed = |error: std::io::Error| CliError::file("write", &array, &error);
        let file = fs::File::create(&array).map_err(failed)?;
        let mut writer = npy::writer(file, seen.dim(), Channels::Grey)?;
        for plane in seen.axis_iter(Axis(0)) {
            writer.write_frame(plane)?;
        }
        writer.finish()?;
        let pilot = tile.pilot.as_ref().and_then(|pilot| pilot.evidence.as_ref());
        let evidence = tile.outcome.evidence.as_ref().or(pilot);
        let schedule = tile.pilot.as_ref().map(|pilot| pilot.decide(&key.schedule));
        let expected = Model::of(schedule.as_ref().unwrap_or(&key.schedule)).map(|model| {
            let errors = model.log_errors(seen_of_tile, evidence);
            let psnr = |frame: ArrayView2<'_, f32>| {
                -10.0 * frame.mapv(|error| 10f32.powf(error)).mean().unwrap_or(0.0).log10()
            };
            let mean = errors.outer_iter().map(psnr).sum::<f32>() / frames as f32;
            mean - 20.0 * tile.white.log10()
        });
        let about = json!({"clip": clip.name, "setting": setting, "cr": frames, "features": FEATURES,
            "algorithm": arguments.algorithm, "psnr_db": psnr, "expected_psnr_db": expected,
            "white": tile.white, "evidence": evidence, "pilot": tile.pilot});
        let path = out.join(format!("{}.json", clip.name));
        fs::write(&path, about.to_string())
            .map_err(|error| CliError::file("write", &path, &error))?;
        let expected = expected.map_or("-".into(), |psnr| format!("{psnr:.2}"));
        eprintln!("{}: {psnr:.2} dB, expected {expected}", clip.name);
    }
    Ok(())
}
