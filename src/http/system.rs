//! `/v1/system`: what the service is and how busy it is, for people.

use std::collections::BTreeMap;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use serde::Serialize;

use super::app::App;
use super::error::ApiError;
use crate::job::{JobState, TaskState, Timestamp};
use crate::store::WorkerRow;

/// Workers that were silent for longer are not shown.
const WORKER_AGE: Duration = Duration::from_secs(15);

/// The service as it is shown.
#[derive(Debug, Serialize)]
pub(super) struct SystemBody {
    version: &'static str,
    started_at: Timestamp,
    now: Timestamp,
    /// Where the network runs, as the service was told.
    device: String,
    /// Name of the execution provider for that device.
    provider: &'static str,
    /// As the last worker told that used it.
    onnxruntime: Option<String>,
    workers_wanted: usize,
    workers: Vec<WorkerRow>,
    /// Jobs by state.
    jobs: BTreeMap<&'static str, u64>,
    /// Tasks that can be taken up, wait for others, and are in work.
    queue: QueueBody,
    disk: DiskBody,
    limits: LimitsBody,
}

#[derive(Debug, Serialize)]
struct QueueBody {
    ready: u64,
    blocked: u64,
    running: u64,
}

#[derive(Debug, Serialize)]
struct DiskBody {
    free_bytes: u64,
    size_bytes: u64,
    reserved_bytes: u64,
    files: u64,
    file_bytes: u64,
}

#[derive(Debug, Serialize)]
struct LimitsBody {
    upload_bytes: u64,
    uploads: usize,
    worker_memory_bytes: u64,
}

/// `GET /v1/system`
pub(super) async fn show(State(app): State<App>) -> Result<Json<SystemBody>, ApiError> {
    let about = &app.about;
    Ok(Json(SystemBody {
        version: env!("CARGO_PKG_VERSION"),
        started_at: about.started_at,
        now: Timestamp::now(),
        device: about.device.clone(),
        provider: about.provider,
        onnxruntime: app.store.last_onnxruntime().await?,
        workers_wanted: about.workers,
        workers: app.store.live_workers(WORKER_AGE).await?,
        jobs: jobs(&app).await?,
        queue: queue(&app).await?,
        disk: disk(&app).await?,
        limits: LimitsBody {
            upload_bytes: app.max_upload_bytes,
            uploads: about.uploads,
            worker_memory_bytes: app.worker_memory_bytes,
        },
    }))
}

async fn jobs(app: &App) -> Result<BTreeMap<&'static str, u64>, ApiError> {
    let counted = app.store.job_counts().await?;
    let count = |state| counted.iter().find(|(found, _)| *found == state).map_or(0, |(_, n)| *n);
    Ok(JobState::ALL.iter().map(|&state| (state.name(), count(state))).collect())
}

async fn queue(app: &App) -> Result<QueueBody, ApiError> {
    let tasks = app.store.task_counts().await?;
    let count = |state: TaskState| {
        tasks.iter().filter(|((_, found), _)| *found == state).map(|(_, count)| count).sum()
    };
    Ok(QueueBody {
        ready: count(TaskState::Ready),
        blocked: count(TaskState::Blocked),
        running: count(TaskState::Running),
    })
}

async fn disk(app: &App) -> Result<DiskBody, ApiError> {
    let (free_bytes, size_bytes) = app.store.dir().disk()?;
    let (files, file_bytes) = app.store.blob_totals().await?;
    let reserved_bytes = app.min_free_bytes;
    Ok(DiskBody { free_bytes, size_bytes, reserved_bytes, files, file_bytes })
}
