//! Tiles of a job as they are worked on, and how the solver converges on each.

use axum::http::HeaderMap;
use axum::response::Response;
use serde::Serialize;

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params};
use super::jobs::with_snapshot;
use engine::job::{JobId, SnapshotRange};
use store::{TileHistory, TileState};

#[derive(Debug, Serialize)]
struct TilesBody {
    snapshot: u32,
    items: Vec<TileBody>,
}

#[derive(Debug, Serialize)]
struct TileBody {
    /// The place in the picture that it has a part in.
    row: usize,
    column: usize,
    height: usize,
    width: usize,
    /// Which sub-image of a mosaic it belongs to.
    plane: Option<usize>,
    /// The run of snapshots that it belongs to.
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
