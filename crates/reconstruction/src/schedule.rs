//! The schedule of a reconstruction: which priors run, how often, and how strongly.
//!
//! Jobs, `--schedule FILE` and manifests hold it as JSON. `docs/schedule.schema.json` and the components `Schedule` and
//! `Stage` of `openapi.yaml` are generated from these types.

use std::sync::LazyLock;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::bounds::{self, Fault};
use super::error::{ReconError, Result};
use super::priors::Network;
use super::priors::network::{FastdvdnetInt8Spec, FastdvdnetSpec};
use super::priors::registry::PriorSpec;
use super::stage::Stage;

/// The stages of the solver, one after the other. Algorithm 1 of the paper has two.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "Schedule of a reconstruction", extend("$id" = "urn:sci-recon:schema:schedule"))]
pub struct Schedule {
    /// The alternation of projection and prior.
    #[serde(default)]
    pub method: Method,
    /// Accelerated GAP: residuals accumulate through all stages, as far as the memory of each stage keeps them.
    #[serde(default = "yes")]
    pub accelerated: bool,
    /// Noise term added to the Gram diagonal; 0 forces y = Hx.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub gamma: f32,
    /// True if a pilot adapts the stages to the measurement, once for all tiles, by hold-out validation on a crop of the
    /// first snapshot. The iterations of a stage are then a maximum. The manifest states what the pilot decided.
    #[serde(default)]
    pub adaptive: bool,
    /// Heuristics of the pilot to leave out, for example to measure their gain.
    #[serde(default)]
    pub disabled: Vec<Heuristic>,
    /// The stages.
    #[schemars(length(min = 1, max = 32))]
    pub stages: Vec<Stage>,
}

/// The alternation of projection and prior. P(w) = w + R H^T (H R H^T + gamma)^-1 (y - H w), where R = 1 unless a stage sets
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

/// A decision of the pilot of an adaptive schedule (docs/ALGORITHM.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Heuristic {
    /// Ends the last stage where its hold-out error is smallest.
    EarlyStopping,
    /// Drops total variation along time.
    TemporalVariation,
    /// Multiplies temporal_shrinkage by 4, then by 8.
    TemporalShrinkage,
    /// Accepts strong shrinkage that removes nearly all temporal change, unless it is clearly worse.
    StaticScene,
    /// Applies strong shrinkage to static regions only.
    StaticRegions,
    /// Drops static_variance.
    StaticVariance,
    /// Adds a noise term gamma.
    NoiseTerm,
}

fn yes() -> bool {
    true
}

/// Largest number of iterations of a schedule; with more, a job would look hung.
pub const MAX_ITERATIONS: usize = 10_000;

/// The JSON schema, which holds the bounds of all parameters.
static SCHEMA: LazyLock<Value> = LazyLock::new(|| schemars::schema_for!(Schedule).to_value());

impl Schedule {
    /// A schedule without stages, for an algorithm that does not iterate.
    pub fn none() -> Self {
        Self { accelerated: false, adaptive: false, ..Self::gap(Vec::new()) }
    }

    /// Accelerated GAP with these stages, adapted to the measurement if any prior has a noise level.
    pub(crate) fn gap(stages: Vec<Stage>) -> Self {
        let adaptive = stages.iter().any(|stage| stage.prior.sigma().is_some());
        let (method, disabled) = (Method::Gap, Vec::new());
        Self { method, accelerated: true, gamma: 0.0, adaptive, disabled, stages }
    }

    /// True unless the schedule disables this heuristic of the pilot.
    pub(crate) fn has(&self, heuristic: Heuristic) -> bool {
        !self.disabled.contains(&heuristic)
    }

    /// Largest number of iterations of all stages together.
    pub fn planned_iterations(&self) -> usize {
        self.stages.iter().fold(0, |sum, stage| sum.saturating_add(stage.iterations_run()))
    }

    /// Largest number of iterations with a network.
    pub fn planned_passes(&self) -> usize {
        let learned = self.stages.iter().filter(|stage| stage.prior.network().is_some());
        learned.map(|stage| stage.iterations).sum()
    }

