//! Denoisers that stand for the prior in the loop.

pub mod fastdvdnet;
pub mod onnx;
pub mod tv;

use ndarray::Array3;

use super::error::ReconError;
use super::schedule::Sigma;

/// A learned video denoiser.
pub trait Denoiser {
    /// Removes noise of level `sigma` from frames \[B,H,W\] on \[0,1\], in place. The array is
    /// in standard layout.
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: Sigma) -> Result<(), ReconError>;
}
