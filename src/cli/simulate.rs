//! `sci-recon simulate`: simulates masks and a measurement of a known scene.

mod captures;

use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};
use serde::Serialize;

use super::CliError;
use super::arguments::{DispersionArguments, named};
use super::masks::{Apertures, MaskArguments, SimulatedMasks};
use super::optics::OpticsFile;
use crate::cli::error::Result;
use engine::intake::{read_clip, read_colours};
use formats::{Channels, npy};
use optics::{Dispersion, Mosaic, OpticsError, illumination, measure, noisy};

/// Simulate masks and measurements of a clip.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The scene: npy, npz, multi-page TIFF, a .mat scene's `orig`, or a folder of PNGs.
    #[arg(long, value_name = "FILE")]
    frames: PathBuf,
    /// The colours of the sensor's pixels, row by row of a 2x2 cell. The scene must then have colours: npy [frame, row,
    /// column, 3] or a folder of colour PNGs [default: a grey sensor].
    #[arg(long, value_name = "NAME", value_parser = named::<Mosaic>())]
    mosaic: Option<Mosaic>,
    #[command(flatten)]
    dispersion: DispersionArguments,
    /// Value in the frames' file that means 1 [default: 255 for uint8 and .mat scenes, 65535 for
    /// uint16, 1 for floats].
    #[arg(long, value_name = "VALUE")]
    full_scale: Option<f32>,
    /// Frames in one snapshot.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    compression_ratio: u16,
    /// Number of snapshots, each from the next frames of the scene.
    #[arg(long, value_name = "N", default_value_t = 1,
          value_parser = clap::value_parser!(u16).range(1..))]
    snapshots: u16,
    #[command(flatten)]
    masks: MaskArguments,
    /// Seed of the random numbers.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Also write the raw captures that a lab would take, with this number of repeats of each, as 16-bit numbers to the
    /// folder captures; captures.json there lists them.
    #[arg(long, value_name = "REPEATS", value_parser = clap::value_parser!(u16).range(1..=1000))]
    captures: Option<u16>,
    /// Noise of the measurement on the scale of 255 grey values: S/255 is the standard deviation
    /// added to y = sum C x, with x and C from 0 to 1.
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    noise_sigma: f32,
    /// Folder for masks.npy, measurement.npy, truth.npy and simulation.json.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
}

