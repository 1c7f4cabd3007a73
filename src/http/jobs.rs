//! `/v1/jobs`: reconstructions.

use std::str::FromStr;

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_with::DeserializeFromStr;
use strum::VariantArray;

use super::access::Access;
use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Code, MAX_RETRY_SECONDS, Problem, Result, retry_seconds};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{Cursor, Limit, PageBody};
use super::truth;
use engine::intake;
use engine::job::{
    Algorithm, Assessment, CalibrationId, Dispersion, Finding, FindingCode, Grade, InvalidField,
    JobId, JobRequest, JobSpec, JobState, Lab, Label, MeasurementId, ModelId, Registered,
    RegistrationRequest, Role, RunSpec, SceneShape, Schedule, Sequence, Sha256, SnapshotRange,
    TileSpec, Timestamp, Webhook, priority_error,
};
use store::{
    Estimate, FailedTask, FailureCause, Inserted, Job, JobChanges, JobFilter, JobProgress, NewJob,
    Page, RequestKey, ResourceKind, Span, StoreError,
};

/// A job with its progress.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Job")]
pub(super) struct JobBody {
    id: JobId,
    lab: Lab,
    state: JobState,
    label: Option<Label>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    /// The size of the frames.
    shape: SceneShape,
    /// Displacement of the bands of a spectral camera, whose bands are the frames; null for a video.
    dispersion: Option<Dispersion>,
    snapshots: SnapshotRange,
    sequence: Sequence,
    run: RunSpec,
    algorithm: Algorithm,
    /// The model of algorithm `learned`; null for other algorithms.
    model: Option<ModelId>,
    schedule: Schedule,
    tile: TileSpec,
    registration: RegistrationRequest,
    /// The outcome of the registration; null before it, and if it is off.
    registered: Option<Registered>,
    priority: i32,
    /// The upload with the true frames; null if they are unknown.
    truth: Option<Sha256>,
    /// Findings of the check of the measurement, `bad_calibration`, `moved_masks` and `misplaced_masks`; while no worker takes
    /// tiles, `no_tile_workers`.
    warnings: Vec<Finding>,
    /// The failure in words.
    error: Option<String>,
    /// The failure with its place.
    problem: Option<JobProblem>,
    created_at: Timestamp,
    started_at: Option<Timestamp>,
    finished_at: Option<Timestamp>,
    /// The verdict on the frames, which every client shows: `bad` after errors, `doubtful` if a finding questions the scale,
    /// the dark or the masks, otherwise by the expected PSNR. Before the end only findings count. Null if nothing was found and no
    /// quality can be predicted, and for jobs that have failed or were cancelled.
    verdict: Option<Grade>,
    /// The verdict in a line, with the expected PSNR, the threshold that it missed, and why the order of the masks is not
    /// verified. Null until the job has succeeded.
    verdict_text: Option<String>,
    /// Predicted quality of the frames, mean over the snapshots. Null until the job has succeeded, and where no prediction
    /// is possible: colour sensors, models of users, and schedules without a quality model.
    assessment: Option<Assessment>,
    /// The address that is notified when the job ends.
    webhook: Option<WebhookBody>,
    progress: JobProgress,
}

/// The notification of a job.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "JobWebhook")]
struct WebhookBody {
    /// Scheme and host of the address, such as `https://lab.example`. Path and query may hold a secret of the receiver, so
    /// they are not shown.
    url: String,
    state: WebhookState,
    /// Failed attempts since the job ended.
    attempts: u32,
    /// Time of the next attempt.
    next_at: Option<Timestamp>,
    /// Why the last attempt failed.
    error: Option<String>,
}

/// State of a notification.
#[derive(Debug, Clone, Copy, Serialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
enum WebhookState {
    /// The job has not ended.
    Pending,
    /// It is being sent, or sent again after a pause.
    Sending,
    /// The receiver has confirmed it.
    Delivered,
    /// It was given up.
    Failed,
}

impl WebhookBody {
    async fn new(app: &App, job: &Job) -> Result<Option<Self>> {
        let Some(url) = job.spec.webhook.as_ref().map(Webhook::origin) else { return Ok(None) };
        let delivery = app.store.delivery(job).await?;
        let state = match &delivery {
            _ if !job.state.is_final() => WebhookState::Pending,
            None => WebhookState::Delivered,
            Some(delivery) if delivery.next_at.is_some() => WebhookState::Sending,
            Some(_) => WebhookState::Failed,
        };
        let attempts = delivery.as_ref().map_or(0, |delivery| delivery.attempts);
        let (next_at, error) =
            delivery.map_or((None, None), |delivery| (delivery.next_at, delivery.error));
        Ok(Some(Self { url, state, attempts, next_at, error }))
    }
}

