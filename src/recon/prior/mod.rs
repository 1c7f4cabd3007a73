//! Denoisers that stand for the prior in the loop.

pub mod fastdvdnet;
pub mod ffdnet;
pub mod nonlocal;
pub mod onnx;
pub mod temporal;
pub mod tv;

use ndarray::Array3;

use super::error::ReconError;
use super::schedule::{Network, Sigma};

/// A learned denoiser.
pub trait Denoiser {
    /// Removes noise of level `sigma` from frames \[B,H,W\] on \[0,1\], in place. The array is
    /// in standard layout.
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: Sigma) -> Result<(), ReconError>;
}

/// Where the solver gets its networks from.
pub trait Networks {
    /// The network, loaded at its first use.
    fn network(&mut self, which: Network) -> Result<&mut dyn Denoiser, ReconError>;
}

/// No networks at all.
impl Networks for () {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser, ReconError> {
        Err(ReconError::NoDenoiser)
    }
}
