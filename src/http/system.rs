//! State of the service: `/v1/system` for users, `/livez` and `/readyz` for supervisors, `/metrics` for Prometheus.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use metrics::{counter, gauge};
use serde::Serialize;

use super::app::{App, WORKER_AGE};
use super::error::Result;
use super::extract::Caller;
use super::metrics::Figures;
use crate::config::{DeviceState, VERSION};
use engine::job::{JobState, TaskState, Timestamp};
use store::{StoreError, WorkerRow};
use strum::VariantArray;

/// Time between two tests that write a file.
const DISK_TEST_INTERVAL: Duration = Duration::from_secs(2);

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "System")]
pub(super) struct SystemBody {
    version: &'static str,
    started_at: Timestamp,
    now: Timestamp,
    /// Device that runs networks.
    device: String,
    /// Name of the execution provider for that device.
    provider: &'static str,
    /// Version of ONNX Runtime, as reported by the last worker that used it.
    onnxruntime: Option<String>,
    /// Workers that the service keeps running.
    workers_wanted: usize,
    /// Workers that are alive.
    workers: Vec<WorkerRow>,
    /// What keeps the service from doing some jobs; empty if it does all.
    degraded: Vec<String>,
    /// Jobs by state.
    jobs: BTreeMap<&'static str, u64>,
    /// Tasks by state.
    queue: QueueBody,
    disk: DiskBody,
    limits: LimitsBody,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "QueueCounts")]
struct QueueBody {
    ready: u64,
    blocked: u64,
    running: u64,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Disk")]
struct DiskBody {
    free_bytes: u64,
    size_bytes: u64,
    /// Bytes that uploads leave free.
    reserved_bytes: u64,
    /// Uploads, prepared arrays and tiles.
    files: u64,
    file_bytes: u64,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "SystemLimits")]
struct LimitsBody {
    upload_bytes: u64,
    /// Uploads at the same time.
    uploads: usize,
    worker_memory_bytes: u64,
}

pub(super) async fn show(State(app): State<App>) -> Result<Json<SystemBody>> {
    let settings = &app.settings;
    Ok(Json(SystemBody {
        version: VERSION,
        started_at: app.started_at,
        now: Timestamp::now(),
        device: settings.engine.device.clone(),
        provider: settings.engine.provider(),
        onnxruntime: app.store.last_onnxruntime().await?,
        workers_wanted: settings.worker_count() + settings.host_worker_count(),
        workers: app.store.live_workers(WORKER_AGE).await?,
        degraded: app.troubles().await?,
        jobs: jobs(&app).await?,
        queue: queue(&app).await?,
        disk: disk(&app).await?,
        limits: LimitsBody {
            upload_bytes: settings.max_upload_bytes,
            uploads: settings.max_uploads,
            worker_memory_bytes: settings.worker_memory_bytes,
        },
    }))
}

async fn jobs(app: &App) -> Result<BTreeMap<&'static str, u64>> {
    let counts = app.store.job_counts().await?;
    let count = |state| counts.iter().find(|(counted, _)| *counted == state).map_or(0, |(_, n)| *n);
    Ok(JobState::VARIANTS.iter().map(|&state| (state.into_str(), count(state))).collect())
}

async fn queue(app: &App) -> Result<QueueBody> {
    let tasks = app.store.task_counts().await?;
    let count = |state: TaskState| {
        tasks.iter().filter(|((_, counted), _)| *counted == state).map(|(_, count)| count).sum()
    };
    Ok(QueueBody {
        ready: count(TaskState::Ready),
        blocked: count(TaskState::Blocked),
        running: count(TaskState::Running),
    })
}

async fn disk(app: &App) -> Result<DiskBody> {
    let (free_bytes, size_bytes) = app.store.dir().disk()?;
    let (files, file_bytes) = app.store.blob_totals().await?;
    let reserved_bytes = app.settings.min_free_bytes;
    Ok(DiskBody { free_bytes, size_bytes, reserved_bytes, files, file_bytes })
}

/// Readiness of the service. Each part is `ok` or states its fault.
#[derive(Debug, Serialize, schemars::JsonSchema)]
pub(super) struct Readiness {
    ready: bool,
    /// True if some jobs cannot be done while others can.
    degraded: bool,
    database: String,
    disk: String,
    workers: String,
    /// The problem if no worker takes tiles.
    tiles: String,
    /// Connection to other machines; only with `serve --nats`.
    #[serde(skip_serializing_if = "Option::is_none")]
    cluster: Option<String>,
    /// The library and the device that jobs with networks need.
    networks: String,
    /// The device of this machine's workers, and whether one of them has run a network on it.
    device: String,
    /// Confinement of networks of users, which keeps files from them.
    confinement: String,
}

/// The process answers.
#[derive(Debug, Serialize, schemars::JsonSchema)]
pub(super) struct Liveness {
    live: bool,
}

/// `GET /livez`: the process answers.
pub(super) async fn live() -> Json<Liveness> {
    Json(Liveness { live: true })
}

