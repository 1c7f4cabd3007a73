//! The solver's schedule as data: what stands in a job, in `--schedule FILE` and in the manifest.
//!
//! `docs/schedule.schema.json` is the published schema of this JSON.

use serde::{Deserialize, Serialize};

use super::text::InvalidField;
use crate::recon::ReconError;
use crate::recon::schedule::{Method, Network, Prior, Schedule, Sigma, Stage};

/// A schedule: the stages of the solver, one after the other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleSpec {
    /// How projection and prior alternate.
    #[serde(default)]
    pub method: MethodSpec,
    /// Use accelerated GAP; its residual accumulator lives through all stages.
    #[serde(default = "yes")]
    pub accelerated: bool,
    /// Noise term added to the gram diagonal, at least 0. 0 forces y = Hx.
    #[serde(default)]
    pub gamma: f32,
    /// Find out on a piece of the measurement, once for all tiles, how many iterations of the stages
    /// with a level pay; `iterations` is the most that there will be.
    #[serde(default)]
    pub adaptive: bool,
    /// The stages, at least one.
    pub stages: Vec<StageSpec>,
}

/// How projection and prior alternate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodSpec {
    /// Generalized alternating projection.
    #[default]
    Gap,
    /// Alternating direction method of multipliers.
    Admm,
}

/// One stage: a prior and the number of iterations with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StageSpec {
    /// The denoiser of this stage.
    pub prior: PriorSpec,
    /// The most iterations, at least 1.
    pub iterations: usize,
    /// Noise level on [0, 1] at the first and the last iteration, geometric between them.
    /// Needed by all priors but `tv`, and refused for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<[f32; 2]>,
    /// Weight of the total variation; needed by `tv` and `tv+fastdvdnet`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tv_weight: Option<f32>,
    /// Dual (Chambolle) updates for each TV step; 4 where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tv_updates: Option<usize>,
    /// Weight of the total variation along time, which comes before that of each frame; none where it
    /// is left out. An adaptive schedule leaves it out where it does not pay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub temporal_weight: Option<f32>,
    /// Share of the accumulated residual that accelerated GAP keeps from one iteration to the
    /// next, on [0, 1]; 1 where it is left out.
    #[serde(default = "one")]
    pub memory: f32,
    /// Extrapolation of the iterates, on [0, 1); 0 where it is left out.
    #[serde(default)]
    pub momentum: f32,
    /// The stage ends early once ||v_k - v_(k-1)|| / ||v_k|| is below this; 0 never does.
    #[serde(default)]
    pub tolerance: f32,
}

/// The priors that a stage can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum PriorSpec {
    /// Isotropic total variation of each frame.
    #[serde(rename = "tv")]
    Tv,
    /// Groups of similar patches, filtered by their own covariance.
    #[serde(rename = "nonlocal")]
    Nonlocal,
    /// FFDNet, frame by frame.
    #[serde(rename = "ffdnet")]
    FfdNet,
    /// FastDVDNet over the clip.
    #[serde(rename = "fastdvdnet")]
    FastDvdNet,
    /// FastDVDNet with weights and activations of 8 bits.
    #[serde(rename = "fastdvdnet-int8")]
    FastDvdNetInt8,
    /// TV, then FastDVDNet, in each iteration.
    #[serde(rename = "tv+fastdvdnet")]
    TvFastDvdNet,
}

fn yes() -> bool {
    true
}

fn one() -> f32 {
    1.0
}

/// Dual updates of a TV step where the schedule does not say.
pub(super) const DEFAULT_TV_UPDATES: usize = 4;
/// The most stages of a schedule.
const MAX_STAGES: usize = 32;
/// The most iterations of a schedule; with more, a job would look hung.
const MAX_ITERATIONS: usize = 10_000;

impl PriorSpec {
    fn to_prior(self) -> Prior {
        match self {
            Self::Tv => Prior::Tv,
            Self::Nonlocal => Prior::Nonlocal,
            Self::FfdNet => Prior::Deep(Network::FfdNet),
            Self::FastDvdNet => Prior::Deep(Network::FastDvdNet),
            Self::FastDvdNetInt8 => Prior::Deep(Network::FastDvdNetInt8),
            Self::TvFastDvdNet => Prior::TvFastDvdNet,
        }
    }

