//! Sigma schedules: which prior runs how often, and how strongly.

use super::error::ReconError;

/// A noise level: the standard deviation on the \[0,1\] scale of the frames.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Sigma(f32);

impl Sigma {
    /// A level in (0,1].
    pub fn new(value: f32) -> Result<Self, ReconError> {
        if value > 0.0 && value <= 1.0 {
            return Ok(Self(value));
        }
        Err(ReconError::Parameter {
            name: "sigma",
            value: value.to_string(),
            range: "above 0 and at most 1 (a level of 25 grey values is 25/255 = 0.098)",
        })
    }

    /// A level given in grey values of 255.
    pub(super) fn of_grey(level: f32) -> Self {
        Self(level / 255.0)
    }

    /// The level on \[0,1\].
    pub fn value(self) -> f32 {
        self.0
    }
}

/// A learned denoiser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Network {
    /// FFDNet, frame by frame.
    FfdNet,
    /// FastDVDNet, five frames at a time.
    FastDvdNet,
    /// The same with weights and activations of 8 bits: about three times as fast on a CPU, and a little
    /// less exact.
    FastDvdNetInt8,
}

/// What stands for `D` in `v = D(x)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prior {
    /// Total variation, frame by frame.
    Tv,
    /// Groups of similar patches, filtered by their own covariance.
    Nonlocal,
    /// A network alone.
    Deep(Network),
    /// Total variation, then the video denoiser: the second period of Algorithm 1.
    TvFastDvdNet,
}

impl Prior {
    /// Whether the prior has a total-variation part.
    pub fn uses_tv(self) -> bool {
        matches!(self, Self::Tv | Self::TvFastDvdNet)
    }

    /// Whether the prior is told a noise level.
    pub fn has_level(self) -> bool {
        self != Self::Tv
    }

    /// The network of the prior, if it has one.
    pub fn network(self) -> Option<Network> {
        match self {
            Self::Tv | Self::Nonlocal => None,
            Self::Deep(network) => Some(network),
            Self::TvFastDvdNet => Some(Network::FastDvdNet),
        }
    }
}

/// How projection and prior alternate. `P(w) = w + H^T (H H^T + gamma)^-1 (y - H w)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Generalized alternating projection: `x = P(v)`, `v = D(x)`.
    Gap,
    /// Alternating direction method of multipliers: `x = P(v + u)`, `v = D(x - u)`,
    /// `u <- u - (x - v)`.
    Admm,
}

/// A run of iterations with one prior.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// The prior.
    pub prior: Prior,
    /// Most iterations of the stage, at least 1.
    pub iterations: usize,
    /// First and last noise level of the prior, falling (or rising) geometrically; none for total
    /// variation alone.
    pub sigma: Option<(Sigma, Sigma)>,
    /// Weight of the total variation, on the \[0,1\] scale; 0 for none.
    pub tv_weight: f32,
    /// Dual updates of the total variation in each iteration.
    pub tv_updates: usize,
    /// Weight of the total variation along time, which comes before that of each frame and makes as
    /// many updates; 0 for none. In an adaptive schedule it is left out where it does not pay.
    pub temporal_weight: f32,
    /// Share of the accumulated residual that accelerated GAP keeps from one iteration to the
    /// next, on \[0,1\]: 1 is accelerated GAP, 0 is plain GAP. A learned denoiser never explains
    /// the measurement fully, so with 1 the residual winds up in its stages.
    pub memory: f32,
    /// Extrapolation of the iterates, on \[0,1): the projection starts from
    /// `v_k + momentum (v_k - v_(k-1))`. It makes fewer passes do. Where the
    /// prior passes everything (even brightness), an error `e` follows `e_(k+1) =
    /// -memory momentum (e_k - e_(k-1))`: it grows if the product is above 1/2, so that is refused.
    pub momentum: f32,
    /// The stage ends early once `||v_k - v_(k-1)|| / ||v_k||` falls below this; 0 never.
    pub tolerance: f32,
}

impl Stage {
    /// The noise level of iteration `index` (from 0) of the stage.
    pub fn sigma_at(&self, index: usize) -> Option<Sigma> {
        let (first, last) = self.sigma?;
        let share = index as f32 / (self.iterations.max(2) - 1) as f32;
        Some(Sigma(first.0 * (last.0 / first.0).powf(share)))
    }

    fn validate(&self) -> Result<(), ReconError> {
        let parameter =
            |name, value: String, range| Err(ReconError::Parameter { name, value, range });
        if self.iterations == 0 || self.iterations > 100_000 {
            return parameter("iterations", self.iterations.to_string(), "from 1 to 100000");
        }
        if !self.tv_weight.is_finite() || self.tv_weight < 0.0 {
            return parameter("tv_weight", self.tv_weight.to_string(), "a number of at least 0");
        }
        if !self.temporal_weight.is_finite() || self.temporal_weight < 0.0 {
            let value = self.temporal_weight.to_string();
            return parameter("temporal_weight", value, "a number of at least 0");
        }
        let updated = self.prior.uses_tv() && self.tv_weight.max(self.temporal_weight) > 0.0;
        if updated && !(1..=1000).contains(&self.tv_updates) {
            return parameter("tv_updates", self.tv_updates.to_string(), "from 1 to 1000");
        }
        if !self.tolerance.is_finite() || !(0.0..1.0).contains(&self.tolerance) {
            return parameter("tolerance", self.tolerance.to_string(), "at least 0 and below 1");
        }
        if !(0.0..=1.0).contains(&self.memory) {
            return parameter("memory", self.memory.to_string(), "from 0 to 1");
        }
        if !(0.0..1.0).contains(&self.momentum) {
            return parameter("momentum", self.momentum.to_string(), "at least 0 and below 1");
        }
        let product = self.memory * self.momentum;
        if product > 0.5 {
            return parameter(
                "momentum",
                format!("{} with memory {}", self.momentum, self.memory),
                "such that momentum times memory is at most 0.5; above, the brightness diverges",
            );
        }
        if self.prior.has_level() && self.sigma.is_none() {
            return parameter(
                "sigma",
                "missing".into(),
                "given as first and last level in a stage with another prior than total variation",
            );
        }
        if !self.prior.has_level() && self.sigma.is_some() {
            return parameter(
                "sigma",
                "given".into(),
                "left out in a stage of total variation alone",
            );
        }
        Ok(())
    }
}

