//! The default schedules of the algorithms.

use super::priors::network::{FastdvdnetInt8Spec, FastdvdnetSpec, FfdnetSpec};
use super::priors::nonlocal::NonlocalSpec;
use super::priors::registry::PriorSpec;
use super::priors::tv::TvSpec;
use super::schedule::{Method, Schedule};
use super::stage::{ProjectionSpec, Stage};

impl Schedule {
    /// GAP-TV.
    pub fn gap_tv() -> Self {
        Self::gap(vec![tv_stage(150, 0.0, 3e-4)])
    }

    /// GAP-TV with total variation also along time, unless the pilot finds it worse.
    pub fn gap_tv3d() -> Self {
        Self { adaptive: true, ..Self::gap(vec![tv_stage(150, TEMPORAL_WEIGHT, 3e-4)]) }
    }

    /// ADMM-TV: slower than GAP, but it does not force `y = Hx`, so it amplifies less noise.
    pub fn admm_tv() -> Self {
        let method = Method::Admm;
        let stages = vec![tv_stage(200, 0.0, 3e-4)];
        Self { method, accelerated: false, gamma: 0.01, ..Self::gap(stages) }
    }

    /// PnP-FFDNet: total variation, then the image denoiser, frame by frame. Behind correlated masks it is better than
    /// total variation only with a long memory, no momentum and low noise levels.
    pub fn pnp_ffdnet() -> Self {
        let sigma = levels(15.0, 3.0);
        let prior = PriorSpec::Ffdnet(FfdnetSpec { sigma });
        Self::gap(vec![first_stage(), stage(prior, 30, 0.95, 0.0)])
    }

    /// PnP-FastDVDNet: total variation, then the video denoiser.
    pub fn pnp_fastdvdnet() -> Self {
        let [int8, float] = fastdvdnet_stages(18, 6, 25.0, 4.4);
        Self::gap(vec![first_stage(), int8, float])
    }

    /// PnP with the nonlocal prior, which needs no network.
    pub fn pnp_nonlocal() -> Self {
        Self::gap(vec![first_stage(), nonlocal_stage(60, 30.0, 2.6)])
    }

    /// PnP-TV-FastDVDNet: total variation, a few iterations of the video denoiser, then the nonlocal prior.
    ///
    /// The order was chosen by measurement. The network makes progress behind correlated masks, where total variation
    /// stagnates. The nonlocal prior continues from there with the structure of the scene, and repairs the losses of 8
    /// bits. Total variation in series (the second period of Algorithm 1, `tv+fastdvdnet`) gained only with memory 1.
    ///
    /// An iteration of the nonlocal prior costs a tenth of the network's, so there are many. Their first noise level is a
    /// compromise: 12 is better by up to 0.5 dB behind correlated masks, 20 by up to 0.3 dB behind independent ones.
    pub fn pnp_tv_fastdvdnet() -> Self {
        let sigma = levels(25.0, 5.3);
        let network = PriorSpec::FastdvdnetInt8(FastdvdnetInt8Spec { sigma });
        let learned = stage(network, 12, 0.85, 0.5);
        Self::gap(vec![first_stage(), learned, nonlocal_stage(65, 15.0, 1.7)])
    }
}

/// The weight from 0.002 to 0.01 with the largest mean gain over scenes, masks and noise. A larger one blurs motion. The
/// pilot drops total variation along time from a stage that is better without it.
const TEMPORAL_WEIGHT: f32 = 0.004;

/// The best static variance behind independent pixels at Cr 6 to 24; the projection reduces it for correlated masks.
const STATIC_VARIANCE: f32 = 0.55;

/// A smaller shrinkage gains less; a larger one blurs motion. Fine texture that moves by a fraction of a pixel loses 0.1 to
/// 0.2 dB.
const TEMPORAL_SHRINKAGE: f32 = 0.35;

/// Total variation before the other priors.
fn first_stage() -> Stage {
    tv_stage(60, TEMPORAL_WEIGHT, 0.0)
}

fn tv_stage(iterations: usize, temporal_weight: f32, tolerance: f32) -> Stage {
    let prior = PriorSpec::Tv(TvSpec { tv_weight: 0.15, tv_updates: 4, temporal_weight });
    Stage { tolerance, ..stage(prior, iterations, 1.0, 0.0) }
}

fn stage(prior: PriorSpec, iterations: usize, memory: f32, momentum: f32) -> Stage {
    let projection = ProjectionSpec { memory, static_variance: None, gamma: None };
    Stage { prior, iterations, projection, momentum, tolerance: 0.0 }
}

/// Noise levels on \[0,1\] from levels in grey values of 255.
fn levels(first: f32, last: f32) -> [f32; 2] {
    [first / 255.0, last / 255.0]
}

/// The video denoiser with 8 bits for as many iterations as that loses nothing, then in floating point. Noise levels, in
/// grey values of 255, fall through both as through one stage.
fn fastdvdnet_stages(int8: usize, float: usize, first: f32, last: f32) -> [Stage; 2] {
    let prior = PriorSpec::Fastdvdnet(FastdvdnetSpec { sigma: levels(first, last) });
    let whole = stage(prior, int8 + float, 0.85, 0.5);
    let level = |index| whole.sigma_at(index).unwrap_or_default();
    let sigma = [level(0), level(int8 - 1)];
    let int8_prior = PriorSpec::FastdvdnetInt8(FastdvdnetInt8Spec { sigma });
    let sigma = [level(int8), level(int8 + float - 1)];
    let float_prior = PriorSpec::Fastdvdnet(FastdvdnetSpec { sigma });
    [stage(int8_prior, int8, 0.85, 0.5), stage(float_prior, float, 0.85, 0.5)]
}

fn nonlocal_stage(iterations: usize, first: f32, last: f32) -> Stage {
    let prior = NonlocalSpec::new(levels(first, last), TEMPORAL_SHRINKAGE);
    let mut stage = stage(PriorSpec::Nonlocal(prior), iterations, 0.6, 0.8);
    stage.projection.static_variance = Some(STATIC_VARIANCE);
    stage
}

#[cfg(test)]
impl Schedule {
    /// All default schedules.
    pub fn defaults() -> [Self; 7] {
        [
            Self::gap_tv(),
            Self::gap_tv3d(),
            Self::admm_tv(),
            Self::pnp_nonlocal(),
            Self::pnp_ffdnet(),
            Self::pnp_fastdvdnet(),
            Self::pnp_tv_fastdvdnet(),
        ]
    }
}
