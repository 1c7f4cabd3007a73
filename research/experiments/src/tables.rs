//! The paper's Tables 1 and 2: algorithms compared on your own clips.

use std::path::PathBuf;

use clap::Args;

use engine::job::{Algorithm, RunSpec};
use sci_recon::cli::{CliError, MaskArguments, Model, NetworkArguments, algorithms};

use super::clips::read_clips;
use super::markdown::{Layout, line};
use super::record::{Records, Setting};
use super::trial::{Bench, Choice};

/// Compare algorithms as in the paper's Tables 1 and 2: PSNR and SSIM of each clip at each scale
/// and compression ratio, with CPU seconds and deep passes. Each clip is measured through simulated
/// masks and reconstructed like by `sci-recon reconstruct`. Each row is written when it is
/// computed; the same command continues after an interruption.
#[derive(Debug, Args)]
pub struct Arguments {
    /// A folder of clips: folders of PNGs, .npy, .npz, .mat or TIFF files. A folder of PNGs is one clip.
    #[arg(long, value_name = "FOLDER")]
    clips: PathBuf,
    /// Sides in pixels of the squares that are cropped from the centre of each frame.
    #[arg(long, value_name = "PIXELS,...", value_delimiter = ',', default_values_t = [256],
          value_parser = clap::value_parser!(u16).range(16..))]
    scales: Vec<u16>,
    /// Compression ratios: the first N frames of each clip make one snapshot, the next N the next.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [10, 20],
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    cr: Vec<u16>,
    /// Consecutive snapshots of each clip.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    snapshots: u16,
    /// Modes of joint reconstruction, one row each: separate, contiguous (like a job), or runs of
    /// at most LENGTH snapshots that share at least OVERLAP.
    #[arg(long, value_name = "separate|contiguous|LENGTH:OVERLAP,...", value_delimiter = ',',
          default_value = "contiguous", value_parser = choice)]
    sequence: Vec<Choice>,
    /// The algorithms, in the order of the tables' rows.
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', value_parser = algorithms(),
          default_values = PAPER.map(|algorithm| algorithm.into_str()))]
    algorithms: Vec<Algorithm>,
    /// Add a row `learned` for this network: an ONNX file as for `reconstruct --model`. Scales and
    /// ratios that it does not support have no row.
    #[arg(long, value_name = "FILE")]
    learned: Option<PathBuf>,
    #[command(flatten)]
    masks: MaskArguments,
    /// Noise of the measurements on the scale of 255 grey values: S/255 is the standard deviation
    /// added to y = sum C x, with x and C from 0 to 1.
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    noise_sigma: f32,
    /// Also show the PSNR of each frame.
    #[arg(long)]
    by_frame: bool,
    /// Also show the PSNR of rings from the centre to the rim.
    #[arg(long)]
    by_zone: bool,
    #[command(flatten)]
    engine: NetworkArguments,
    /// Seed of masks and noise.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for tables.md, the rows of this command, and tables.json, all rows computed there.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
}

/// Algorithms of the paper's tables that need no network trained for each set of masks.
const PAPER: [Algorithm; 3] = [Algorithm::GapTv, Algorithm::PnpFfdnet, Algorithm::PnpTvFastdvdnet];

/// Rejects settings that are impossible at the largest scale and ratio before the computation.
pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    let (ratios, scales) = (distinct(&arguments.cr), distinct(&arguments.scales));
    let most = |values: &[u16]| values.iter().copied().max().map(usize::from);
    let snapshots = usize::from(arguments.snapshots);
    let frames = most(&ratios).unwrap_or(1) * snapshots;
    let clips = read_clips(&arguments.clips, frames, most(&scales))?;
    let mut algorithms = distinct(&arguments.algorithms);
    algorithms.extend(arguments.learned.is_some().then_some(Algorithm::Learned));
    let layout = Layout {
        clips: clips.iter().map(|clip| clip.name.clone()).collect(),
        algorithms,
        by_frame: arguments.by_frame,
        by_zone: arguments.by_zone,
    };
    let mut records = Records::open(&arguments.out)?;
    let setting = Setting {
        pattern: arguments.masks.described(),
        noise_sigma: arguments.noise_sigma,
        seed: arguments.seed,
    };
    let network = arguments.engine.network()?;
    let learned = arguments.learned.as_ref().map(|path| Model::open(path, &network)).transpose()?;
    let bench = Bench::new(network, learned, setting);
    // Reject impossible patterns now, not after hours.
    let smallest = usize::from(scales.iter().copied().min().unwrap_or(1));
    for &ratio in &ratios {
        bench.masks(&arguments.masks, ratio.into(), smallest)?;
    }
    let mut rows = Vec::new();
    for ratio in ratios {
        for &scale in &scales {
            let masks = bench.masks(&arguments.masks, ratio.into(), scale.into())?;
            for clip in &clips {
                let measured = bench.measure(&masks, clip, snapshots)?;
                for &algorithm in &layout.algorithms {
                    if let Some(why) = bench.obstacle(algorithm, ratio.into(), scale.into()) {
                        eprintln!("{}, no {}: {why}", clip.name, algorithm.into_str());
                        continue;
                    }
                    for &sequence in &arguments.sequence {
                        let key = bench.key(&measured, algorithm, sequence)?;
                        let row = match records.find(&key) {
                            Some(row) => row.clone(),
                            None => records.add(bench.run(&measured, key)?)?,
                        };
                        eprintln!("{}", line(&row));
                        rows.push(row);
                        records.write("tables.md", &layout.markdown(&rows))?;
                    }
                }
            }
        }
    }
    print!("{}", layout.markdown(&rows));
    Ok(())
}

fn choice(text: &str) -> Result<Choice, String> {
    if let Ok(sequence) = text.parse() {
        return Ok(Choice::Default(sequence));
    }
    let runs = text.split_once(':').and_then(|(length, overlap)| {
        let (length, overlap) = (length.parse().ok()?, overlap.parse().ok()?);
        (overlap < length).then_some(RunSpec { length, overlap })
    });
    let wrong = "separate, contiguous or LENGTH:OVERLAP, where the overlap is below the length";
    runs.map(Choice::Runs).ok_or_else(|| format!("name {wrong}"))
}

/// The values without repetitions, in their original order.
fn distinct<T: PartialEq + Copy>(values: &[T]) -> Vec<T> {
    let mut distinct = Vec::with_capacity(values.len());
    for value in values {
        if !distinct.contains(value) {
            distinct.push(*value);
        }
    }
    distinct
}
