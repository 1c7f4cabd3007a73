//! The frames of a snapshot, or of all snapshots of a job one after the other, as a movie. It takes long to make, so
//! a worker makes it when it is first asked for.

use axum::Json;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::super::download::Download;
use super::super::error::{ApiError, Code, Result};
use super::super::extract::QueryOf;
use super::super::pictures;
use super::super::results::{file_name, media_type, white_level};
use super::clip::Clip;
use engine::job::MIN_MOVIE_SIDE;
use engine::pipeline::movie::DisplayWindow;
use store::{Movie, StoreError};

const NAME: &str = "movie.mp4";
/// Seconds after which to ask again.
const AGAIN: HeaderValue = HeaderValue::from_static("1");

/// Values to show as black and as white instead of 0 and the job's white level.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct WindowQuery {
    black: Option<f32>,
    white: Option<f32>,
}

/// A movie that is not there yet.
#[derive(Debug, Serialize)]
struct MovieBody {
    /// `waiting` until a worker has nothing else to do, then `running`.
    state: &'static str,
    percent: f64,
}

/// `movie.mp4`: AV1, at ten frames a second.
pub(in crate::http) async fn movie(
    clip: Clip,
    QueryOf(query): QueryOf<WindowQuery>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    if !clip.job.spec.has_movie() {
        let detail = format!(
            "there is no movie of frames of {}x{}: it would have a side below {MIN_MOVIE_SIDE} pixels",
            clip.job.spec.shape.height, clip.job.spec.shape.width
        );
        return Err(ApiError::new(Code::NotFound, detail));
    }
    // Of what is not there no movie can be made.
    clip.pieces().await?;
    let window = display_window(&clip, &query).await?;
    loop {
        match clip.app.store.movie(&clip.job, clip.snapshot, &window).await? {
            Movie::Ready { sha256, size } => {
                let file = match clip.app.store.open_blob(sha256).await {
                    // Known to be damaged by now, it is made again.
                    Err(StoreError::Damaged { .. }) => continue,
                    file => file?,
                };
                let name = file_name(clip.job.id, clip.snapshot, NAME);
                let disposition = format!("inline; {name}");
                let kind = media_type(NAME);
                let download = Download { sha256, size, kind, disposition, in_parts: true };
                return download.send(async { Ok(file) }, (&method, &headers)).await;
            }
            Movie::Asked(fraction) => return Ok(asked(fraction)),
            Movie::Failed(reason) => {
                let detail = format!("{reason}. Asked for again, it is tried again");
                return Err(ApiError::new(Code::MovieFailed, detail));
            }
        }
    }
}

/// The requested values of black and white as the store keeps them; null for the job's white level.
async fn display_window(clip: &Clip, query: &WindowQuery) -> Result<Value> {
    if query.black.is_none() && query.white.is_none() {
        return Ok(Value::Null);
    }
    let white = match query.white {
        None => white_level(&clip.app, clip.job.id).await?,
        white => white,
    };
    let (black, white) = pictures::window(query.black.unwrap_or(0.0), white.unwrap_or(1.0))?;
    serde_json::to_value(DisplayWindow { black, white }).map_err(|error| ApiError::internal(&error))
}

fn asked(fraction: Option<f64>) -> Response {
    let state = if fraction.is_some() { "running" } else { "waiting" };
    let percent = (fraction.unwrap_or(0.0) * 1000.0).round() / 10.0;
    let fields = [
        (header::RETRY_AFTER, AGAIN),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    ];
    (StatusCode::ACCEPTED, fields, Json(MovieBody { state, percent })).into_response()
}
