//! `/v1/jobs`: asking for a reconstruction and watching it.

use axum::Json;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::app::App;
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, idempotency_key};
use super::page::{Limit, PageBody};
use crate::job::{
    Algorithm, CalibrationId, Finding, JobId, JobRequest, JobSpec, JobState, Lab, Label,
    MeasurementId, ModelId, SceneShape, Schedule, Sha256, SnapshotRange, TileSpec, Timestamp,
};
use crate::store::{Inserted, Job, JobFilter, JobProgress, NewJob, Page, StoreError};

#[derive(Debug, Serialize)]
pub(super) struct JobBody {
    id: JobId,
    state: JobState,
    label: Option<Label>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    shape: SceneShape,
    snapshots: SnapshotRange,
    algorithm: Algorithm,
    /// The network of `learned`; null for all others.
    model: Option<ModelId>,
    schedule: Schedule,
    tile: TileSpec,
    priority: i32,
    warnings: Vec<Finding>,
    error: Option<String>,
    created_at: Timestamp,
    started_at: Option<Timestamp>,
    finished_at: Option<Timestamp>,
    progress: JobProgress,
}

impl JobBody {
    fn new(job: Job, progress: JobProgress) -> Self {
        let spec = job.spec;
        Self {
            id: job.id,
            state: job.state,
            label: spec.label,
            calibration: spec.calibration,
            measurement: spec.measurement,
            shape: spec.shape,
            snapshots: spec.snapshots,
            algorithm: spec.algorithm,
            model: spec.model.map(|model| model.id),
            schedule: spec.schedule,
            tile: spec.tile,
            priority: spec.priority,
            warnings: spec.warnings,
            error: job.error,
            created_at: job.created_at,
            started_at: job.started_at,
            finished_at: job.finished_at,
            progress,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<JobId>,
    state: Option<JobState>,
    calibration: Option<CalibrationId>,
    measurement: Option<MeasurementId>,
    label: Option<Label>,
    /// A part of the label or identifier.
    search: Option<Label>,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<JobRequest>,
) -> Result<Response> {
    let idempotency_key = idempotency_key(&headers)?;
    // Hashed as it was understood, so that white space and the order of fields do not matter.
    let text = serde_json::to_vec(&request).map_err(|error| ApiError::internal(&error))?;
    let inserted = insert(&app, access.lab.clone(), request, Sha256::of(&text), idempotency_key);
    let (id, status) = match inserted.await? {
        Inserted::New(id) => (id, StatusCode::CREATED),
        Inserted::Before(id) => (id, StatusCode::OK),
    };
    let location = [(header::LOCATION, format!("/v1/jobs/{id}"))];
    Ok((status, location, Json(body(&app, &access.lab, id).await?)).into_response())
}

/// Accepts a job, unless it was accepted before, if there is room for it.
async fn insert(
    app: &App,
    lab: Lab,
    request: JobRequest,
    hash: Sha256,
    idempotency_key: Option<String>,
) -> Result<Inserted> {
    if let Some(key) = &idempotency_key
        && let Some(job) = app.store.job_with_key(&lab, key, hash).await?
    {
        return Ok(Inserted::Before(job));
    }
    let spec = resolve(app, &lab, request).await?;
    app.admission.check_room("the job", spec.disk_bytes()).await?;
    let most_jobs = app.settings.max_jobs;
    let new = NewJob { most_jobs, lab, spec, request: hash, idempotency_key };
    Ok(app.store.add_job(new).await?)
}

/// Checks a request against the measurement that it names.
async fn resolve(app: &App, lab: &Lab, request: JobRequest) -> Result<JobSpec> {
    let measurement = app.store.measurement(lab, request.measurement).await;
    let measurement =
        measurement.map_err(|error| ApiError::reference("/measurement", error))?.facts;
    let calibration = app.store.calibration(lab, measurement.calibration).await;
    let calibration = calibration.map_err(|error| ApiError::reference("/measurement", error))?;
    let shape = SceneShape {
        frames: calibration.facts.frames,
        height: measurement.height,
        width: measurement.width,
        snapshots: measurement.snapshots,
    };
    let model = match request.model {
        None => None,
        Some(id) => {
            let model = app.store.model(lab, id).await;
            Some(model.map_err(|error| ApiError::reference("/model", error))?.into())
        }
    };
    let resolved = request.resolve(calibration.id, shape, model);
    let mut spec = resolved.map_err(|errors| ApiError::fields(Code::InvalidRequest, errors))?;
    spec.warnings = warnings_of(measurement.warnings, spec.snapshots);
    check_memory(app, &spec)?;
    Ok(spec)
}

/// The warnings about the snapshots of a job.
fn warnings_of(warnings: Vec<Finding>, snapshots: SnapshotRange) -> Vec<Finding> {
    let concerns =
        |warning: &Finding| warning.snapshot.is_none_or(|snapshot| snapshots.contains(snapshot));
    warnings.into_iter().filter(concerns).collect()
}

/// Refuses a job that no worker could do.
fn check_memory(app: &App, spec: &JobSpec) -> Result<()> {
    let (needed, allowed) = (spec.worker_bytes() >> 20, app.settings.worker_memory_bytes >> 20);
    if needed <= allowed {
        return Ok(());
    }
    let detail = format!(
        "a worker would need up to {needed} MiB for tiles of {0}x{0} pixels and {1} frames, and \
         may have {allowed} MiB: use smaller tiles",
        spec.tile.size, spec.shape.frames
    );
    Err(ApiError::field("/tile/size", detail))
}

async fn body(app: &App, lab: &Lab, id: JobId) -> Result<JobBody> {
    let job = app.store.job(lab, id).await?;
    let progress = app.store.progress(&job).await?;
    Ok(JobBody::new(job, progress))
}

/// `GET /v1/jobs`, with an ETag, so that watching costs little.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let filter = JobFilter {
        state: query.state,
        calibration: query.calibration,
        measurement: query.measurement,
        label: query.label,
        search: query.search,
        after: query.cursor,
    };
    let page = app.store.jobs(&access.lab, &filter, query.limit.get()).await?;
    let progress = app.store.progress_of(&page.items).await?;
    let items = page.items.into_iter().zip(progress).map(|(job, at)| JobBody::new(job, at));
    let page = Page { items: items.collect(), more: page.more };
    conditional::json(
        &PageBody::new(page, |item: &JobBody| item.id.to_string(), |item| item),
        &headers,
    )
}