/// The failure of a job. Codes are `task_failed`, `out_of_memory`, `worker_crashed` and `worker_lost`.
#[derive(Debug, Serialize, schemars::JsonSchema)]
struct JobProblem {
    #[serde(flatten)]
    problem: Problem,
    /// The kind of the task that failed.
    stage: Option<&'static str>,
    /// The snapshot of the task, or the first of its run.
    snapshot: Option<u32>,
    tile: Option<u32>,
    /// Attempts at the task.
    attempts: Option<u32>,
    /// Instruction for the user.
    remedy: &'static str,
}

impl JobProblem {
    fn new(error: &str, task: Option<FailedTask>) -> Self {
        let code = task.as_ref().map_or(Code::TaskFailed, |task| match task.cause {
            FailureCause::Task => Code::TaskFailed,
            FailureCause::Memory => Code::OutOfMemory,
            FailureCause::Crash => Code::WorkerCrashed,
            FailureCause::Loss => Code::WorkerLost,
        });
        let (.., remedy) = code.row();
        Self {
            problem: ApiError::new(code, error).problem_of_job(),
            stage: task.as_ref().map(|task| task.kind.into_str()),
            snapshot: task.as_ref().and_then(|task| task.kind.snapshot()),
            tile: task.as_ref().and_then(|task| task.kind.tile()),
            attempts: task.map(|task| task.attempts),
            remedy,
        }
    }
}

impl JobBody {
    /// Address of the job.
    pub(super) fn address(&self) -> String {
        format!("/v1/jobs/{}", self.id)
    }

    async fn new(app: &App, job: Job, progress: JobProgress) -> Result<Self> {
        let problem = match &job.error {
            Some(error) if job.state == JobState::Failed => {
                Some(JobProblem::new(error, app.store.failed_task(job.id).await?))
            }
            _ => None,
        };
        let webhook = WebhookBody::new(app, &job).await?;
        let (verdict, verdict_text) = (job.verdict(), job.verdict_text());
        let spec = job.spec;
        let shape = spec.frame_shape();
        Ok(Self {
            id: job.id,
            lab: job.lab,
            state: job.state,
            label: spec.label,
            calibration: spec.calibration,
            measurement: spec.measurement,
            shape,
            dispersion: spec.dispersion,
            snapshots: spec.snapshots,
            sequence: spec.sequence,
            run: spec.run,
            algorithm: spec.algorithm,
            model: spec.model.map(|model| model.id),
            schedule: spec.schedule,
            tile: spec.tile,
            registration: spec.registration,
            registered: spec.registered,
            priority: spec.priority,
            truth: spec.truth,
            warnings: spec.warnings,
            error: job.error,
            problem,
            created_at: job.created_at,
            started_at: job.started_at,
            finished_at: job.finished_at,
            verdict,
            verdict_text,
            assessment: job.assessment,
            webhook,
            progress,
        })
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<Cursor<JobId>>,
    state: Option<States>,
    calibration: Option<CalibrationId>,
    measurement: Option<MeasurementId>,
    label: Option<Label>,
    /// A part of the label or identifier.
    search: Option<Label>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// One or several states, separated by commas.
#[derive(Debug, DeserializeFromStr)]
struct States(Vec<JobState>);

impl FromStr for States {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let state = |name: &str| {
            name.parse::<JobState>().map_err(|_| {
                let names = JobState::VARIANTS.iter().map(|state| state.into_str());
                let names = names.collect::<Vec<_>>().join(", ");
                format!("{name:?} is not a state; states are {names}")
            })
        };
        text.split(',').map(state).collect::<Result<_, _>>().map(Self)
    }
}

/// Changes of a job. Omitted fields keep their values.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "JobChanges")]
pub(super) struct Changes {
    /// Null removes the label.
    #[serde(default, with = "serde_with::rust::double_option")]
    #[schemars(with = "Option<Label>")]
    label: Option<Option<Label>>,
    /// From -100 to 100; above 0 with the role admin alone.
    #[schemars(range(min = -100, max = 100))]
    priority: Option<i32>,
    /// The upload with the true frames. Null removes it from the job; the upload is kept.
    #[serde(default, with = "serde_with::rust::double_option")]
    #[schemars(with = "Option<Sha256>")]
    truth: Option<Option<Sha256>>,
}

/// Predicted cost of a job.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Estimate")]
pub(super) struct EstimateBody {
    /// Tiles of all snapshots.
    tiles: u64,
    tasks: usize,
    /// Planned CPU seconds.
    cpu_seconds: f64,
    #[serde(flatten)]
    forecast: Estimate,
    /// Largest number of bytes that the job writes to the disk.
    disk_bytes: u64,
    /// Largest memory that a worker needs.
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
    let location = [(header::LOCATION, body.address())];
    Ok((location, changed(status, &body)?).into_response())
}

/// Creates a job, or returns the one that was created with the same key.
pub(super) async fn make(
    app: &App,
    access: &Access,
    request: JobRequest,
    key: Option<RequestKey>,
) -> Result<(StatusCode, JobBody)> {
    let inserted =
        match app.store.created_with(&access.lab, ResourceKind::Job, key.as_ref()).await? {
            Some(id) => Inserted::Before(id),
            None => insert(app, access, request, key).await?,
        };
    let (status, id) = created(inserted);
    Ok((status, body(app, &access.lab, id).await?))
}

/// Adds a job if the queue and the disk have space for it.
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
    let place = app.admission.with_room(&access.lab, "the job", needed, app.store.add_job(new));
    match place.await {
        Err(full) if full.code() == Code::QueueFull => Err(full.retry_after(next_end(app).await?)),
        inserted => inserted,
    }
}

