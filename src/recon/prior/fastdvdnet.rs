//! FastDVDNet over whole clips (Tassano et al., CVPR 2020).

use ndarray::{Array3, ArrayView2, ArrayView4, ArrayViewMut2, Axis};

use super::Denoiser;
use super::onnx::{ClipNetwork, Runtime};
use crate::recon::error::ReconError;
use crate::recon::schedule::Sigma;

/// Pixels that go through a block at once: more would take more memory and no less time.
const PIXELS_AT_ONCE: usize = 2 * 256 * 256;

/// Frames of `plane` pixels that go through a block at once, if the clip has as many.
fn frames_at_once(plane: u64) -> u64 {
    (PIXELS_AT_ONCE as u64 / plane.max(1)).max(1)
}

/// The two blocks of FastDVDNet, gray.
///
/// Each block denoises the middle of three frames. The first stage runs once for each triplet
/// of the clip and serves three outputs, so a frame costs 2 blocks, not 4. Frames go through
/// in chunks, which bounds the memory whatever the number of frames and changes no bit.
pub struct FastDvdNet {
    first: ClipNetwork,
    second: ClipNetwork,
    padded: Vec<f32>,
    middle: Vec<f32>,
    output: Vec<f32>,
}

impl FastDvdNet {
    /// Loads the two blocks from ONNX models (see [`ClipNetwork::load`] for their faces).
    pub fn load(runtime: &Runtime, first: &[u8], second: &[u8]) -> Result<Self, ReconError> {
        Ok(Self {
            first: ClipNetwork::load(runtime, "FastDVDNet stage 1", first)?,
            second: ClipNetwork::load(runtime, "FastDVDNet stage 2", second)?,
            padded: Vec::new(),
            middle: Vec::new(),
            output: Vec::new(),
        })
    }
}

impl Denoiser for FastDvdNet {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: Sigma) -> Result<(), ReconError> {
        let (count, height, width) = frames.dim();
        // The network halves the size twice.
        let (rows, columns) = (height.next_multiple_of(4), width.next_multiple_of(4));
        let plane = rows * columns;
        self.padded.resize((count + 4) * plane, 0.0);
        self.middle.resize((count + 2) * plane, 0.0);
        self.output.resize(count * plane, 0.0);
        for (k, padded) in self.padded.chunks_exact_mut(plane).enumerate() {
            let frame = reflect(k as isize - 2, count);
            pad_frame(frames.index_axis(Axis(0), frame), padded, columns);
        }
        let size = (rows, columns);
        run_chunked(&mut self.first, &self.padded, &mut self.middle, size, sigma)?;
        run_chunked(&mut self.second, &self.middle, &mut self.output, size, sigma)?;
        for (frame, output) in frames.outer_iter_mut().zip(self.output.chunks_exact(plane)) {
            unpad_frame(output, columns, frame);
        }
        Ok(())
    }
}

/// Copies a frame into one with rows of `columns` pixels and as many rows as fit, mirrored at its
/// lower and right ends.
pub(super) fn pad_frame(frame: ArrayView2<'_, f32>, padded: &mut [f32], columns: usize) {
    let (height, width) = frame.dim();
    for (i, row) in padded.chunks_exact_mut(columns).enumerate() {
        let source = frame.row(reflect(i as isize, height));
        for (j, value) in row.iter_mut().enumerate() {
            *value = source[reflect(j as isize, width)];
        }
    }
}

/// Takes a frame out of one that was padded by [`pad_frame`].
pub(super) fn unpad_frame(padded: &[f32], columns: usize, mut frame: ArrayViewMut2<'_, f32>) {
    for (mut row, padded) in frame.outer_iter_mut().zip(padded.chunks_exact(columns)) {
        row.iter_mut().zip(padded).for_each(|(value, &x)| *value = x);
    }
}

