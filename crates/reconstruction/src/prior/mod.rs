//! Priors: what may stand for `D` in `v = D(x)`.
//!
//! Each is described once, by its [`Prior`]: what a schedule may say of it, what it costs, and how it is
//! computed. A new one is a file here and its line in [`registry::PRIORS`].

pub mod network;
pub mod nonlocal;
pub mod onnx;
pub mod registry;
pub mod temporal;
pub mod tv;

use std::ops::{Bound, Range, RangeBounds};

use ndarray::{Array3, Array4, ArrayView3};
use schemars::Schema;

use super::error::{ReconError, Result};

/// A denoiser that a schedule's stage may name.
pub trait Prior: Sync {
    /// Its name in schedules.
    fn name(&self) -> &'static str;

    /// What it does, in a phrase.
    fn summary(&self) -> &'static str;

    /// The parameters that it takes; a stage must leave the others out.
    fn parameters(&self) -> Vec<&'static Parameter>;

    /// The network that it runs, if any.
    fn network(&self) -> Option<Network> {
        None
    }

    /// Cost of a pass, CPU-nanoseconds per voxel, measured on one core with AVX-512. Only ratios matter: what
    /// a machine really takes is learned from the tasks it has done.
    fn cost(&self, settings: &Settings) -> f64;

    /// Whether what it makes of a frame depends on other frames.
    fn looks_along_time(&self, _: &Settings) -> bool {
        true
    }

    /// Memory that it needs beside the solver's arrays.
    fn memory(&self) -> Memory {
        Memory::default()
    }

    /// Whether strips of rows may come one after the other, instead of all rows at once.
    fn by_strips(&self) -> bool {
        false
    }

    /// The prior at work on clips of (frames, height, width), for the iterations of one stage.
    fn begin(&self, size: (usize, usize, usize)) -> Box<dyn Pass>;

    /// Whether it takes this parameter.
    fn takes(&self, parameter: &Parameter) -> bool {
        self.parameters().iter().any(|own| own.name == parameter.name)
    }
}

/// A prior at work, with its memory.
pub trait Pass {
    /// `v = D(x)` in place of `x` \[B,H,W\], which is in standard layout and lives on \[0,1\].
    ///
    /// Of a prior that works by strips only `rows` have arrived, those before them in earlier calls; of any
    /// other they are all rows. `ready` is told of the rows of each frame that are done now.
    fn apply(
        &mut self,
        x: &mut Array3<f32>,
        rows: Range<usize>,
        settings: &Settings,
        networks: &mut dyn Networks,
        ready: &mut Ready<'_>,
    ) -> Result<()>;
}

/// Is told the clip, a frame, and rows of the frame that are done.
pub type Ready<'a> = dyn FnMut(&Array3<f32>, usize, Range<usize>) + 'a;

/// What a stage tells its prior in an iteration.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Noise level: the standard deviation on the \[0,1\] scale of the frames; 0 for a prior that is told
    /// none.
    pub sigma: f32,
    /// Weight of the total variation, on the \[0,1\] scale; 0 for none.
    pub tv_weight: f32,
    /// Dual updates of the total variation.
    pub tv_updates: usize,
    /// Weight of the total variation along time; 0 for none.
    pub temporal_weight: f32,
    /// Changes along time below this times `sigma` are shrunk; 0 shrinks none.
    pub temporal_shrinkage: f32,
}

/// Bytes that a prior needs, measured.
#[derive(Debug, Clone, Copy, Default)]
pub struct Memory {
    /// For each voxel of a tile.
    pub per_voxel: u64,
    /// For each pixel of the frames that its network takes at once.
    pub per_network_pixel: u64,
}

impl Memory {
    /// The larger of both, field by field.
    pub fn most(self, other: Self) -> Self {
        Self {
            per_voxel: self.per_voxel.max(other.per_voxel),
            per_network_pixel: self.per_network_pixel.max(other.per_network_pixel),
        }
    }
}

/// A number that a schedule may hold.
#[derive(Debug, Clone, Copy)]
pub struct Parameter {
    /// Its name.
    pub name: &'static str,
    /// Whether a stage must give it if its prior takes it.
    pub needed: bool,
    /// The values that it may have.
    pub range: (Bound<f64>, Bound<f64>),
    /// The same in words.
    pub words: &'static str,
}

