//! The schedule of a reconstruction: which prior runs how often, and how strongly.
//!
//! It is told here once, as it stands in jobs, in `--schedule FILE` and in manifests;
//! `docs/schedule.schema.json` is made from these types.

use std::ops::Bound;

use schemars::{JsonSchema, Schema, json_schema};
use serde::{Deserialize, Serialize};

use super::error::{ReconError, Result};
use super::prior::registry::PRIORS;
use super::prior::{
    Network, Parameter, Prior, SIGMA, Settings, TEMPORAL_SHRINKAGE, TEMPORAL_WEIGHT, TV_UPDATES,
    TV_WEIGHT,
};

/// The stages of the solver, one after the other (Algorithm 1 of the paper is two).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "Schedule of a reconstruction", extend("$id" = "urn:sci-recon:schema:schedule"))]
pub struct Schedule {
    /// How projection and prior alternate.
    #[serde(default)]
    pub method: Method,
    /// Accelerated GAP: the residuals add up, through all stages, as far as each stage's memory keeps them.
    #[serde(default = "yes")]
    pub accelerated: bool,
    /// Noise term added to the gram diagonal; 0 forces y = Hx.
    #[serde(default)]
    #[schemars(transform = GAMMA.bounds())]
    pub gamma: f32,
    /// Find out on a piece of the measurement, once for all tiles, how many iterations of the stages with a
    /// level pay (hold-out validation with early stopping); iterations is then the most that there will be.
    #[serde(default)]
    pub adaptive: bool,
    /// The stages.
    #[schemars(length(min = 1, max = MAX_STAGES))]
    pub stages: Vec<Stage>,
}

/// How projection and prior alternate. P(w) = w + R H^T (H R H^T + gamma)^-1 (y - H w), where R = 1 or by a stage's
/// static_variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Generalized alternating projection: x = P(v), v = D(x).
    #[default]
    Gap,
    /// Alternating direction method of multipliers: x = P(v + u), v = D(x - u), u becomes u - (x - v).
    Admm,
}