/// Estimated seconds until a job ends: the time for all jobs, divided by their number. Without a worker, none ends.
async fn next_end(app: &App) -> Result<u64> {
    let Estimate { eta_seconds, queue_position } = app.store.estimate(&[]).await?;
    let mean = |all: f64| all / queue_position.max(1) as f64;
    Ok(retry_seconds(eta_seconds.map_or(MAX_RETRY_SECONDS, mean)))
}

/// Resolves a request: checks it against its measurement, and fills in the defaults.
async fn resolve(app: &App, access: &Access, mut request: JobRequest) -> Result<JobSpec> {
    let lab = &access.lab;
    let invalid_priority = role_error(access, request.priority);
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
    let networks = &app.machine.networks;
    if request.algorithm != Algorithm::Learned {
        // All tiles use one network, on any worker.
        let schedule = request.schedule.take();
        let schedule = schedule.unwrap_or_else(|| request.algorithm.default_schedule());
        let has_gpu = app.has_gpu().await?;
        let schedule = if has_gpu { schedule.with_float_networks() } else { schedule };
        request.schedule = Some(networks.suited(schedule));
    }
    let resolved = request.resolve(calibration.id, shape, measurement.sequence, model);
    let resolved = invalid_priority.map_or(resolved, |error| Err(vec![error]));
    let resolved = resolved.and_then(|spec| spec.with_dispersion(calibration.facts.dispersion));
    let mut spec = resolved.map_err(|errors| ApiError::fields(Code::InvalidRequest, errors))?;
    // If the report is not finished yet, the task that writes it adds the warning. A bad calibration causes other findings,
    // so it comes first.
    let report = app.store.report(calibration.id).await?;
    spec.networks = networks.records(&spec.schedule);
    spec.warnings = report.and_then(|report| report.warning()).into_iter().collect();
    spec.warnings.extend(warnings_of(measurement.warnings, spec.snapshots));
    intake::causes_first(&mut spec.warnings);
    check_memory(app, &spec)?;
    check_networks(app, &spec)?;
    check_webhook(app, &spec)?;
    if let Some(truth) = spec.truth {
        truth::check(app, lab, truth, spec.frame_shape()).await?;
    }
    Ok(spec)
}

/// The error of a priority that the role may not set: only admins may place a job ahead of other labs.
fn role_error(access: &Access, priority: i32) -> Option<InvalidField> {
    let role = access.role;
    (priority > 0 && role < Role::Admin).then(|| {
        let detail = format!(
            "priority is {priority}; with role {role} it must be from -100 to 0, because only an admin may \
             place a job ahead of other labs"
        );
        InvalidField::new("/priority", detail)
    })
}

/// The warnings that concern the snapshots of a job.
fn warnings_of(warnings: Vec<Finding>, snapshots: SnapshotRange) -> Vec<Finding> {
    let concerns =
        |warning: &Finding| warning.snapshot.is_none_or(|snapshot| snapshots.contains(snapshot));
    warnings.into_iter().filter(concerns).collect()
}

/// Rejects a webhook on a host that the administrator has not allowed.
fn check_webhook(app: &App, spec: &JobSpec) -> Result<()> {
    let Some(webhook) = &spec.webhook else { return Ok(()) };
    if webhook.is_allowed(&app.settings.webhook_hosts) {
        return Ok(());
    }
    let place = webhook.place();
    let detail = format!(
        "webhooks may not notify the host {place}: ask the administrator to start the service with \
         --webhook-host {place}"
    );
    Err(ApiError::fields(Code::InvalidRequest, vec![InvalidField::new("/webhook", detail)]))
}

/// Rejects a job that needs more memory than a worker has.
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

