//! `/v1/labs`: all labs with their limits and usage, for administrators.

use std::collections::HashMap;

use axum::http::StatusCode;
use axum::response::Response;
use serde::{Deserialize, Serialize};

use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params};
use engine::job::{InvalidField, Lab};
use store::{Entitlement, LabRow, LabUse, share_error};

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "LabItem")]
pub(super) struct LabBody {
    lab: Lab,
    /// Part of the machine, relative to the shares of other labs.
    share: f64,
    limits: LimitsBody,
    #[serde(rename = "use")]
    usage: UsageBody,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "LabLimits")]
struct LimitsBody {
    /// Bytes that it may keep; none: the default of the service.
    bytes: Option<u64>,
    /// Jobs that may wait and run; none: the default of the service.
    jobs: Option<u64>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "LabUsage")]
struct UsageBody {
    /// Bytes that the lab keeps, with the space promised to its jobs.
    bytes: u64,
    #[serde(flatten)]
    lab: LabUse,
    /// Planned CPU seconds of unfinished jobs.
    cpu_seconds_left: f64,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "LabList")]
pub(super) struct ListBody {
    items: Vec<LabBody>,
}

/// New share and limits of a lab: missing fields stay, null sets the default of the service.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "LabChanges")]
pub(super) struct Changes {
    /// Part of the machine, relative to the shares of other labs.
    #[schemars(range(min = 0.001, max = 1000.0))]
    share: Option<f64>,
    /// Bytes that the lab may keep.
    #[serde(default, with = "serde_with::rust::double_option")]
    #[schemars(with = "Option<u64>")]
    bytes: Option<Option<u64>>,
    /// Jobs that may wait and run.
    #[serde(default, with = "serde_with::rust::double_option")]
    #[schemars(with = "Option<u64>")]
    jobs: Option<Option<u64>>,
}

pub(super) async fn list(Caller(app, _): Caller, request: RequestContext) -> Result<Response> {
    let (mut items, costs) = (Vec::new(), app.store.cost_left_by_lab().await?);
    for row in app.store.labs().await? {
        items.push(body(&app, row, &costs).await?);
    }
    request.json(&ListBody { items })
}

pub(super) async fn show(
    Caller(app, _): Caller,
    Params(lab): Params<String>,
    request: RequestContext,
) -> Result<Response> {
    request.json(&one(&app, &lab).await?)
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
    for (pointer, limit) in [("/bytes", bytes), ("/jobs", jobs)] {
        if limit.flatten().is_some_and(|limit| i64::try_from(limit).is_err()) {
            errors.push(InvalidField::new(pointer, "a limit must be below 2^63"));
        }
    }
    if !errors.is_empty() {
        return Err(ApiError::fields(Code::InvalidRequest, errors));
    }
    let _guard = app.precondition(&request, &lab, one(&app, lab.as_str())).await?;
    app.store.entitle(&lab, Entitlement { share, max_bytes: bytes, max_jobs: jobs }).await?;
    changed(StatusCode::OK, &one(&app, lab.as_str()).await?)
}

async fn one(app: &App, lab: &str) -> Result<LabBody> {
    let row = app.store.lab(lab).await?;
    body(app, row, &app.store.cost_left_by_lab().await?).await
}

async fn body(app: &App, row: LabRow, costs: &HashMap<Lab, f64>) -> Result<LabBody> {
    let bytes = app.store.lab_bytes(&row.lab).await?;
    let lab = app.store.lab_use(&row.lab).await?;
    let limits = LimitsBody { bytes: row.max_bytes, jobs: row.max_jobs };
    let cpu_seconds_left = costs.get(&row.lab).copied().unwrap_or_default();
    let usage = UsageBody { bytes, lab, cpu_seconds_left };
    Ok(LabBody { lab: row.lab, share: row.share, limits, usage })
}
