//! Networks as priors: FFDNet, frame by frame (Zhang, Zuo and Zhang, IEEE TIP 2018), and FastDVDNet over whole
//! clips (Tassano et al., CVPR 2020), with floating point or 8 bits.

use std::ops::Range;

use ndarray::{Array3, Array4, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut2, Axis};

use super::onnx::{ClipNetwork, Runtime};
use super::{
    BLOCK, CHANNELS, Denoiser, Encoder, Memory, Network, Networks, Parameter, Pass, Prior, Ready,
    SIGMA, Settings,
};
use crate::error::{ReconError, Result};

/// FFDNet, frame by frame.
pub const FFDNET: NetworkPrior = NetworkPrior {
    name: "ffdnet",
    summary: "FFDNet, frame by frame",
    network: Network::FfdNet,
    pass_ns: 1_450.0,
    memory: FLOAT_MEMORY,
};
/// FastDVDNet over the clip, with a shared first stage.
pub const FASTDVDNET: NetworkPrior = NetworkPrior {
    name: "fastdvdnet",
    summary: "FastDVDNet over the clip",
    network: Network::FastDvdNet,
    pass_ns: 4_900.0,
    memory: Memory { per_network_pixel: FLOAT_MEMORY.per_network_pixel + ENCODER, ..FLOAT_MEMORY },
};
/// The same with weights and activations of 8 bits.
pub const FASTDVDNET_INT8: NetworkPrior = NetworkPrior {
    name: "fastdvdnet-int8",
    summary: "FastDVDNet with weights and activations of 8 bits",
    network: Network::FastDvdNetInt8,
    // 0.36 of it, with AVX-512 VNNI.
    pass_ns: 1_800.0,
    // It stays loaded beside its twin.
    memory: Memory {
        per_network_pixel: FLOAT_MEMORY.per_network_pixel + 2000 + ENCODER,
        ..FLOAT_MEMORY
    },
};

/// Padded input, middle and output for each voxel, and the activations.
const FLOAT_MEMORY: Memory = Memory { per_voxel: 24, per_network_pixel: 2600 };
/// Bytes for each pixel of a frame of the encoder by which results are assessed.
const ENCODER: u64 = 1100;

/// A network alone.
pub struct NetworkPrior {
    name: &'static str,
    summary: &'static str,
    network: Network,
    pass_ns: f64,
    memory: Memory,
}

impl Prior for NetworkPrior {
    fn name(&self) -> &'static str {
        self.name
    }

    fn summary(&self) -> &'static str {
        self.summary
    }

    fn parameters(&self) -> Vec<&'static Parameter> {
        vec![&SIGMA]
    }

    fn network(&self) -> Option<Network> {
        Some(self.network)
    }

    fn cost(&self, _: &Settings) -> f64 {
        self.pass_ns
    }

    fn looks_along_time(&self, _: &Settings) -> bool {
        self.network != Network::FfdNet
    }

    fn memory(&self) -> Memory {
        self.memory
    }

    fn begin(&self, _: (usize, usize, usize)) -> Box<dyn Pass> {
        Box::new(self.network)
    }
}

impl Pass for Network {
    fn apply(
        &mut self,
        x: &mut Array3<f32>,
        rows: Range<usize>,
        settings: &Settings,
        networks: &mut dyn Networks,
        ready: &mut Ready<'_>,
    ) -> Result<()> {
        networks.network(*self)?.denoise(x, settings.sigma)?;
        (0..x.dim().0).for_each(|k| ready(x, k, rows.clone()));
        Ok(())
    }
}

/// Pixels that go through a block at once, whole frames: more would take more memory and no less time.
const PIXELS_AT_ONCE: usize = 2 * 256 * 256;

/// A network for gray clips, loaded.
///
/// FFDNet is one block, from a frame to a frame. FastDVDNet is two, each of which denoises the middle of three
/// frames: the first runs once for each triplet of the clip and serves three outputs, so a frame costs 2 blocks,
/// not 4. Frames go through in chunks, which bounds the memory whatever the number of frames and changes no bit.
pub struct ClipDenoiser {
    blocks: Vec<ClipNetwork>,
    /// Frames before and after a frame that a block looks at.
    reach: usize,
    /// Sides must be multiples of it: a network halves them once or twice.
    multiple: usize,
    input: Vec<f32>,
    output: Vec<f32>,
}

