//! `sci-recon bench noise`: what multiplexing is good for. One sub-aperture in each frame gives masks
//! that differ more, half of them open give masks that pass more light.

use std::fs;
use std::path::PathBuf;
use std::thread;

use clap::Args;
use ndarray::{Array3, ArrayView2};
use serde::Serialize;

use super::clips::{Clip, read_clips};
use super::noise_chart;
use crate::cli::CliError;
use crate::cli::arguments::{EngineArguments, algorithms};
use crate::job::{Algorithm, TileSpec};
use crate::optics::{
    ApertureGrid, Draw, HybridAperture, Multiplexing, Normalisation, ProjectedMasks, generator,
    measure, noisy, single_apertures,
};
use crate::pipeline::{NetworkSource, SnapshotInput, Solver, blended_frame, solve};
use crate::recon::metrics;
use crate::recon::schedule::Schedule;
use crate::recon::tile::TilePlan;

/// Compare multiplexed masks with single sub-apertures as noise grows. Masks are normalised by
/// light throughput, so that a mask through one of twelve sub-apertures is a sixth as bright as one
/// through six.
#[derive(Debug, Args)]
pub struct Arguments {
    /// A folder of clips: folders of PNGs, .npy, .npz, .mat or TIFF files. A folder of PNGs is one clip.
    #[arg(long, value_name = "FOLDER")]
    clips: PathBuf,
    /// Frames in one snapshot: the first N of each clip are used.
    #[arg(long, value_name = "N", default_value_t = 10,
          value_parser = clap::value_parser!(u16).range(1..=1000))]
    cr: u16,
    /// Side of the square that is cut from the middle of each frame [default: whole frames].
    #[arg(long, value_name = "PIXELS")]
    scale: Option<usize>,
    /// Noise levels: S is the standard deviation added to y = sum C x with x from 0 to 255.
    #[arg(long, value_name = "S,S,...", value_delimiter = ',',
          default_values_t = [0.0, 2.5, 5.0, 10.0, 15.0, 20.0])]
    sigmas: Vec<f32>,
    /// The algorithm.
    #[arg(long, value_name = "NAME", default_value = Algorithm::GapTv.name(),
          value_parser = algorithms())]
    algorithm: Algorithm,
    #[command(flatten)]
    engine: EngineArguments,
    /// Seed of masks and noise.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for noise.json and noise.svg.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
}

/// `noise.json`.
#[derive(Debug, Serialize)]
pub(super) struct Record {
    schema: &'static str,
    program_version: &'static str,
    pub(super) algorithm: &'static str,
    compression_ratio: usize,
    seed: u64,
    clips: Vec<String>,
    /// Noise levels on the scale of 255 grey values.
    pub(super) sigmas: Vec<f32>,
    pub(super) curves: Vec<Curve>,
    /// The noise level at which the curves cross, between the two levels beside it by a straight line;
    /// none if they do not cross once.
    crossing_sigma: Option<f64>,
}

/// One kind of masks.
#[derive(Debug, Serialize)]
pub(super) struct Curve {
    pub(super) masks: &'static str,
    /// Share of the light of the whole open aperture, without a mask, that passes.
    light_throughput: f64,
    /// Mean over the clips, by noise level.
    pub(super) psnr_db: Vec<f64>,
    /// For each clip, by noise level.
    psnr_db_by_clip: Vec<Vec<f64>>,
}

/// Runs the experiment.
///
/// # Errors
/// Clips that can't be used, or a failure on the way.
pub(super) fn run(arguments: &Arguments) -> Result<(), CliError> {
    let frames = usize::from(arguments.cr);
    let clips = read_clips(&arguments.clips, frames, arguments.scale)?;
    let bench = Bench {
        schedule: arguments.algorithm.default_schedule(),
        network: arguments.engine.network()?,
        sigmas: &arguments.sigmas,
        seed: arguments.seed,
    };
    let grid = ApertureGrid::for_frames(frames);
    let mut rng = generator(arguments.seed);
    let draw = Draw::of(grid.count() / 2);
    let multiplexed = Multiplexing::random(frames, grid.count(), draw, &mut rng)?.patterns(grid);
    let single = single_apertures(frames, grid, &mut rng)?;
    let curves = vec![
        bench.curve("random squares, half of the sub-apertures open", &multiplexed, &clips)?,
        bench.curve("one sub-aperture open", &single, &clips)?,
    ];
    let record = Record {
        schema: "sci-recon/bench-noise/1",
        program_version: env!("CARGO_PKG_VERSION"),
        algorithm: arguments.algorithm.name(),
        compression_ratio: frames,
        seed: arguments.seed,
        clips: clips.into_iter().map(|clip| clip.name).collect(),
        sigmas: arguments.sigmas.clone(),
        crossing_sigma: crossing(&arguments.sigmas, &curves[0].psnr_db, &curves[1].psnr_db),
        curves,
    };
    print(&record);
    write(arguments, &record)
}

struct Bench<'a> {
    schedule: Schedule,
    network: NetworkSource,
    sigmas: &'a [f32],
    seed: u64,
}

