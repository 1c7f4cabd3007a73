//! The schedules of the algorithms: what runs where a job names none of its own.

use std::ops::Range;

use super::prior::Prior;
use super::prior::network::{FASTDVDNET, FASTDVDNET_INT8, FFDNET};
use super::prior::nonlocal::NONLOCAL;
use super::prior::tv::TV;
use super::schedule::{Method, Schedule, Stage};

impl Schedule {
    /// GAP-TV.
    pub fn gap_tv() -> Self {
        Self::gap(vec![tv_stage(150, 3e-4)])
    }

    /// GAP-TV with total variation along time, too, where it pays.
    pub fn gap_tv3d() -> Self {
        let stage = Stage { temporal_weight: Some(TEMPORAL_WEIGHT), ..tv_stage(150, 3e-4) };
        Self { adaptive: true, ..Self::gap(vec![stage]) }
    }

    /// ADMM-TV: slower than GAP, but it does not force `y = Hx`, so it amplifies less noise.
    pub fn admm_tv() -> Self {
        let method = Method::Admm;
        Self { method, accelerated: false, gamma: 0.01, ..Self::gap(vec![tv_stage(200, 3e-4)]) }
    }

    /// PnP-FFDNet: total variation, then the image denoiser, frame by frame. Behind correlated masks
    /// it stays above total variation only with a long memory, no momentum and low levels.
    pub fn pnp_ffdnet() -> Self {
        let deep = level_stage(&FFDNET, 30, 15.0, 3.0);
        let patient = Stage { memory: 0.95, momentum: 0.0, ..deep };
        Self::gap(vec![first_stage(), patient])
    }

    /// PnP-FastDVDNet: total variation, then the video denoiser.
    pub fn pnp_fastdvdnet() -> Self {
        let [quick, exact] = fastdvdnet_stages(18, 6, 25.0, 4.4);
        Self::gap(vec![first_stage(), quick, exact])
    }

    /// PnP with the nonlocal prior, which needs no network.
    pub fn pnp_nonlocal() -> Self {
        Self::gap(vec![first_stage(), nonlocal_stage(60, 30.0, 2.6)])
    }

    /// PnP-TV-FastDVDNet: total variation, a few passes of the video denoiser, then the nonlocal
    /// prior.
    ///
    /// The order was chosen by measurement. The network gets through where masks are correlated
    /// and total variation stands still; from there the nonlocal prior goes on, with structure of
    /// the scene that no training has seen, and makes good what 8 bits lose in the network's last
    /// passes. Total variation in series (Algorithm 1's second period; `tv+fastdvdnet` in a
    /// schedule) gained only while the memory was 1.
    ///
    /// Passes of the nonlocal prior cost a tenth of the network's, so there are many. Their first level is a
    /// compromise: 12 is better by up to 0.5 dB behind correlated masks, where the network has come further
    /// than the prior can from 20; behind independent pixels 20 is better by up to 0.3 dB. The pilot ends
    /// them where they no longer pay.
    pub fn pnp_tv_fastdvdnet() -> Self {
        let deep = level_stage(&FASTDVDNET_INT8, 12, 25.0, 5.3);
        Self::gap(vec![first_stage(), deep, nonlocal_stage(65, 15.0, 1.7)])
    }

    fn gap(stages: Vec<Stage>) -> Self {
        let adaptive = stages.iter().any(|stage| stage.sigma.is_some());
        Self { method: Method::Gap, accelerated: true, gamma: 0.0, adaptive, stages }
    }
}

/// Of the weights from 0.002 to 0.01 the one that gains most in the mean over scenes, masks and noise. More
/// blurs what moves; where even this does, the pilot leaves it out.
const TEMPORAL_WEIGHT: f32 = 0.004;

/// The best behind independent pixels, at Cr 6 to 24; for masks that are alike the projection takes less.
const STATIC_VARIANCE: f32 = 0.55;

/// Less gains less, at rest and in motion; more blurs what moves. Fine texture that moves by a fraction of a
/// pixel loses 0.1 to 0.2 dB.
const TEMPORAL_SHRINKAGE: f32 = 0.35;

/// What comes before the plugged-in priors.
fn first_stage() -> Stage {
    Stage { temporal_weight: Some(TEMPORAL_WEIGHT), ..tv_stage(60, 0.0) }
}

fn tv_stage(iterations: usize, tolerance: f32) -> Stage {
    Stage {
        prior: &TV,
        iterations,
        sigma: None,
        tv_weight: Some(0.15),
        tv_updates: Some(4),
        temporal_weight: None,
        temporal_shrinkage: None,
        rest_shrinkage: None,
        rest_everywhere: false,
        memory: 1.0,
        momentum: 0.0,
        static_variance: None,
        gamma: None,
        tolerance,
    }
}

/// Levels in units of 255 grey values.
fn level_stage(prior: &'static dyn Prior, iterations: usize, first: f32, last: f32) -> Stage {
    Stage {
        prior,
        iterations,
        sigma: Some([first / 255.0, last / 255.0]),
        tv_weight: None,
        tv_updates: None,
        temporal_weight: None,
        temporal_shrinkage: None,
        rest_shrinkage: None,
        rest_everywhere: false,
        memory: 0.85,
        momentum: 0.5,
        static_variance: None,
        gamma: None,
        tolerance: 0.0,
    }
}

/// The video denoiser with 8 bits for as many iterations as that costs nothing, then with floating point: the
/// levels fall through both as through one. Levels in units of 255 grey values.
fn fastdvdnet_stages(quick: usize, exact: usize, first: f32, last: f32) -> [Stage; 2] {
    let whole = level_stage(&FASTDVDNET, quick + exact, first, last);
    let level = |index| whole.sigma_at(index);
    let part = |prior: &'static dyn Prior, range: Range<usize>| Stage {
        prior,
        iterations: range.len(),
        sigma: level(range.start).zip(level(range.end - 1)).map(<[f32; 2]>::from),
        ..whole.clone()
    };
    [part(&FASTDVDNET_INT8, 0..quick), part(&FASTDVDNET, quick..quick + exact)]
}

fn nonlocal_stage(iterations: usize, first: f32, last: f32) -> Stage {
    let variance = Some(STATIC_VARIANCE);
    Stage {
        temporal_shrinkage: Some(TEMPORAL_SHRINKAGE),
        memory: 0.6,
        momentum: 0.8,
        static_variance: variance,
        ..level_stage(&NONLOCAL, iterations, first, last)
    }
}

#[cfg(test)]
impl Schedule {
    /// All of them.
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
