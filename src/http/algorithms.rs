//! `/v1/algorithms`: the algorithms with their defaults.

use axum::response::Response;
use serde::Serialize;

use super::context::RequestContext;
use super::error::Result;
use engine::job::{Algorithm, Schedule, TileSpec};
use engine::pipeline::networks;
use strum::VariantArray;

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "AlgorithmInfo")]
struct AlgorithmBody {
    name: Algorithm,
    summary: &'static str,
    /// Networks of the default schedule.
    networks: Vec<&'static str>,
    /// Priors that a schedule of this algorithm may name.
    priors: Vec<&'static str>,
    schedule: Schedule,
    /// Iterations of the default schedule.
    planned_iterations: usize,
    /// Passes of deep denoisers in the default schedule.
    planned_passes: usize,
    tile: TileSpec,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "AlgorithmList")]
pub(super) struct ListBody {
    items: Vec<AlgorithmBody>,
}

pub(super) async fn list(request: RequestContext) -> Result<Response> {
    let show = |name: Algorithm| {
        let schedule = name.default_schedule();
        AlgorithmBody {
            name,
            summary: name.summary(),
            networks: schedule
                .networks()
                .into_iter()
                .map(|which| networks::carried(which).name)
                .collect(),
            priors: name.priors().iter().map(|&prior| prior.into()).collect(),
            planned_iterations: schedule.planned_iterations(),
            planned_passes: schedule.planned_passes(),
            schedule,
            tile: name.default_tile(),
        }
    };
    request.json(&ListBody { items: Algorithm::VARIANTS.iter().copied().map(show).collect() })
}