/// A run of iterations with one prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(transform = tell_who_takes_what)]
pub struct Stage {
    /// The prior: what stands for D in v = D(x).
    pub prior: &'static dyn Prior,
    /// The most iterations; over all stages at most 10000.
    #[schemars(transform = ITERATIONS.bounds())]
    pub iterations: usize,
    /// Noise level on [0, 1] at the first and the last iteration, geometric between them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = SIGMA.bounds())]
    pub sigma: Option<[f32; 2]>,
    /// Weight of the total variation on the [0, 1] scale; 0 for none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = TV_WEIGHT.bounds())]
    pub tv_weight: Option<f32>,
    /// Dual (Chambolle) updates of each step of total variation; 4 where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = TV_UPDATES.bounds())]
    pub tv_updates: Option<usize>,
    /// Weight of the total variation along time, pixel by pixel, which comes before that of each frame and
    /// makes as many updates; none where it is left out. An adaptive schedule leaves it out where it does not
    /// pay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = TEMPORAL_WEIGHT.bounds())]
    pub temporal_weight: Option<f32>,
    /// Shrinkage of changes along time in the nonlocal prior: cosines along time of a pixel (DCT-II) whose
    /// mean square e over 5x5 pixels is small lose the share l^4 / (l^4 + e^2), where l is this times sigma;
    /// none where it is left out. An adaptive schedule takes twice as much, or leaves it out, where that pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = TEMPORAL_SHRINKAGE.bounds())]
    pub temporal_shrinkage: Option<f32>,
    /// The same where nothing moves. The stage is run a second time from its start, with this shrinkage, and its
    /// frames are those of the second run where the changes before the stage and after its first run, over 17x17
    /// pixels, have a correlation below 0.65, those of the first from 0.8 on, and a mean between; one run where it
    /// is left out. Only beside temporal_shrinkage. An adaptive schedule takes four or eight times that where that
    /// pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = REST_SHRINKAGE.bounds())]
    pub rest_shrinkage: Option<f32>,
    /// Whether all is taken to be at rest: the frames are those of the second run, and the first one only helps to
    /// tell how near they come to the truth. Only beside rest_shrinkage. An adaptive schedule does so with a stage
    /// that it ends in its first half, whose changes are mostly noise.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rest_everywhere: bool,
    /// Share of the accumulated residual that accelerated GAP keeps from one iteration to the next: 1 is
    /// accelerated GAP, 0 plain GAP. A learned denoiser never explains the measurement fully, so with 1 the
    /// residual winds up in its stages.
    #[serde(default = "one")]
    #[schemars(transform = MEMORY.bounds())]
    pub memory: f32,
    /// Extrapolation of the iterates: the projection starts from v_k + momentum (v_k - v_(k-1)), which makes
    /// fewer passes do. Momentum times memory is at most 0.5.
    #[serde(default)]
    #[schemars(transform = MOMENTUM.bounds())]
    pub momentum: f32,
    /// Variance of the part of the frames' error that all frames of a snapshot share, in units of that of its
    /// slowest change. The projection supposes then that errors change slowly from frame to frame, with the
    /// covariance R, the variance of whose cosine m is this for m = 0 and m^-0.4 from m = 1 on; without it R
    /// = 1. More frames have more to change, and masks that are alike tell little of the changes: so this is
    /// for Cr 10, and at others, and where only a share c of the masks' energy changes from frame to frame,
    /// it is multiplied by the least of n = (10 / Cr)^0.5, (c / 0.125)^1.5 and the greater of 0.55 and
    /// n (c / c0)^0.9, where c0 = 0.45 (1 - 1 / Cr). An adaptive schedule doubles it, or leaves it out, where
    /// that pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = STATIC_VARIANCE.bounds())]
    pub static_variance: Option<f32>,
    /// Noise term of this stage in place of the schedule's: the variance of a measured pixel's noise, in units
    /// of that of the slowest change of the frames' error at a pixel. Where it is left out, an adaptive schedule
    /// finds one of 0.3, 1 and 3 for a stage with static_variance, if one pays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(transform = GAMMA.bounds())]
    pub gamma: Option<f32>,
    /// The stage ends early once ||v_k - v_(k-1)|| / ||v_k|| is below this; 0 never does.
    #[serde(default)]
    #[schemars(transform = TOLERANCE.bounds())]
    pub tolerance: f32,
}

fn yes() -> bool {
    true
}

fn one() -> f32 {
    1.0
}

/// Dual updates where the schedule does not say.
const DEFAULT_TV_UPDATES: usize = 4;
/// The most stages of a schedule.
const MAX_STAGES: usize = 32;
/// The most iterations of a schedule; with more, a job would look hung.
pub const MAX_ITERATIONS: usize = 10_000;
/// Cost of a projection with its update, CPU-nanoseconds per voxel (see [`Prior::cost`]).
const PROJECTION_NS: f64 = 0.7;

const GAMMA: Parameter = Parameter::not_negative("gamma");
const ITERATIONS: Parameter = Parameter {
    name: "iterations",
    needed: true,
    range: (Bound::Included(1.0), Bound::Included(MAX_ITERATIONS as f64)),
    words: "from 1 to 10000",
};
const MEMORY: Parameter = Parameter {
    name: "memory",
    needed: false,
    range: (Bound::Included(0.0), Bound::Included(1.0)),
    words: "from 0 to 1",
};
const MOMENTUM: Parameter = Parameter::share("momentum");
/// The highest static variance.
pub(super) const MAX_STATIC_VARIANCE: f32 = 2.0;
const STATIC_VARIANCE: Parameter = Parameter {
    name: "static_variance",
    needed: false,
    range: (Bound::Included(0.01), Bound::Included(MAX_STATIC_VARIANCE as f64)),
    words: "from 0.01 to 2",
};
const REST_SHRINKAGE: Parameter = Parameter::not_negative("rest_shrinkage");
const TOLERANCE: Parameter = Parameter::share("tolerance");

