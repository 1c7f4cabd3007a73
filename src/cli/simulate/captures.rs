//! Simulates the raw captures that a lab would take: 16-bit numbers and an index.

use std::fs;
use std::path::Path;

use ndarray::{Array2, ArrayView2, ArrayView3, Axis};
use serde::Serialize;

use crate::cli::CliError;
use crate::cli::error::Result;
use engine::job::Captures;
use formats::npy;
use optics::{Camera, generator, measure};

/// Share of the background that the lithography mask transmits.
const BACKGROUND_THROUGH_MASK: f64 = 0.5;

/// The content of `captures.json`: the files of each capture, and the scale of their numbers.
#[derive(Debug, Serialize)]
struct Index {
    schema: &'static str,
    #[serde(flatten)]
    captures: Captures<String>,
    measurement: Measurement,
}

#[derive(Debug, Serialize)]
struct Measurement {
    data: String,
    /// Captures with the LCoS all black, at the exposure of the measurement.
    dark: Vec<String>,
    /// The number that means 1 after the dark is subtracted, with masks whose largest value is 1.
    full_scale: f32,
    saturation: u16,
}

pub(super) struct Lab<'a> {
    pub(super) camera: Camera,
    /// Relative light \[H,W\] of the white board.
    pub(super) illumination: ArrayView2<'a, f32>,
    /// Masks \[B,H,W\].
    pub(super) masks: ArrayView3<'a, f32>,
    /// Share of the whole aperture's light that a mask value of 1 transmits.
    pub(super) scale: f32,
    pub(super) repeats: usize,
    pub(super) seed: u64,
}

impl Lab<'_> {
    /// Writes all captures of a calibration, and the measurement of `scene`. The scene contains the frames of all
    /// snapshots in order, with the illumination. Returns the measurement's full scale.
    pub(super) fn write(
        &self,
        folder: &Path,
        snapshots: usize,
        scene: ArrayView3<'_, f32>,
    ) -> Result<f32> {
        fs::create_dir_all(folder).map_err(|error| CliError::file("make", folder, &error))?;
        let camera = self.camera;
        let dim = self.illumination.dim();
        let (exposure, closed) = (single(camera.calibration_exposure), Array2::zeros(dim));
        let masked_background = camera.background * BACKGROUND_THROUGH_MASK;
        let mut shots = Shots { lab: self, folder, stream: 2 };
        let mut masks = Vec::new();
        for (index, mask) in self.masks.outer_iter().enumerate() {
            let light = (&mask * &self.illumination) * (exposure * self.scale);
            masks.push(vec![shots.take(
                &format!("mask_{:02}.npy", index + 1),
                &light,
                masked_background,
            )?]);
        }
        let white = &self.illumination * exposure;
        let index = Index {
            schema: "sci-recon/captures/1",
            captures: Captures {
                masks,
                white: vec![shots.take("white.npy", &white, camera.background)?],
                black: vec![shots.take("black.npy", &closed, camera.background)?],
                black_with_mask: vec![shots.take(
                    "black_with_mask.npy",
                    &closed,
                    masked_background,
                )?],
                patterns: None,
                saturation: Some(camera.saturation().into()),
            },
            measurement: Measurement {
                dark: vec![shots.take("scene_black.npy", &closed, masked_background)?],
                data: self.snapshots(&mut shots, snapshots, scene, masked_background)?,
                full_scale: self.full_scale(),
                saturation: camera.saturation(),
            },
        };
        let text = serde_json::to_string_pretty(&index)
            .map_err(|error| CliError::Failure(format!("captures.json: {error}")))?;
        let path = folder.join("captures.json");
        fs::write(&path, text + "\n").map_err(|error| CliError::file("write", &path, &error))?;
        Ok(index.measurement.full_scale)
    }

    fn full_scale(&self) -> f32 {
        let white = single(self.camera.measurement_exposure) * self.scale;
        white * f32::from(self.camera.saturation())
    }

    fn snapshots(
        &self,
        shots: &mut Shots<'_, '_>,
        count: usize,
        scene: ArrayView3<'_, f32>,
        background: f64,
    ) -> Result<String> {
        let exposure = single(self.camera.measurement_exposure) * self.scale;
        let mut lights = Vec::with_capacity(count);
        for clip in scene.axis_chunks_iter(Axis(0), self.masks.dim().0) {
            lights.push(measure(self.masks, clip)? * exposure);
        }
        shots.write("measurement.npy", count, |index| (&lights[index], background))
    }
}

/// Takes captures with independent noise.
struct Shots<'s, 'a> {
    lab: &'s Lab<'a>,
    folder: &'s Path,
    /// Stream of the random generator. Streams 0 and 1 serve the masks and the noise of the float measurement.
    stream: u64,
}

impl Shots<'_, '_> {
    /// Writes all repeats of one capture, and returns the file's name.
    fn take(&mut self, name: &str, light: &Array2<f32>, background: f64) -> Result<String> {
        self.write(name, self.lab.repeats, |_| (light, background))
    }

    fn write<'l>(
        &mut self,
        name: &str,
        count: usize,
        light: impl Fn(usize) -> (&'l Array2<f32>, f64),
    ) -> Result<String> {
        let mut rng = generator(self.lab.seed);
        rng.set_stream(self.stream);
        self.stream += 1;
        let (height, width) = self.lab.illumination.dim();
        npy::write_u16(&self.folder.join(name), (count, height, width), |index| {
            let (light, background) = light(index);
            let capture = self.lab.camera.capture(light.view(), background, &mut rng);
            capture.map_err(CliError::from)
        })?;
        Ok(name.to_owned())
    }
}

#[allow(clippy::cast_possible_truncation)] // pictures have single precision
fn single(value: f64) -> f32 {
    value as f32
}