/// Noise level at the first and the last iteration of a stage.
pub const SIGMA: Parameter = Parameter {
    name: "sigma",
    needed: true,
    range: (Bound::Excluded(0.0), Bound::Included(1.0)),
    words: "above 0 and at most 1 (a level of 25 grey values is 25/255 = 0.098)",
};
/// Weight of the total variation of each frame.
pub const TV_WEIGHT: Parameter = Parameter { needed: true, ..Parameter::not_negative("tv_weight") };
/// Dual updates of the total variation.
pub const TV_UPDATES: Parameter = Parameter {
    name: "tv_updates",
    needed: false,
    range: (Bound::Included(1.0), Bound::Included(1000.0)),
    words: "from 1 to 1000",
};
/// Weight of the total variation along time.
pub const TEMPORAL_WEIGHT: Parameter = Parameter::not_negative("temporal_weight");
/// Level below which changes along time are shrunk, in units of the noise level.
pub const TEMPORAL_SHRINKAGE: Parameter = Parameter::not_negative("temporal_shrinkage");

impl Parameter {
    /// One that may be any number from 0.
    pub const fn not_negative(name: &'static str) -> Self {
        let range = (Bound::Included(0.0), Bound::Unbounded);
        Self { name, needed: false, range, words: "a finite number of at least 0" }
    }

    /// One that may be any share below 1.
    pub const fn share(name: &'static str) -> Self {
        let range = (Bound::Included(0.0), Bound::Excluded(1.0));
        Self { name, needed: false, range, words: "at least 0 and below 1" }
    }

    /// Writes the range into the JSON schema of a number, or of the numbers of an array.
    pub fn bounds(&self) -> impl Fn(&mut Schema) + use<> {
        let (least, most) = self.range;
        move |schema| {
            let numbers = match schema.get_mut("items").and_then(|items| items.as_object_mut()) {
                Some(items) => items,
                None => schema.ensure_object(),
            };
            for (bound, included, excluded) in
                [(least, "minimum", "exclusiveMinimum"), (most, "maximum", "exclusiveMaximum")]
            {
                // Some types come with bounds of their own.
                numbers.remove(included);
                match bound {
                    Bound::Included(value) => numbers.insert(included.into(), value.into()),
                    Bound::Excluded(value) => numbers.insert(excluded.into(), value.into()),
                    Bound::Unbounded => None,
                };
            }
        }
    }

    /// Refuses a value outside the range.
    pub fn check(&self, value: f32) -> Result<()> {
        if value.is_finite() && self.range.contains(&f64::from(value)) {
            return Ok(());
        }
        Err(self.refused(value.to_string(), self.words))
    }

    /// The error that says what is wrong with it and what would be right.
    pub fn refused(&self, value: impl Into<String>, range: &'static str) -> ReconError {
        ReconError::Parameter { name: self.name, value: value.into(), range }
    }
}

/// A network that denoises clips.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Network {
    /// FFDNet, frame by frame.
    FfdNet,
    /// FastDVDNet, five frames at a time.
    FastDvdNet,
    /// The same with weights and activations of 8 bits: about three times as fast on a CPU, and a little
    /// less exact.
    FastDvdNetInt8,
}

impl Network {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::FfdNet, Self::FastDvdNet, Self::FastDvdNetInt8];
}

/// A loaded network.
pub trait Denoiser {
    /// Removes noise of level `sigma` from frames \[B,H,W\], both on the \[0,1\] scale, in place. The array
    /// is in standard layout.
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()>;
}

/// A loaded network that tells what blocks of frames look like.
pub trait Encoder {
    /// What it sees of each block of [`BLOCK`] x [`BLOCK`] pixels \[[`CHANNELS`], B, rows, columns\] of
    /// frames \[B,H,W\] on the \[0,1\] scale. Blocks at the far edges are filled up with mirrored pixels.
    fn encode(&mut self, frames: ArrayView3<'_, f32>) -> Result<Array4<f32>>;
}

/// Side of the blocks of which an encoder tells, in pixels.
pub const BLOCK: usize = 16;
/// How many values an encoder has for a block.
pub const CHANNELS: usize = 128;

/// Where the solver gets its networks from.
pub trait Networks {
    /// The network, loaded at its first use.
    fn network(&mut self, which: Network) -> Result<&mut dyn Denoiser>;

    /// The encoder, loaded at its first use; none where there is none.
    fn encoder(&mut self) -> Result<Option<&mut dyn Encoder>> {
        Ok(None)
    }
}

/// No networks at all.
impl Networks for () {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser> {
        Err(ReconError::NoDenoiser)
    }
}