impl Stage {
    /// The noise level of iteration `index` (from 0) of the stage.
    pub fn sigma_at(&self, index: usize) -> Option<f32> {
        let [first, last] = self.sigma?;
        let share = index as f32 / (self.iterations.max(2) - 1) as f32;
        Some(first * (last / first).powf(share))
    }

    /// What the prior is told in iteration `index` (from 0).
    pub(super) fn settings(&self, index: usize) -> Settings {
        Settings {
            sigma: self.sigma_at(index).unwrap_or(0.0),
            tv_weight: self.tv_weight.unwrap_or(0.0),
            tv_updates: self.tv_updates.unwrap_or(DEFAULT_TV_UPDATES),
            temporal_weight: self.temporal_weight.unwrap_or(0.0),
            temporal_shrinkage: self.temporal_shrinkage.unwrap_or(0.0),
        }
    }

    /// The parameters that belong to a prior, as far as they are given.
    fn given(&self) -> [(&'static Parameter, Option<Vec<f32>>); 5] {
        let one = |value: Option<f32>| value.map(|value| vec![value]);
        // Without total variation it does no harm.
        let updates = self.tv_updates.filter(|_| self.prior.takes(&TV_UPDATES));
        [
            (&SIGMA, self.sigma.map(Vec::from)),
            (&TV_WEIGHT, one(self.tv_weight)),
            (&TEMPORAL_WEIGHT, one(self.temporal_weight)),
            (&TEMPORAL_SHRINKAGE, one(self.temporal_shrinkage)),
            (&TV_UPDATES, one(updates.map(|updates| updates as f32))),
        ]
    }

    fn check(&self) -> Result<()> {
        ITERATIONS.check(self.iterations as f32)?;
        for (parameter, given) in self.given() {
            match (self.prior.takes(parameter), given) {
                (false, Some(_)) => {
                    return Err(parameter.refused("given", "left out: this prior takes none"));
                }
                (true, None) if parameter.needed => {
                    return Err(parameter.refused("missing", "given: this prior needs it"));
                }
                (_, values) => {
                    values.iter().flatten().try_for_each(|&value| parameter.check(value))?;
                }
            }
        }
        TOLERANCE.check(self.tolerance)?;
        MEMORY.check(self.memory)?;
        MOMENTUM.check(self.momentum)?;
        self.static_variance.map_or(Ok(()), |variance| STATIC_VARIANCE.check(variance))?;
        self.gamma.map_or(Ok(()), |gamma| GAMMA.check(gamma))?;
        self.rest_shrinkage.map_or(Ok(()), |level| REST_SHRINKAGE.check(level))?;
        if self.rest_shrinkage.is_some() && self.temporal_shrinkage.is_none() {
            return Err(REST_SHRINKAGE.refused("given", "left out without temporal_shrinkage"));
        }
        if self.rest_everywhere && self.rest_shrinkage.is_none() {
            return Err(ReconError::Parameter {
                name: "rest_everywhere",
                value: "true".into(),
                range: "false without rest_shrinkage",
            });
        }
        // Where the prior passes everything (even brightness), an error `e` follows
        // `e_(k+1) = -memory momentum (e_k - e_(k-1))`.
        if self.memory * self.momentum > 0.5 {
            return Err(MOMENTUM.refused(
                format!("{} with memory {}", self.momentum, self.memory),
                "such that momentum times memory is at most 0.5; above, the brightness diverges",
            ));
        }
        Ok(())
    }

    /// The first run of a stage alone.
    pub(super) fn run_once(&self) -> Self {
        Self { rest_shrinkage: None, rest_everywhere: false, ..self.clone() }
    }

    /// The most iterations that are run, of both runs if there are two.
    pub(super) fn iterations_run(&self) -> usize {
        self.iterations.saturating_mul(1 + usize::from(self.rest_shrinkage.is_some()))
    }

    /// Planned cost of all its iterations, CPU-nanoseconds per voxel.
    pub(super) fn planned_ns(&self) -> f64 {
        self.iteration_ns() * self.iterations_run() as f64
    }

    /// Cost of one iteration, CPU-nanoseconds per voxel.
    fn iteration_ns(&self) -> f64 {
        PROJECTION_NS + self.prior.cost(&self.settings(0))
    }
}

impl Schedule {
    /// One without stages, of an algorithm that does not iterate.
    pub fn none() -> Self {
        let (method, gamma, stages) = (Method::Gap, 0.0, Vec::new());
        Self { method, accelerated: false, gamma, adaptive: false, stages }
    }