impl Bench<'_> {
    fn curve(
        &self,
        masks: &'static str,
        patterns: &Array3<f32>,
        clips: &[Clip],
    ) -> Result<Curve, CliError> {
        let optics = HybridAperture {
            normalisation: Normalisation::Throughput,
            ..HybridAperture::default()
        };
        let (mut by_clip, mut throughput) = (Vec::new(), 0.0);
        for clip in clips {
            let (_, height, width) = clip.frames.dim();
            // The same lithography mask for both kinds of patterns.
            let mut rng = generator(self.seed);
            let made = optics.masks(patterns.view(), (height, width), &mut rng)?;
            throughput += made.throughput / clips.len() as f64;
            by_clip.push(self.clip(&made, clip, masks)?);
        }
        let level =
            |index: usize| by_clip.iter().map(|values: &Vec<f64>| values[index]).sum::<f64>();
        Ok(Curve {
            masks,
            light_throughput: throughput,
            psnr_db: (0..self.sigmas.len()).map(|at| level(at) / clips.len() as f64).collect(),
            psnr_db_by_clip: by_clip,
        })
    }

    /// PSNR of a clip at each noise level.
    fn clip(&self, made: &ProjectedMasks, clip: &Clip, name: &str) -> Result<Vec<f64>, CliError> {
        let clean = measure(made.masks.view(), clip.frames.view())?;
        let mut psnr = Vec::with_capacity(self.sigmas.len());
        for &sigma in self.sigmas {
            let y = noisy(clean.clone(), sigma / 255.0, self.seed)?;
            let value = self.solve(made, y.view(), clip.frames.view())?;
            eprintln!("{}, {name}, sigma {sigma}: {value:.2} dB", clip.name);
            psnr.push(value);
        }
        Ok(psnr)
    }

    fn solve(
        &self,
        made: &ProjectedMasks,
        y: ArrayView2<'_, f32>,
        truth: ndarray::ArrayView3<'_, f32>,
    ) -> Result<f64, CliError> {
        let (frames, height, width) = truth.dim();
        let TileSpec { size, overlap } = Algorithm::GapTv.default_tile();
        let plan = TilePlan::new(height, width, size.max(overlap * 2), overlap)?;
        let input = SnapshotInput {
            snapshot: 0,
            masks: made.masks.view(),
            measurement: y,
            // The scene's own: its level is known here, so noise does not disturb it.
            white: 1.0,
            solver: Solver::Schedule(&self.schedule),
            plan: &plan,
        };
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let tiles = solve(&input, &self.network, cores, &())?.tiles;
        let mut psnr = 0.0;
        for (k, truth) in truth.axis_chunks_iter(ndarray::Axis(0), 1).enumerate() {
            let frame = blended_frame(&plan, &tiles, k);
            psnr += metrics::psnr(frame.view().insert_axis(ndarray::Axis(0)), truth)?;
        }
        Ok(psnr / frames as f64)
    }
}

/// Where the first curve comes to lie above the second one, if it does so once and for all.
fn crossing(sigmas: &[f32], first: &[f64], second: &[f64]) -> Option<f64> {
    let ahead: Vec<f64> = first.iter().zip(second).map(|(first, second)| first - second).collect();
    let at = ahead.iter().position(|ahead| *ahead > 0.0).filter(|at| *at > 0)?;
    if ahead[at..].iter().any(|ahead| *ahead <= 0.0) {
        return None;
    }
    let (before, after) = (ahead[at - 1], ahead[at]);
    let (low, high) = (f64::from(sigmas[at - 1]), f64::from(sigmas[at]));
    Some(low + (high - low) * before / (before - after))
}

fn print(record: &Record) {
    println!("PSNR in dB, mean over {} clips, {}\n", record.clips.len(), record.algorithm);
    let row = |cells: Vec<String>| println!("| {} |", cells.join(" | "));
    let first = |name: &str| vec![name.to_owned()];
    let sigmas = record.sigmas.iter().map(ToString::to_string);
    row(first("masks \\ sigma").into_iter().chain(sigmas).collect());
    row(vec!["---".to_owned(); record.sigmas.len() + 1]);
    for curve in &record.curves {
        let values = curve.psnr_db.iter().map(|value| format!("{value:.2}"));
        row(first(curve.masks).into_iter().chain(values).collect());
    }
    match record.crossing_sigma {
        Some(sigma) => println!("\nThe curves cross at sigma {sigma:.1}."),
        None => println!("\nThe curves do not cross between these noise levels."),
    }
}

fn write(arguments: &Arguments, record: &Record) -> Result<(), CliError> {
    let out = &arguments.out;
    let failed = |error| CliError::file("write", out, &error);
    fs::create_dir_all(out).map_err(failed)?;
    let text = serde_json::to_string_pretty(record)
        .map_err(|error| CliError::Failure(format!("noise.json: {error}")))?;
    fs::write(out.join("noise.json"), text + "\n").map_err(failed)?;
    fs::write(out.join("noise.svg"), noise_chart::svg(record)).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::crossing;

    #[test]
    fn a_crossing_lies_between_the_levels_beside_it() {
        let sigmas = [0.0, 10.0, 20.0];
        assert_eq!(crossing(&sigmas, &[20.0, 19.0, 18.0], &[21.0, 18.0, 15.0]), Some(5.0));
        assert_eq!(
            crossing(&sigmas, &[22.0, 19.0, 18.0], &[21.0, 18.0, 15.0]),
            None,
            "always ahead"
        );
        assert_eq!(crossing(&sigmas, &[20.0, 19.0, 14.0], &[21.0, 18.0, 15.0]), None, "and back");
        assert_eq!(crossing(&sigmas, &[20.0, 17.0, 14.0], &[21.0, 18.0, 15.0]), None);
    }
}
