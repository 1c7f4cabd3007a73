//! `/v1/jobs`: asking for a reconstruction and watching it.

use std::str::FromStr;

use axum::Json;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_with::DeserializeFromStr;
use strum::VariantArray;

use super::access::Access;
use super::app::App;
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{Limit, PageBody, ShowQuery};
use engine::job::{
    Algorithm, Assessment, CalibrationId, Finding, FindingCode, InvalidField, JobId, JobRequest,
    JobSpec, JobState, Lab, Label, MeasurementId, ModelId, Role, RunSpec, SceneShape, Schedule,
    Sequence, SnapshotRange, TileSpec, Timestamp, priority_error,
};
use store::{
    Estimate, Inserted, Job, JobChanges, JobFilter, JobProgress, Made, NewJob, Page, RequestKey,
    Span, StoreError,
};

#[derive(Debug, Serialize)]
pub(super) struct JobBody {
    id: JobId,
    lab: Lab,
    state: JobState,
    label: Option<Label>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    shape: SceneShape,
    snapshots: SnapshotRange,
    sequence: Sequence,
    run: RunSpec,
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
    assessment: Option<Assessment>,
    progress: JobProgress,
}

impl JobBody {
    /// Its address.
    pub(super) fn place(&self) -> String {
        format!("/v1/jobs/{}", self.id)
    }

    fn new(job: Job, progress: JobProgress) -> Self {
        let spec = job.spec;
        Self {
            id: job.id,
            lab: job.lab,
            state: job.state,
            label: spec.label,
            calibration: spec.calibration,
            measurement: spec.measurement,
            shape: spec.shape,
            snapshots: spec.snapshots,
            sequence: spec.sequence,
            run: spec.run,
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
            assessment: job.assessment,
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
    state: Option<States>,
    calibration: Option<CalibrationId>,
    measurement: Option<MeasurementId>,
    label: Option<Label>,
    /// A part of the label or identifier.
    search: Option<Label>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// One state, or several with commas between them.
#[derive(Debug, DeserializeFromStr)]
struct States(Vec<JobState>);

impl FromStr for States {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let state = |name: &str| {
            name.parse::<JobState>().map_err(|_| {
                let names = JobState::VARIANTS.iter().map(|state| state.into_str());
                let names = names.collect::<Vec<_>>().join(", ");
                format!("{name:?} is no state; states are {names}")
            })
        };
        text.split(',').map(state).collect::<Result<_, _>>().map(Self)
    }
}

/// What a user changes of a job: what is left out stays.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Changes {
    /// Null takes it away.
    #[serde(default, with = "serde_with::rust::double_option")]
    label: Option<Option<Label>>,
    priority: Option<i32>,
}

/// What a job would take.
#[derive(Debug, Serialize)]
pub(super) struct EstimateBody {
    tiles: u64,
    tasks: usize,
    /// Planned processor seconds.
    cpu_seconds: f64,
    #[serde(flatten)]
    forecast: Estimate,
    /// The most that it writes to the disk.
    disk_bytes: u64,
    /// The most memory that a worker needs.
    worker_memory_bytes: u64,
    warnings: Vec<Finding>,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<JobRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let (status, body) = make(&app, &access, request, key).await?;
    let location = [(header::LOCATION, body.place())];
    Ok((status, location, Json(body)).into_response())
}

/// Makes a job, or finds the one that was made with the same key.
pub(super) async fn make(
    app: &App,
    access: &Access,
    request: JobRequest,
    key: Option<RequestKey>,
) -> Result<(StatusCode, JobBody)> {
    let inserted = match app.store.made_with(&access.lab, Made::Job, key.as_ref()).await? {
        Some(id) => Inserted::Before(id),
        None => insert(app, access, request, key).await?,
    };
    let (status, id) = created(inserted);
    Ok((status, body(app, &access.lab, id).await?))
}

/// Accepts a job, if there is room for it.
async fn insert(
    app: &App,
    access: &Access,
    request: JobRequest,
    key: Option<RequestKey>,
) -> Result<Inserted> {
    let spec = resolve(app, access, request).await?;
    let lab = access.lab.clone();
    let (most_jobs, needed) = (app.settings.max_jobs, spec.disk_bytes());
    let new = NewJob { most_jobs, lab, spec, key };
    app.admission.with_room(&access.lab, ("the job", needed), app.store.add_job(new)).await
}

/// Checks a request against the measurement that it names.
async fn resolve(app: &App, access: &Access, request: JobRequest) -> Result<JobSpec> {
    let lab = &access.lab;
    let beyond_role = role_error(access, request.priority);
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
        mosaic: calibration.facts.mosaic,
    };
    let model = match request.model {
        None => None,
        Some(id) => {
            let model = app.store.model(lab, id).await;
            Some(model.map_err(|error| ApiError::reference("/model", error))?.into())
        }
    };
    let resolved = request.resolve(calibration.id, shape, measurement.sequence, model);
    let resolved = beyond_role.map_or(resolved, |error| Err(vec![error]));
    let mut spec = resolved.map_err(|errors| ApiError::fields(Code::InvalidRequest, errors))?;
    spec.warnings = warnings_of(measurement.warnings, spec.snapshots);
    // If the report is not made yet, its end adds the warning.
    let report = app.store.report(calibration.id).await?;
    spec.warnings.extend(report.and_then(|report| report.warning()));
    check_memory(app, &spec)?;
    check_networks(app, &spec)?;
    Ok(spec)
}

