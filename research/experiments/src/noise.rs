//! The benefit of multiplexing. One open sub-aperture per frame gives masks that differ more; half
//! of them open give brighter masks.

use std::fs;
use std::path::PathBuf;

use clap::Args;
use engine::job::{Algorithm, Sequence};
use engine::pipeline::NetworkSource;
use engine::pipeline::quality::Quality;
use engine::pipeline::sequence::{SequenceInput, Solver};
use formats::Channels;
use maud::{Markup, html};
use ndarray::{Array3, Axis};
use optics::{
    ApertureGrid, Draw, HybridAperture, Multiplexing, Normalisation, generator, measure, noisy,
    single_apertures,
};
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use sci_recon::cli::{CliError, NetworkArguments, algorithms, cut};
use serde::Serialize;

use super::clips::{Clip, read_clips};
use super::markdown;
use super::trial::solve_on_all_cores;

/// Compare multiplexed masks with single sub-apertures as noise grows. Masks are normalised by
/// light throughput, so a mask through one of twelve sub-apertures is a sixth as bright as one
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
    /// Side of the square that is cropped from the centre of each frame [default: whole frames].
    #[arg(long, value_name = "PIXELS")]
    scale: Option<usize>,
    /// Noise levels: S is the standard deviation added to y = sum C x with x from 0 to 255.
    #[arg(long, value_name = "S,S,...", value_delimiter = ',',
          default_values_t = [0.0, 2.5, 5.0, 10.0, 15.0, 20.0])]
    sigmas: Vec<f32>,
    /// The algorithm.
    #[arg(long, value_name = "NAME", default_value = Algorithm::GapTv.into_str(),
          value_parser = algorithms())]
    algorithm: Algorithm,
    #[command(flatten)]
    engine: NetworkArguments,
    /// Seed of masks and noise.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for noise.json and noise.svg.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
}

/// `noise.json`.
#[derive(Debug, Serialize)]
struct Record {
    schema: &'static str,
    program_version: &'static str,
    algorithm: &'static str,
    compression_ratio: usize,
    seed: u64,
    clips: Vec<String>,
    /// Noise levels on the scale of 255 grey values.
    sigmas: Vec<f32>,
    curves: Vec<Curve>,
    /// Noise level at which the curves cross, interpolated between two levels; none unless they
    /// cross exactly once.
    crossing_sigma: Option<f64>,
}

#[derive(Debug, Serialize)]
struct Curve {
    masks: &'static str,
    /// Light throughput without a mask, relative to the open aperture.
    light_throughput: f64,
    /// Mean over the clips, by noise level.
    psnr_db: Vec<f64>,
    /// For each clip, by noise level.
    psnr_db_by_clip: Vec<Vec<f64>>,
}

pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    let &Arguments { algorithm, seed, ref sigmas, .. } = arguments;
    let frames = usize::from(arguments.cr);
    let clips = read_clips(&arguments.clips, frames, arguments.scale)?;
    let network = arguments.engine.network()?;
    let schedule = network.suited(algorithm.default_schedule());
    let bench = Bench { schedule, network, sigmas, seed };
    let grid = ApertureGrid::for_frames(frames);
    let mut rng = generator(seed);
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
        algorithm: algorithm.into_str(),
        compression_ratio: frames,
        seed,
        clips: clips.into_iter().map(|clip| clip.name).collect(),
        sigmas: sigmas.clone(),
        crossing_sigma: crossing(sigmas, &curves[0].psnr_db, &curves[1].psnr_db),
        curves,
    };
    print(&record);
    let out = &arguments.out;
    let failed = |error| CliError::file("write", out, &error);
    let text = serde_json::to_string_pretty(&record)
        .map_err(|error| CliError::Failure(format!("noise.json: {error}")))?;
    fs::create_dir_all(out).map_err(failed)?;
    fs::write(out.join("noise.json"), text + "\n").map_err(failed)?;
    fs::write(out.join("noise.svg"), chart(&record)).map_err(failed)
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
            // Both kinds of patterns use the same lithography mask.
            let mut rng = generator(self.seed);
            let made = optics.masks(patterns.view(), (height, width), &mut rng)?;
            throughput += made.throughput / clips.len() as f64;
            by_clip.push(self.psnr_by_sigma(&made.masks, clip, masks)?);
        }
        let mean = |at: usize| {
            by_clip.iter().map(|values: &Vec<f64>| values[at]).sum::<f64>() / clips.len() as f64
        };
        Ok(Curve {
            masks,
            light_throughput: throughput,
            psnr_db: (0..self.sigmas.len()).map(mean).collect(),
            psnr_db_by_clip: by_clip,
        })
    }

    fn psnr_by_sigma(
        &self,
        masks: &Array3<f32>,
        clip: &Clip,
        name: &str,
    ) -> Result<Vec<f64>, CliError> {
        let clean = measure(masks.view(), clip.frames.view())?;
        let alone = (Sequence::Separate, 1);
        let cut = cut(Algorithm::GapTv, &self.schedule, None, None, None, alone, masks.dim())?;
        let plan = cut.tiles(masks.dim().1, masks.dim().2)?;
        let mut by_sigma = Vec::with_capacity(self.sigmas.len());
        for &sigma in self.sigmas {
            let y = noisy(clean.clone(), sigma / 255.0, self.seed)?;
            let y = y.insert_axis(Axis(0));
            let input = SequenceInput {
                masks: masks.view(),
                measurement: y.view(),
                first: 0,
                // The white level is that of the scene, so noise does not disturb it.
                white: 1.0,
                solver: Solver::Schedule(&self.schedule),
                plan: &plan,
                runs: &SequencePlan::separate(0..1),
                mosaic: None,
            };
            let solved = solve_on_all_cores(&input, &self.network)?;
            let frame = |k| solved.frame(&input, 0, k);
            let value = Quality::compare(frame, clip.frames.view(), Channels::Grey)?.psnr;
            eprintln!("{}, {name}, sigma {sigma}: {value:.2} dB", clip.name);
            by_sigma.push(value);
        }
        Ok(by_sigma)
    }
}