    /// Most iterations of all stages together.
    pub fn planned_iterations(&self) -> usize {
        self.stages.iter().fold(0, |sum, stage| sum.saturating_add(stage.iterations_run()))
    }

    /// Most passes of networks.
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

    /// Whether a stage runs a network.
    pub fn needs_network(&self) -> bool {
        self.stages.iter().any(|stage| stage.prior.network().is_some())
    }

    /// Whether frames depend on those before and after them: only then snapshots that follow one another
    /// are better together.
    pub fn looks_along_time(&self) -> bool {
        self.stages.iter().any(|stage| stage.prior.looks_along_time(&stage.settings(0)))
    }

    /// Fixes the total number of iterations, with one run of each stage, and switches the convergence tests off:
    /// earlier stages keep their length as far as it goes, the last one takes the rest.
    pub fn with_iterations(mut self, total: usize) -> Self {
        self.adaptive = false;
        let mut left = total;
        let count = self.stages.len();
        for (index, stage) in self.stages.iter_mut().enumerate() {
            let wanted = if index + 1 == count { left } else { stage.iterations };
            stage.iterations = wanted.min(left);
            stage.tolerance = 0.0;
            (stage.rest_shrinkage, stage.rest_everywhere) = (None, false);
            left -= stage.iterations;
        }
        self.stages.retain(|stage| stage.iterations > 0);
        self
    }

    /// The same with nothing left to a default: what is recorded of a run.
    pub fn filled(mut self) -> Self {
        for stage in &mut self.stages {
            let updates = stage.settings(0).tv_updates;
            stage.tv_updates = stage.prior.takes(&TV_UPDATES).then_some(updates);
            stage.temporal_weight = stage.temporal_weight.filter(|weight| *weight > 0.0);
            stage.temporal_shrinkage = stage.temporal_shrinkage.filter(|level| *level > 0.0);
            let twice = stage.temporal_shrinkage.is_some();
            stage.rest_shrinkage = stage.rest_shrinkage.filter(|_| twice);
            stage.rest_everywhere &= stage.rest_shrinkage.is_some();
        }
        self
    }

    /// What is wrong with it: for each stage the first fault, with a JSON pointer relative to the schedule.
    pub fn faults(&self) -> Vec<(String, ReconError)> {
        let parameter = |name, value, range| ReconError::Parameter { name, value, range };
        let count = self.stages.len();
        if !(1..=MAX_STAGES).contains(&count) {
            let error = parameter("stages", format!("a list of {count}"), "one of 1 to 32 stages");
            return vec![("/stages".into(), error)];
        }
        let fault = |place: String, error: ReconError| match &error {
            ReconError::Parameter { name, .. } => (format!("{place}/{name}"), error),
            _ => (place, error),
        };
        let mut faults: Vec<_> = (0..)
            .zip(&self.stages)
            .filter_map(|(index, stage)| {
                Some(fault(format!("/stages/{index}"), stage.check().err()?))
            })
            .collect();
        let planned = self.planned_iterations();
        if planned > MAX_ITERATIONS {
            let error = parameter(
                "iterations",
                format!("{planned} in all"),
                "at most 10000 over all stages",
            );
            faults.push(("/stages".into(), error));
        }
        faults.extend(GAMMA.check(self.gamma).err().map(|error| fault(String::new(), error)));
        faults
    }