/// What is wrong with a priority that would put a lab's job before those of all others.
fn role_error(access: &Access, priority: i32) -> Option<InvalidField> {
    let role = access.role;
    (priority > 0 && role < Role::Admin).then(|| {
        let detail = format!(
            "priority is {priority}; with a token of role {role} it must be from -100 to 0: only an \
             admin puts a job before those of other labs"
        );
        InvalidField::new("/priority", detail)
    })
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

/// Refuses a job with a network while none can be run.
fn check_networks(app: &App, spec: &JobSpec) -> Result<()> {
    if spec.model.is_none() && !spec.schedule.needs_network() {
        return Ok(());
    }
    app.networks().map_err(|missing| {
        let name = spec.algorithm.into_str();
        let detail =
            format!("{name} runs a network, and this service has {missing}; gap-tv3d needs none");
        ApiError::field("/algorithm", detail)
    })
}

async fn body(app: &App, lab: &Lab, id: JobId) -> Result<JobBody> {
    let job = app.store.job(lab, id).await?;
    let progress = app.store.progress(&job).await?;
    let mut bodies = [JobBody::new(job, progress)];
    warn_of_tiles(app, &mut bodies).await?;
    let [body] = bodies;
    Ok(body)
}

/// Adds a finding to jobs whose tiles no worker takes.
async fn warn_of_tiles(app: &App, jobs: &mut [JobBody]) -> Result<()> {
    let waits = |job: &&mut JobBody| {
        matches!(job.state, JobState::Queued | JobState::Running)
            && job.progress.tiles_done < job.progress.tiles_total
    };
    let mut waiting = jobs.iter_mut().filter(waits).peekable();
    if waiting.peek().is_none() {
        return Ok(());
    }
    if let Err(detail) = app.tiles().await? {
        let finding = Finding::new(FindingCode::NoTileWorkers, detail);
        waiting.for_each(|job| job.warnings.push(finding.clone()));
    }
    Ok(())
}

/// `GET /v1/jobs`, of one lab or of all of them, with an ETag, so that watching costs little.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let filter = JobFilter {
        states: query.state.map(|States(states)| states),
        calibration: query.calibration,
        measurement: query.measurement,
        label: query.label,
        search: query.search,
        created: Span { from: query.created_after, before: query.created_before },
        after: query.cursor,
    };
    let page = app.store.jobs(access.shown(), &filter, query.limit.get()).await?;
    let progress = app.store.progress_of(&page.items).await?;
    let items = page.items.into_iter().zip(progress).map(|(job, at)| JobBody::new(job, at));
    let mut page = Page { items: items.collect::<Vec<_>>(), more: page.more };
    warn_of_tiles(&app, &mut page.items).await?;
    conditional::json(
        &PageBody::new(page, |item: &JobBody| item.id.to_string(), |item| item),
        &headers,
    )
}

/// `GET /v1/jobs/{job}`, with an ETag, so that watching costs little.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    QueryOf(query): QueryOf<ShowQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    if let Some(time) = query.wait(&app) {
        app.events.ended(&app.store, &access.lab, id, time).await?;
    }
    conditional::json(&body(&app, &access.lab, id).await?, &headers)
}

/// `PATCH /v1/jobs/{job}`.
pub(super) async fn change(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    Body(changes): Body<Changes>,
) -> Result<Json<JobBody>> {
    let Changes { label, priority } = changes;
    let wrong = priority.and_then(|to| priority_error(to).or_else(|| role_error(&access, to)));
    if let Some(error) = wrong {
        return Err(ApiError::fields(Code::InvalidRequest, vec![error]));
    }
    app.store.change_job(&access.lab, id, &JobChanges { label, priority }).await?;
    Ok(Json(body(&app, &access.lab, id).await?))
}

/// `POST /v1/jobs/estimate`: what a job would take, which is checked as one that is meant.
pub(super) async fn estimate(
    Caller(app, access): Caller,
    Body(request): Body<JobRequest>,
) -> Result<Json<EstimateBody>> {
    let spec = resolve(&app, &access, request).await?;
    let tasks = spec.tasks().map_err(|error| ApiError::internal(&error))?;
    let tiles = tasks.iter().filter(|(kind, _)| kind.tile().is_some()).count() as u64;
    Ok(Json(EstimateBody {
        tiles,
        tasks: tasks.len(),
        cpu_seconds: tasks.iter().map(|(_, cost)| cost).sum(),
        forecast: app.store.estimate(&tasks).await?,
        disk_bytes: spec.disk_bytes(),
        worker_memory_bytes: spec.worker_bytes(),
        warnings: spec.warnings,
    }))
}

pub(super) async fn cancel(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    headers: HeaderMap,
) -> Result<Response> {
    check_match(&app, &access.lab, id, &headers).await?;
    app.store.cancel_job(&access.lab, id).await?;
    accepted(&app, &access.lab, id).await
}

pub(super) async fn retry(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    headers: HeaderMap,
) -> Result<Response> {
    check_match(&app, &access.lab, id, &headers).await?;
    app.store.retry_job(&access.lab, id).await?;
    accepted(&app, &access.lab, id).await
}

/// Refuses a change of a job that the client has seen in another state.
async fn check_match(app: &App, lab: &Lab, id: JobId, headers: &HeaderMap) -> Result<()> {
    if !headers.contains_key(header::IF_MATCH) {
        return Ok(());
    }
    conditional::check_match(headers, &conditional::etag_of(&body(app, lab, id).await?)?)
}

async fn accepted(app: &App, lab: &Lab, id: JobId) -> Result<Response> {
    let retry_after: (HeaderName, &str) = (header::RETRY_AFTER, "1");
    Ok((StatusCode::ACCEPTED, [retry_after], Json(body(app, lab, id).await?)).into_response())
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    headers: HeaderMap,
) -> Result<StatusCode> {
    check_match(&app, &access.lab, id, &headers).await?;
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
