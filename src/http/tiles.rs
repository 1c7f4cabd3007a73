//! Tiles of a job with their state, and the convergence of the solver on each.

use axum::http::HeaderMap;
use axum::response::Response;
use serde::Serialize;

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params};
use super::jobs::with_snapshot;
use engine::job::{JobId, SnapshotRange};
use store::{TileHistory, TileState};

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "TileList")]
pub(super) struct TilesBody {
    snapshot: u32,
    items: Vec<TileBody>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "TileState")]
struct TileBody {
    /// First row of the tile in the picture.
    row: usize,
    /// First column of the tile in the picture.
    column: usize,
    height: usize,
    width: usize,
    /// Sub-image of a mosaic, from 0 to 3, row by row of a cell; null for a grey sensor.
    plane: Option<usize>,
    /// The run of snapshots that the tile belongs to.
    snapshots: SnapshotRange,
    #[serde(flatten)]
    state: TileState,
}

pub(super) async fn list(
    Caller(app, access): Caller,
    Params((id, snapshot)): Params<(JobId, u32)>,
    headers: HeaderMap,
) -> Result<Response> {
    let job = with_snapshot(&app, &access.lab, id, snapshot).await?;
    let plan = job.spec.tile_plan().map_err(|error| ApiError::internal(&error))?;
    let states = app.store.tile_states(id, snapshot).await?;
    let show = |state: TileState| {
        let tile = plan.tile(state.tile as usize)?;
        let ([row, column, height, width], plane) = (tile.place(), tile.plane());
        let snapshots = SnapshotRange { first: state.run, count: state.snapshots };
        Some(TileBody { row, column, height, width, plane, snapshots, state })
    };
    let body = TilesBody { snapshot, items: states.into_iter().filter_map(show).collect() };
    conditional::json(&body, &headers)
}

pub(super) async fn history(
    Caller(app, access): Caller,
    Params((id, snapshot, tile)): Params<(JobId, u32, u32)>,
    headers: HeaderMap,
) -> Result<Response> {
    with_snapshot(&app, &access.lab, id, snapshot).await?;
    let history: Option<TileHistory> = app.store.tile_history(id, snapshot, tile).await?;
    let none = || ApiError::new(Code::NotFound, format!("the job has no tile {tile}"));
    conditional::json(&history.ok_or_else(none)?, &headers)
}
