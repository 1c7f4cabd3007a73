//! How good frames are where the truth is known: PSNR and SSIM, frame by frame, so that memory holds
//! one of each.

use ndarray::{Array2, ArrayView2, ArrayView3, Axis};
use serde::Serialize;

use crate::recon::{ReconError, metrics};

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FrameQuality {
    /// The frame, from 1.
    pub frame: usize,
    /// In dB; infinite if the frame equals its truth.
    pub psnr: f64,
    /// None for a frame that is smaller than the window of SSIM.
    pub ssim: Option<f64>,
}

impl FrameQuality {
    /// Of the frame \[H,W\] with index `k`, from 0, on \[0,1\].
    pub fn of(
        k: usize,
        frame: ArrayView2<'_, f32>,
        truth: ArrayView2<'_, f32>,
    ) -> Result<Self, ReconError> {
        let (frame, truth) = (frame.insert_axis(Axis(0)), truth.insert_axis(Axis(0)));
        let psnr = metrics::psnr(frame, truth)?;
        // Of frames that PSNR takes, SSIM refuses only those that are too small.
        Ok(Self { frame: k + 1, psnr, ssim: metrics::ssim(frame, truth).ok() })
    }
}

/// How good all frames of a snapshot are.
#[derive(Debug, Clone, Serialize)]
pub struct Quality {
    /// Mean over the frames, in dB.
    pub psnr: f64,
    /// Mean over the frames; none if one of them has none.
    pub ssim: Option<f64>,
    pub frames: Vec<FrameQuality>,
}

impl Quality {
    /// Of frames \[H,W\] by their index, against true ones \[frames,H,W\].
    pub fn of_frames(
        frame: impl Fn(usize) -> Array2<f32>,
        truth: ArrayView3<'_, f32>,
    ) -> Result<Self, ReconError> {
        let frames = truth.outer_iter().enumerate();
        let frames = frames.map(|(k, truth)| FrameQuality::of(k, frame(k).view(), truth));
        Ok(frames.collect::<Result<Vec<_>, _>>()?.into())
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