    /// The name in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Tv => "tv",
            Self::Nonlocal => "nonlocal",
            Self::FfdNet => "ffdnet",
            Self::FastDvdNet => "fastdvdnet",
            Self::FastDvdNetInt8 => "fastdvdnet-int8",
            Self::TvFastDvdNet => "tv+fastdvdnet",
        }
    }

    /// True if the prior runs a learned denoiser.
    #[must_use]
    pub fn is_deep(self) -> bool {
        self.to_prior().network().is_some()
    }

    /// True if the prior runs total variation.
    #[must_use]
    pub fn has_tv(self) -> bool {
        self.to_prior().uses_tv()
    }
}

impl StageSpec {
    fn to_stage(&self) -> Result<Stage, ReconError> {
        let sigma = match self.sigma {
            Some([first, last]) => Some((Sigma::new(first)?, Sigma::new(last)?)),
            None => None,
        };
        Ok(Stage {
            prior: self.prior.to_prior(),
            iterations: self.iterations,
            sigma,
            tv_weight: self.tv_weight.unwrap_or(0.0),
            tv_updates: self.tv_updates.unwrap_or(DEFAULT_TV_UPDATES),
            temporal_weight: self.temporal_weight.unwrap_or(0.0),
            memory: self.memory,
            momentum: self.momentum,
            tolerance: self.tolerance,
        })
    }

    /// What the core does not refuse, because it is no error of numbers: a TV without a weight,
    /// or a weight without a TV.
    fn misfit(&self) -> Option<(&'static str, String)> {
        match (self.prior.has_tv(), self.tv_weight) {
            (true, None) => Some(("tv_weight", "a stage with TV needs its weight".into())),
            (false, Some(_)) => Some(("tv_weight", "this stage has no TV; leave it out".into())),
            (false, None) if self.temporal_weight.is_some() => {
                Some(("temporal_weight", "this stage has no TV; leave it out".into()))
            }
            _ => None,
        }
    }
}

impl ScheduleSpec {
    /// That of an algorithm that does not iterate.
    pub(super) fn without_stages() -> Self {
        Self {
            method: MethodSpec::Gap,
            accelerated: false,
            gamma: 0.0,
            adaptive: false,
            stages: Vec::new(),
        }
    }

    /// The schedule as the core takes it.
    ///
    /// # Errors
    /// One entry for each stage that is wrong, with a JSON pointer relative to the schedule.
    pub fn to_schedule(&self) -> Result<Schedule, Vec<InvalidField>> {
        let mut errors = Vec::new();
        let method = match self.method {
            MethodSpec::Gap => Method::Gap,
            MethodSpec::Admm => Method::Admm,
        };
        let (accelerated, gamma, adaptive) = (self.accelerated, self.gamma, self.adaptive);
        let mut whole = Schedule { method, accelerated, gamma, adaptive, stages: Vec::new() };
        if self.stages.len() > MAX_STAGES {
            let message = format!("{} stages; at most {MAX_STAGES} are taken", self.stages.len());
            return Err(vec![InvalidField::new("/stages", message)]);
        }
        for (index, spec) in self.stages.iter().enumerate() {
            let stage = spec.to_stage().and_then(|stage| {
                // Alone in a schedule, so that the error is known to be this stage's.
                let alone = Schedule { stages: vec![stage.clone()], ..Schedule::gap_tv() };
                alone.validate().map(|()| stage)
            });
            match (stage, spec.misfit()) {
                (Err(error), _) => errors.push(at(&format!("/stages/{index}"), &error)),
                (Ok(_), Some((field, message))) => {
                    errors.push(InvalidField::new(format!("/stages/{index}/{field}"), message));
                }
                (Ok(stage), None) => whole.stages.push(stage),
            }
        }
        if self.planned_iterations() > MAX_ITERATIONS {
            let planned = self.planned_iterations();
            let message =
                format!("{planned} iterations in all; at most {MAX_ITERATIONS} are taken");
            errors.push(InvalidField::new("/stages", message));
        }
        if errors.is_empty() {
            whole.validate().map_err(|error| vec![at("", &error)])?;
            return Ok(whole);
        }
        Err(errors)
    }

    /// The most iterations that a run takes.
    #[must_use]
    pub fn planned_iterations(&self) -> usize {
        self.stages.iter().fold(0, |sum, stage| sum.saturating_add(stage.iterations))
    }

    /// The most deep passes that a run takes.
    #[must_use]
    pub fn planned_passes(&self) -> usize {
        self.stages.iter().filter(|s| s.prior.is_deep()).map(|s| s.iterations).sum()
    }

    /// The networks that the stages need, each once.
    #[must_use]
    pub fn networks(&self) -> Vec<Network> {
        let mut networks: Vec<Network> =
            self.stages.iter().filter_map(|stage| stage.prior.to_prior().network()).collect();
        networks.sort();
        networks.dedup();
        networks
    }

