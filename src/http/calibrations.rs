//! `/v1/calibrations`: masks of optical setups.

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{Problem, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{Cursor, Limit, NoQuery, PageBody, Renaming};
use super::submissions::{PATIENCE, Stage, make, pending};
use engine::job::{
    CalibrationId, CalibrationRequest, Dispersion, Lab, Label, Mosaic, Reading, Sha256, Submission,
    Timestamp,
};
use store::{Asked, Calibration, Filter, Made, Page, Request, Span};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<Cursor<CalibrationId>>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// A calibration. Facts about masks are null until the masks are ready.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Calibration")]
pub(super) struct CalibrationBody {
    id: CalibrationId,
    state: Stage,
    /// Share of the work that is done, in percent.
    percent: f64,
    /// The failure in words.
    error: Option<String>,
    /// The failure, as an answer to the request would have stated it.
    problem: Option<Problem>,
    created_at: Timestamp,
    name: Option<Label>,
    /// The file of the masks.
    masks: Option<Sha256>,
    /// Format of the file.
    format: Option<String>,
    /// Type of the samples in the file.
    sample: Option<String>,
    /// Order of the axes of the array; null for pictures.
    axes: Option<String>,
    /// Number of masks, the compression ratio B.
    frames: Option<usize>,
    height: Option<usize>,
    width: Option<usize>,
    /// The stored number that means 1.
    full_scale: Option<f32>,
    /// Mean of all masks, on [0, 1].
    mask_mean: Option<f64>,
    /// Pixels that are dark in all masks.
    dead_pixels: Option<u64>,
    /// Values at or below 0 that were set to 0.
    clipped_negatives: Option<u64>,
    /// Colours of the pixels of the sensor; null for a grey sensor.
    mosaic: Option<Mosaic>,
    /// Displacement of the bands of a spectral camera; null for other cameras. Height and width are those of the measurement.
    dispersion: Option<Dispersion>,
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
            dispersion: facts.dispersion,
            reading: facts.reading,
        }
    }
}

impl From<Request> for CalibrationBody {
    fn from(request: Request) -> Self {
        let (state, error, problem) = pending(&request);
        let (frames, mosaic, dispersion) = match &request.submission {
            Submission::Calibration(CalibrationRequest {
                captures, mosaic, dispersion, ..
            }) => (
                captures.as_ref().map(|captures| captures.masks.len()),
                *mosaic,
                dispersion.clone(),
            ),
            Submission::Measurement(_) | Submission::Model(_) => (None, None, None),
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
            dispersion,
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
    context: RequestContext,
    Body(request): Body<CalibrationRequest>,
) -> Result<Response> {
    let (key, wait) = (request_key(&context.headers, &request)?, context.wait());
    let submission = Submission::Calibration(request);
    let inserted = make(&app, &access, submission, key.as_ref(), wait.time(PATIENCE)).await?;
    let (status, id) = created(inserted);
    let body = body(&app, &access.lab, id).await?;
    let status = if body.state == Stage::Ready { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("/v1/calibrations/{id}"))];
    Ok(wait.applied((location, changed(status, &body)?).into_response()))
}

async fn body(app: &App, lab: &Lab, id: CalibrationId) -> Result<CalibrationBody> {
    Ok(app.store.asked_calibration(lab, id).await?.into())
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    request: RequestContext,
) -> Result<Response> {
    let limit = query.limit.get();
    let created = Span { from: query.created_after, before: query.created_before };
    let after = query.cursor.map(|Cursor(id)| id);
    let filter = Filter { calibration: None, created, after };
    let page = app.store.calibrations(&access.lab, filter, limit).await?;
    let items: Vec<CalibrationBody> = page.items.into_iter().map(Into::into).collect();
    let id = |item: &CalibrationBody| item.id.to_string();
    let page = Page { items, more: page.more };
    PageBody::new(page, id, |item| item).answer(&request)
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    QueryOf(NoQuery {}): QueryOf<NoQuery>,
    request: RequestContext,
) -> Result<Response> {
    let wait = request.wait();
    if let Some(time) = app.wait(wait) {
        let resource = (Made::Calibration, id.into());
        app.events.settled(&app.store, &access.lab, resource, time).await?;
    }
    Ok(wait.applied(request.json(&body(&app, &access.lab, id).await?)?))
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    request: RequestContext,
    Body(renaming): Body<Renaming>,
) -> Result<Response> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.rename_calibration(&access.lab, id, renaming.name.as_ref()).await?;
    changed(StatusCode::OK, &body(&app, &access.lab, id).await?)
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.delete_calibration(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
