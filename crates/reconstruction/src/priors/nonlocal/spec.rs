//! The nonlocal prior as a stage of a schedule.

use ndarray::Array3;

#[cfg(feature = "gpu")]
use super::on_gpu::OnGpu;
use super::{Nonlocal, NonlocalSpec};
use crate::error::Result;
use crate::priors::{Family, Networks, Prior, Size, Spec, WorkingSet};

impl Spec for NonlocalSpec {
    fn family(&self) -> Family {
        Family::Nonlocal
    }

    fn sigma(&self) -> Option<[f32; 2]> {
        Some(self.sigma)
    }

    fn set_sigma(&mut self, sigma: [f32; 2]) {
        self.sigma = sigma;
    }

    fn iteration_ns(&self) -> f64 {
        200.0
    }

    /// Four clips with margins, and 40 indices for each 25 pixels.
    fn working_set(&self) -> WorkingSet {
        WorkingSet { per_voxel: 30, per_network_pixel: 0 }
    }

    fn start<'n>(&self, size: Size, networks: &'n mut dyn Networks) -> Result<Box<dyn Prior + 'n>> {
        let mut nonlocal = Nonlocal::new(size);
        nonlocal.cores = networks.cores();
        nonlocal.motion_compensation = self.motion_compensation;
        nonlocal.outlier_limit = self.outlier_limit.unwrap_or(f32::INFINITY);
        #[cfg(feature = "gpu")]
        if let Some(gpu) = networks.gpu()? {
            return Ok(Box::new(OnGpu::new(gpu, nonlocal, self.temporal_shrinkage)?));
        }
        Ok(Box::new(NonlocalPrior { nonlocal, shrinkage: self.temporal_shrinkage }))
    }
}

struct NonlocalPrior {
    nonlocal: Nonlocal,
    shrinkage: f32,
}

impl Prior for NonlocalPrior {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        self.nonlocal.denoise(frames, sigma, self.shrinkage);
        Ok(())
    }
}
