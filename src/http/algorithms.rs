//! `/v1/algorithms`: what can be asked for, with the defaults.

use axum::response::Response;
use serde::Serialize;

use super::context::RequestContext;
use super::error::Result;
use engine::job::{Algorithm, Schedule, TileSpec};
use engine::pipeline::networks;
use strum::VariantArray;

#[derive(Debug, Serialize)]
struct AlgorithmBody {
    name: Algorithm,
    summary: &'static str,
    networks: Vec<&'static str>,
    priors: Vec<&'static str>,
    schedule: Schedule,
    planned_iterations: usize,
    planned_passes: usize,
    tile: TileSpec,
}

#[derive(Debug, Serialize)]
struct ListBody {
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
            priors: name.priors().iter().map(|prior| prior.name()).collect(),
            planned_iterations: schedule.planned_iterations(),
            planned_passes: schedule.planned_passes(),
            schedule,
            tile: name.default_tile(),
        }
    };
    request.json(&ListBody { items: Algorithm::VARIANTS.iter().copied().map(show).collect() })
}
