//! Snapshots of a job and their files, which [`exports`](super::exports) serves with ETag and Range.

use std::path::PathBuf;

use axum::response::Response;
use serde::Serialize;

use super::app::App;
use super::context::RequestContext;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf, canonical_number};
use super::jobs::with_snapshot;
use super::page::{Cursor, PageBody, PageQuery};
use engine::job::{JobId, JobState, ResultFile, WrittenFile};
use engine::pipeline::records::WhiteRecord;
use store::{Job, Page, StoreError};

/// A snapshot of a job, with its files.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "SnapshotFiles")]
pub(super) struct SnapshotBody {
    snapshot: u32,
    /// True once the files exist.
    ready: bool,
    files: Vec<FileBody>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "SnapshotFile")]
struct FileBody {
    #[serde(flatten)]
    file: ResultFile,
    /// Address of the file, relative to the address of this answer.
    href: Option<String>,
}

/// `GET /v1/jobs/{job}/snapshots`: the snapshots of a job, by index.
pub(super) async fn list(
    Caller(app, access): Caller,
    Params(id): Params<JobId>,
    QueryOf(query): QueryOf<PageQuery<u32>>,
    request: RequestContext,
) -> Result<Response> {
    let job = app.store.job(&access.lab, id).await?;
    let after = query.cursor.map(|Cursor(snapshot)| snapshot);
    let mut snapshots =
        job.spec.snapshots.indices().filter(|at| after.is_none_or(|after| *at > after));
    let mut items = Vec::new();
    for snapshot in snapshots.by_ref().take(query.limit.get() as usize) {
        items.push(body(&app, &job, snapshot, &request).await?);
    }
    let page = Page { items, more: snapshots.next().is_some() };
    PageBody::new(page, |item: &SnapshotBody| item.snapshot.to_string(), |item| item)
        .answer(&request)
}

pub(super) async fn snapshot(
    Caller(app, access): Caller,
    Params((job, snapshot)): Params<(JobId, u32)>,
    request: RequestContext,
) -> Result<Response> {
    let job = with_snapshot(&app, &access.lab, job, snapshot).await?;
    request.json(&body(&app, &job, snapshot, &request).await?)
}

async fn body(
    app: &App,
    job: &Job,
    snapshot: u32,
    request: &RequestContext,
) -> Result<SnapshotBody> {
    let files = app.store.result_files(job, Some(snapshot)).await?;
    let show = |WrittenFile { file, .. }: WrittenFile| {
        let href = export(&file.name).map(|export| {
            request.reference(&format!("/v1/jobs/{}/snapshots/{snapshot}/exports/{export}", job.id))
        });
        FileBody { href, file }
    };
    let ready = !files.is_empty();
    Ok(SnapshotBody { snapshot, ready, files: files.into_iter().map(show).collect() })
}

/// The path of the export that serves a result file.
fn export(name: &str) -> Option<String> {
    let format = match name {
        "stack.exr" => "exr",
        "frames.npy" => "npy",
        "mosaic.npy" => "mosaic",
        "error.npy" => "error",
        "manifest.json" => "manifest",
        _ => {
            let (stem, kind) = name.rsplit_once('/')?.1.rsplit_once('.')?;
            let number: u32 = stem.strip_prefix("frame_")?.parse().ok()?;
            return Some(format!("frames/{number}.{kind}"));
        }
    };
    Some(format.to_owned())
}

/// The result file of a frame such as `1.exr` or `1.png`. Frames are counted from 1 to `frames`.
pub(super) fn frame_file(frame: &str, frames: usize) -> Option<String> {
    let (number, kind) = frame.split_once('.')?;
    let folder = match kind {
        "exr" => "frames",
        "png" => "png",
        _ => return None,
    };
    let number = canonical_number(number)?;
    (1..=frames).contains(&number).then(|| format!("{folder}/frame_{number:04}.{kind}"))
}

/// The reason why a finished job has no `error.npy`.
const NO_PREDICTION: &str =
    "no error can be predicted for frames of this algorithm, schedule or sensor";

/// The record of a result file, and its path unless it is derived.
///
/// Errors: 404 if it does not exist yet.
pub(super) async fn result_file(
    app: &App,
    job: &Job,
    snapshot: Option<u32>,
    name: &str,
) -> Result<(WrittenFile, PathBuf)> {
    match app.store.result_file(job, snapshot, name).await {
        Err(StoreError::NotFound { .. })
            if name == "error.npy" && job.state == JobState::Succeeded =>
        {
            Err(ApiError::new(Code::NotFound, NO_PREDICTION))
        }
        Err(StoreError::NotFound { .. }) => {
            let detail =
                format!("{name} is not ready yet; the state of the job shows its progress");
            Err(ApiError::new(Code::NotReady, detail))
        }
        result => Ok(result?),
    }
}

pub(super) fn media_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map(|(_, kind)| kind) {
        Some("exr") => "image/x-exr",
        Some("png") => "image/png",
        Some("mp4") => "video/mp4",
        Some("gif") => "image/gif",
        Some("json") => "application/json",
        _ => "application/octet-stream",
    }
}

/// A `Content-Disposition` that has the browser save the file.
pub(super) fn attachment(job: JobId, snapshot: Option<u32>, name: &str) -> String {
    format!("attachment; {}", file_name(job, snapshot, name))
}

/// The file name in a `Content-Disposition`. It differs between jobs and between snapshots.
pub(super) fn file_name(job: JobId, snapshot: Option<u32>, name: &str) -> String {
    let file = name.rsplit('/').next().unwrap_or(name);
    let short: String =
        job.to_string().chars().rev().take(8).collect::<Vec<_>>().into_iter().rev().collect();
    match snapshot {
        Some(snapshot) => format!("filename=\"{short}_{snapshot:04}_{file}\""),
        None => format!("filename=\"{short}_{file}\""),
    }
}

/// The white level of a job's frames; `None` before it is determined.
pub(in crate::http) async fn white_level(app: &App, job: JobId) -> Result<Option<f32>> {
    let record = app.store.white_record(job).await?;
    let read = |record| serde_json::from_value::<WhiteRecord>(record);
    let record = record.map(read).transpose().map_err(|error| ApiError::internal(&error))?;
    Ok(record.map(|record| record.white_level))
}

#[cfg(test)]
mod tests {
    use super::{export, frame_file};

    #[test]
    fn frames_are_named_by_number_and_kind() {
        assert_eq!(frame_file("1.exr", 8).unwrap(), "frames/frame_0001.exr");
        assert_eq!(frame_file("8.png", 8).unwrap(), "png/frame_0008.png");
        for bad in ["0.exr", "9.exr", "1.tiff", "01.exr", "+1.exr", "../1.exr", "1", "1.exr.png"] {
            assert_eq!(frame_file(bad, 8), None, "{bad}");
        }
    }

    #[test]
    fn every_file_is_an_export() {
        for (name, expected) in [
            ("frames/frame_0012.exr", Some("frames/12.exr")),
            ("png/frame_0012.png", Some("frames/12.png")),
            ("stack.exr", Some("exr")),
            ("error.npy", Some("error")),
            ("notes.txt", None),
        ] {
            assert_eq!(export(name).as_deref(), expected, "{name}");
        }
    }
}