    /// Refuses a schedule with a fault: the first is told.
    pub fn validate(&self) -> Result<()> {
        self.faults().into_iter().next().map_or(Ok(()), |(_, error)| Err(error))
    }

    /// The planned cost, CPU-nanoseconds per voxel: the weight behind percent, remaining time and fair sharing.
    pub fn planned_ns_per_voxel(&self) -> f64 {
        self.stages.iter().map(Stage::planned_ns).sum()
    }

    /// The share of the planned cost, on \[0,1\], that is behind a run which has done `iteration` iterations of
    /// the stage with index `stage` and has left all stages before it.
    pub fn share_done(&self, stage: usize, iteration: usize) -> f64 {
        let cost = |stage: &Stage, done: usize| {
            stage.iteration_ns() * done.min(stage.iterations_run()) as f64
        };
        let before: f64 = self.stages.iter().take(stage).map(Stage::planned_ns).sum();
        let here = self.stages.get(stage).map_or(0.0, |stage| cost(stage, iteration));
        let planned = self.planned_ns_per_voxel();
        if planned > 0.0 { ((before + here) / planned).clamp(0.0, 1.0) } else { 0.0 }
    }
}

/// Writes into the schema of a stage which priors take which parameters.
fn tell_who_takes_what(schema: &mut Schema) {
    let rule = |parameter: &Parameter| {
        let takers = PRIORS.iter().filter(|prior| prior.takes(parameter));
        let takers: Vec<&str> = takers.map(|prior| prior.name()).collect();
        let name = parameter.name;
        let given = json_schema!({ "required": [name], "properties": { name: { "not": { "type": "null" } } } });
        json_schema!({
            "if": { "properties": { "prior": { "enum": takers } } },
            "then": if parameter.needed { given } else { true.into() },
            "else": { "properties": { name: { "type": "null" } } },
        })
    };
    schema.insert(
        "allOf".into(),
        [&SIGMA, &TV_WEIGHT, &TEMPORAL_WEIGHT].map(rule).map(Schema::to_value).to_vec().into(),
    );
}

#[cfg(test)]
mod tests {
    use super::Schedule;
    use crate::prior::Network;
    use crate::prior::registry::PRIORS;
    use serde_json::{Value, json};
    use std::path::Path;

    fn pointers(schedule: Value) -> Vec<String> {
        let schedule: Schedule = serde_json::from_value(schedule).unwrap();
        schedule.faults().into_iter().map(|(pointer, _)| pointer).collect()
    }

    #[test]
    fn defaults_are_valid_and_survive_the_way_through_json() {
        for schedule in Schedule::defaults() {
            schedule.validate().unwrap();
            let text = serde_json::to_string(&schedule).unwrap();
            assert_eq!(serde_json::from_str::<Schedule>(&text).unwrap(), schedule);
            assert_eq!(schedule.clone().filled(), schedule);
        }
        assert!(Schedule::pnp_tv_fastdvdnet().planned_passes() <= 24);
        let both = [Network::FastDvdNet, Network::FastDvdNetInt8];
        assert_eq!(Schedule::pnp_fastdvdnet().networks(), both);
        assert_eq!(Schedule::pnp_tv_fastdvdnet().networks(), [Network::FastDvdNetInt8]);
        assert_eq!(Schedule::pnp_nonlocal().networks(), []);
    }

