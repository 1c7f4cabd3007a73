//! Networks as priors: FFDNet, frame by frame (Zhang, Zuo and Zhang, IEEE TIP 2018), and FastDVDNet over whole
//! clips (Tassano et al., CVPR 2020), with floating point or 8 bits.

use std::borrow::Cow;

use ndarray::{Array3, Array4, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut2, Axis};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::onnx::{ClipNetwork, Runtime};
use super::{
    BLOCK, CHANNELS, Denoiser, Encoder, Family, Network, Networks, Prior, Size, Spec, WorkingSet,
    noise_levels,
};
use crate::error::{ReconError, Result};

/// Declares the parameters of priors that are a network alone.
macro_rules! network_priors {
    ($($(#[$doc:meta])+ $spec:ident => $network:expr, $iteration_ns:expr, $working_set:expr;)+) => {$(
        $(#[$doc])+
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
        pub struct $spec {
            /// Noise level on [0, 1] at the first and the last iteration, geometric between them.
            #[schemars(transform = noise_levels)]
            pub sigma: [f32; 2],
        }

        impl Spec for $spec {
            fn family(&self) -> Family {
                Family::Learned
            }

            fn network(&self) -> Option<Network> {
                Some($network)
            }

            fn sigma(&self) -> Option<[f32; 2]> {
                Some(self.sigma)
            }

            fn set_sigma(&mut self, sigma: [f32; 2]) {
                self.sigma = sigma;
            }

            fn iteration_ns(&self) -> f64 {
                $iteration_ns
            }

            fn looks_along_time(&self) -> bool {
                $network != Network::FfdNet
            }

            fn working_set(&self) -> WorkingSet {
                $working_set
            }

            fn start<'n>(
                &self,
                _: Size,
                networks: &'n mut dyn Networks,
            ) -> Result<Box<dyn Prior + 'n>> {
                Ok(Box::new(NetworkPrior(networks.network($network)?)))
            }
        }
    )+};
}

/// Padded input, middle and output for each voxel, and the activations.
const FLOAT: WorkingSet = WorkingSet { per_voxel: 24, per_network_pixel: 2600 };
/// Bytes of the quality model's encoder for each pixel of a frame.
const ENCODER_BYTES: u64 = 1100;
/// Bytes of the 8-bit network for each pixel, which stays loaded together with the floating-point one.
const INT8_BYTES: u64 = 2000;

network_priors! {
    /// Parameters of FFDNet, frame by frame.
    FfdnetSpec => Network::FfdNet, 1_450.0, FLOAT;
    /// Parameters of FastDVDNet over the clip.
    FastdvdnetSpec => Network::FastDvdNet, 4_900.0, float_and(ENCODER_BYTES);
    /// Parameters of FastDVDNet with weights and activations of 8 bits.
    FastdvdnetInt8Spec => Network::FastDvdNetInt8, 1_800.0, float_and(INT8_BYTES + ENCODER_BYTES);
}

/// The working set in floating point, with more bytes for each network pixel.
fn float_and(bytes: u64) -> WorkingSet {
    WorkingSet { per_network_pixel: FLOAT.per_network_pixel + bytes, ..FLOAT }
}

/// A loaded network as a prior.
struct NetworkPrior<'n>(&'n mut dyn Denoiser);

impl Prior for NetworkPrior<'_> {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        self.0.denoise(frames, sigma)
    }
}

/// Pixels that a block processes at once, in whole frames. More take more memory and no less time.
const PIXELS_AT_ONCE: usize = 2 * 256 * 256;

/// A network for gray clips, loaded.
///
/// FFDNet is one block, from a frame to a frame. FastDVDNet is two, each of which denoises the middle of three
/// frames: the first runs once for each triplet of the clip and serves three outputs, so a frame costs 2 blocks,
/// not 4. Frames go through in chunks, which bounds the memory whatever the number of frames and changes no bit.
pub struct ClipDenoiser {
    blocks: Vec<ClipNetwork>,
    /// Number of frames before and after a frame that a block uses.
    reach: usize,
    /// Divisor of both sides, because a network halves them once or twice.
    multiple: usize,
    input: Vec<f32>,
    output: Vec<f32>,
}

impl ClipDenoiser {
    /// Loads a network from its ONNX files, a block each (see [`ClipNetwork::load`] for their inputs and outputs).
    pub fn load(
        runtime: &Runtime,
        which: Network,
        files: impl IntoIterator<Item = Cow<'static, [u8]>>,
    ) -> Result<Self> {
        let (names, reach, multiple): (&[_], _, _) = match which {
            Network::FfdNet => (&["FFDNet"], 0, 2),
            Network::FastDvdNet | Network::FastDvdNetInt8 => {
                (&["FastDVDNet stage 1", "FastDVDNet stage 2"], 1, 4)
            }
        };
        let files = names.iter().zip(files);
        let blocks = files.map(|(name, file)| ClipNetwork::load(runtime, name, file));
        let blocks = blocks.collect::<Result<_, _>>()?;
        Ok(Self { blocks, reach, multiple, input: Vec::new(), output: Vec::new() })
    }
}

