//! `/v1/labs`: all labs with what they have and may have, for those who look after them.

use axum::http::StatusCode;
use axum::response::Response;
use serde::{Deserialize, Serialize};

use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params};
use engine::job::{InvalidField, Lab};
use store::{Entitlement, LabRow, LabUse, share_error};

#[derive(Debug, Serialize)]
struct LabBody {
    lab: Lab,
    /// Of the machine, beside the shares of the other labs.
    share: f64,
    limits: LimitsBody,
    #[serde(rename = "use")]
    taken: TakenBody,
}

#[derive(Debug, Serialize)]
struct LimitsBody {
    /// What it may keep here; none: no limit.
    bytes: Option<u64>,
    /// Jobs that may wait and run; none: no limit of its own.
    jobs: Option<u64>,
}

#[derive(Debug, Serialize)]
struct TakenBody {
    /// All that it keeps, and what was promised to its jobs.
    bytes: u64,
    #[serde(flatten)]
    of: LabUse,
    /// Planned CPU-seconds of its jobs that are left.
    cpu_seconds_left: f64,
}

#[derive(Debug, Serialize)]
struct ListBody {
    items: Vec<LabBody>,
}

/// What a lab is to be entitled to: what is left out stays, null takes a limit away.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Changes {
    share: Option<f64>,
    #[serde(default, with = "serde_with::rust::double_option")]
    bytes: Option<Option<u64>>,
    #[serde(default, with = "serde_with::rust::double_option")]
    jobs: Option<Option<u64>>,
}

pub(super) async fn list(Caller(app, _): Caller, request: RequestContext) -> Result<Response> {
    let mut items = Vec::new();
    for row in app.store.labs().await? {
        items.push(show_row(&app, row).await?);
    }
    request.json(&ListBody { items })
}

pub(super) async fn show(
    Caller(app, _): Caller,
    Params(lab): Params<String>,
    request: RequestContext,
) -> Result<Response> {
    request.json(&body(&app, &lab).await?)
}

/// `PATCH /v1/labs/{lab}`.
pub(super) async fn change(
    Caller(app, _): Caller,
    Params(lab): Params<String>,
    request: RequestContext,
    Body(changes): Body<Changes>,
) -> Result<Response> {
    let lab = app.store.lab(&lab).await?.lab;
    let Changes { share, bytes, jobs } = changes;
    let mut errors: Vec<_> =
        share.and_then(share_error).map(|e| InvalidField::new("/share", e)).into_iter().collect();
    for (place, limit) in [("/bytes", bytes), ("/jobs", jobs)] {
        if limit.flatten().is_some_and(|limit| i64::try_from(limit).is_err()) {
            errors.push(InvalidField::new(place, "a limit is below 2^63"));
        }
    }
    if !errors.is_empty() {
        return Err(ApiError::fields(Code::InvalidRequest, errors));
    }
    let _guard = request.precondition(&app, body(&app, lab.as_str())).await?;
    app.store.entitle(&lab, Entitlement { share, max_bytes: bytes, max_jobs: jobs }).await?;
    changed(StatusCode::OK, &body(&app, lab.as_str()).await?)
}

async fn body(app: &App, lab: &str) -> Result<LabBody> {
    show_row(app, app.store.lab(lab).await?).await
}

async fn show_row(app: &App, row: LabRow) -> Result<LabBody> {
    let bytes = app.store.lab_bytes(&row.lab).await?;
    let of = app.store.lab_use(&row.lab).await?;
    let limits = LimitsBody { bytes: row.max_bytes, jobs: row.max_jobs };
    let taken = TakenBody { bytes, of, cpu_seconds_left: row.cost_left };
    Ok(LabBody { lab: row.lab, share: row.share, limits, taken })
}