    #[test]
    fn sigma_falls_geometrically_from_first_to_last() {
        let schedule = Schedule::pnp_fastdvdnet();
        let stage = &schedule.stages[1];
        let [first, last] = stage.sigma.unwrap();
        let at = |index| stage.sigma_at(index).unwrap();
        assert_eq!(at(0), first);
        assert!((at(stage.iterations - 1) - last).abs() < 1e-6);
        assert!((at(2) / at(1) - at(1) / at(0)).abs() < 1e-5);
        // From 8 bits to floating point as from one iteration to the next.
        let next = schedule.stages[2].sigma_at(0).unwrap();
        assert!((next / last - at(1) / at(0)).abs() < 1e-5);
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
    fn shrinkage_at_rest_belongs_to_that_of_all_changes() {
        let mut schedule = Schedule::pnp_nonlocal();
        let planned = (schedule.planned_iterations(), schedule.planned_ns_per_voxel());
        let once = (schedule.stages[1].iterations, schedule.stages[1].planned_ns());
        schedule.stages[1].rest_shrinkage = Some(1.4);
        assert!(schedule.validate().is_ok(), "{:?}", schedule.validate());
        assert_eq!(schedule.planned_iterations(), planned.0 + once.0, "it is run twice");
        assert_eq!(schedule.planned_ns_per_voxel(), planned.1 + once.1);
        assert_eq!(schedule.share_done(2, 0), 1.0);
        schedule.stages[1].temporal_shrinkage = None;
        let error = schedule.validate().unwrap_err().to_string();
        assert!(
            error.contains("rest_shrinkage") && error.contains("temporal_shrinkage"),
            "{error}"
        );
        (schedule.stages[1].rest_shrinkage, schedule.stages[1].rest_everywhere) = (None, true);
        let error = schedule.validate().unwrap_err().to_string();
        assert!(error.contains("rest_everywhere") && error.contains("rest_shrinkage"), "{error}");
    }

    #[test]
    fn levels_outside_the_unit_interval_are_refused() {
        for value in [0.0, -0.1, 25.0, f32::NAN] {
            let mut schedule = Schedule::pnp_nonlocal();
            schedule.stages[1].sigma = Some([value, 0.1]);
            assert!(schedule.validate().unwrap_err().to_string().contains("25/255"));
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
        let long = json!({"prior": "tv", "iterations": 6000, "tv_weight": 0.1});
        assert_eq!(pointers(json!({"stages": [long, long]})), ["/stages"]);
    }

    #[test]
    fn unknown_fields_and_priors_are_refused() {
        let error = |stage: Value| {
            serde_json::from_value::<Schedule>(json!({"stages": [stage]})).unwrap_err().to_string()
        };
        assert!(
            error(json!({"prior": "tv", "iteration": 5})).contains("unknown field `iteration`")
        );
        let text = error(json!({"prior": "median", "iterations": 5}));
        assert!(
            text.contains("unknown variant `median`, expected one of `tv`, `nonlocal`"),
            "{text}"
        );
    }

    #[test]
    fn one_deep_pass_weighs_as_thousands_of_tv_iterations() {
        let schedule = Schedule::pnp_ffdnet();
        assert_eq!(schedule.share_done(0, 0), 0.0);
        assert!(schedule.share_done(1, 0) < 0.01, "after all TV iterations");
        let half = schedule.stages[1].iterations / 2;
        assert!((schedule.share_done(1, half) - 0.5).abs() < 0.01, "half of the deep passes");
        assert_eq!(schedule.share_done(2, 0), 1.0);
    }

    fn text(path: &str) -> String {
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path))
            .unwrap()
    }

    #[test]
    fn the_published_schema_is_that_of_the_type() {
        let schema = format!("{:#}\n", schemars::schema_for!(Schedule).to_value());
        if std::env::var_os("SCI_RECON_WRITE_SCHEMA").is_some() {
            std::fs::write("../../docs/schedule.schema.json", &schema).unwrap();
        }
        assert!(
            text("docs/schedule.schema.json") == schema,
            "docs/schedule.schema.json is not up to date: run this test with SCI_RECON_WRITE_SCHEMA=1"
        );
    }
}
