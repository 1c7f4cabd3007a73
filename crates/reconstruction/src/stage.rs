//! A stage of a schedule: a number of iterations with one prior.

use std::collections::HashMap;
use std::sync::LazyLock;

use schemars::{JsonSchema, Schema};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;
use strum::VariantNames;

use super::bounds;
use super::error::ReconError;
use super::fields::{self, Fields};
use super::priors::registry::{PriorName, PriorSpec};

/// Iterations with one prior.
///
/// JSON has one flat object: the fields of the stage, of its projection and of its prior.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(transform = close)]
pub struct Stage {
    /// The prior, which stands for D in v = D(x), and its parameters.
    #[serde(flatten)]
    pub prior: PriorSpec,
    /// Largest number of iterations; over all stages at most 10000.
    #[schemars(range(min = 1, max = 10_000))]
    pub iterations: usize,
    /// The projection that precedes the prior.
    #[serde(flatten)]
    pub projection: ProjectionSpec,
    /// Extrapolation of the iterates: the projection starts from v_k + momentum (v_k - v_(k-1)). Momentum times
    /// memory is at most 0.5.
    #[serde(default)]
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub momentum: f32,
    /// The stage ends early once ||v_k - v_(k-1)|| / ||v_k|| is below this; 0 never does.
    #[serde(default)]
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub tolerance: f32,
}

/// The parameters of the projection x = w + R H^T (H R H^T + gamma)^-1 (y1 - H w).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ProjectionSpec {
    /// Share of the accumulated residual that accelerated GAP keeps from one iteration to the next: 1 is accelerated
    /// GAP, 0 plain GAP. A learned denoiser never explains the measurement fully, so with 1 the residual winds up.
    #[serde(default = "one")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub memory: f32,
    /// Variance of the error that all frames of a snapshot share, in units of the variance of its slowest change. It
    /// sets the covariance R of the frames' errors: DCT coefficient m along time has this variance for m = 0, and
    /// m^-0.4 from m = 1 on. It holds for Cr 10 and masks of high contrast; the projection scales it for others
    /// (docs/ALGORITHM.md). With null, R = 1. An adaptive schedule sets null where that is better.
    #[serde(default)]
    #[schemars(range(min = 0.01, max = 2.0))]
    pub static_variance: Option<f32>,
    /// Noise term of this stage in place of the schedule's: variance of the noise of a measured pixel, in units of the
    /// variance of the slowest change of the frames' error. With null, an adaptive schedule tries 1, then 3, in a
    /// stage with static_variance.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub gamma: Option<f32>,
}

/// Cost of a projection with its extrapolation, CPU-nanoseconds per voxel (see [`super::priors::Spec::iteration_ns`]).
const PROJECTION_NS: f64 = 0.7;

fn one() -> f32 {
    1.0
}

/// Refuses other fields in the schema of a stage.
fn close(schema: &mut Schema) {
    schema.insert("unevaluatedProperties".into(), false.into());
}

impl Stage {
    /// Noise level of iteration `index` (from 0); none for a prior without one.
    pub fn sigma_at(&self, index: usize) -> Option<f32> {
        let [first, last] = self.prior.sigma()?;
        let share = index as f32 / (self.iterations.max(2) - 1) as f32;
        Some(first * (last / first).powf(share))
    }

    /// The stage with fewer iterations. Noise levels fall as before, but end earlier.
    pub(crate) fn shortened(&self, iterations: usize) -> Self {
        let mut stage = Self { iterations, ..self.clone() };
        let last = iterations.checked_sub(1).and_then(|last| self.sigma_at(last));
        if let (Some([first, _]), Some(last)) = (self.prior.sigma(), last) {
            stage.prior.set_sigma([first, last]);
        }
        stage
    }

    /// The first of the two runs of a stage that blends static regions; else the stage itself.
    pub(crate) fn without_static_regions(&self) -> Self {
        let mut stage = self.clone();
        if let Some(nonlocal) = stage.prior.nonlocal_mut() {
            (nonlocal.static_shrinkage, nonlocal.all_static) = (None, false);
        }
        stage
    }

    /// Shrinkage of static regions, if the stage is run twice and blended.
    pub fn static_shrinkage(&self) -> Option<f32> {
        self.prior.nonlocal().and_then(|nonlocal| nonlocal.static_shrinkage)
    }

    /// Largest number of iterations, both runs counted where static regions are blended.
    pub(crate) fn iterations_run(&self) -> usize {
        self.iterations.saturating_mul(1 + usize::from(self.static_shrinkage().is_some()))
    }

    /// Planned cost of all iterations, CPU-nanoseconds per voxel.
    pub(crate) fn planned_ns(&self) -> f64 {
        self.iteration_ns() * self.iterations_run() as f64
    }

    /// Cost of one iteration, CPU-nanoseconds per voxel.
    pub(crate) fn iteration_ns(&self) -> f64 {
        PROJECTION_NS + self.prior.iteration_ns()
    }