impl ClipDenoiser {
    /// Loads a network from its ONNX files, a block each (see [`ClipNetwork::load`] for their faces).
    pub fn load(runtime: &Runtime, which: Network, files: &[impl AsRef<[u8]>]) -> Result<Self> {
        let (names, reach, multiple): (&[_], _, _) = match which {
            Network::FfdNet => (&["FFDNet"], 0, 2),
            Network::FastDvdNet | Network::FastDvdNetInt8 => {
                (&["FastDVDNet stage 1", "FastDVDNet stage 2"], 1, 4)
            }
        };
        let files = names.iter().zip(files);
        let blocks = files.map(|(name, file)| ClipNetwork::load(runtime, name, file.as_ref()));
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

/// The first half of FastDVDNet's first stage, loaded: what the denoiser sees of a block and its two
/// neighbours in time before it begins to draw it.
pub struct ClipEncoder {
    network: ClipNetwork,
    input: Vec<f32>,
    output: Vec<f32>,
}

/// The noise that it is told of: as little as there is in frames of a reconstruction.
const LITTLE_NOISE: f32 = 10.0 / 255.0;

impl ClipEncoder {
    /// Loads it from its ONNX file (see [`ClipNetwork::load`] for its face).
    pub fn load(runtime: &Runtime, file: &[u8]) -> Result<Self> {
        let network = ClipNetwork::load(runtime, "FastDVDNet encoder", file)?;
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
        // Several frames at once would take as much memory each.
        let each = (1, CHANNELS * rows * columns);
        run_chunked(network, (input, output), padded, each, LITTLE_NOISE)?;
        let seen = ArrayView4::from_shape((count, CHANNELS, rows, columns), output)
            .map_err(|error| ReconError::Runtime(error.to_string()))?;
        Ok(seen.permuted_axes([1, 0, 2, 3]).as_standard_layout().into_owned())
    }
}

/// Copies a clip into one of frames of `rows` x `columns` pixels with so many more at both ends, mirrored in space
/// and time.
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

/// Copies a frame into one with rows of `columns` pixels and as many rows as fit, mirrored at its
/// lower and right ends.
fn pad_frame(frame: ArrayView2<'_, f32>, padded: &mut [f32], columns: usize) {
    let (height, width) = frame.dim();
    for (i, row) in padded.chunks_exact_mut(columns).enumerate() {
        let source = frame.row(reflect(i as isize, height));
        for (j, value) in row.iter_mut().enumerate() {
            *value = source[reflect(j as isize, width)];
        }
    }
}

/// Takes a frame out of one that was padded by [`pad_frame`].
fn unpad_frame(padded: &[f32], columns: usize, mut frame: ArrayViewMut2<'_, f32>) {
    for (mut row, padded) in frame.outer_iter_mut().zip(padded.chunks_exact(columns)) {
        row.iter_mut().zip(padded).for_each(|(value, &x)| *value = x);
    }
}

/// One block over a clip of `rows` x `columns` pixels, so many frames at a time, with so many values of
/// output for each.
fn run_chunked(
    block: &mut ClipNetwork,
    (input, output): (&[f32], &mut [f32]),
    (rows, columns): (usize, usize),
    (chunk, values): (usize, usize),
    sigma: f32,
) -> Result<()> {
    let plane = rows * columns;
    let beside = input.len() / plane - output.len() / values;
    for (index, output) in output.chunks_mut(chunk * values).enumerate() {
        let count = output.len() / values + beside;
        let frames = &input[index * chunk * plane..][..count * plane];
        let frames = ArrayView4::from_shape((count, 1, rows, columns), frames)
            .map_err(|error| ReconError::Runtime(error.to_string()))?;
        block.run(frames, sigma, output)?;
    }
    Ok(())
}

/// The index inside `0..length` that mirrors `index` at the ends, without repeating them.
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
        let seen: Vec<usize> = (-3..7).map(|index| reflect(index, 4)).collect();
        assert_eq!(seen, [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]);
        assert_eq!((reflect(-2, 1), reflect(5, 1)), (0, 0));
        assert_eq!((reflect(-2, 2), reflect(2, 2)), (0, 0));
    }
}
