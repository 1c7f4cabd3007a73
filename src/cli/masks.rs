//! The options of simulated masks, which all simulating commands share.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use ndarray::{Array2, Array3, Axis};
use serde::Serialize;
use strum::IntoStaticStr;

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::cli::optics::OpticsFile;
use engine::intake::read_clip;
use optics::{
    HybridAperture, Method, Multiplexing, Normalisation, Placement, check_patterns, generator,
    iid_masks, pattern_rank, single_apertures, soften,
};

/// Options of the masks.
#[derive(Debug, Args)]
pub struct MaskArguments {
    /// Kind of masks.
    #[arg(long, default_value = "random-squares")]
    pattern: Pattern,
    /// Optical parameters as TOML (see `sci-recon optics`) [default: the paper's].
    #[arg(long, value_name = "FILE")]
    optics: Option<PathBuf>,
    /// Aperture patterns, one for each frame, for --pattern images: what each part of the LCoS
    /// transmits (a stack or a folder of PNGs, of any size up to the LCoS's).
    #[arg(long, value_name = "FILE", required_if_eq("pattern", "images"))]
    images: Option<PathBuf>,
    /// The lithography mask, a picture of at least the sensor's size; its centre is used [default:
    /// random, half of it open].
    #[arg(long, value_name = "FILE")]
    lithography: Option<PathBuf>,
    /// Meaning of a mask value of 1.
    #[arg(long, value_name = "HOW", default_value = "maximum")]
    normalise: Normalise,
    /// Blur of the masks by a lens, beyond that of the optics: standard deviation in sensor pixels.
    #[arg(long, value_name = "PIXELS", default_value_t = 0.0)]
    blur: f64,
    /// Light that closed pixels transmit, as a share of the light of open ones.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    leak: f32,
}

/// Kinds of masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
enum Pattern {
    /// Independent binary pixels, half of them open, as in the public benchmark.
    Iid,
    /// The hybrid coded aperture: a lithography mask seen through random sub-apertures.
    RandomSquares,
    /// The lithography mask seen through an open circle that turns from frame to frame.
    RotatingCircle,
    /// The lithography mask seen through one sub-aperture in each frame: no multiplexing.
    SingleApertures,
    /// The lithography mask seen through custom patterns (--images).
    Images,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Normalise {
    /// The largest value of all masks, as after a calibration.
    Maximum,
    /// The light of the whole open aperture without a mask.
    Throughput,
}

#[derive(Debug, Serialize)]
pub struct Apertures {
    rows: usize,
    columns: usize,
    rank: usize,
    /// For each frame, `1` for each open sub-aperture and `0` for each closed one, row by row. `None` for patterns
    /// without a grid.
    open: Option<Vec<String>>,
}

/// Masks, and properties of their aperture.
pub struct SimulatedMasks {
    /// \[B,H,W\] on \[0,1\].
    pub masks: Array3<f32>,
    /// Share of the light of the whole open aperture, without a mask, that the masks pass.
    pub throughput: f64,
    /// That share where a mask is 1.
    pub scale: f32,
    /// `None` for masks without an aperture.
    pub apertures: Option<Apertures>,
}

impl MaskArguments {
    pub fn pattern(&self) -> &'static str {
        self.pattern.into()
    }

    /// The pattern, the blur and the leak as text, such as `iid, blur 0.7, leak 0.1`.
    pub fn described(&self) -> String {
        let mut text = self.pattern().to_owned();
        if self.blur != 0.0 {
            text += &format!(", blur {}", self.blur);
        }
        if self.leak != 0.0 {
            text += &format!(", leak {}", self.leak);
        }
        text
    }

    /// Standard deviation of the lens's blur in sensor pixels.
    pub fn blur(&self) -> f64 {
        self.blur
    }

    /// Share of light that closed pixels transmit.
    pub fn leak(&self) -> f32 {
        self.leak
    }

    pub fn optics(&self) -> Result<OpticsFile> {
        OpticsFile::read(self.optics.as_deref())
    }

