//! `/v1/measurements`: coded snapshots.

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Problem, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{ListQuery, NoQuery, PageBody, Renaming};
use super::submissions::{PATIENCE, Stage, make, pending};
use engine::job::{
    CalibrationId, Finding, Lab, Label, MeasurementId, MeasurementRequest, Reading, Sequence,
    Sha256, Submission, Timestamp,
};
use store::{Asked, Made, Measurement, Page, Request, StoreError};

/// A measurement. Facts about its data are null until they are checked.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Measurement")]
pub(super) struct MeasurementBody {
    id: MeasurementId,
    state: Stage,
    /// The failure in words.
    error: Option<String>,
    /// The failure, as an answer to the request would have stated it.
    problem: Option<Problem>,
    created_at: Timestamp,
    name: Option<Label>,
    calibration: CalibrationId,
    data: Sha256,
    /// Format of the file.
    format: Option<String>,
    /// Type of the samples in the file.
    sample: Option<String>,
    /// Order of the axes of the array; null for pictures.
    axes: Option<String>,
    snapshots: Option<u32>,
    height: Option<usize>,
    width: Option<usize>,
    /// The stored number that means 1.
    full_scale: Option<f32>,
    /// Snapshots per second.
    camera_fps: Option<f64>,
    /// Exposure of a snapshot in seconds.
    exposure_s: Option<f64>,
    sequence: Option<Sequence>,
    dark: Vec<Sha256>,
    /// Findings of the check against the calibration. Every job of the measurement repeats them.
    warnings: Vec<Finding>,
    reading: Option<Reading>,
}

impl From<Measurement> for MeasurementBody {
    fn from(Measurement { id, created_at, facts, .. }: Measurement) -> Self {
        Self {
            id,
            state: Stage::Ready,
            error: None,
            problem: None,
            created_at,
            name: facts.name,
            calibration: facts.calibration,
            data: facts.data,
            format: Some(facts.format),
            sample: Some(facts.sample),
            axes: facts.axes,
            snapshots: Some(facts.snapshots),
            height: Some(facts.height),
            width: Some(facts.width),
            full_scale: Some(facts.full_scale),
            camera_fps: facts.camera_fps,
            exposure_s: facts.exposure_s,
            sequence: Some(facts.sequence),
            dark: facts.dark,
            warnings: facts.warnings,
            reading: Some(facts.reading),
        }
    }
}

impl TryFrom<Request> for MeasurementBody {
    type Error = ApiError;

    fn try_from(request: Request) -> Result<Self> {
        let (state, error, problem) = pending(&request);
        let Submission::Measurement(submission) = request.submission else {
            return Err(
                StoreError::NotFound { what: "measurement", id: request.id.to_string() }.into()
            );
        };
        Ok(Self {
            id: request.id.into(),
            state,
            error,
            problem,
            created_at: request.created_at,
            name: request.name,
            calibration: submission.calibration,
            data: submission.data,
            format: None,
            sample: None,
            axes: None,
            snapshots: None,
            height: None,
            width: None,
            full_scale: None,
            camera_fps: submission.camera_fps,
            exposure_s: submission.exposure_s,
            sequence: None,
            dark: submission.dark,
            warnings: Vec::new(),
            reading: None,
        })
    }
}

impl TryFrom<Asked<Measurement>> for MeasurementBody {
    type Error = ApiError;

    fn try_from(asked: Asked<Measurement>) -> Result<Self> {
        match asked {
            Asked::Ready(measurement) => Ok(measurement.into()),
            Asked::Pending(request) => (*request).try_into(),
        }
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    context: RequestContext,
    Body(request): Body<MeasurementRequest>,
) -> Result<Response> {
    let (key, wait) = (request_key(&context.headers, &request)?, context.wait());
    let submission = Submission::Measurement(request);
    let inserted = make(&app, &access, submission, key.as_ref(), wait.time(PATIENCE)).await?;
    let (status, id) = created(inserted);
    let body = body(&app, &access.lab, id).await?;
    let status = if body.state == Stage::Ready { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("/v1/measurements/{id}"))];
    Ok(wait.applied((location, changed(status, &body)?).into_response()))
}

async fn body(app: &App, lab: &Lab, id: MeasurementId) -> Result<MeasurementBody> {
    app.store.asked_measurement(lab, id).await?.try_into()
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<MeasurementId>>,
    request: RequestContext,
) -> Result<Response> {
    let (limit, filter) = (query.limit.get(), query.filter());
    let Page { items, more } = app.store.measurements(&access.lab, filter, limit).await?;
    let items = items.into_iter().map(TryInto::try_into);
    let items: Vec<MeasurementBody> = items.collect::<Result<_>>()?;
    PageBody::new(Page { items, more }, |item| item.id.to_string(), |item| item).answer(&request)
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    QueryOf(NoQuery {}): QueryOf<NoQuery>,
    request: RequestContext,
) -> Result<Response> {
    let wait = request.wait();
    if let Some(time) = app.wait(wait) {
        let resource = (Made::Measurement, id.into());
        app.events.settled(&app.store, &access.lab, resource, time).await?;
    }
    Ok(wait.applied(request.json(&body(&app, &access.lab, id).await?)?))
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    request: RequestContext,
    Body(renaming): Body<Renaming>,
) -> Result<Response> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.rename_measurement(&access.lab, id, renaming.name.as_ref()).await?;
    changed(StatusCode::OK, &body(&app, &access.lab, id).await?)
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.delete_measurement(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