/// The content of `simulation.json`.
#[derive(Debug, Serialize)]
struct Record {
    program_version: &'static str,
    pattern: &'static str,
    /// Standard deviation of the masks' blur in sensor pixels.
    blur: f64,
    leak: f32,
    seed: u64,
    /// `None` for a grey sensor.
    mosaic: Option<Mosaic>,
    /// Displacement of the bands, which are the frames of the scene; `None` for a video.
    dispersion: Option<Dispersion>,
    compression_ratio: usize,
    snapshots: usize,
    height: usize,
    width: usize,
    /// Number of unused frames at the end of the scene.
    unused_frames: usize,
    /// Standard deviation of the noise on the measurement's scale.
    noise_sigma: f32,
    mask_mean: f32,
    /// Share of the light of the whole open aperture, without a mask, that the masks pass.
    light_throughput: f64,
    /// That share where a mask is 1.
    mask_scale: f32,
    /// Value of the measurement in `captures` that means 1. `None` without captures.
    capture_full_scale: Option<f32>,
    optics: OpticsFile,
    apertures: Option<Apertures>,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let frames = match arguments.mosaic {
        None => read_clip(&arguments.frames, arguments.full_scale)?,
        Some(_) => read_colours(&arguments.frames, arguments.full_scale)?,
    };
    let channels = if arguments.mosaic.is_some() { Channels::Rgb } else { Channels::Grey };
    check_range(&arguments.frames, &frames, channels)?;
    let ratio = usize::from(arguments.compression_ratio);
    let used = ratio * usize::from(arguments.snapshots);
    let (count, height, samples) = frames.dim();
    let width = samples / channels.count();
    if let Some(mosaic) = arguments.mosaic
        && !(height.is_multiple_of(2) && width.is_multiple_of(2))
    {
        return Err(CliError::Input(format!(
            "{} has frames of {height}x{width} (rows x columns); the mosaic {mosaic} needs an even number of both",
            arguments.frames.display()
        )));
    }
    if count < used {
        return Err(CliError::Input(format!(
            "{} has {count} frames, but {} snapshots of {ratio} frames need {used}",
            arguments.frames.display(),
            arguments.snapshots
        )));
    }
    let optics = arguments.masks.optics()?;
    let light = illumination((height, width), optics.vignetting())?;
    // The illumination is part of the scene, because a reconstruction can't separate them.
    let mut truth = frames.slice(s![..used, .., ..]).to_owned();
    for channel in 0..channels.count() {
        let mut values = truth.slice_mut(s![.., .., channel..;channels.count().cast_signed()]);
        values *= &light;
    }
    let dispersion = arguments.spectral()?;
    // One mask codes all bands.
    let (frames, mask_size) = match &dispersion {
        Some(bands) => (1, bands.mask_size((height, width))),
        None => (ratio, (height, width)),
    };
    let size = (frames, mask_size.0, mask_size.1);
    let simulated = arguments.masks.make(&optics, size, arguments.seed)?;
    let SimulatedMasks { masks, throughput, scale, apertures } = simulated;
    let sensor_frames = match (arguments.mosaic, &dispersion) {
        (None, None) => truth.clone(),
        (None, Some(bands)) => on_sensor(&truth, |band, k| bands.shear(band, k % ratio))?,
        (Some(mosaic), _) => {
            let mut sampled = Array3::zeros((used, height, width));
            for (mut frame, truth) in sampled.outer_iter_mut().zip(truth.outer_iter()) {
                frame.assign(&mosaic.sample(truth, (0, 0)));
            }
            sampled
        }
    };
    let scene = sensor_frames.view();
    let sheared = match &dispersion {
        Some(bands) => {
            let mask = masks.broadcast((ratio, mask_size.0, mask_size.1));
            let mask = mask.ok_or_else(|| CliError::Failure("there is no mask".into()))?;
            Some(on_sensor(&mask.to_owned(), |mask, k| bands.shear_mask(mask, k))?)
        }
        None => None,
    };
    let coding = sheared.as_ref().unwrap_or(&masks);
    let snapshots = measure_all(coding, scene, arguments.noise_sigma / 255.0, arguments.seed)?;
    let mut record = Record {
        program_version: env!("CARGO_PKG_VERSION"),
        pattern: arguments.masks.pattern(),
        blur: arguments.masks.blur(),
        leak: arguments.masks.leak(),
        seed: arguments.seed,
        mosaic: arguments.mosaic,
        dispersion,
        compression_ratio: ratio,
        snapshots: snapshots.len(),
        height,
        width,
        unused_frames: count - used,
        noise_sigma: arguments.noise_sigma / 255.0,
        mask_mean: masks.mean().unwrap_or(0.0),
        light_throughput: throughput,
        mask_scale: scale,
        capture_full_scale: None,
        optics,
        apertures,
    };
    fs::create_dir_all(&arguments.out)
        .map_err(|error| CliError::file("make", &arguments.out, &error))?;
    if let Some(repeats) = arguments.captures {
        let lab = captures::Lab {
            camera: record.optics.camera,
            illumination: light.view(),
            masks: masks.view(),
            scale,
            repeats: repeats.into(),
            seed: arguments.seed,
        };
        let full_scale = lab.write(&arguments.out.join("captures"), snapshots.len(), scene)?;
        record.capture_full_scale = Some(full_scale);
    }
    write(&arguments.out, &masks, &snapshots, (truth.view(), channels), &record)
}