    /// Simulates masks of frames x rows x columns.
    pub fn make(
        &self,
        optics: &OpticsFile,
        size: (usize, usize, usize),
        seed: u64,
    ) -> Result<SimulatedMasks> {
        let sharp = self.sharp(optics, size, seed)?;
        if self.blur == 0.0 && self.leak == 0.0 {
            return Ok(sharp);
        }
        let SimulatedMasks { mut masks, mut scale, apertures, .. } = sharp;
        soften(&mut masks, self.blur, self.leak)?;
        if self.normalise == Normalise::Maximum {
            let largest = masks.iter().copied().fold(0.0, f32::max);
            if largest > 0.0 {
                masks.mapv_inplace(|mask| mask / largest);
                scale *= largest;
            }
        }
        let throughput = f64::from(masks.mean().unwrap_or(0.0)) * f64::from(scale);
        Ok(SimulatedMasks { masks, throughput, scale, apertures })
    }

    /// Simulates the masks without blur and leak.
    fn sharp(
        &self,
        optics: &OpticsFile,
        (frames, height, width): (usize, usize, usize),
        seed: u64,
    ) -> Result<SimulatedMasks> {
        if self.pattern == Pattern::Iid {
            let masks = iid_masks(frames, height, width, seed)?;
            let throughput = f64::from(masks.mean().unwrap_or(0.0));
            return Ok(SimulatedMasks { masks, throughput, scale: 1.0, apertures: None });
        }
        let mut rng = generator(seed);
        let grid = optics.grid(frames)?;
        let patterns = match self.pattern {
            Pattern::RotatingCircle => optics.circle.patterns(frames, &optics.geometry())?,
            Pattern::SingleApertures => single_apertures(frames, grid, &mut rng)?,
            Pattern::Images => self.images(frames)?,
            Pattern::RandomSquares | Pattern::Iid => {
                let draw = optics.draw(grid)?;
                Multiplexing::random(frames, grid.count(), draw, &mut rng)?.patterns(grid)
            }
        };
        let projected = self.aperture(optics)?.masks(patterns.view(), (height, width), &mut rng)?;
        Ok(SimulatedMasks {
            masks: projected.masks,
            throughput: projected.throughput,
            scale: projected.scale,
            apertures: Some(self.apertures(&patterns)),
        })
    }

    fn on_grid(&self) -> bool {
        matches!(self.pattern, Pattern::RandomSquares | Pattern::SingleApertures)
    }

    fn aperture(&self, optics: &OpticsFile) -> Result<HybridAperture> {
        let (placement, method) = if self.on_grid() {
            (optics.projection.placement, optics.projection.method)
        } else {
            (Placement::Geometric, Method::Convolution)
        };
        Ok(HybridAperture {
            geometry: optics.geometry(),
            placement,
            method,
            lithography: self.lithography()?,
            normalisation: match self.normalise {
                Normalise::Maximum => Normalisation::Maximum,
                Normalise::Throughput => Normalisation::Throughput,
            },
        })
    }

    fn images(&self, frames: usize) -> Result<Array3<f32>> {
        let missing = || CliError::Input("--pattern images needs --images".into());
        let patterns = read_clip(self.images.as_deref().ok_or_else(missing)?, None)?;
        check_patterns(patterns.view(), frames)?;
        Ok(patterns)
    }

    fn lithography(&self) -> Result<Option<Array2<f32>>> {
        let Some(path) = &self.lithography else { return Ok(None) };
        let stack = read_clip(path, None)?;
        match stack.dim().0 {
            1 => Ok(Some(stack.index_axis_move(Axis(0), 0))),
            count => Err(CliError::Input(format!(
                "the lithography mask {} is a stack of {count} pictures; it must be one",
                path.display()
            ))),
        }
    }

    fn apertures(&self, patterns: &Array3<f32>) -> Apertures {
        let (_, rows, columns) = patterns.dim();
        let digit = |&open: &f32| if open > 0.0 { '1' } else { '0' };
        let open = patterns.outer_iter().map(|pattern| pattern.iter().map(digit).collect());
        let open = self.on_grid().then(|| open.collect());
        Apertures { rows, columns, rank: pattern_rank(patterns.view()), open }
    }
}
