//! Exports: the frames of a snapshot or of a whole job, in formats that other programs read. Frames are stored once, as
//! the stack `stack.exr`. Other exports of frames are composed of it while a client reads them. Workers encode movies.

mod archive;
mod clip;
mod composed;
mod exr;
mod format;
mod lines;
pub(super) mod movie;

use axum::http::{HeaderMap, Method};
use axum::response::Response;
use serde::Deserialize;

use super::error::{ApiError, Code, Result};
use super::extract::{Params, QueryOf};
use super::results::frame_file;
use clip::Clip;
use engine::job::MovieFormat;
use format::Format;
pub(super) use movie::create;

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ExportQuery {
    /// Additional layers of an EXR.
    layers: Option<Layer>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Layer {
    /// The expected error of the pixels.
    Sigma,
}

/// Sends an export of a snapshot that is a single file.
pub(super) async fn snapshot_file(
    QueryOf(query): QueryOf<ExportQuery>,
    clip: Clip,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    file(clip, query, (&method, &headers)).await
}

/// Sends an export of a whole job that is a single file.
pub(super) async fn job_file(clip: Clip, method: Method, headers: HeaderMap) -> Result<Response> {
    file(clip, ExportQuery::default(), (&method, &headers)).await
}

async fn file(clip: Clip, query: ExportQuery, request: (&Method, &HeaderMap)) -> Result<Response> {
    if query.layers.is_some() && clip.format != Format::Exr {
        return Err(ApiError::new(
            Code::InvalidQuery,
            "layers is only valid for exr: remove it, or ask for exr",
        ));
    }
    match (clip.format, clip.snapshot) {
        (Format::Exr, Some(_)) => match query.layers {
            Some(Layer::Sigma) => exr::with_sigma(clip, request).await,
            None => clip::result(clip, "stack.exr", request).await,
        },
        (Format::Npy, Some(_)) => clip::result(clip, "frames.npy", request).await,
        (Format::Npy, None) => clip::array(clip, request).await,
        (Format::Tiff, _) => clip::tiff(clip, request).await,
        (Format::ZarrZip, _) => archive::zarr(clip, request).await,
        (Format::Mp4, _) => movie::movie(clip, MovieFormat::Mp4, request).await,
        (Format::Gif, _) => movie::movie(clip, MovieFormat::Gif, request).await,
        (Format::Mosaic, Some(_)) if clip.job.spec.shape.mosaic.is_none() => {
            let detail =
                "the sensor of this job is grey and has no mosaic: the export npy has its frames";
            Err(ApiError::new(Code::NotFound, detail))
        }
        (Format::Mosaic, Some(_)) => clip::result(clip, "mosaic.npy", request).await,
        (Format::Error, Some(_)) => clip::result(clip, "error.npy", request).await,
        (Format::Manifest, _) => clip::result(clip, "manifest.json", request).await,
        (Format::Zip, None) => archive::archive(clip, request).await,
        (Format::Zip, Some(_)) => {
            not_found("zip exports the whole job: ask for it at exports of the job")
        }
        (Format::Zarr, _) => not_found("zarr is a directory: its metadata are at zarr/zarr.json"),
        (Format::Frames, Some(_)) => {
            not_found("frames is a directory: its first file is frames/1.exr")
        }
        (Format::Exr | Format::Frames | Format::Mosaic | Format::Error, None) => not_found(
            "this format exports a single snapshot: ask for it at snapshots/N/exports/ of the job",
        ),
    }
}

/// The path of a file in an export that is a directory.
#[derive(Deserialize)]
pub(super) struct FilePath {
    path: String,
}

/// Sends a file of an export that is a directory.
pub(super) async fn part(
    clip: Clip,
    Params(FilePath { path }): Params<FilePath>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let request = (&method, &headers);
    match (clip.format, clip.snapshot) {
        (Format::Zarr, _) => clip::zarr(clip, &path, request).await,
        (Format::Frames, Some(_)) => {
            let frames = clip.job.spec.shape.frames;
            let name = frame_file(&path, frames).ok_or_else(|| {
                let detail = format!("frames are 1.exr to {frames}.exr, and 1.png to {frames}.png");
                ApiError::new(Code::NotFound, detail)
            })?;
            clip::result(clip, &name, request).await
        }
        _ => not_found(
            "this format is a single file; only zarr and the frames of a snapshot are directories",
        ),
    }
}

fn not_found(detail: &str) -> Result<Response> {
    Err(ApiError::new(Code::NotFound, detail))
}
