//! Pictures for looking at: frames, measurements and masks as 8-bit PNG, whole and reduced, or in
//! tiles at any zoom, with a window of contrast. The numbers themselves are in the results.

mod names;
mod source;

use std::sync::Arc;

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use names::Named;
pub(super) use names::{OfBlob, OfCalibration, OfJob, OfMeasurement};

use super::app::App;
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf};
use super::rendering::{self, Picture, Region, TILE};
use engine::job::Sha256;
use formats::png;

/// Pixels of a preview's longer side: default, and the range.
const PREVIEW: usize = 512;
const PREVIEWS: std::ops::RangeInclusive<usize> = 16..=1024;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PreviewQuery {
    size: Option<usize>,
    black: Option<f32>,
    white: Option<f32>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TileQuery {
    black: f32,
    white: f32,
}

/// Size of a picture and range of its values, from which a viewer chooses tiles and contrast.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Spread")]
pub(in crate::http) struct SpreadBody {
    height: usize,
    width: usize,
    /// Side of a tile in pixels.
    tile: usize,
    /// The last level, at which one tile shows the whole picture.
    levels: u32,
    minimum: f32,
    maximum: f32,
    /// Half a percent of the pixels lie below.
    low: f32,
    /// Half a percent of the pixels lie above.
    high: f32,
}

#[derive(Debug, Deserialize)]
pub(super) struct TilePath {
    level: u32,
    row: usize,
    column: usize,
}

pub(super) async fn preview<N: Named>(
    Caller(app, access): Caller,
    Params(name): Params<N>,
    QueryOf(query): QueryOf<PreviewQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let picture = name.find(&app, &access.lab).await?;
    let size = query.size.unwrap_or(PREVIEW);
    if !PREVIEWS.contains(&size) {
        let (least, most) = (PREVIEWS.start(), PREVIEWS.end());
        let detail = format!("size is {size}; it must be from {least} to {most}");
        return Err(ApiError::new(Code::InvalidQuery, detail));
    }
    let window = match (query.black, query.white.or(picture.white)) {
        (None, None) => None,
        (black, Some(white)) => Some(window(black.unwrap_or(0.0), white)?),
        (Some(_), None) => {
            let detail = "black needs white here: this picture has no white level";
            return Err(ApiError::new(Code::InvalidQuery, detail));
        }
    };
    let region = picture.whole(picture.level_within(size));
    draw(&app, picture, region, window, &headers).await
}

pub(super) async fn tile<N: Named>(
    Caller(app, access): Caller,
    Params(name): Params<N>,
    Params(TilePath { level, row, column }): Params<TilePath>,
    QueryOf(query): QueryOf<TileQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let picture = name.find(&app, &access.lab).await?;
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
    draw(&app, picture, region, Some(window), &headers).await
}

pub(super) async fn spread<N: Named>(
    Caller(app, access): Caller,
    Params(name): Params<N>,
    headers: HeaderMap,
) -> Result<Response> {
    let picture = name.find(&app, &access.lab).await?;
    let (height, width) = (picture.height, picture.width);
    let levels = picture.level_within(TILE);
    let region = picture.whole(picture.level_within(PREVIEW));
    let white = picture.white;
    let found = rendering::spread(&*app.pictures.reduced(Arc::new(picture), region).await?);
    let (minimum, maximum, low, high) = (found.minimum, found.maximum, found.low, found.high);
    let (low, high) = white.map_or((low, high), |white| (0.0, white));
    let body = SpreadBody { height, width, tile: TILE, levels, minimum, maximum, low, high };
    conditional::json(&body, &headers)
}

/// The values that become black and white.
pub(super) fn window(black: f32, white: f32) -> Result<(f32, f32)> {
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
) -> Result<Response> {
    let content = format!("picture/1 {} {region:?} {window:?}", picture.identity);
    let etag = conditional::etag(&Sha256::of(content.as_bytes()));
    // What is done stays the same under this address for ever; private, as results are.
    let keep = if picture.settled { "private, max-age=86400, immutable" } else { "no-cache" };
    let tags = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, keep.to_owned())];
    conditional::check_match(headers, &etag)?;
    if conditional::is_known(headers, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, tags).into_response());
    }
    let channels = picture.channels;
    let values = app.pictures.reduced(Arc::new(picture), region).await?;
    let encode = tokio::task::spawn_blocking(move || {
        let (black, white) = window.unwrap_or_else(|| {
            let found = rendering::spread(&values);
            (found.low, if found.high > found.low { found.high } else { found.low + 1.0 })
        });
        png::encode_u8(values.view(), channels, black, white)
    });
    let bytes = encode.await.map_err(|error| ApiError::internal(&error))??;
    Ok((tags, [(header::CONTENT_TYPE, "image/png")], bytes).into_response())
}
