//! `/v1/labs`: all labs with what they have and may have, for those who look after them.

use std::collections::HashMap;

use axum::Json;
use serde::{Deserialize, Serialize};

use super::app::App;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params};
use engine::job::{InvalidField, Lab};
use store::{Entitlement, LabRow, LabUse, share_error};

#[derive(Debug, Serialize)]
pub(super) struct LabBody {
    lab: Lab,
    /// Of the machine, beside the shares of the other labs.
    share: f64,
    limits: LimitsBody,
    #[serde(rename = "use")]
    taken: TakenBody,
}

#[derive(Debug, Serialize)]
struct LimitsBody {
    /// Bytes that it may keep; none: the default of the service.
    bytes: Option<u64>,
    /// Jobs that may wait and run; none: the default of the service.
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
pub(super) struct ListBody {
    items: Vec<LabBody>,
}

/// New share and limits of a lab: missing fields stay, null sets the default of the service.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Changes {
    share: Option<f64>,
    #[serde(default, with = "serde_with::rust::double_option")]
    bytes: Option<Option<u64>>,
    #[serde(default, with = "serde_with::rust::double_option")]
    jobs: Option<Option<u64>>,
}

pub(super) async fn list(Caller(app, _): Caller) -> Result<Json<ListBody>> {
    let (mut items, costs) = (Vec::new(), app.store.cost_left_by_lab().await?);
    for row in app.store.labs().await? {
        items.push(body(&app, row, &costs).await?);
    }
    Ok(Json(ListBody { items }))
}

pub(super) async fn show(
    Caller(app, _): Caller,
    Params(lab): Params<String>,
) -> Result<Json<LabBody>> {
    let row = app.store.lab(&lab).await?;
    Ok(Json(body(&app, row, &app.store.cost_left_by_lab().await?).await?))
}

/// `PATCH /v1/labs/{lab}`.
pub(super) async fn change(
    Caller(app, _): Caller,
    Params(lab): Params<String>,
    Body(changes): Body<Changes>,
) -> Result<Json<LabBody>> {
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
    app.store.entitle(&lab, Entitlement { share, max_bytes: bytes, max_jobs: jobs }).await?;
    let row = app.store.lab(lab.as_str()).await?;
    Ok(Json(body(&app, row, &app.store.cost_left_by_lab().await?).await?))
}

async fn body(app: &App, row: LabRow, costs: &HashMap<Lab, f64>) -> Result<LabBody> {
    let bytes = app.store.lab_bytes(&row.lab).await?;
    let of = app.store.lab_use(&row.lab).await?;
    let limits = LimitsBody { bytes: row.max_bytes, jobs: row.max_jobs };
    let cpu_seconds_left = costs.get(&row.lab).copied().unwrap_or_default();
    let taken = TakenBody { bytes, of, cpu_seconds_left };
    Ok(LabBody { lab: row.lab, share: row.share, limits, taken })
}
