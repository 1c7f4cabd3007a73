//! `/livez` and `/readyz`: for what watches the service; and the contract, `/openapi.yaml`.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::app::App;

/// Workers that were silent for longer are not counted.
const WORKER_AGE: Duration = Duration::from_secs(15);

/// Each part of the service: `ok`, or what is wrong.
#[derive(Debug, Serialize)]
struct Readiness {
    ready: bool,
    database: String,
    disk: String,
    workers: String,
}

/// `GET /livez`: the process answers.
pub(super) async fn live() -> Json<serde_json::Value> {
    Json(serde_json::json!({"live": true}))
}

/// `GET /readyz`: database, disk and workers are there. A long queue is no fault.
pub(super) async fn ready(State(app): State<App>) -> Response {
    let checks = [database(&app).await, disk(&app), workers(&app).await];
    let ready = checks.iter().all(Result::is_ok);
    let [database, disk, workers] =
        checks.map(|check| check.err().unwrap_or_else(|| "ok".to_owned()));
    let status = if ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(Readiness { ready, database, disk, workers })).into_response()
}

async fn database(app: &App) -> Result<(), String> {
    app.store.ping().await.map_err(|_| "the database does not answer".to_owned())
}

fn disk(app: &App) -> Result<(), String> {
    let (free, _) = app.store.dir().disk().map_err(|_| "the disk does not answer".to_owned())?;
    if free < app.min_free_bytes {
        return Err(format!("{free} bytes are free, {} should be", app.min_free_bytes));
    }
    Ok(())
}

async fn workers(app: &App) -> Result<(), String> {
    let live = app.store.live_workers(WORKER_AGE).await;
    let live = live.map_err(|_| "the database does not answer".to_owned())?.len();
    if live == 0 { Err("no worker lives".to_owned()) } else { Ok(()) }
}

/// `GET /openapi.yaml`
pub(super) async fn contract() -> Response {
    let kind = [(header::CONTENT_TYPE, "application/yaml")];
    (kind, include_str!("../../openapi.yaml")).into_response()
}
