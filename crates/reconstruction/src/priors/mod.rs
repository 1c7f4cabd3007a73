//! Priors: the denoisers that stand for `D` in `v = D(x)`.
//!
//! A prior is a file in this folder with two parts: its parameters, which implement [`Spec`], and the prior at work, which
//! implements [`Prior`]. A line in [`registry`] gives it a name in schedules.

pub mod network;
pub mod nonlocal;
pub mod onnx;
pub mod registry;
pub mod temporal;
pub mod tv;
pub mod tv_fastdvdnet;

use std::fmt::Debug;

use ndarray::{Array3, Array4, ArrayView3};
use schemars::Schema;

use super::cores::Cores;
use super::error::{ReconError, Result};
#[cfg(feature = "gpu")]
use super::gpu::{adapter::Gpu, frames::DeviceFrames};
use super::projection::Projection;

/// Frames, height and width of a clip.
pub type Size = (usize, usize, usize);

/// The parameters of a prior, and the facts that follow from them.
pub trait Spec: Debug {
    /// The kind of prior, for progress displays.
    fn family(&self) -> Family;

    /// The network that the prior runs, if any.
    fn network(&self) -> Option<Network> {
        None
    }

    /// True if total variation with a weight above 0 is a part of the prior.
    fn has_total_variation(&self) -> bool {
        false
    }

    /// Noise level on \[0,1\] at the first and the last iteration, if the prior has one.
    fn sigma(&self) -> Option<[f32; 2]> {
        None
    }

    /// Sets [`Spec::sigma`]; no effect for a prior without one.
    fn set_sigma(&mut self, _: [f32; 2]) {}

    /// Cost of one iteration, CPU-nanoseconds per voxel, measured on one core with AVX-512. Only ratios matter: the
    /// speed of a machine is learned from the tasks it has done.
    fn iteration_ns(&self) -> f64;

    /// True if a result frame depends on its neighbours in time.
    fn looks_along_time(&self) -> bool {
        true
    }

    /// Memory in addition to the solver's arrays.
    fn working_set(&self) -> WorkingSet {
        WorkingSet::default()
    }

    /// Prepares the prior for the iterations of one stage, on clips of this size.
    ///
    /// # Errors
    /// The network is missing or fails to load.
    fn start<'n>(&self, size: Size, networks: &'n mut dyn Networks) -> Result<Box<dyn Prior + 'n>>;
}

/// A prior at work on the iterates of one stage.
pub trait Prior {
    /// Denoises whole frames \[S B,H,W\] in place. The array is in standard layout; `sigma` is the assumed noise level
    /// on \[0,1\].
    ///
    /// # Errors
    /// A network fails.
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()>;

    /// Denoises frames in the memory of a GPU, in place. A prior without kernels works on a copy.
    ///
    /// # Errors
    /// As [`Prior::denoise`]; the GPU is lost.
    #[cfg(feature = "gpu")]
    fn denoise_on_gpu(&mut self, frames: &DeviceFrames, sigma: f32) -> Result<()> {
        let mut copy = frames.read()?;
        self.denoise(&mut copy, sigma)?;
        frames.write(&copy);
        Ok(())
    }

    /// Projects, then denoises. A prior that can work on strips of rows overrides this, to keep a strip in cache between
    /// projection and denoising (see `tv.rs`).
    ///
    /// # Errors
    /// As [`Prior::denoise`].
    fn step(&mut self, projection: &mut Projection<'_>, sigma: f32) -> Result<Array3<f32>> {
        let mut frames = projection.all_rows();
        self.denoise(&mut frames, sigma)?;
        Ok(frames)
    }
}

/// Kinds of priors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Family {
    /// Total variation.
    TotalVariation,
    /// A learned denoiser.
    Learned,
    /// Groups of similar patches.
    Nonlocal,
}

/// Bytes that a prior needs (measured).
#[derive(Debug, Clone, Copy, Default)]
pub struct WorkingSet {
    /// For each voxel of a tile.
    pub per_voxel: u64,
    /// For each pixel of the frames that the network processes at once.
    pub per_network_pixel: u64,
}

impl WorkingSet {
    /// The larger of both, field by field.
    pub fn max(self, other: Self) -> Self {
        Self {
            per_voxel: self.per_voxel.max(other.per_voxel),
            per_network_pixel: self.per_network_pixel.max(other.per_network_pixel),
        }
    }
}

/// Writes the bounds of noise levels into the schema of [`Spec::sigma`].
pub(crate) fn noise_levels(schema: &mut Schema) {
    let items = serde_json::json!({
        "type": "number", "exclusiveMinimum": 0.0, "maximum": 1.0,
        "x-hint": "a level of 25 grey values is 25/255 = 0.098",
    });
    schema.insert("items".into(), items);
}

/// A network that denoises clips.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Network {
    /// FFDNet, frame by frame.
    FfdNet,
    /// FastDVDNet, five frames at a time.
    FastDvdNet,
    /// FastDVDNet with weights and activations of 8 bits: about three times as fast on a CPU, and slightly less exact.
    FastDvdNetInt8,
}

impl Network {
    /// All networks.
    pub const ALL: [Self; 3] = [Self::FfdNet, Self::FastDvdNet, Self::FastDvdNetInt8];
}

/// A loaded network.
pub trait Denoiser {
    /// Removes noise of level `sigma` from frames \[B,H,W\], both on the \[0,1\] scale, in place. The array is in
    /// standard layout.
    ///
    /// # Errors
    /// The runtime fails.
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()>;
}

/// A loaded network that describes blocks of frames by feature vectors.
pub trait Encoder {
    /// Features \[[`CHANNELS`], B, rows, columns\] of the blocks of [`BLOCK`] x [`BLOCK`] pixels of frames \[B,H,W\] on
    /// the \[0,1\] scale. Blocks at the far edges are completed with mirrored pixels.
    ///
    /// # Errors
    /// The runtime fails.
    fn encode(&mut self, frames: ArrayView3<'_, f32>) -> Result<Array4<f32>>;
}

/// Side of an encoder's blocks, in pixels.
pub const BLOCK: usize = 16;
/// Number of features of a block.
pub const CHANNELS: usize = 128;

/// A source of networks for the solver, and the cores that it may use.
pub trait Networks {
    /// The cores for priors; one, unless stated otherwise.
    fn cores(&self) -> Cores {
        Cores::default()
    }

    /// The network, loaded at its first use.
    ///
    /// # Errors
    /// It is missing or fails to load.
    fn network(&mut self, which: Network) -> Result<&mut dyn Denoiser>;

    /// The encoder, loaded at its first use, if there is one.
    ///
    /// # Errors
    /// It fails to load.
    fn encoder(&mut self) -> Result<Option<&mut dyn Encoder>> {
        Ok(None)
    }

    /// The GPU that keeps the variables and runs the solver's kernels, opened at its first use. Without one the CPU does.
    ///
    /// # Errors
    /// It can't be used.
    #[cfg(feature = "gpu")]
    fn gpu(&mut self) -> Result<Option<std::sync::Arc<Gpu>>> {
        Ok(None)
    }
}

/// A source without networks.
impl Networks for () {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser> {
        Err(ReconError::NoDenoiser)
    }
}