impl Denoiser for ClipDenoiser {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        let Self { blocks, reach, multiple, input, output } = self;
        let (_, height, width) = frames.dim();
        let (rows, columns) =
            (height.next_multiple_of(*multiple), width.next_multiple_of(*multiple));
        let plane = rows * columns;
        pad(frames.view(), input, (rows, columns), *reach * blocks.len());
        let chunk = (PIXELS_AT_ONCE / plane).max(1);
        for block in blocks {
            output.resize(input.len() - 2 * *reach * plane, 0.0);
            run_chunked(block, (input, output), (rows, columns), (chunk, plane), sigma)?;
            std::mem::swap(input, output);
        }
        for (frame, output) in frames.outer_iter_mut().zip(input.chunks_exact(plane)) {
            unpad_frame(output, columns, frame);
        }
        Ok(())
    }
}

/// The first half of FastDVDNet's first stage, loaded: its features of a block and its two neighbours in time.
pub struct ClipEncoder {
    network: ClipNetwork,
    input: Vec<f32>,
    output: Vec<f32>,
}

/// Noise level given to the encoder: about that of reconstructed frames.
const ENCODER_SIGMA: f32 = 10.0 / 255.0;

impl ClipEncoder {
    /// Loads it from its ONNX file (see [`ClipNetwork::load`] for its inputs and outputs).
    pub fn load(runtime: &Runtime, file: &'static [u8]) -> Result<Self> {
        let network = ClipNetwork::load(runtime, "FastDVDNet encoder", file.into())?;
        Ok(Self { network, input: Vec::new(), output: Vec::new() })
    }
}

impl Encoder for ClipEncoder {
    fn encode(&mut self, frames: ArrayView3<'_, f32>) -> Result<Array4<f32>> {
        let Self { network, input, output } = self;
        let (count, height, width) = frames.dim();
        let (rows, columns) = (height.div_ceil(BLOCK), width.div_ceil(BLOCK));
        let padded = (rows * BLOCK, columns * BLOCK);
        pad(frames, input, padded, 1);
        output.resize(count * CHANNELS * rows * columns, 0.0);
        // Several frames at once would multiply the memory.
        let each = (1, CHANNELS * rows * columns);
        run_chunked(network, (input, output), padded, each, ENCODER_SIGMA)?;
        let features = ArrayView4::from_shape((count, CHANNELS, rows, columns), output)
            .map_err(|error| ReconError::Runtime(error.to_string()))?;
        Ok(features.permuted_axes([1, 0, 2, 3]).as_standard_layout().into_owned())
    }
}

/// Copies a clip into one of frames of `rows` x `columns` pixels, with `margin` more frames at both ends, mirrored in
/// space and time.
fn pad(
    frames: ArrayView3<'_, f32>,
    padded: &mut Vec<f32>,
    (rows, columns): (usize, usize),
    margin: usize,
) {
    let count = frames.len_of(Axis(0));
    padded.resize((count + 2 * margin) * rows * columns, 0.0);
    for (k, padded) in padded.chunks_exact_mut(rows * columns).enumerate() {
        let frame = reflect(k as isize - margin as isize, count);
        pad_frame(frames.index_axis(Axis(0), frame), padded, columns);
    }
}

/// Copies a frame into one with rows of `columns` pixels and as many rows as fit, mirrored at its lower and right edges.
fn pad_frame(frame: ArrayView2<'_, f32>, padded: &mut [f32], columns: usize) {
    let (height, width) = frame.dim();
    for (i, row) in padded.chunks_exact_mut(columns).enumerate() {
        let source = frame.row(reflect(i as isize, height));
        for (j, value) in row.iter_mut().enumerate() {
            *value = source[reflect(j as isize, width)];
        }
    }
}

/// Inverse of [`pad_frame`].
fn unpad_frame(padded: &[f32], columns: usize, mut frame: ArrayViewMut2<'_, f32>) {
    for (mut row, padded) in frame.outer_iter_mut().zip(padded.chunks_exact(columns)) {
        row.iter_mut().zip(padded).for_each(|(value, &x)| *value = x);
    }
}

/// Runs one block over a clip of `rows` x `columns` pixels, `chunk` frames at a time, with `values` output values for
/// each.
fn run_chunked(
    block: &mut ClipNetwork,
    (input, output): (&[f32], &mut [f32]),
    (rows, columns): (usize, usize),
    (chunk, values): (usize, usize),
    sigma: f32,
) -> Result<()> {
    let plane = rows * columns;
    let margins = input.len() / plane - output.len() / values;
    for (index, output) in output.chunks_mut(chunk * values).enumerate() {
        let count = output.len() / values + margins;
        let frames = &input[index * chunk * plane..][..count * plane];
        let frames = ArrayView4::from_shape((count, 1, rows, columns), frames)
            .map_err(|error| ReconError::Runtime(error.to_string()))?;
        block.run(frames, sigma, output)?;
    }
    Ok(())
}

/// The index in `0..length` that mirrors `index` at the ends, without repeating them.
fn reflect(index: isize, length: usize) -> usize {
    if length == 1 {
        return 0;
    }
    let period = 2 * (length as isize - 1);
    let index = index.rem_euclid(period);
    index.min(period - index) as usize
}

#[cfg(test)]
mod tests {
    use super::reflect;

    #[test]
    fn reflection_mirrors_without_repeating_the_ends() {
        let reflected: Vec<usize> = (-3..7).map(|index| reflect(index, 4)).collect();
        assert_eq!(reflected, [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]);
        assert_eq!((reflect(-2, 1), reflect(5, 1)), (0, 0));
        assert_eq!((reflect(-2, 2), reflect(2, 2)), (0, 0));
    }
}