/// Rejects a job with a network if the service can't run networks.
fn check_networks(app: &App, spec: &JobSpec) -> Result<()> {
    if spec.model.is_none() && !spec.schedule.needs_network() {
        return Ok(());
    }
    app.networks().map_err(|missing| {
        let name = spec.algorithm.into_str();
        let detail = format!("{name} runs a network, but {missing}; gap-tv3d needs no network");
        ApiError::field("/algorithm", detail)
    })
}

async fn body(app: &App, lab: &Lab, id: JobId) -> Result<JobBody> {
    let job = app.store.job(lab, id).await?;
    let progress = app.store.progress(&job).await?;
    let mut bodies = [JobBody::new(app, job, progress).await?];
    warn_of_tiles(app, &mut bodies).await?;
    let [body] = bodies;
    Ok(body)
}

/// Adds a finding to unfinished jobs if no worker takes tiles.
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

/// `GET /v1/jobs`: the jobs of one lab or of all labs, with an ETag, so that polling is cheap.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    request: RequestContext,
) -> Result<Response> {
    let filter = JobFilter {
        states: query.state.map(|States(states)| states),
        calibration: query.calibration,
        measurement: query.measurement,
        label: query.label,
        search: query.search,
        created: Span { from: query.created_after, before: query.created_before },
        after: query.cursor.map(|Cursor(id)| id),
    };
    let page = app.store.jobs(access.shown(), &filter, query.limit.get()).await?;
    let progress = app.store.progress_of(&page.items).await?;
    let mut items = Vec::new();
    for (job, at) in page.items.into_iter().zip(progress) {
        items.push(JobBody::new(&app, job, at).await?);
    }
    warn_of_tiles(&app, &mut items).await?;
    let page = Page { items, more: page.more };
    PageBody::new(page, |item: &JobBody| item.id.to_string(), |item| item).answer(&request)
}

/// `GET /v1/jobs/{job}`: a job, with an ETag, so that polling is cheap.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    request: RequestContext,
) -> Result<Response> {
    let wait = request.wait();
    if let Some(time) = app.wait(wait) {
        app.events.ended(&app.store, &access.lab, id, time).await?;
    }
    Ok(wait.applied(request.json(&body(&app, &access.lab, id).await?)?))
}

/// `PATCH /v1/jobs/{job}`.
pub(super) async fn change(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    request: RequestContext,
    Body(changes): Body<Changes>,
) -> Result<Response> {
    let Changes { label, priority, truth } = changes;
    let invalid = priority.and_then(|to| priority_error(to).or_else(|| role_error(&access, to)));
    if let Some(error) = invalid {
        return Err(ApiError::fields(Code::InvalidRequest, vec![error]));
    }
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    if let Some(Some(sha256)) = truth {
        let shape = app.store.job(&access.lab, id).await?.spec.frame_shape();
        truth::check(&app, &access.lab, sha256, shape).await?;
    }
    app.store.change_job(&access.lab, id, &JobChanges { label, priority, truth }).await?;
    changed(StatusCode::OK, &body(&app, &access.lab, id).await?)
}

/// `POST /v1/jobs/estimate`: the predicted cost of a job. The request is checked as if it were to be submitted.
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
    request: RequestContext,
) -> Result<Response> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    app.store.cancel_job(&access.lab, id).await?;
    let body = body(&app, &access.lab, id).await?;
    // A running tile stops after the iteration that it is in.
    let tiles = app.store.totals().await?.into_iter().find(|totals| totals.kind == "tile");
    let iteration = tiles.map(|tiles| tiles.seconds / tiles.iterations.max(1) as f64);
    accepted(&body, iteration.filter(|_| !body.state.is_final()))
}

pub(super) async fn retry(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    request: RequestContext,
) -> Result<Response> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    app.store.retry_job(&access.lab, id).await?;
    let body = body(&app, &access.lab, id).await?;
    accepted(&body, body.progress.eta_seconds)
}

/// Answers 202 with a job, and with an estimate of the seconds until its end.
fn accepted(body: &JobBody, estimate: Option<f64>) -> Result<Response> {
    let mut answer = changed(StatusCode::ACCEPTED, body)?;
    if let Some(estimate) = estimate {
        answer.headers_mut().insert(header::RETRY_AFTER, retry_seconds(estimate).into());
    }
    Ok(answer)
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    app.store.delete_job(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// The job.
///
/// Errors: 404 if the job or this snapshot of it does not exist.
pub(super) async fn with_snapshot(app: &App, lab: &Lab, id: JobId, snapshot: u32) -> Result<Job> {
    let job = app.store.job(lab, id).await?;
    if job.spec.snapshots.contains(snapshot) {
        return Ok(job);
    }
    let not_found =
        StoreError::NotFound { what: "snapshot in this job:", id: snapshot.to_string() };
    Err(not_found.into())
}
