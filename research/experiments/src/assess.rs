//! Fits of the quality model need the features of each block and its true error, which `assess`
//! writes.

use std::fs;
use std::path::PathBuf;

use clap::Args;
use engine::job::{Algorithm, Sequence};
use engine::pipeline::PipelineError;
use formats::{Channels, npy};
use ndarray::{Array3, ArrayView2};
use reconstruction::assessment::{BLOCK, BlockFeatures, Features, blocks};
use reconstruction::metrics;
use reconstruction::quality::Model;
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
        let Some(features) = tile.outcome.features.first() else {
            let name = arguments.algorithm.into_str();
            return Err(CliError::Input(format!(
                "{name}: there is no quality model for its results"
            )));
        };
        let mut seen = rows_of(features);
        if let Some(first_run) = &features.first_run {
            seen.extend(rows_of(&first_run.features));
            seen.push(first_run.distance.clone());
        }
        let psnr = metrics::psnr(found.view(), truth.view()).map_err(PipelineError::from)?;
        let mut errors = Array3::zeros((frames, rows, columns));
        let pairs = found.outer_iter().zip(truth.outer_iter());
        for (mut errors, (found, truth)) in errors.outer_iter_mut().zip(pairs) {
            let squares = (&found - &truth).mapv(|error| (error / tile.white).powi(2));
            let blocks = squares.exact_chunks((BLOCK, BLOCK));
            errors.iter_mut().zip(blocks).for_each(|(error, block)| {
                *error = block.mean().unwrap_or(0.0);
            });
        }
        seen.push(errors);
        let array = out.join(format!("{}.npy", clip.name));
        let failed = |error: std::io::Error| CliError::file("write", &array, &error);
        let file = fs::File::create(&array).map_err(failed)?;
        let shape = (seen.len(), frames, rows * columns);
        let mut writer = npy::writer(file, shape, Channels::Grey)?;
        for row in &seen {
            let plane = row.to_shape((frames, rows * columns));
            writer
                .write_frame(plane.map_err(|error| CliError::Failure(error.to_string()))?.view())?;
        }
        writer.finish()?;
        let pilot = tile.pilot.as_ref().and_then(|pilot| pilot.evidence.as_ref());
        let evidence = tile.outcome.evidence.as_ref().or(pilot);
        let schedule = tile.pilot.as_ref().map(|pilot| pilot.decide(&key.schedule));
        let expected = Model::of(schedule.as_ref().unwrap_or(&key.schedule)).map(|model| {
            let errors = model.log_errors(features, evidence);
            let psnr = |frame: ArrayView2<'_, f32>| {
                -10.0 * frame.mapv(|error| 10f32.powf(error)).mean().unwrap_or(0.0).log10()
            };
            let mean = errors.outer_iter().map(psnr).sum::<f32>() / frames as f32;
            mean - 20.0 * tile.white.log10()
        });
        let about = json!({"clip": clip.name, "setting": setting, "cr": frames,
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

/// Each feature of the blocks, and each of the encoder's channels, \[frames, rows, columns\].
fn rows_of(features: &Features) -> Vec<Array3<f32>> {
    let values = features.blocks.map(BlockFeatures::values);
    let count = values.first().map_or(0, Vec::len);
    let mut rows: Vec<_> = (0..count).map(|n| values.map(|values| values[n])).collect();
    let encoded = features.encoded.iter().flat_map(|encoded| encoded.outer_iter());
    rows.extend(encoded.map(|channel| channel.to_owned()));
    rows
}
