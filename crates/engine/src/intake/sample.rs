//! A sample data set, simulated from the embedded clip: masks, one snapshot, and the true frames.

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::Array3;

use super::IntakeError;
use super::read::read_clip;
use crate::intake::error::Result;
use formats::{FormatError, npy};
use optics::{measure, random_squares};

/// The first frames of `demo/clip`, enough for one snapshot. The README of the folder states their source.
const FRAMES: [&[u8]; 8] = [
    include_bytes!("../../../../demo/clip/frame_0001.png"),
    include_bytes!("../../../../demo/clip/frame_0002.png"),
    include_bytes!("../../../../demo/clip/frame_0003.png"),
    include_bytes!("../../../../demo/clip/frame_0004.png"),
    include_bytes!("../../../../demo/clip/frame_0005.png"),
    include_bytes!("../../../../demo/clip/frame_0006.png"),
    include_bytes!("../../../../demo/clip/frame_0007.png"),
    include_bytes!("../../../../demo/clip/frame_0008.png"),
];

/// Seed of the masks.
const SEED: u64 = 1;

/// The files of a sample.
#[derive(Debug)]
pub struct Sample {
    pub masks: PathBuf,
    pub measurement: PathBuf,
    /// The true frames as one array.
    pub truth: PathBuf,
    /// The true frames \[B,H,W\] on \[0,1\].
    pub frames: Array3<f32>,
}

/// Creates `folder` and writes `masks.npy`, `measurement.npy`, `truth.npy`, and the true frames as PNG in `clip`.
///
/// Errors: I/O.
pub fn sample(folder: &Path) -> Result<Sample> {
    let clip = folder.join("clip");
    fs::create_dir_all(&clip).map_err(FormatError::io("create the folder"))?;
    for (number, png) in (1..).zip(FRAMES) {
        fs::write(clip.join(format!("frame_{number:04}.png")), png)
            .map_err(FormatError::io("write the file"))?;
    }
    let frames = read_clip(&clip, None)?;
    let (count, height, width) = frames.dim();
    // The clip is embedded, so these steps can't fail.
    let failed = |error: &dyn std::fmt::Display| IntakeError::content("sample", error);
    let (masks, _) = random_squares(count, height, width, SEED).map_err(|error| failed(&error))?;
    let y = measure(masks.view(), frames.view()).map_err(|error| failed(&error))?;
    let path = |name: &str| folder.join(name);
    let sample = Sample {
        masks: path("masks.npy"),
        measurement: path("measurement.npy"),
        truth: path("truth.npy"),
        frames,
    };
    npy::write_f32(&sample.masks, masks.view())?;
    npy::write_image_f32(&sample.measurement, y.view())?;
    npy::write_f32(&sample.truth, sample.frames.view())?;
    Ok(sample)
}

#[cfg(test)]
mod tests {
    use super::sample;

    #[test]
    fn the_sample_has_one_snapshot_with_motion() {
        let folder = tempfile::tempdir().unwrap();
        let sample = sample(folder.path()).unwrap();
        let truth = &sample.frames;
        assert_eq!(truth.dim(), (8, 256, 256));
        let change = (&truth.slice(ndarray::s![7, .., ..]) - &truth.slice(ndarray::s![0, .., ..]))
            .mapv(f32::abs)
            .mean()
            .unwrap();
        assert!(change > 0.02, "{change}");
        assert!(sample.masks.is_file() && sample.measurement.is_file() && sample.truth.is_file());
    }
}
