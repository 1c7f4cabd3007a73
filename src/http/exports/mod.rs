//! Frames in the formats of other programs, of a snapshot or of a whole job. Most exports are composed while they are
//! read and take no space on the disk; movies are encoded by workers.

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
use super::results::{frame_file, send};
use clip::Clip;
use engine::job::MovieFormat;
use format::Format;
pub(super) use movie::create;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ExportQuery {
    /// Layers of an EXR beside its frames.
    layers: Option<Layer>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Layer {
    /// The expected error.
    Sigma,
}

/// An export that is one file.
pub(super) async fn file(
    clip: Clip,
    QueryOf(query): QueryOf<ExportQuery>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let request = (&method, &headers);
    if query.layers.is_some() && clip.format != Format::Exr {
        return Err(ApiError::new(Code::InvalidQuery, "only exr has layers"));
    }
    match (clip.format, clip.snapshot) {
        (Format::Exr, Some(_)) => match query.layers {
            Some(Layer::Sigma) => exr::with_sigma(clip, request).await,
            None => stored(&clip, "stack.exr", request).await,
        },
        (Format::Npy, Some(_)) => stored(&clip, "frames.npy", request).await,
        (Format::Npy, None) => clip::array(clip, request).await,
        (Format::Tiff, _) => clip::tiff(clip, request).await,
        (Format::Mp4, _) => movie::movie(clip, MovieFormat::Mp4, request).await,
        (Format::Gif, _) => movie::movie(clip, MovieFormat::Gif, request).await,
        (Format::Mosaic, Some(_)) if clip.job.spec.shape.mosaic.is_none() => {
            let detail = "the sensor of this job is grey: npy has its frames";
            Err(ApiError::new(Code::NotFound, detail))
        }
        (Format::Mosaic, Some(_)) => stored(&clip, "mosaic.npy", request).await,
        (Format::Error, Some(_)) => stored(&clip, "error.npy", request).await,
        (Format::Manifest, _) => stored(&clip, "manifest.json", request).await,
        (Format::Zip, None) => archive::archive(clip, request).await,
        (Format::Zip, Some(_)) => elsewhere("zip is an export of the whole job"),
        (Format::Zarr, _) => elsewhere("zarr is a tree: it begins with zarr/zarr.json"),
        (Format::Frames, Some(_)) => elsewhere("frames is a tree: it begins with frames/1.exr"),
        (Format::Exr | Format::Frames | Format::Mosaic | Format::Error, None) => {
            elsewhere("this format is an export of a snapshot: snapshots/N/exports/ has it")
        }
    }
}

/// The rest of the path in a tree.
#[derive(Deserialize)]
pub(super) struct InTree {
    path: String,
}

/// A file of an export that is a tree.
pub(super) async fn part(
    clip: Clip,
    Params(InTree { path }): Params<InTree>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let request = (&method, &headers);
    match (clip.format, clip.snapshot) {
        (Format::Zarr, _) => clip::zarr(clip, &path, request).await,
        (Format::Frames, Some(_)) => {
            let frames = clip.job.spec.shape.frames;
            let name = frame_file(&path, frames).ok_or_else(|| {
                let detail = format!("frames are 1.exr to {frames}.exr, and the same with .png");
                ApiError::new(Code::NotFound, detail)
            })?;
            stored(&clip, &name, request).await
        }
        _ => elsewhere("this format is no tree; zarr and the frames of a snapshot are"),
    }
}

fn elsewhere(detail: &str) -> Result<Response> {
    Err(ApiError::new(Code::NotFound, detail))
}

/// Sends a stored result file.
async fn stored(clip: &Clip, name: &str, request: (&Method, &HeaderMap)) -> Result<Response> {
    send(&clip.app, &clip.job, clip.snapshot, name, request).await
}
