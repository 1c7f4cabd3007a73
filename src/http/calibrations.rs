//! `/v1/calibrations`: masks of optical settings.

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::app::App;
use super::conditional;
use super::error::Result;
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{Limit, PageBody, Renaming, ShowQuery};
use super::submissions::{Stage, make, patience, pending};
use engine::job::{
    CalibrationId, CalibrationRequest, Lab, Label, Mosaic, Reading, Sha256, Submission, Timestamp,
};
use store::{Asked, Calibration, Filter, Made, Page, Request, Span};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<CalibrationId>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// A calibration as it is shown. What is known of masks is null until they are there.
#[derive(Debug, Serialize)]
pub(super) struct CalibrationBody {
    id: CalibrationId,
    state: Stage,
    /// How much of the work is done, in percent.
    percent: f64,
    error: Option<String>,
    /// The same as the problem with which the request would have been answered.
    problem: Option<Value>,
    created_at: Timestamp,
    name: Option<Label>,
    masks: Option<Sha256>,
    format: Option<String>,
    sample: Option<String>,
    axes: Option<String>,
    frames: Option<usize>,
    height: Option<usize>,
    width: Option<usize>,
    full_scale: Option<f32>,
    mask_mean: Option<f64>,
    dead_pixels: Option<u64>,
    clipped_negatives: Option<u64>,
    mosaic: Option<Mosaic>,
    reading: Option<Reading>,
}

impl From<Calibration> for CalibrationBody {
    fn from(calibration: Calibration) -> Self {
        let Calibration { id, created_at, facts, .. } = calibration;
        Self {
            id,
            state: Stage::Ready,
            percent: 100.0,
            error: None,
            problem: None,
            created_at,
            name: facts.name,
            masks: Some(facts.masks),
            format: Some(facts.format),
            sample: Some(facts.sample),
            axes: facts.axes,
            frames: Some(facts.frames),
            height: Some(facts.height),
            width: Some(facts.width),
            full_scale: Some(facts.full_scale),
            mask_mean: Some(facts.mask_mean),
            dead_pixels: Some(facts.dead_pixels),
            clipped_negatives: Some(facts.clipped_negatives),
            mosaic: facts.mosaic,
            reading: facts.reading,
        }
    }
}

impl From<Request> for CalibrationBody {
    fn from(request: Request) -> Self {
        let (state, error, problem) = pending(&request);
        let (frames, mosaic) = match &request.submission {
            Submission::Calibration(CalibrationRequest { captures, mosaic, .. }) => {
                (captures.as_ref().map(|captures| captures.masks.len()), *mosaic)
            }
            Submission::Measurement(_) | Submission::Model(_) => (None, None),
        };
        Self {
            id: request.id.into(),
            state,
            percent: (request.fraction * 1000.0).round() / 10.0,
            error,
            problem,
            created_at: request.created_at,
            name: request.name,
            masks: None,
            format: None,
            sample: None,
            axes: None,
            frames,
            height: None,
            width: None,
            full_scale: None,
            mask_mean: None,
            dead_pixels: None,
            clipped_negatives: None,
            mosaic,
            reading: None,
        }
    }
}

impl From<Asked<Calibration>> for CalibrationBody {
    fn from(asked: Asked<Calibration>) -> Self {
        match asked {
            Asked::Ready(calibration) => calibration.into(),
            Asked::Pending(request) => (*request).into(),
        }
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<CalibrationRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let request = Submission::Calibration(request);
    let made = make(&app, &access, request, key.as_ref(), patience(&headers)).await?;
    let (status, id) = created(made);
    let body = body(&app, &access.lab, id).await?;
    let made = body.state == Stage::Ready;
    let status = if made { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("/v1/calibrations/{id}"))];
    Ok((status, location, Json(body)).into_response())
}

async fn body(app: &App, lab: &Lab, id: CalibrationId) -> Result<CalibrationBody> {
    Ok(app.store.asked_calibration(lab, id).await?.into())
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let limit = query.limit.get();
    let created = Span { from: query.created_after, before: query.created_before };
    let filter = Filter { calibration: None, created, after: query.cursor };
    let page = app.store.calibrations(&access.lab, filter, limit).await?;
    let items: Vec<CalibrationBody> = page.items.into_iter().map(Into::into).collect();
    let id = |item: &CalibrationBody| item.id.to_string();
    let page = Page { items, more: page.more };
    conditional::json(&PageBody::new(page, id, |item| item), &headers)
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    QueryOf(query): QueryOf<ShowQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    if let Some(time) = query.wait(&app) {
        let what = (Made::Calibration, id.into());
        app.events.settled(&app.store, &access.lab, what, time).await?;
    }
    conditional::json(&body(&app, &access.lab, id).await?, &headers)
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    Body(renaming): Body<Renaming>,
) -> Result<Json<CalibrationBody>> {
    app.store.rename_calibration(&access.lab, id, renaming.name.as_ref()).await?;
    Ok(Json(body(&app, &access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
) -> Result<StatusCode> {
    app.store.delete_calibration(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
