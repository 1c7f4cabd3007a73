//! The frames of a snapshot, or of all snapshots of a job in order, as a movie. Encoding takes long, so a worker encodes
//! the movie once a client has requested it with POST.

use axum::Json;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::super::app::App;
use super::super::download::Download;
use super::super::error::{ApiError, Code, MAX_RETRY_SECONDS, Result, retry_seconds};
use super::super::extract::{Body, Caller, Params};
use super::super::results::{file_name, media_type, white_level};
use super::clip::Clip;
use engine::job::{JobId, MIN_MOVIE_SIDE, MovieFormat};
use engine::pipeline::movie::DisplayWindow;
use store::{Movie, StoreError};

/// The body of `POST /v1/jobs/{job}/exports`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(schemars::JsonSchema)]
pub(in crate::http) struct ExportRequest {
    format: MovieFormat,
    /// The snapshot; by default all snapshots of the job, in order.
    snapshot: Option<u32>,
    /// The value of the frames to show as black; by default 0.
    black: Option<f32>,
    /// The value of the frames to show as white; by default the job's white level.
    white: Option<f32>,
}

/// An export that a worker makes.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Export")]
pub(in crate::http) struct ExportBody {
    state: ExportState,
    /// Share of the work that is done, in percent.
    percent: f64,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
#[derive(schemars::JsonSchema)]
enum ExportState {
    /// No worker is free yet.
    Waiting,
    Running,
    Ready,
}

/// `POST /v1/jobs/{job}/exports`: has a worker encode a movie, unless it exists.
pub(in crate::http) async fn create(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    Body(request): Body<ExportRequest>,
) -> Result<Response> {
    let ExportRequest { format, snapshot, black, white } = request;
    let job = app.store.job(&access.lab, id).await?;
    if let Some(missing) = snapshot.filter(|snapshot| !job.spec.snapshots.contains(*snapshot)) {
        return Err(ApiError::field("/snapshot", format!("the job has no snapshot {missing}")));
    }
    let base = snapshot.map_or(String::new(), |snapshot| format!("/snapshots/{snapshot}"));
    let address = format!("/v1/jobs/{id}{base}/exports/{}", format.into_str());
    let clip = Clip { app, job, snapshot, format: format.into() };
    check(&clip, format).await?;
    let window = requested_window(&clip.app, id, black, white).await?;
    let movie = clip.app.store.create_movie(&clip.job, snapshot, format, &window).await?;
    let answer = match movie {
        Movie::Ready { .. } => {
            Json(ExportBody { state: ExportState::Ready, percent: 100.0 }).into_response()
        }
        Movie::Asked(fraction) => pending(&clip, format, fraction).await?,
        Movie::Failed(reason) => return Err(failed(&reason)),
    };
    Ok(([(header::LOCATION, address)], answer).into_response())
}

/// The movie in a format, at ten frames per second.
pub(super) async fn movie(
    clip: Clip,
    format: MovieFormat,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    check(&clip, format).await?;
    match clip.app.store.movie(&clip.job, clip.snapshot, format).await? {
        Some(Movie::Ready { sha256, size }) => {
            let file = match clip.app.store.open_blob(sha256).await {
                Err(StoreError::Damaged { .. }) => return Err(missing(format)),
                file => file?,
            };
            let name = format!("movie.{}", format.into_str());
            let kind = media_type(&name);
            let name = file_name(clip.job.id, clip.snapshot, &name);
            let disposition = format!("inline; {name}");
            let download = Download { sha256, size, kind, disposition, accepts_ranges: true };
            download.send(async { Ok(file) }, request).await
        }
        Some(Movie::Asked(fraction)) => {
            let uncached = [(header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
            Ok((uncached, pending(&clip, format, fraction).await?).into_response())
        }
        Some(Movie::Failed(reason)) => Err(failed(&reason)),
        None => Err(missing(format)),
    }
}

/// Checks that the frames exist and that a movie can show them.
///
/// Errors: 404 if a side of the movie would be too short, or if the frames do not exist yet.
async fn check(clip: &Clip, format: MovieFormat) -> Result<()> {
    if !clip.job.spec.has_movie(format) {
        let shape = clip.job.spec.frame_shape();
        let detail = format!(
            "frames of {}x{} have no MP4, because a side would be below {MIN_MOVIE_SIDE} pixels; they have a GIF",
            shape.height, shape.width
        );
        return Err(ApiError::new(Code::NotFound, detail));
    }
    clip.sources().await?;
    Ok(())
}

/// The requested display window in the form that the store keeps. Null stands for 0 to the job's white level.
async fn requested_window(
    app: &App,
    job: JobId,
    black: Option<f32>,
    white: Option<f32>,
) -> Result<Value> {
    if black.is_none() && white.is_none() {
        return Ok(Value::Null);
    }
    let white = match white {
        None => white_level(app, job).await?,
        white => white,
    };
    let window = DisplayWindow::new(black.unwrap_or(0.0), white.unwrap_or(1.0))
        .map_err(|error| ApiError::field("/black", error.to_string()))?;
    serde_json::to_value(window).map_err(|error| ApiError::internal(&error))
}

/// Answers 202 for a movie that is being made, with an estimate of the seconds until it is ready. `fraction` is the share
/// that is done.
async fn pending(clip: &Clip, format: MovieFormat, fraction: Option<f64>) -> Result<Response> {
    let state = if fraction.is_some() { ExportState::Running } else { ExportState::Waiting };
    let percent = (fraction.unwrap_or(0.0) * 1000.0).round() / 10.0;
    let movie = (clip.snapshot, format);
    let estimate = clip.app.store.movie_seconds(&clip.job, movie, fraction).await?;
    // Without a worker, it does not become ready.
    let seconds = retry_seconds(estimate.unwrap_or(MAX_RETRY_SECONDS));
    let retry_after = [(header::RETRY_AFTER, HeaderValue::from(seconds))];
    Ok((StatusCode::ACCEPTED, retry_after, Json(ExportBody { state, percent })).into_response())
}

fn missing(format: MovieFormat) -> ApiError {
    let detail = format!(
        "there is no movie yet: to create it, POST {{\"format\": \"{}\"}} to exports of the job, with the snapshot \
         if the movie is of one",
        format.into_str()
    );
    ApiError::new(Code::NotFound, detail)
}

fn failed(reason: &str) -> ApiError {
    let detail = format!("{reason}. To try again, POST to exports of the job");
    ApiError::new(Code::MovieFailed, detail)
}
