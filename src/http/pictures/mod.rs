//! Pictures of frames, measurements and masks for viewers: 8-bit PNG, WebP or JPEG of a display window, either reduced to
//! a preview or in tiles at several zoom levels. The results have the exact values.

mod names;
mod source;

use std::sync::Arc;

use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use names::Named;
pub(super) use names::{Of, OfJob};

use super::app::App;
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf};
use super::negotiation::picture_encoding;
use super::rendering::{self, Picture, Region, Spread, TILE};
use engine::job::Sha256;
use engine::pipeline::movie::DisplayWindow;
use formats::display;

/// Default length of the longer side of a preview, in pixels.
const PREVIEW_SIDE: usize = 512;
/// Lengths of the longer side of a preview that a request may ask for, in pixels.
const PREVIEW_SIDES: std::ops::RangeInclusive<usize> = 16..=1024;

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
    let size = query.size.unwrap_or(PREVIEW_SIDE);
    if !PREVIEW_SIDES.contains(&size) {
        let (least, most) = (PREVIEW_SIDES.start(), PREVIEW_SIDES.end());
        let detail = format!("size is {size}; it must be from {least} to {most}");
        return Err(ApiError::new(Code::InvalidQuery, detail));
    }
    let window = match (query.black, query.white.or(picture.white)) {
        (None, None) => None,
        (black, Some(white)) => Some(display_window(black.unwrap_or(0.0), white)?),
        (Some(_), None) => {
            let detail =
                "black without white: this picture has no white level, so state white, too";
            return Err(ApiError::new(Code::InvalidQuery, detail));
        }
    };
    let region = picture.whole(picture.level_within(size));
    draw(&app, picture, region, window, &headers).await
}

pub(super) async fn tile<N: Named>(
    Caller(app, access): Caller,
    Params(name): Params<N>,
    Params(at): Params<TilePath>,
    QueryOf(query): QueryOf<TileQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let picture = name.find(&app, &access.lab).await?;
    let window = display_window(query.black, query.white)?;
    let region = tile_region(&picture, &at)?;
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
    let region = picture.whole(picture.level_within(PREVIEW_SIDE));
    let white = picture.white;
    let values = app.pictures.reduced(Arc::new(picture), region).await?;
    let Spread { minimum, maximum, low, high } = rendering::spread(&values);
    let (low, high) = white.map_or((low, high), |white| (0.0, white));
    let body = SpreadBody { height, width, tile: TILE, levels, minimum, maximum, low, high };
    conditional::json(&body, &headers)
}

/// The values of a tile: float32, little-endian, by rows; three colours per pixel behind a mosaic.
pub(super) async fn values<N: Named>(
    Caller(app, access): Caller,
    Params(name): Params<N>,
    Params(at): Params<TilePath>,
    headers: HeaderMap,
) -> Result<Response> {
    let picture = name.find(&app, &access.lab).await?;
    let region = tile_region(&picture, &at)?;
    let etag = conditional::etag(&Sha256::of(
        format!("values/1 {} {region:?}", picture.identity).as_bytes(),
    ));
    let tags = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, "private, no-cache".into())];
    if let Some(known) = conditional::not_modified(&headers, &etag, tags.clone())? {
        return Ok(known);
    }
    let values = app.pictures.reduced(Arc::new(picture), region).await?;
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    Ok((tags, [(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}

/// The region of a tile.
///
/// Errors: 404 if the picture has no such tile.
fn tile_region(picture: &Picture, &TilePath { level, row, column }: &TilePath) -> Result<Region> {
    picture.tile(level, row, column).ok_or_else(|| {
        let detail = format!(
            "there is no tile {level}/{row}/{column} of {}x{} pixels (rows x columns); tiles have \
             {TILE} pixels a side, levels are 0 to {}",
            picture.height,
            picture.width,
            picture.level_within(TILE)
        );
        ApiError::new(Code::NotFound, detail)
    })
}

fn display_window(black: f32, white: f32) -> Result<DisplayWindow> {
    DisplayWindow::new(black, white)
        .map_err(|error| ApiError::new(Code::InvalidQuery, error.to_string()))
}

/// Answers with a region of a picture in the encoding that the client prefers. If the client has it, the answer is 304 and no values are read. Without a
/// window, black and white are set so that half a percent of the pixels is below and above.
async fn draw(
    app: &App,
    picture: Picture,
    region: Region,
    window: Option<DisplayWindow>,
    headers: &HeaderMap,
) -> Result<Response> {
    let encoding = picture_encoding(headers)?;
    let content = format!("picture/2 {} {region:?} {window:?} {encoding:?}", picture.identity);
    let etag = conditional::etag(&Sha256::of(content.as_bytes()));
    // The browser asks again before it shows a picture, so that it shows none after the end of a session.
    let tags = [
        (header::ETAG, etag.clone()),
        (header::CACHE_CONTROL, "private, no-cache".into()),
        (header::VARY, "accept".into()),
    ];
    if let Some(known) = conditional::not_modified(headers, &etag, tags.clone())? {
        return Ok(known);
    }
    let channels = picture.channels;
    let values = app.pictures.reduced(Arc::new(picture), region).await?;
    let encode = tokio::task::spawn_blocking(move || {
        let DisplayWindow { black, white } = window.unwrap_or_else(|| {
            let Spread { low, high, .. } = rendering::spread(&values);
            DisplayWindow { black: low, white: if high > low { high } else { low + 1.0 } }
        });
        display::Picture::new(values.view(), channels, (black, white))?.encode(encoding)
    });
    let bytes = encode.await.map_err(|error| ApiError::internal(&error))??;
    Ok((tags, [(header::CONTENT_TYPE, encoding.media_type())], bytes).into_response())
}
