//! How much of a tile's work is done.

use crate::job::Schedule;
use crate::recon::solver::Progress;

/// Turns the solver's progress into the share of the planned cost that is behind it.
#[derive(Debug, Clone)]
pub struct ShareDone {
    schedule: Schedule,
    stage: usize,
    iterations: usize,
}

impl ShareDone {
    /// For one run of `schedule`.
    pub fn new(schedule: Schedule) -> Self {
        Self { schedule, stage: 0, iterations: 0 }
    }

    /// The share on \[0,1\] after the iteration that `progress` tells of; to be called for
    /// every iteration. A stage that ends early lets the share jump.
    pub fn after(&mut self, progress: &Progress) -> f64 {
        if progress.stage != self.stage {
            (self.stage, self.iterations) = (progress.stage, 0);
        }
        self.iterations += 1;
        self.schedule.share_done(self.stage, self.iterations)
    }
}

#[cfg(test)]
mod tests {
    use super::ShareDone;
    use crate::recon::schedule::Schedule;
    use crate::recon::solver::Progress;

    #[test]
    fn an_early_end_of_a_stage_jumps_to_its_end() {
        let schedule = Schedule::pnp_ffdnet();
        let passes = schedule.stages[1].iterations;
        let mut share = ShareDone::new(schedule);
        let at = |stage, done| Progress {
            stage,
            done,
            planned: 64,
            residual: 0.1,
            change: 0.1,
            sigma: None,
            deep: stage > 0,
        };
        let first = share.after(&at(0, 1));
        // The stage of total variation ended after three iterations.
        let mut last = first;
        for pass in 1..=passes {
            let now = share.after(&at(1, 3 + pass));
            assert!(now > last);
            last = now;
        }
        assert!(first < 0.01);
        assert!((last - 1.0).abs() < 1e-9, "{last}");
    }
}