    /// True if a stage runs a learned denoiser.
    #[must_use]
    pub fn needs_network(&self) -> bool {
        self.stages.iter().any(|stage| stage.prior.is_deep())
    }
}

/// Where in the JSON a parameter that the core refuses stands.
fn at(place: &str, error: &ReconError) -> InvalidField {
    let pointer = match error {
        ReconError::Parameter { name, .. } => format!("{place}/{name}"),
        _ => place.to_owned(),
    };
    InvalidField::new(pointer, error.to_string())
}

impl From<&Schedule> for ScheduleSpec {
    fn from(schedule: &Schedule) -> Self {
        let stage = |stage: &Stage| {
            let tv = stage.prior.uses_tv();
            StageSpec {
                prior: match stage.prior {
                    Prior::Tv => PriorSpec::Tv,
                    Prior::Nonlocal => PriorSpec::Nonlocal,
                    Prior::Deep(Network::FfdNet) => PriorSpec::FfdNet,
                    Prior::Deep(Network::FastDvdNet) => PriorSpec::FastDvdNet,
                    Prior::Deep(Network::FastDvdNetInt8) => PriorSpec::FastDvdNetInt8,
                    Prior::TvFastDvdNet => PriorSpec::TvFastDvdNet,
                },
                iterations: stage.iterations,
                sigma: stage.sigma.map(|(first, last)| [first.value(), last.value()]),
                tv_weight: tv.then_some(stage.tv_weight),
                tv_updates: tv.then_some(stage.tv_updates),
                temporal_weight: (stage.temporal_weight > 0.0).then_some(stage.temporal_weight),
                memory: stage.memory,
                momentum: stage.momentum,
                tolerance: stage.tolerance,
            }
        };
        Self {
            method: match schedule.method {
                Method::Gap => MethodSpec::Gap,
                Method::Admm => MethodSpec::Admm,
            },
            accelerated: schedule.accelerated,
            gamma: schedule.gamma,
            adaptive: schedule.adaptive,
            stages: schedule.stages.iter().map(stage).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::ScheduleSpec;
    use crate::recon::schedule::Schedule;
    use serde_json::{Value, json};

    fn pointers(schedule: Value) -> Vec<String> {
        let spec: ScheduleSpec = serde_json::from_value(schedule).unwrap();
        spec.to_schedule().unwrap_err().into_iter().map(|error| error.pointer).collect()
    }

    #[test]
    fn the_default_schedules_survive_the_way_through_json() {
        for schedule in Schedule::defaults() {
            let spec = ScheduleSpec::from(&schedule);
            let text = serde_json::to_string(&spec).unwrap();
            let read: ScheduleSpec = serde_json::from_str(&text).unwrap();
            assert_eq!(read, spec);
            assert_eq!(read.to_schedule().unwrap(), schedule);
        }
    }

    #[test]
    fn errors_point_at_their_place() {
        let tv = json!({"prior": "tv", "iterations": 5, "tv_weight": 0.1});
        let deep = json!({"prior": "fastdvdnet", "iterations": 5});
        let zero = json!({"prior": "tv", "iterations": 0, "tv_weight": 0.1});
        let bare = json!({"prior": "tv", "iterations": 3});
        let timed = json!({"prior": "nonlocal", "iterations": 3, "sigma": [0.1, 0.1], "temporal_weight": 0.1});
        let negative =
            json!({"prior": "tv", "iterations": 3, "tv_weight": 0.1, "temporal_weight": -0.1});
        let idle = json!({"prior": "tv", "iterations": 3, "tv_weight": 0.0, "temporal_weight": 0.1, "tv_updates": 0});
        let stages = json!({"stages": [tv, deep, zero, bare, timed, negative, idle]});
        let expected = [
            "/stages/1/sigma",
            "/stages/2/iterations",
            "/stages/3/tv_weight",
            "/stages/4/temporal_weight",
            "/stages/5/temporal_weight",
            "/stages/6/tv_updates",
        ];
        assert_eq!(pointers(stages), expected);
        assert_eq!(pointers(json!({"stages": []})), ["/stages"]);
        assert_eq!(pointers(json!({"gamma": -1.0, "stages": [tv]})), ["/gamma"]);
    }

    #[test]
    fn unknown_fields_are_refused() {
        let typo = json!({"stages": [{"prior": "tv", "iteration": 5}]});
        assert!(serde_json::from_value::<ScheduleSpec>(typo).is_err());
    }
}