/// `GET /readyz`: the state of database, disk and workers. A long queue does not make the service unready. An unreachable
/// message server is reported, but makes it unready only if no worker of this machine takes tiles.
pub(super) async fn ready(State(app): State<App>) -> Response {
    let checks =
        [database_answers(&app).await, disk_takes_files(&app).await, workers_live(&app).await];
    let cluster = app.machine.cluster.as_ref().map(|trouble| trouble.borrow().clone());
    let tiles_continue = matches!(cluster, None | Some(None)) || !app.settings.without_tiles();
    let ready = checks.iter().all(Result::is_ok) && tiles_continue;
    let [database, disk, workers] =
        checks.map(|check| check.err().unwrap_or_else(|| "ok".to_owned()));
    let status = if ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    // A device that is refused between the two is named by both.
    let device = device_state(&app);
    let networks = app.networks();
    let tiles =
        app.tiles().await.unwrap_or_else(|_| Err("the database does not answer".to_owned()));
    let degraded = networks.is_err() || tiles.is_err() || matches!(cluster, Some(Some(_)));
    let tiles = tiles.err().unwrap_or_else(|| "ok".to_owned());
    let networks = networks.err().unwrap_or_else(|| "ok".to_owned());
    let cluster = cluster.map(|trouble| trouble.unwrap_or_else(|| "ok".to_owned()));
    let confinement = app.machine.confinement.clone().err().unwrap_or_else(|| "ok".to_owned());
    let body = Readiness {
        ready,
        degraded,
        database,
        disk,
        workers,
        tiles,
        cluster,
        networks,
        device,
        confinement,
    };
    (status, Json(body)).into_response()
}

/// The device of this machine's workers, with its state in words.
fn device_state(app: &App) -> String {
    let device = &app.settings.engine.device;
    match &*app.machine.device.borrow() {
        // The CPU is always there.
        _ if device == "cpu" => device.clone(),
        DeviceState::Ready => format!("{device}: a worker has run a network on it"),
        DeviceState::Untried => format!("{device}: no worker of this machine has tried it yet"),
        DeviceState::Refused(_) => format!("{device}: refused; see networks"),
    }
}

async fn database_answers(app: &App) -> Result<(), String> {
    app.store.ping().await.map_err(|_| "the database does not answer".to_owned())?;
    app.store.check_database_file().map_err(|_| {
        "a file of it was removed, replaced or truncated: stop the service, and restore the file or a backup"
            .to_owned()
    })?;
    app.store.database_damage().map_or(Ok(()), |_| {
        Err("the database is damaged; the log says where: restore a backup".to_owned())
    })
}

async fn disk_takes_files(app: &App) -> Result<(), String> {
    let (free, _) = app.store.dir().disk().map_err(|_| "the disk does not answer".to_owned())?;
    if free < app.settings.min_free_bytes {
        return Err(format!(
            "{free} bytes are free, but at least {} must be",
            app.settings.min_free_bytes
        ));
    }
    // Requests need no token and a test waits for the disk, so they share a recent result.
    let mut tried = app.disk_tried.lock().await;
    if let Some((at, result)) = &*tried
        && at.elapsed() < DISK_TEST_INTERVAL
    {
        return result.clone();
    }
    let result = app.store.try_disk().await.map_err(|error| match error {
        StoreError::Io { source, .. } => format!("no file can be written: {}", source.kind()),
        error if error.is_damage() => "the database is damaged: restore a backup".to_owned(),
        StoreError::Database(_) => "the database can't be changed; the log says why".to_owned(),
        _ => "no file can be written".to_owned(),
    });
    *tried = Some((Instant::now(), result.clone()));
    result
}

async fn workers_live(app: &App) -> Result<(), String> {
    let live = app.store.live_workers(WORKER_AGE).await;
    let live = live.map_err(|_| "the database does not answer".to_owned())?.len();
    if live == 0 { Err("no worker lives".to_owned()) } else { Ok(()) }
}

/// `GET /metrics`, for the role admin. Figures per lab cover the lab of the token, or all labs with a token for all labs.
#[allow(clippy::cast_precision_loss)] // counts and bytes far below 2^53
pub(super) async fn metrics(Caller(app, access): Caller) -> Result<Response> {
    for (state, count) in jobs(&app).await? {
        gauge!("sci_recon_jobs", "state" => state).set(count as f64);
    }
    for ((kind, state), count) in app.store.task_counts().await? {
        gauge!("sci_recon_tasks", "kind" => kind, "state" => state.into_str()).set(count as f64);
    }
    let totals = app.store.totals().await?;
    for done in &totals {
        let kind = || done.kind.clone();
        counter!("sci_recon_tasks_done_total", "kind" => kind()).absolute(done.tasks);
        if done.kind == "tile" {
            counter!("sci_recon_solver_iterations_total").absolute(done.iterations);
            counter!("sci_recon_denoiser_passes_total").absolute(done.passes);
        }
    }
    gauge!("sci_recon_disk_promised_bytes").set(app.store.reservations().await?.total() as f64);
    let workers = app.store.live_workers(WORKER_AGE).await?.len();
    gauge!("sci_recon_workers").set(workers as f64);
    let for_tiles = app.store.live_tile_workers(WORKER_AGE).await?;
    gauge!("sci_recon_tile_workers").set(for_tiles as f64);
    let (files, bytes) = app.store.blob_totals().await?;
    gauge!("sci_recon_blobs").set(files as f64);
    gauge!("sci_recon_blob_bytes").set(bytes as f64);
    gauge!("sci_recon_damaged_files").set(app.store.damaged_files().await? as f64);
    let (free, size) = app.store.dir().disk()?;
    gauge!("sci_recon_disk_free_bytes").set(free as f64);
    gauge!("sci_recon_disk_size_bytes").set(size as f64);
    let kind = [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
    let mut figures = Figures::default();
    figures.add_tasks(&totals);
    let mut labs = app.store.lab_figures().await?;
    labs.retain(|figures| access.all_labs || figures.lab == access.lab);
    figures.add_labs(&labs);
    Ok((kind, app.metrics.render() + &figures.into_text()).into_response())
}