/// The plan of a reconstruction (Algorithm 1 of the paper is two stages).
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// How projection and prior alternate.
    pub method: Method,
    /// Accelerated GAP: the residuals add up in `y1`, through all stages, as far as each stage's
    /// `memory` keeps them.
    pub accelerated: bool,
    /// Noise term added to the gram diagonal, >= 0.
    pub gamma: f32,
    /// The iterations of stages with a level are the most that may be: how many pay is found out
    /// on a piece of the measurement ([`super::pilot`]), once for all tiles.
    pub adaptive: bool,
    /// The stages, one after the other ("in cascade").
    pub stages: Vec<Stage>,
}

impl Schedule {
    /// Most iterations of all stages together.
    pub fn planned_iterations(&self) -> usize {
        self.stages.iter().map(|stage| stage.iterations).sum()
    }

    /// Most passes of the learned denoisers.
    pub fn planned_passes(&self) -> usize {
        let deep = self.stages.iter().filter(|stage| stage.prior.network().is_some());
        deep.map(|stage| stage.iterations).sum()
    }

    /// Whether a projection starts from anything but the last iterate itself.
    pub(super) fn has_own_start(&self) -> bool {
        self.method == Method::Admm || self.stages.iter().any(|stage| stage.momentum > 0.0)
    }

    /// The networks that the stages need, each once.
    pub fn networks(&self) -> Vec<Network> {
        let mut networks: Vec<Network> =
            self.stages.iter().filter_map(|stage| stage.prior.network()).collect();
        networks.sort();
        networks.dedup();
        networks
    }

    /// Fixes the total number of iterations and switches the convergence tests off: earlier
    /// stages keep their length as far as it goes, the last one takes the rest.
    pub fn with_iterations(mut self, total: usize) -> Self {
        self.adaptive = false;
        let mut left = total;
        let count = self.stages.len();
        for (index, stage) in self.stages.iter_mut().enumerate() {
            let wanted = if index + 1 == count { left } else { stage.iterations };
            stage.iterations = wanted.min(left);
            stage.tolerance = 0.0;
            left -= stage.iterations;
        }
        self.stages.retain(|stage| stage.iterations > 0);
        self
    }

    /// Checks every parameter; the error names the first that is out of range.
    pub fn validate(&self) -> Result<(), ReconError> {
        if self.stages.is_empty() {
            return Err(ReconError::Parameter {
                name: "stages",
                value: "empty".into(),
                range: "at least one stage of at least one iteration",
            });
        }
        if !self.gamma.is_finite() || self.gamma < 0.0 {
            return Err(ReconError::Parameter {
                name: "gamma",
                value: self.gamma.to_string(),
                range: "a finite number of at least 0",
            });
        }
        self.stages.iter().try_for_each(Stage::validate)
    }
}

#[cfg(test)]
mod tests {
    use super::{Network, Schedule, Sigma};

    #[test]
    fn defaults_are_valid() {
        for schedule in Schedule::defaults() {
            schedule.validate().unwrap();
        }
        assert!(Schedule::pnp_tv_fastdvdnet().planned_passes() <= 24);
        let both = [Network::FastDvdNet, Network::FastDvdNetInt8];
        assert_eq!(Schedule::pnp_tv_fastdvdnet().networks(), both);
        assert_eq!(Schedule::pnp_nonlocal().networks(), []);
    }

    #[test]
    fn sigma_falls_geometrically_from_first_to_last() {
        let schedule = Schedule::pnp_tv_fastdvdnet();
        let stage = &schedule.stages[1];
        let (first, last) = stage.sigma.unwrap();
        let at = |index| stage.sigma_at(index).unwrap().value();
        assert_eq!(at(0), first.value());
        assert!((at(stage.iterations - 1) - last.value()).abs() < 1e-6);
        assert!((at(2) / at(1) - at(1) / at(0)).abs() < 1e-5);
        // From 8 bits to floating point as from one iteration to the next.
        let next = schedule.stages[2].sigma_at(0).unwrap().value();
        assert!((next / last.value() - at(1) / at(0)).abs() < 1e-5);
    }

    #[test]
    fn a_fixed_count_cuts_or_stretches_the_last_stage() {
        let pnp = Schedule::pnp_tv_fastdvdnet();
        assert_eq!(pnp.clone().with_iterations(200).planned_iterations(), 200);
        let short = pnp.with_iterations(7);
        assert_eq!((short.stages.len(), short.planned_iterations()), (1, 7));
    }

    #[test]
    fn momentum_that_diverges_is_refused() {
        let mut schedule = Schedule::pnp_nonlocal();
        schedule.stages[1].memory = 0.75;
        let error = schedule.validate().unwrap_err().to_string();
        assert!(error.contains("memory 0.75") && error.contains("0.5"), "{error}");
    }

    #[test]
    fn levels_outside_the_unit_interval_are_refused() {
        for value in [0.0, -0.1, 25.0, f32::NAN] {
            assert!(Sigma::new(value).unwrap_err().to_string().contains("25/255"));
        }
    }
}
