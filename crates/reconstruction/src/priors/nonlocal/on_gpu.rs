//! The nonlocal prior with its clip in the memory of a GPU.

use std::sync::Arc;

use ndarray::{Array3, ArrayView3};

use super::layout::{PATCHES, SIDE};
use super::{Nonlocal, REFRESH, STRENGTH, search};
use crate::error::Result;
use crate::gpu::adapter::Gpu;
use crate::gpu::frames::DeviceFrames;
use crate::gpu::nonlocal::{Clip, Levels, NamedKernel};
use crate::motion::Motion;
use crate::priors::Prior;

/// The prior with its clip on a GPU, and the settings of the prior on the CPU.
pub(crate) struct OnGpu {
    gpu: Arc<Gpu>,
    clip: Clip,
    settings: Nonlocal,
    shrinkage: f32,
}

impl OnGpu {
    /// For clips of the size of `settings`.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new(gpu: Arc<Gpu>, settings: Nonlocal, shrinkage: f32) -> Result<Self> {
        let size = (settings.frames, settings.height, settings.width);
        let clip = Clip::new(Arc::clone(&gpu), size, settings.temporal_shrinkage.cosines())?;
        Ok(Self { gpu, clip, settings, shrinkage })
    }

    fn levels(&self, sigma: f32) -> Levels {
        Levels {
            margin: self.settings.outlier_limit * sigma,
            shrinkage: self.shrinkage * sigma,
            tau: STRENGTH * PATCHES as f32 * sigma * sigma,
        }
    }

    /// The kernels, for measurements after a pass.
    pub(crate) fn kernels<'a>(
        &'a self,
        frames: &'a DeviceFrames,
        sigma: f32,
    ) -> [NamedKernel<'a>; 5] {
        self.clip.kernels(self.levels(sigma), frames)
    }
}

impl Prior for OnGpu {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        let copy = DeviceFrames::zeros(Arc::clone(&self.gpu), frames.dim())?;
        copy.write(frames);
        self.denoise_on_gpu(&copy, sigma)?;
        frames.assign(&copy.read()?);
        Ok(())
    }

    fn denoise_on_gpu(&mut self, frames: &DeviceFrames, sigma: f32) -> Result<()> {
        let levels = self.levels(sigma);
        let Self { clip, settings, .. } = self;
        let size = (settings.frames, settings.height, settings.width);
        if size.1 < SIDE || size.2 < SIDE {
            return Ok(());
        }
        clip.load(frames, levels);
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
            clip.search(&search::windows(size, settings.passes / REFRESH, &motion))?;
        }
        settings.passes += 1;
        clip.filter(levels, frames);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ndarray::{Array2, Array3};
    use rand::{RngExt, SeedableRng};

    use super::super::tests::{Reference, coarse, noisy};
    use super::super::{Nonlocal, NonlocalSpec, REFRESH};
    use super::OnGpu;
    use crate::error::Result;
    use crate::gpu::adapter::Gpu;
    use crate::gpu::tests::{On, gpu, small_gpu};
    use crate::priors::{Networks, Prior, Size, Spec};

    /// Two searches, and a run that gives the same bits.
    #[test]
    fn passes_on_a_gpu_are_those_of_the_reference() {
        let Some(gpu) = gpu() else { return };
        let mut networks = On(gpu);
        let mut largest = 0.0f32;
        for (size, shrinkage) in [((2, 23, 26), 0.0), ((5, 12, 17), 1.5), ((1, 6, 9), 1.5)] {
            let mut run = |passes: usize| {
                let spec = NonlocalSpec::new([0.08; 2], shrinkage);
                let mut prior = spec.start(size, &mut networks).unwrap();
                let mut found = coarse(size);
                let mut results = Vec::new();
                for _ in 0..passes {
                    prior.denoise(&mut found, 0.08).unwrap();
                    results.push(found.clone());
                }
                results
            };
            let found = run(REFRESH + 2);
            assert_eq!(found, run(REFRESH + 2), "runs differ");
            let mut expected = coarse(size);
            let mut reference = Reference::new(&expected);
            for (pass, found) in found.iter().enumerate().take(2) {
                reference.denoise(&mut expected, 0.08, shrinkage);
                let worst = (found - &expected).mapv(f32::abs).fold(0.0, |a: f32, &b| a.max(b));
                assert!(worst < 1e-4, "{size:?} pass {pass}: {worst}");
                largest = largest.max(worst);
            }
            assert!(found.iter().flatten().all(|value| value.is_finite()));
        }
        eprintln!("largest difference: {largest:e}");
        // Texture that moves out of the search window: the GPU follows the same motion as the CPU.
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(6);
        let fine = Array2::from_shape_fn((120, 120), |_| rng.random::<f32>());
        let video = Array3::from_shape_fn((6, 72, 96), |(k, i, j)| {
            let (i, j) = (i + 40 - 6 * k, j + 3 * k);
            0.3 * fine[[i, j]] + 0.2 * ((i as f32 / 9.0).sin() + (j as f32 / 11.0).cos())
        });
        let on_device = |networks: &mut dyn Networks| {
            let mut found = video.clone();
            let mut prior = NonlocalSpec::new([0.05; 2], 0.4).start(found.dim(), networks).unwrap();
            prior.denoise(&mut found, 0.05).unwrap();
            found
        };
        let difference = &on_device(&mut networks) - &on_device(&mut ());
        let worst = difference.mapv(f32::abs).fold(0.0, |a: f32, &b| a.max(b));
        assert!(worst < 1e-4, "along the motion: {worst}");
    }

    /// The prior on a GPU: the frames after some passes, and the number of bands.
    fn passes_on(gpu: &Arc<Gpu>, size: Size, passes: usize) -> Result<(Array3<f32>, usize)> {
        let mut prior = OnGpu::new(Arc::clone(gpu), Nonlocal::new(size), 0.4)?;
        let mut found = noisy(size, 0.1).1;
        for _ in 0..passes {
            prior.denoise(&mut found, 0.05)?;
        }
        Ok((found, prior.clip.band_count()))
    }

    #[test]
    fn bands_on_a_gpu_change_no_bit() {
        let Some(gpu) = gpu() else { return };
        let size = (2, 61, 20);
        let (expected, bands) = passes_on(&gpu, size, 2).unwrap();
        assert_eq!(bands, 1);
        // All patches take 770 kB, those of the groups that reach a single row 350 kB.
        let (found, bands) = passes_on(&small_gpu(500_000), size, 2).unwrap();
        assert!(bands > 1, "{bands} bands");
        assert_eq!(found, expected, "{bands} bands");
        let error = passes_on(&small_gpu(200_000), size, 1).unwrap_err().to_string();
        assert!(error.contains("200000 bytes") && error.contains("smaller tiles"), "{error}");
    }
}
