//! What a schedule will cost: the weights behind percent, remaining time and fair sharing.
//!
//! The figures were measured on one core with AVX-512. Only their ratios matter: what a machine really
//! takes is learned from the tasks it has done.

use super::schedule::{DEFAULT_TV_UPDATES, PriorSpec, ScheduleSpec, StageSpec};

/// Cost of one projection and one accelerated update, CPU-nanoseconds per voxel (measured).
const PROJECTION_NS: f64 = 0.7;
/// Cost of one dual update of TV, CPU-nanoseconds per voxel (measured).
const TV_UPDATE_NS: f64 = 0.56;
/// Cost of one dual update of TV along time, CPU-nanoseconds per voxel (measured: 0.37 of the former).
const TEMPORAL_UPDATE_NS: f64 = 0.21;
/// Cost of one nonlocal pass, CPU-nanoseconds per voxel (measured).
const NONLOCAL_NS: f64 = 1_700.0;
/// Cost of one pass of FFDNet, CPU-nanoseconds per voxel (measured).
const FFDNET_PASS_NS: f64 = 1_450.0;
/// Cost of one pass of FastDVDNet with a shared first stage, CPU-nanoseconds per voxel (measured).
const DEEP_PASS_NS: f64 = 4_900.0;
/// Cost of the same with 8 bits (measured: 0.36 of it, with AVX-512 VNNI).
const INT8_PASS_NS: f64 = 1_800.0;

impl PriorSpec {
    /// Cost of one iteration without projection and TV, CPU-nanoseconds per voxel.
    fn pass_ns(self) -> f64 {
        match self {
            Self::Tv => 0.0,
            Self::Nonlocal => NONLOCAL_NS,
            Self::FfdNet => FFDNET_PASS_NS,
            Self::FastDvdNetInt8 => INT8_PASS_NS,
            Self::FastDvdNet | Self::TvFastDvdNet => DEEP_PASS_NS,
        }
    }
}

impl StageSpec {
    /// The cost of one iteration in CPU-nanoseconds per voxel, as on the machine it was measured on.
    fn iteration_ns(&self) -> f64 {
        let dual_updates =
            u32::try_from(self.tv_updates.unwrap_or(DEFAULT_TV_UPDATES)).unwrap_or(u32::MAX);
        let in_time = self.temporal_weight.is_some_and(|weight| weight > 0.0);
        let update_ns = TV_UPDATE_NS + if in_time { TEMPORAL_UPDATE_NS } else { 0.0 };
        let tv = if self.prior.has_tv() { update_ns * f64::from(dual_updates) } else { 0.0 };
        PROJECTION_NS + tv + self.prior.pass_ns()
    }
}

impl ScheduleSpec {
    /// The planned cost in CPU-nanoseconds per voxel.
    #[must_use]
    pub fn planned_ns_per_voxel(&self) -> f64 {
        self.stages.iter().map(|stage| stage.iteration_ns() * count(stage.iterations)).sum()
    }

    /// The share of the planned cost, on [0, 1], that is behind a run which has done `iteration`
    /// iterations of the stage with index `stage` and has left all stages before it.
    #[must_use]
    pub fn share_done(&self, stage: usize, iteration: usize) -> f64 {
        let before: f64 =
            self.stages.iter().take(stage).map(|s| s.iteration_ns() * count(s.iterations)).sum();
        let here = self
            .stages
            .get(stage)
            .map_or(0.0, |s| s.iteration_ns() * count(iteration.min(s.iterations)));
        let planned = self.planned_ns_per_voxel();
        if planned > 0.0 { ((before + here) / planned).clamp(0.0, 1.0) } else { 0.0 }
    }
}

fn count(n: usize) -> f64 {
    f64::from(u32::try_from(n).unwrap_or(u32::MAX))
}

#[cfg(test)]
mod tests {
    use crate::job::ScheduleSpec;
    use crate::recon::schedule::Schedule;

    #[test]
    fn one_deep_pass_weighs_as_thousands_of_tv_iterations() {
        let spec = ScheduleSpec::from(&Schedule::pnp_ffdnet());
        assert_eq!(spec.share_done(0, 0), 0.0);
        assert!(spec.share_done(1, 0) < 0.01, "after all TV iterations");
        let half = spec.stages[1].iterations / 2;
        assert!((spec.share_done(1, half) - 0.5).abs() < 0.01, "half of the deep passes");
        assert_eq!(spec.share_done(2, 0), 1.0);
    }
}