    /// True if a projection starts from anything but the last iterate.
    pub(crate) fn extrapolates(&self) -> bool {
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

    /// True if a stage runs a network.
    pub fn needs_network(&self) -> bool {
        self.stages.iter().any(|stage| stage.prior.network().is_some())
    }

    /// True if a result frame depends on its neighbours in time. Only then does it help to reconstruct snapshots together.
    pub fn looks_along_time(&self) -> bool {
        self.stages.iter().any(|stage| stage.prior.looks_along_time())
    }

    /// Replaces networks of 8 bits, which are faster on a CPU only, by those of 32 bits.
    #[must_use]
    pub fn with_float_networks(mut self) -> Self {
        for stage in &mut self.stages {
            if let PriorSpec::FastdvdnetInt8(FastdvdnetInt8Spec { sigma }) = stage.prior {
                stage.prior = PriorSpec::Fastdvdnet(FastdvdnetSpec { sigma });
            }
        }
        self
    }

    /// Fixes the total number of iterations and switches convergence tests, adaptation and static regions off: earlier
    /// stages keep their length as far as possible, the last one takes the remainder.
    pub fn with_iterations(mut self, total: usize) -> Self {
        self.adaptive = false;
        let mut remaining = total;
        let count = self.stages.len();
        for (index, stage) in self.stages.iter_mut().enumerate() {
            let wanted = if index + 1 == count { remaining } else { stage.iterations };
            let iterations = wanted.min(remaining);
            *stage = Stage { iterations, tolerance: 0.0, ..stage.without_static_regions() };
            remaining -= iterations;
        }
        self.stages.retain(|stage| stage.iterations > 0);
        self
    }

    /// All faults, each with a JSON pointer relative to the schedule.
    pub fn faults(&self) -> Vec<(String, ReconError)> {
        let value = serde_json::to_value(self).unwrap_or_default();
        let mut faults: Vec<Fault> = bounds::check(&value, &SCHEMA, &SCHEMA, "");
        for (index, stage) in self.stages.iter().enumerate() {
            let conflict = stage.conflict();
            faults
                .extend(conflict.map(|(field, error)| (format!("/stages/{index}/{field}"), error)));
        }
        let planned = self.planned_iterations();
        if planned > MAX_ITERATIONS {
            let range = "at most 10000 over all stages".into();
            let (name, value) = ("iterations".into(), format!("{planned} in all"));
            faults.push(("/stages".into(), ReconError::Parameter { name, value, range }));
        }
        faults
    }

    /// Refuses a schedule with a fault.
    ///
    /// # Errors
    /// The first of [`Schedule::faults`].
    pub fn validate(&self) -> Result<()> {
        self.faults().into_iter().next().map_or(Ok(()), |(_, error)| Err(error))
    }

    /// Planned cost, CPU-nanoseconds per voxel: the weight behind progress, remaining time and fair sharing.
    pub fn planned_ns_per_voxel(&self) -> f64 {
        self.stages.iter().map(Stage::planned_ns).sum()
    }

    /// Completed share of the planned cost, on \[0,1\], after `iteration` iterations of the stage with index `stage` and all
    /// stages before it.
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

#[cfg(test)]
mod tests {
    use super::{SCHEMA, Schedule};
    use crate::priors::Network;
    use crate::priors::nonlocal::NonlocalSpec;
    use crate::priors::registry::PriorName;
    use crate::stage::Stage;
    use serde_json::{Value, json};
    use std::collections::BTreeSet;
    use std::path::{Path, PathBuf};
    use strum::VariantNames;

    fn pointers(schedule: Value) -> Vec<String> {
        let schedule: Schedule = serde_json::from_value(schedule).unwrap();
        schedule.faults().into_iter().map(|(pointer, _)| pointer).collect()
    }

    #[test]
    fn defaults_are_valid_and_survive_json() {
        for schedule in Schedule::defaults() {
            schedule.validate().unwrap();
            let text = serde_json::to_string(&schedule).unwrap();
            assert_eq!(serde_json::from_str::<Schedule>(&text).unwrap(), schedule);
        }
        assert!(Schedule::pnp_tv_fastdvdnet().planned_passes() <= 24);
        let both = [Network::FastDvdNet, Network::FastDvdNetInt8];
        assert_eq!(Schedule::pnp_fastdvdnet().networks(), both);
        assert_eq!(Schedule::pnp_tv_fastdvdnet().networks(), [Network::FastDvdNetInt8]);
        assert_eq!(Schedule::pnp_nonlocal().networks(), []);
    }

    #[test]
    fn numbers_beyond_32_bits_are_refused() {
        for (field, value) in
            [("gamma", "1e308"), ("static_variance", "-1e308"), ("momentum", "1e39")]
        {
            let text = format!(
                r#"{{"stages":[{{"prior":"nonlocal","sigma":[0.1,0.01],"iterations":9,"{field}":{value}}}]}}"#
            );
            let error = serde_json::from_str::<Schedule>(&text).unwrap_err().to_string();
            assert!(error.contains(field) && error.contains("out of range"), "{error}");
        }
    }

    #[test]
    fn sigma_falls_geometrically_from_first_to_last() {
        let schedule = Schedule::pnp_fastdvdnet();
        let stage = &schedule.stages[1];
        let [first, last] = stage.prior.sigma().unwrap();
        let at = |index| stage.sigma_at(index).unwrap();
        assert_eq!(at(0), first);
        assert!((at(stage.iterations - 1) - last).abs() < 1e-6);
        assert!((at(2) / at(1) - at(1) / at(0)).abs() < 1e-5);
        // The step from 8 bits to floating point equals the step between iterations.
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
        schedule.stages[1].projection.memory = 0.75;
        let error = schedule.validate().unwrap_err().to_string();
        assert!(error.contains("memory 0.75") && error.contains("0.5"), "{error}");
    }

    #[test]
    fn static_shrinkage_requires_temporal_shrinkage() {
        let mut schedule = Schedule::pnp_nonlocal();
        let planned = (schedule.planned_iterations(), schedule.planned_ns_per_voxel());
        let once = (schedule.stages[1].iterations, schedule.stages[1].planned_ns());
        let nonlocal = |schedule: &mut Schedule, edit: fn(&mut NonlocalSpec)| {
            edit(schedule.stages[1].prior.nonlocal_mut().unwrap());
        };
        nonlocal(&mut schedule, |spec| spec.static_shrinkage = Some(1.4));
        assert!(schedule.validate().is_ok(), "{:?}", schedule.validate());
        assert_eq!(schedule.planned_iterations(), planned.0 + once.0, "it is run twice");
        assert_eq!(schedule.planned_ns_per_voxel(), planned.1 + once.1);
        assert_eq!(schedule.share_done(2, 0), 1.0);
        nonlocal(&mut schedule, |spec| spec.temporal_shrinkage = 0.0);
        let error = schedule.validate().unwrap_err().to_string();
        assert!(error.contains("static_shrinkage") && error.contains("temporal_shrinkage"));
        nonlocal(&mut schedule, |spec| (spec.static_shrinkage, spec.all_static) = (None, true));
        let error = schedule.validate().unwrap_err().to_string();
        assert!(error.contains("all_static") && error.contains("static_shrinkage"), "{error}");
    }

    #[test]
    fn levels_outside_the_unit_interval_are_refused() {
        for value in [0.0, -0.1, 25.0, f32::NAN] {
            let mut schedule = Schedule::pnp_nonlocal();
            schedule.stages[1].prior.set_sigma([value, 0.1]);
            let error = schedule.validate().unwrap_err().to_string();
            assert!(error.contains("above 0 and at most 1") && error.contains("25/255"), "{error}");
        }
    }

    #[test]
    fn faults_point_at_their_place() {
        let tv = json!({"prior": "tv", "iterations": 5, "tv_weight": 0.1});
        let zero = json!({"prior": "tv", "iterations": 0, "tv_weight": 0.1});
        let deep = json!({"prior": "ffdnet", "iterations": 5, "sigma": [0.1, 2.0]});
        let negative =
            json!({"prior": "tv", "iterations": 3, "tv_weight": 0.1, "temporal_weight": -0.1});
        let idle = json!({"prior": "tv", "iterations": 3, "tv_weight": 0.0, "tv_updates": 0});
        let smallest =
            json!({"prior": "tv", "iterations": 3, "tv_weight": 0.0, "static_variance": 0.01});
        let lower =
            json!({"prior": "tv", "iterations": 3, "tv_weight": 0.0, "static_variance": 0.009});
        let stages = json!({"stages": [tv, zero, deep, negative, idle, smallest, lower]});
        let expected = [
            "/stages/1/iterations",
            "/stages/2/sigma",
            "/stages/3/temporal_weight",
            "/stages/4/tv_updates",
            "/stages/6/static_variance",
        ];
        assert_eq!(pointers(stages), expected);
        assert_eq!(pointers(json!({"stages": []})), ["/stages"]);
        assert_eq!(pointers(json!({"stages": vec![tv.clone(); 33]})), ["/stages"]);
        assert_eq!(pointers(json!({"gamma": -1.0, "stages": [tv]})), ["/gamma"]);
        let long = json!({"prior": "tv", "iterations": 6000, "tv_weight": 0.1});
        assert_eq!(pointers(json!({"stages": [long, long]})), ["/stages"]);
    }

    #[test]
    fn stages_that_do_not_fit_their_prior_are_refused() {
        let error = |stage: Value| {
            serde_json::from_value::<Schedule>(json!({"stages": [stage]})).unwrap_err().to_string()
        };
        for (stage, message) in [
            (json!({"prior": "tv", "iteration": 5}), "unknown field `iteration`, expected one of"),
            (
                json!({"prior": "median", "iterations": 5}),
                "unknown variant `median`, expected one of `tv`, `nonlocal`",
            ),
            (json!({"iterations": 5}), "missing field `prior`"),
            (json!({"prior": "tv", "tv_weight": 0.1}), "missing field `iterations`"),
            (json!({"prior": "tv", "iterations": 5}), "missing field `tv_weight`"),
            (json!({"prior": "fastdvdnet", "iterations": 5}), "missing field `sigma`"),
            (
                json!({"prior": "tv+fastdvdnet", "iterations": 5, "sigma": [0.1, 0.1]}),
                "missing field `tv_weight`",
            ),
            (
                json!({"prior": "tv", "iterations": "x", "tv_weight": 0.1}),
                "iterations: invalid type",
            ),
            (json!({"prior": "tv", "iterations": 5, "tv_weight": "x"}), "tv_weight: invalid type"),
            (
                json!({"prior": "tv", "iterations": 5, "tv_weight": 0.1, "sigma": [0.1, 0.1]}),
                "unknown field `sigma`",
            ),
            (
                json!({"prior": "nonlocal", "iterations": 3, "sigma": [0.1, 0.1], "temporal_weight": 0.1}),
                "unknown field `temporal_weight`",
            ),
        ] {
            let found = error(stage);
            assert!(found.contains(message), "{found}");
        }
    }

    /// The schema and the server agree on each prior with each parameter.
    #[test]
    fn the_schema_names_the_fields_that_the_server_reads() {
        let every = json!({"iterations": 3, "sigma": [0.1, 0.1], "tv_weight": 0.1, "tv_updates": 4,
            "temporal_weight": 0.0, "temporal_shrinkage": 0.3, "static_shrinkage": 1.0,
            "all_static": false, "motion_compensation": true, "outlier_limit": 4.0, "memory": 1.0,
            "static_variance": null, "gamma": null, "momentum": 0.0, "tolerance": 0.0});
        let schema = schemars::schema_for!(Stage).to_value();
        for prior in PriorName::VARIANTS {
            let alternatives = schema["oneOf"].as_array().unwrap();
            let own = alternatives
                .iter()
                .find(|one| one["properties"]["prior"]["const"] == *prior)
                .unwrap();
            let place = own["$ref"].as_str().unwrap().trim_start_matches('#');
            let parameters = &schema.pointer(place).unwrap()["properties"];
            let known = |name: &String| {
                !schema["properties"][name].is_null() || !parameters[name].is_null()
            };
            let mut fields = every.as_object().unwrap().clone();
            fields.retain(|name, _| known(name));
            fields.insert("prior".into(), (*prior).into());
            let stage: Stage = serde_json::from_value(fields.clone().into()).unwrap();
            let written = serde_json::to_value(&stage).unwrap();
            let names = |fields: &serde_json::Map<String, Value>| -> BTreeSet<String> {
                fields.keys().cloned().collect()
            };
            assert_eq!(names(written.as_object().unwrap()), names(&fields), "{prior}");
        }
    }

    #[test]
    fn shares_of_the_work_follow_the_cost() {
        let schedule = Schedule::pnp_ffdnet();
        assert_eq!(schedule.share_done(0, 0), 0.0);
        assert!(schedule.share_done(1, 0) < 0.01, "after all TV iterations");
        let half = schedule.stages[1].iterations / 2;
        assert!(
            (schedule.share_done(1, half) - 0.5).abs() < 0.01,
            "half of the network's iterations"
        );
        assert_eq!(schedule.share_done(2, 0), 1.0);
    }

    fn place(path: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
    }

    /// Holds a file to `content`, or writes it with `SCI_RECON_WRITE_SCHEMA`.
    fn hold(path: &str, content: &str) {
        if std::env::var_os("SCI_RECON_WRITE_SCHEMA").is_some() {
            std::fs::write(place(path), content).unwrap();
        }
        assert!(
            std::fs::read_to_string(place(path)).unwrap() == content,
            "{path} is not up to date: run this test with SCI_RECON_WRITE_SCHEMA=1"
        );
    }

    #[test]
    fn the_published_schema_is_generated() {
        hold("docs/schedule.schema.json", &format!("{:#}\n", *SCHEMA));
    }
}
