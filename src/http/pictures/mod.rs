//! Pictures for looking at: frames, measurements and masks as 8-bit PNG, whole and reduced, or in
//! tiles at any zoom, with a window of contrast. The numbers themselves are in the results.

mod cache;
mod names;
mod render;
mod source;

use std::io::ErrorKind;
use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

pub(super) use cache::Pictures;
use names::{CalibrationPicture, JobPicture, MeasurementPicture};
use render::{Picture, Region, TILE, spread};

use super::access::Access;
use super::app::App;
use super::conditional;
use super::error::{ApiError, Code};
use super::extract::{Params, QueryOf};
use crate::formats::{FormatError, png};
use crate::job::{CalibrationId, JobId, MeasurementId, Sha256};

/// Pixels of a preview's longer side: default, and the range.
const PREVIEW: usize = 512;
const PREVIEWS: std::ops::RangeInclusive<usize> = 16..=1024;

/// The query of a preview.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PreviewQuery {
    size: Option<usize>,
    black: Option<f32>,
    white: Option<f32>,
}

/// The query of a tile.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TileQuery {
    black: f32,
    white: f32,
}

/// What a viewer must know of a picture before it asks for tiles.
#[derive(Debug, Serialize)]
struct SpreadBody {
    height: usize,
    width: usize,
    tile: usize,
    /// The last level, at which one tile holds all.
    levels: u32,
    minimum: f32,
    maximum: f32,
    low: f32,
    high: f32,
}

type JobPath = (JobId, u32, JobPicture);
type MeasurementPath = (MeasurementId, MeasurementPicture);
type CalibrationPath = (CalibrationId, CalibrationPicture);

/// `GET /v1/jobs/{job}/snapshots/{snapshot}/pictures/{picture}`
pub(super) async fn job_preview(
    State(app): State<App>,
    access: Access,
    Params(path): Params<JobPath>,
    QueryOf(query): QueryOf<PreviewQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    preview(&app, names::of_job(&app, &access.lab, path).await?, &query, &headers).await
}

/// `GET /v1/jobs/{job}/snapshots/{snapshot}/pictures/{picture}/spread`
pub(super) async fn job_spread(
    State(app): State<App>,
    access: Access,
    Params(path): Params<JobPath>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    tell_spread(&app, names::of_job(&app, &access.lab, path).await?, &headers).await
}

/// `GET /v1/jobs/{job}/snapshots/{snapshot}/pictures/{picture}/tiles/{level}/{row}/{column}`
pub(super) async fn job_tile(
    State(app): State<App>,
    access: Access,
    Params((job, snapshot, name, level, row, column)): Params<(
        JobId,
        u32,
        JobPicture,
        u32,
        usize,
        usize,
    )>,
    QueryOf(query): QueryOf<TileQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let picture = names::of_job(&app, &access.lab, (job, snapshot, name)).await?;
    tile(&app, picture, (level, row, column), &query, &headers).await
}

/// `GET /v1/measurements/{measurement}/pictures/{picture}`
pub(super) async fn measurement_preview(
    State(app): State<App>,
    access: Access,
    Params(path): Params<MeasurementPath>,
    QueryOf(query): QueryOf<PreviewQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    preview(&app, names::of_measurement(&app, &access.lab, path).await?, &query, &headers).await
}

/// `GET /v1/measurements/{measurement}/pictures/{picture}/spread`
pub(super) async fn measurement_spread(
    State(app): State<App>,
    access: Access,
    Params(path): Params<MeasurementPath>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    tell_spread(&app, names::of_measurement(&app, &access.lab, path).await?, &headers).await
}

/// `GET /v1/measurements/{measurement}/pictures/{picture}/tiles/{level}/{row}/{column}`
pub(super) async fn measurement_tile(
    State(app): State<App>,
    access: Access,
    Params((id, name, level, row, column)): Params<(
        MeasurementId,
        MeasurementPicture,
        u32,
        usize,
        usize,
    )>,
    QueryOf(query): QueryOf<TileQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let picture = names::of_measurement(&app, &access.lab, (id, name)).await?;
    tile(&app, picture, (level, row, column), &query, &headers).await
}

/// `GET /v1/calibrations/{calibration}/pictures/{picture}`
pub(super) async fn calibration_preview(
    State(app): State<App>,
    access: Access,
    Params(path): Params<CalibrationPath>,
    QueryOf(query): QueryOf<PreviewQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    preview(&app, names::of_calibration(&app, &access.lab, path).await?, &query, &headers).await
}

