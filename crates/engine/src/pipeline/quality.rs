//! PSNR and SSIM against ground truth, computed frame by frame.

use ndarray::{Array2, ArrayView2, ArrayView3, Axis, s};
use serde::Serialize;

use formats::Channels;
use reconstruction::{ReconError, metrics};

/// The quality of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, schemars::JsonSchema)]
pub struct FrameQuality {
    /// Number of the frame, counted from 1.
    pub frame: usize,
    /// PSNR in dB for a data range of 1, unless it was set [relative to](Quality::relative_to) another peak; infinite, and
    /// null in JSON, if the frame equals its truth.
    #[schemars(with = "Option<f64>")]
    pub psnr: f64,
    /// SSIM; `None` if the frame is smaller than the SSIM window.
    pub ssim: Option<f64>,
}

impl FrameQuality {
    /// Compares frame `k` (counted from 0) with its truth, both \[H,W\] on \[0,1\]. Colour frames are \[H,3W\]: the
    /// PSNR is over all samples, the SSIM is the mean of the three channels.
    ///
    /// Errors: [`ReconError::Shape`] if the sizes differ.
    pub fn of(
        k: usize,
        frame: ArrayView2<'_, f32>,
        truth: ArrayView2<'_, f32>,
        channels: Channels,
    ) -> Result<Self, ReconError> {
        let (frame, truth) = (frame.insert_axis(Axis(0)), truth.insert_axis(Axis(0)));
        let psnr = metrics::psnr(frame, truth)?;
        let count = channels.count();
        let ssim = |channel: usize| {
            let samples = s![.., .., channel..;count.cast_signed()];
            metrics::ssim(frame.slice(samples), truth.slice(samples))
        };
        // The sizes are equal here, so SSIM fails only for frames that are too small.
        let ssim = (0..count).map(ssim).sum::<Result<f64, _>>().ok();
        Ok(Self { frame: k + 1, psnr, ssim: ssim.map(|sum| sum / count as f64) })
    }
}

/// The quality of all frames of a snapshot.
#[derive(Debug, Clone, Serialize, schemars::JsonSchema)]
pub struct Quality {
    /// Mean PSNR over the frames in dB; null in JSON if a frame equals its truth.
    #[schemars(with = "Option<f64>")]
    pub psnr: f64,
    /// Mean SSIM over the frames; `None` if a frame has none.
    pub ssim: Option<f64>,
    pub frames: Vec<FrameQuality>,
}

impl Quality {
    /// Compares frames \[H,W\], or colour frames \[H,3W\], with the truth \[B,H,W\] or \[B,H,3W\]. `frame` returns a
    /// frame by its index.
    pub fn compare(
        frame: impl Fn(usize) -> Array2<f32>,
        truth: ArrayView3<'_, f32>,
        channels: Channels,
    ) -> Result<Self, ReconError> {
        let frames = truth.outer_iter().enumerate();
        let frames = frames.map(|(k, truth)| FrameQuality::of(k, frame(k).view(), truth, channels));
        Ok(frames.collect::<Result<Vec<_>, _>>()?.into())
    }
}

impl Quality {
    /// Makes the PSNR relative to another peak than 1.
    #[must_use]
    pub fn relative_to(mut self, peak: f32) -> Self {
        let gain = 20.0 * f64::from(peak).log10();
        self.psnr += gain;
        self.frames.iter_mut().for_each(|frame| frame.psnr += gain);
        self
    }
}

impl From<Vec<FrameQuality>> for Quality {
    fn from(frames: Vec<FrameQuality>) -> Self {
        let count = frames.len().max(1) as f64;
        let psnr = frames.iter().map(|frame| frame.psnr).sum::<f64>() / count;
        let ssim = frames.iter().map(|frame| frame.ssim).sum::<Option<f64>>();
        Self { psnr, ssim: ssim.map(|sum| sum / count), frames }
    }
}

#[cfg(test)]
mod tests {
    use super::FrameQuality;
    use formats::Channels;
    use ndarray::Array2;

    /// Reference values are from scikit-image: `peak_signal_noise_ratio(truth, frame, data_range=1)` and
    /// `structural_similarity(truth, frame, data_range=1, channel_axis=-1)`.
    #[test]
    fn colour_metrics_agree_with_scikit_image() {
        let wave = |i: usize, j: usize, c: usize, phase: f64| {
            let (i, j, c) = (i as f64, j as f64, c as f64);
            (0.5 + 0.4 * (0.3 * i + 0.2 * j + c + phase).sin() * (0.11 * i * j).cos()) as f32
        };
        let frame = |phase: f64| {
            Array2::from_shape_fn((20, 93), |(i, at)| {
                wave(i, at / 3, at % 3, phase * (at % 3) as f64)
            })
        };
        let (truth, distorted) = (frame(0.0), frame(0.2));
        let quality = FrameQuality::of(4, distorted.view(), truth.view(), Channels::Rgb).unwrap();
        assert_eq!(quality.frame, 5);
        assert!((quality.psnr - PSNR).abs() < 1e-4, "{}", quality.psnr);
        assert!((quality.ssim.unwrap() - SSIM).abs() < 1e-4, "{:?}", quality.ssim);
    }

    const PSNR: f64 = 25.432_150;
    const SSIM: f64 = 0.964_991;
}