/// Noise level from which on the first curve is above the second one; none unless it crosses
/// exactly once.
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
    let sigmas = record.sigmas.iter().map(ToString::to_string);
    let head = std::iter::once("masks \\ sigma".to_owned()).chain(sigmas).collect();
    let rows = record.curves.iter().map(|curve| {
        let values = curve.psnr_db.iter().map(|value| format!("{value:.2}"));
        std::iter::once(curve.masks.to_owned()).chain(values).collect()
    });
    print!("{}", markdown::table(head, rows));
    match record.crossing_sigma {
        Some(sigma) => println!("\nThe curves cross at sigma {sigma:.1}."),
        None => println!("\nThe curves do not cross between these noise levels."),
    }
}

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 400.0;
/// Borders of the plot: left, right, top, bottom.
const PLANE: [f64; 4] = [60.0, WIDTH - 20.0, 60.0, HEIGHT - 50.0];

fn chart(record: &Record) -> String {
    let sigmas: Vec<f64> = record.sigmas.iter().map(|&sigma| f64::from(sigma)).collect();
    let span = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        })
    };
    let (sigma, psnr) = (
        span(&mut sigmas.iter().copied()),
        span(&mut record.curves.iter().flat_map(|curve| curve.psnr_db.iter().copied())),
    );
    let [left, right, top, bottom] = PLANE;
    let low = psnr.0.floor() - 1.0;
    let high = (psnr.1.ceil() + 1.0).max(low + 1.0);
    let width = (sigma.1 - sigma.0).max(1.0);
    let x = |value: f64| left + (value - sigma.0) / width * (right - left);
    let y = |value: f64| bottom - (value - low) / (high - low) * (bottom - top);
    #[allow(clippy::cast_possible_truncation)] // decibels
    let levels = (low as i32..=high as i32).step_by(2);
    let chart = html! {
        svg xmlns="http://www.w3.org/2000/svg" width=(WIDTH) height=(HEIGHT)
            font-family="sans-serif" font-size="12" {
            rect width=(WIDTH) height=(HEIGHT) fill="#fff" {}
            @for level in levels {
                @let y = y(f64::from(level));
                line x1=(left) y1=(y) x2=(right) y2=(y) stroke="#ddd" {}
                text x=(left - 6.0) y=(y + 4.0) text-anchor="end" { (level) }
            }
            @for sigma in &sigmas {
                @let x = x(*sigma);
                line x1=(x) y1=(bottom) x2=(x) y2=(bottom + 5.0) stroke="#333" {}
                text x=(x) y=(bottom + 18.0) text-anchor="middle" { (sigma) }
            }
            line x1=(left) y1=(bottom) x2=(right) y2=(bottom) stroke="#333" {}
            @for (index, curve) in record.curves.iter().enumerate() {
                @let points = sigmas.iter().zip(&curve.psnr_db).map(|(&s, &p)| (x(s), y(p)));
                (polyline(points.collect(), curve.masks, index))
            }
            text x=((WIDTH + left) / 2.0) y=(HEIGHT - 12.0) text-anchor="middle" {
                "noise sigma on the scale of 255"
            }
            text x="14" y=(HEIGHT / 2.0) text-anchor="middle"
                transform={ "rotate(-90 14 " (HEIGHT / 2.0) ")" } {
                "PSNR in dB (" (record.algorithm) ")"
            }
        }
    };
    chart.into_string() + "\n"
}

fn polyline(points: Vec<(f64, f64)>, name: &str, index: usize) -> Markup {
    let colour = ["#0b57a8", "#b3541e"][index % 2];
    let (left, label) = (PLANE[0], 22.0 + 18.0 * index as f64);
    let path: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    html! {
        polyline points=(path.join(" ")) fill="none" stroke=(colour) stroke-width="2" {}
        @for (x, y) in &points { circle cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r="3" fill=(colour) {} }
        line x1=(left) y1=(label - 4.0) x2=(left + 24.0) y2=(label - 4.0) stroke=(colour) stroke-width="2" {}
        text x=(left + 30.0) y=(label) { (name) }
    }
}

#[cfg(test)]
mod tests {
    use super::crossing;

    #[test]
    fn a_crossing_lies_between_two_levels() {
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