/// `GET /v1/jobs/{job}`, with an ETag, so that watching costs little.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    headers: HeaderMap,
) -> Result<Response> {
    conditional::json(&body(&app, &access.lab, id).await?, &headers)
}

pub(super) async fn cancel(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
) -> Result<Response> {
    app.store.cancel_job(&access.lab, id).await?;
    accepted(&app, &access.lab, id).await
}

pub(super) async fn retry(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
) -> Result<Response> {
    app.store.retry_job(&access.lab, id).await?;
    accepted(&app, &access.lab, id).await
}

async fn accepted(app: &App, lab: &Lab, id: JobId) -> Result<Response> {
    let retry_after: (HeaderName, &str) = (header::RETRY_AFTER, "1");
    Ok((StatusCode::ACCEPTED, [retry_after], Json(body(app, lab, id).await?)).into_response())
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
) -> Result<StatusCode> {
    app.store.delete_job(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// The job, if it has this snapshot; else there is no such thing.
pub(super) async fn with_snapshot(app: &App, lab: &Lab, id: JobId, snapshot: u32) -> Result<Job> {
    let job = app.store.job(lab, id).await?;
    if job.spec.snapshots.contains(snapshot) {
        return Ok(job);
    }
    let not_found =
        StoreError::NotFound { what: "snapshot in this job:", id: snapshot.to_string() };
    Err(not_found.into())
}