/// `GET /v1/calibrations/{calibration}/pictures/{picture}/spread`
pub(super) async fn calibration_spread(
    State(app): State<App>,
    access: Access,
    Params(path): Params<CalibrationPath>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    tell_spread(&app, names::of_calibration(&app, &access.lab, path).await?, &headers).await
}

/// `GET /v1/calibrations/{calibration}/pictures/{picture}/tiles/{level}/{row}/{column}`
pub(super) async fn calibration_tile(
    State(app): State<App>,
    access: Access,
    Params((id, name, level, row, column)): Params<(
        CalibrationId,
        CalibrationPicture,
        u32,
        usize,
        usize,
    )>,
    QueryOf(query): QueryOf<TileQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let picture = names::of_calibration(&app, &access.lab, (id, name)).await?;
    tile(&app, picture, (level, row, column), &query, &headers).await
}

async fn preview(
    app: &App,
    picture: Picture,
    query: &PreviewQuery,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    let size = query.size.unwrap_or(PREVIEW);
    if !PREVIEWS.contains(&size) {
        let (least, most) = (PREVIEWS.start(), PREVIEWS.end());
        let detail = format!("size is {size}; it must be from {least} to {most}");
        return Err(ApiError::new(Code::InvalidQuery, detail));
    }
    let window = match (query.black, query.white) {
        (None, None) => None,
        (Some(black), Some(white)) => Some(window(black, white)?),
        _ => {
            let detail = "black and white come together, or neither";
            return Err(ApiError::new(Code::InvalidQuery, detail));
        }
    };
    let region = picture.whole(picture.level_within(size));
    draw(app, picture, region, window, headers).await
}

async fn tile(
    app: &App,
    picture: Picture,
    (level, row, column): (u32, usize, usize),
    query: &TileQuery,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    let window = window(query.black, query.white)?;
    let region = picture.tile(level, row, column).ok_or_else(|| {
        let detail = format!(
            "there is no tile {level}/{row}/{column} of {}x{} pixels (rows x columns); tiles have \
             {TILE} pixels a side, levels are 0 to {}",
            picture.height,
            picture.width,
            picture.level_within(TILE)
        );
        ApiError::new(Code::NotFound, detail)
    })?;
    draw(app, picture, region, Some(window), headers).await
}

/// The values that become black and white.
fn window(black: f32, white: f32) -> Result<(f32, f32), ApiError> {
    if black.is_finite() && white.is_finite() && black < white && (white - black).is_finite() {
        return Ok((black, white));
    }
    let detail = format!("black is {black} and white is {white}; black must be below white");
    Err(ApiError::new(Code::InvalidQuery, detail))
}

/// Answers with a region as PNG, or with word that the client has it, which reads nothing.
async fn draw(
    app: &App,
    picture: Picture,
    region: Region,
    window: Option<(f32, f32)>,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    let content = format!("picture/1 {} {region:?} {window:?}", picture.identity);
    let etag = conditional::etag(&Sha256::of(content.as_bytes()));
    // What is done stays the same under this address for ever; private, as results are.
    let keep = if picture.settled { "private, max-age=86400, immutable" } else { "no-cache" };
    let tags = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, keep.to_owned())];
    if conditional::is_known(headers, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, tags).into_response());
    }
    let values = app.pictures.reduced(Arc::new(picture), region).await?;
    let encode = tokio::task::spawn_blocking(move || {
        let (black, white) = window.unwrap_or_else(|| {
            let found = spread(&values);
            (found.low, if found.high > found.low { found.high } else { found.low + 1.0 })
        });
        png::encode_u8(values.view(), black, white)
    });
    let bytes = encode.await.map_err(|error| ApiError::internal(&error))??;
    Ok((tags, [(header::CONTENT_TYPE, "image/png")], bytes).into_response())
}

async fn tell_spread(
    app: &App,
    picture: Picture,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    let (height, width) = (picture.height, picture.width);
    let levels = picture.level_within(TILE);
    let region = picture.whole(picture.level_within(PREVIEW));
    let found = spread(&*app.pictures.reduced(Arc::new(picture), region).await?);
    let (minimum, maximum, low, high) = (found.minimum, found.maximum, found.low, found.high);
    let body = SpreadBody { height, width, tile: TILE, levels, minimum, maximum, low, high };
    conditional::json(&body, headers)
}

/// A file that is gone was one of the tiles that have just been put together.
fn unreadable(error: FormatError) -> ApiError {
    match error {
        FormatError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {
            ApiError::new(Code::NotReady, "the frames are being put together; ask again")
        }
        error => error.into(),
    }
}
