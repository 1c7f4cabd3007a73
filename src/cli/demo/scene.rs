//! The files that a lab would send: masks and a snapshot, made of the clip that comes with the
//! program.

use std::fs;
use std::path::Path;

use ndarray::Array3;

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::formats::npy;
use crate::intake::read_clip;
use crate::optics::{measure, random_squares};

/// The first frames of `demo/clip` (its README says where they come from), one snapshot's worth.
const FRAMES: [&[u8]; 8] = [
    include_bytes!("../../../demo/clip/frame_0001.png"),
    include_bytes!("../../../demo/clip/frame_0002.png"),
    include_bytes!("../../../demo/clip/frame_0003.png"),
    include_bytes!("../../../demo/clip/frame_0004.png"),
    include_bytes!("../../../demo/clip/frame_0005.png"),
    include_bytes!("../../../demo/clip/frame_0006.png"),
    include_bytes!("../../../demo/clip/frame_0007.png"),
    include_bytes!("../../../demo/clip/frame_0008.png"),
];

const SEED: u64 = 1;

/// Writes `masks.npy`, `measurement.npy` and the true frames as PNG into `folder`, and gives the
/// true frames \[B,H,W\] on \[0,1\].
pub(super) fn make(folder: &Path) -> Result<Array3<f32>> {
    let clip = folder.join("clip");
    let unwritable = |error| CliError::file("write", &clip, &error);
    fs::create_dir_all(&clip).map_err(unwritable)?;
    for (number, png) in (1..).zip(FRAMES) {
        fs::write(clip.join(format!("frame_{number:04}.png")), png).map_err(unwritable)?;
    }
    let truth = read_clip(&clip, None)?;
    let (frames, height, width) = truth.dim();
    let (masks, _) = random_squares(frames, height, width, SEED)?;
    let measurement = measure(masks.view(), truth.view())?;
    npy::write_f32(&folder.join("masks.npy"), masks.view())?;
    npy::write_image_f32(&folder.join("measurement.npy"), measurement.view())?;
    Ok(truth)
}

#[cfg(test)]
mod tests {
    use super::make;

    #[test]
    fn the_clip_is_one_snapshot_that_moves() {
        let folder = tempfile::tempdir().unwrap();
        let truth = make(folder.path()).unwrap();
        assert_eq!(truth.dim(), (8, 256, 256));
        let change = (&truth.slice(ndarray::s![7, .., ..]) - &truth.slice(ndarray::s![0, .., ..]))
            .mapv(f32::abs)
            .mean()
            .unwrap();
        assert!(change > 0.02, "{change}");
        assert!(folder.path().join("masks.npy").is_file());
    }
}