/// One block over a clip: n + 2 frames in, n out, some at a time.
fn run_chunked(
    block: &mut ClipNetwork,
    input: &[f32],
    output: &mut [f32],
    (rows, columns): (usize, usize),
    sigma: Sigma,
) -> Result<(), ReconError> {
    let plane = rows * columns;
    let chunk = frames_at_once(plane as u64) as usize;
    for (index, output) in output.chunks_mut(chunk * plane).enumerate() {
        let start = index * chunk * plane;
        let count = output.len() / plane;
        let frames = &input[start..start + (count + 2) * plane];
        let frames = ArrayView4::from_shape((count + 2, 1, rows, columns), frames)
            .map_err(|error| ReconError::Runtime(error.to_string()))?;
        block.run(frames, sigma.value(), output)?;
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
    use super::{FastDvdNet, reflect};
    use crate::pipeline::models;
    use crate::recon::prior::Denoiser;
    use crate::recon::prior::onnx::{Device, Runtime};
    use crate::recon::schedule::{Network, Sigma};
    use ndarray::{Array3, s};
    use rand::{Rng, SeedableRng};
    use std::path::PathBuf;

    /// The network, or none (said aloud) where libonnxruntime has not been fetched.
    fn network(which: Network) -> Option<FastDvdNet> {
        let library = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from).filter(|p| p.exists());
        let Some(library) = library else {
            eprintln!("skipped: no libonnxruntime (run scripts/fetch-onnxruntime.sh)");
            return None;
        };
        let runtime = Runtime::open(&library, Device::Cpu).unwrap();
        let [(_, stage1), (_, stage2)] = models::of(which).files else { unreachable!() };
        Some(FastDvdNet::load(&runtime, stage1, stage2).unwrap())
    }

    fn noisy(frames: usize, height: usize, width: usize) -> (Array3<f32>, Array3<f32>) {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        let clean = Array3::from_shape_fn((frames, height, width), |(k, i, j)| {
            0.5 + 0.3 * ((i + 2 * k) as f32 * 0.15).sin() * (j as f32 * 0.1).cos()
        });
        let noisy = clean.mapv(|x: f32| x + 0.35 * (rng.random::<f32>() - 0.5));
        (clean, noisy)
    }

    fn mean_square(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
        (a - b).mapv(|d| d * d).mean().unwrap()
    }

    #[test]
    fn noise_falls_for_any_size_and_any_number_of_frames() {
        let Some(mut network) = network(Network::FastDvdNet) else { return };
        for (frames, height, width) in [(1, 32, 32), (2, 33, 46), (7, 50, 31)] {
            let (clean, mut video) = noisy(frames, height, width);
            let before = mean_square(&video, &clean);
            network.denoise(&mut video, Sigma::new(0.1).unwrap()).unwrap();
            let after = mean_square(&video, &clean);
            assert!(after < 0.2 * before, "{frames}x{height}x{width}: {before} to {after}");
        }
    }

    #[test]
    fn a_frame_does_not_depend_on_how_the_clip_is_chunked() {
        let Some(mut network) = network(Network::FastDvdNet) else { return };
        // 300x300: two frames at once; the middle of 9 depends on its 4 neighbours alone.
        let (_, video) = noisy(9, 300, 300);
        let mut long = video.clone();
        network.denoise(&mut long, Sigma::new(0.1).unwrap()).unwrap();
        let mut short = video.slice(s![2..7, .., ..]).to_owned();
        network.denoise(&mut short, Sigma::new(0.1).unwrap()).unwrap();
        assert_eq!(long.slice(s![4, .., ..]), short.slice(s![2, .., ..]));
    }

    #[test]
    fn eight_bits_change_little() {
        let (Some(mut exact), Some(mut quick)) =
            (network(Network::FastDvdNet), network(Network::FastDvdNetInt8))
        else {
            return;
        };
        let (clean, mut frames) = noisy(6, 64, 64);
        let mut other = frames.clone();
        exact.denoise(&mut frames, Sigma::new(0.1).unwrap()).unwrap();
        quick.denoise(&mut other, Sigma::new(0.1).unwrap()).unwrap();
        let (error, change) = (mean_square(&frames, &clean), mean_square(&frames, &other));
        assert!(change > 0.0, "these are the same weights");
        assert!(change < 0.05 * error, "{change} where the network's own error is {error}");
    }

    #[test]
    fn reflection_mirrors_without_repeating_the_ends() {
        let seen: Vec<usize> = (-3..7).map(|index| reflect(index, 4)).collect();
        assert_eq!(seen, [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]);
        assert_eq!((reflect(-2, 1), reflect(5, 1)), (0, 0));
        assert_eq!((reflect(-2, 2), reflect(2, 2)), (0, 0));
    }
}
