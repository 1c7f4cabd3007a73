//! The prior on a GPU.

use ndarray::{Array3, ArrayView3};

use super::layout::{PATCHES, SIDE};
use super::search::windows;
use super::{Nonlocal, REFRESH, STRENGTH, Size};
use crate::error::Result;
use crate::gpu::nonlocal::{Clip, Levels};
use crate::motion::Motion;
use crate::priors::Prior;

/// The prior with its clip on a GPU, and the settings of the prior on the CPU.
pub(super) struct OnGpu {
    pub(super) clip: Clip,
    pub(super) settings: Nonlocal,
    pub(super) shrinkage: f32,
}

impl Prior for OnGpu {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        let Self { clip, settings, shrinkage } = self;
        let size: Size = frames.dim();
        if size.1 < SIDE || size.2 < SIDE {
            return Ok(());
        }
        let levels = Levels {
            margin: settings.outlier_limit * sigma,
            shrinkage: *shrinkage * sigma,
            tau: STRENGTH * PATCHES as f32 * sigma * sigma,
        };
        let mut values: Vec<f32> = frames.iter().copied().collect();
        clip.load(&values, levels);
        if settings.passes == 0 {
            clip.guide_by_frames();
        }
        if settings.passes.is_multiple_of(REFRESH) {
            let motion = if settings.motion_compensation {
                let guide = clip.guide()?;
                let guide = ArrayView3::from_shape(size, &guide).expect("a clip");
                Motion::of(guide, &settings.cores)
            } else {
                Motion::none()
            };
            clip.search(&windows(size, settings.passes / REFRESH, &motion))?;
        }
        settings.passes += 1;
        clip.filter(levels, &mut values)?;
        frames.iter_mut().zip(values).for_each(|(frame, value)| *frame = value);
        Ok(())
    }
}