    /// The first rule between fields that the stage breaks: the field, and the error.
    pub(crate) fn conflict(&self) -> Option<(&'static str, ReconError)> {
        let refused = |name: &'static str, value: String, range: &'static str| {
            Some((name, ReconError::Parameter { name: name.into(), value, range: range.into() }))
        };
        if let Some(nonlocal) = self.prior.nonlocal() {
            if nonlocal.static_shrinkage.is_some() && nonlocal.temporal_shrinkage == 0.0 {
                let range = "left out without temporal_shrinkage";
                return refused("static_shrinkage", "given".into(), range);
            }
            if nonlocal.all_static && nonlocal.static_shrinkage.is_none() {
                return refused("all_static", "true".into(), "false without static_shrinkage");
            }
        }
        // Where the prior passes everything (even brightness), an error `e` follows
        // `e_(k+1) = -memory momentum (e_k - e_(k-1))`.
        let memory = self.projection.memory;
        if memory * self.momentum > 0.5 {
            let value = format!("{} with memory {memory}", self.momentum);
            let range =
                "such that momentum times memory is at most 0.5; above, the brightness diverges";
            return refused("momentum", value, range);
        }
        None
    }

    /// Reads a stage from the fields of its JSON object. Unknown fields are refused.
    fn from_fields(fields: &Fields) -> Result<Self, String> {
        /// The fields of [`Stage`] that are not part of another struct.
        #[derive(Deserialize)]
        struct Own {
            iterations: usize,
            #[serde(default)]
            momentum: f32,
            #[serde(default)]
            tolerance: f32,
        }

        let name = prior_name(fields)?.ok_or("missing field `prior`")?;
        // Before the check for missing fields, because a misspelt field is also a missing one.
        let known = field_schemas(Some(name));
        fields.keys().try_for_each(|field| known_field(known, field))?;
        let prior = PriorSpec::read(name, fields)?;
        let projection = fields::read(fields)?;
        let Own { iterations, momentum, tolerance } = fields::read(fields)?;
        Ok(Self { prior, iterations, projection, momentum, tolerance })
    }
}

/// The prior of a stage, if its name has been read.
///
/// # Errors
/// A message that lists the names.
fn prior_name(fields: &Fields) -> Result<Option<PriorName>, String> {
    let name = fields.get("prior").map(|name| name.as_str().unwrap_or_default());
    name.map(PriorName::parse).transpose()
}

/// The schemas of the fields of a stage with this prior; with any prior if none is given.
fn field_schemas(prior: Option<PriorName>) -> &'static Fields {
    // Lists of jobs read hundreds of stages.
    static ALL: LazyLock<HashMap<Option<&str>, Fields>> = LazyLock::new(|| {
        let schema = schemars::schema_for!(Stage).to_value();
        let names = PriorName::VARIANTS.iter().copied().map(Some);
        names.chain([None]).map(|prior| (prior, select_schemas(&schema, prior))).collect()
    });
    &ALL[&prior.map(<&str>::from)]
}

/// The part of the schema of a stage that concerns this prior, or any if none is given.
fn select_schemas(schema: &Value, prior: Option<&str>) -> Fields {
    let alternatives = schema["oneOf"].as_array().into_iter().flatten();
    let possible = alternatives.filter(|alternative| {
        prior.is_none_or(|prior| alternative["properties"]["prior"]["const"] == prior)
    });
    let parameters = possible.filter_map(|alternative| {
        let place = alternative["$ref"].as_str()?.trim_start_matches('#');
        schema.pointer(place)
    });
    let parts = std::iter::once(schema).chain(parameters);
    let properties = parts.filter_map(|part| part["properties"].as_object());
    let own = properties.flatten().map(|(name, schema)| (name.clone(), schema.clone()));
    own.chain([("prior".to_owned(), Value::Null)]).collect()
}

fn known_field(known: &Fields, field: &str) -> Result<(), String> {
    if known.contains_key(field) {
        return Ok(());
    }
    let known: Vec<_> = known.keys().map(String::as_str).collect();
    Err(format!("unknown field `{field}`, expected one of `{}`", known.join("`, `")))
}

/// Refuses a field that no stage with the prior has, and a value of another type. The prior may also follow later.
fn check_field(before: &Fields, field: &str, value: Option<&Value>) -> Result<(), String> {
    let known = field_schemas(prior_name(before)?);
    match value {
        None => known_field(known, field),
        Some(value) if field == "prior" => {
            PriorName::parse(value.as_str().unwrap_or_default()).map(|_| ())
        }
        Some(value) => bounds::check_type(field, value, &known[field]),
    }
}

impl<'de> Deserialize<'de> for Stage {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let fields = deserializer.deserialize_map(fields::Reader(check_field))?;
        Self::from_fields(&fields).map_err(D::Error::custom)
    }
}
