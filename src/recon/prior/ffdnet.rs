//! FFDNet, frame by frame (Zhang, Zuo and Zhang, IEEE TIP 2018).

use ndarray::{Array3, ArrayView4};

use super::Denoiser;
use super::fastdvdnet::{pad_frame, unpad_frame};
use super::onnx::{ClipNetwork, Runtime};
use crate::recon::error::ReconError;
use crate::recon::schedule::Sigma;

/// Pixels that go through the network at once, whole frames.
const PIXELS_AT_ONCE: usize = 2 * 256 * 256;

/// FFDNet, gray. It works on sub-images of half the size, with the noise level as one more channel.
pub struct FfdNet {
    network: ClipNetwork,
    padded: Vec<f32>,
    output: Vec<f32>,
}

impl FfdNet {
    /// Loads the ONNX model: frames \[n,1,H,W\] and `sigma` to frames \[n,1,H,W\].
    pub fn load(runtime: &Runtime, model: &[u8]) -> Result<Self, ReconError> {
        let network = ClipNetwork::load(runtime, "FFDNet", model)?;
        Ok(Self { network, padded: Vec::new(), output: Vec::new() })
    }
}

impl Denoiser for FfdNet {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: Sigma) -> Result<(), ReconError> {
        let (count, height, width) = frames.dim();
        let (rows, columns) = (height.next_multiple_of(2), width.next_multiple_of(2));
        let plane = rows * columns;
        let at_once = (PIXELS_AT_ONCE / plane).clamp(1, count);
        for start in (0..count).step_by(at_once) {
            let part = at_once.min(count - start);
            self.padded.resize(part * plane, 0.0);
            self.output.resize(part * plane, 0.0);
            for (k, padded) in self.padded.chunks_exact_mut(plane).enumerate() {
                pad_frame(frames.index_axis(ndarray::Axis(0), start + k), padded, columns);
            }
            let input = ArrayView4::from_shape((part, 1, rows, columns), &self.padded)
                .map_err(|error| ReconError::Runtime(error.to_string()))?;
            self.network.run(input, sigma.value(), &mut self.output)?;
            for (k, output) in self.output.chunks_exact(plane).enumerate() {
                let frame = frames.index_axis_mut(ndarray::Axis(0), start + k);
                unpad_frame(output, columns, frame);
            }
        }
        Ok(())
    }
}