impl Arguments {
    /// The dispersion, if the scene is spectral.
    fn spectral(&self) -> Result<Option<Dispersion>> {
        let dispersion = self.dispersion.resolve()?;
        let Some(bands) = &dispersion else { return Ok(None) };
        let ratio = usize::from(self.compression_ratio);
        let problem = if bands.bands() != ratio {
            format!(
                "there are {} offsets, but --compression-ratio {ratio}: state one offset for each band",
                bands.bands()
            )
        } else if self.mosaic.is_some() || self.captures.is_some() {
            "a spectral camera has a grey sensor and one mask: leave out --mosaic and --captures"
                .to_owned()
        } else {
            return Ok(dispersion);
        };
        Err(CliError::Input(format!("--dispersion-offsets: {problem}")))
    }
}

/// Displaces each image of a stack.
fn on_sensor(
    images: &Array3<f32>,
    displace: impl Fn(ArrayView2<'_, f32>, usize) -> Array2<f32>,
) -> Result<Array3<f32>> {
    let displaced = images.outer_iter().enumerate().map(|(k, image)| displace(image, k));
    let displaced: Vec<_> = displaced.collect();
    let views: Vec<_> = displaced.iter().map(|image| image.view()).collect();
    ndarray::stack(Axis(0), &views).map_err(|error| CliError::Failure(error.to_string()))
}

/// Simulates one measurement for each `B` frames of the truth.
fn measure_all(
    masks: &Array3<f32>,
    truth: ArrayView3<'_, f32>,
    sigma: f32,
    seed: u64,
) -> Result<Vec<Array2<f32>>> {
    let clips = truth.axis_chunks_iter(ndarray::Axis(0), masks.dim().0);
    let mut snapshots = Vec::with_capacity(clips.len());
    for (index, clip) in clips.enumerate() {
        let y = measure(masks.view(), clip)?;
        // Each snapshot has independent noise.
        snapshots.push(noisy(y, sigma, seed.wrapping_add(index as u64))?);
    }
    Ok(snapshots)
}

fn write(
    out: &Path,
    masks: &Array3<f32>,
    snapshots: &[Array2<f32>],
    (truth, channels): (ArrayView3<'_, f32>, Channels),
    record: &Record,
) -> Result<()> {
    let failed = |error| CliError::file("write", out, &error);
    match &record.dispersion {
        Some(_) => npy::write_image_f32(&out.join("masks.npy"), masks.index_axis(Axis(0), 0))?,
        None => npy::write_f32(&out.join("masks.npy"), masks.view())?,
    }
    match channels {
        Channels::Grey => npy::write_f32(&out.join("truth.npy"), truth)?,
        Channels::Rgb => npy::write_colours(&out.join("truth.npy"), truth)?,
    }
    let measurement = out.join("measurement.npy");
    match snapshots {
        [only] => npy::write_image_f32(&measurement, only.view())?,
        several => {
            let views: Vec<_> = several.iter().map(|y| y.view()).collect();
            let stack = ndarray::stack(ndarray::Axis(0), &views)
                .map_err(|error| CliError::Failure(error.to_string()))?;
            npy::write_f32(&measurement, stack.view())?;
        }
    }
    let text = serde_json::to_string_pretty(record)
        .map_err(|error| CliError::Failure(format!("simulation.json: {error}")))?;
    fs::write(out.join("simulation.json"), text + "\n").map_err(failed)
}

/// Refuses a scene with values outside \[0,1\], because its full scale is unknown.
fn check_range(path: &Path, frames: &Array3<f32>, channels: Channels) -> Result<()> {
    let outside = |value: f32| !(-1e-6..=1.0 + 1e-6).contains(&value);
    let Some(((k, i, j), value)) = frames.indexed_iter().find(|(_, v)| outside(**v)) else {
        return Ok(());
    };
    let j = j / channels.count();
    Err(CliError::Input(format!(
        "frames {}: {value} times the full scale at frame {k}, row {i}, column {j} (counted from \
         0); a scene must lie between 0 and its full scale: state --full-scale",
        path.display()
    )))
}

impl From<OpticsError> for CliError {
    fn from(error: OpticsError) -> Self {
        Self::Input(error.to_string())
    }
}
