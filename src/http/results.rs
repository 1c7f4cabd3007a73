//! Results: frames, stacks and manifests of a job, with ETag and Range.

use std::path::PathBuf;

use axum::Json;
use axum::http::{HeaderMap, Method, Uri};
use axum::response::Response;
use serde::Serialize;

use super::app::App;
use super::download::Download;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params};
use super::jobs::with_snapshot;
use engine::job::{JobId, JobState, ResultFile};
use engine::pipeline::records::WhiteRecord;
use store::{Job, StoreError};

#[derive(Debug, Serialize)]
pub(super) struct SnapshotBody {
    snapshot: u32,
    /// True once the files are there.
    ready: bool,
    files: Vec<FileBody>,
}

#[derive(Debug, Serialize)]
struct FileBody {
    #[serde(flatten)]
    file: ResultFile,
    /// Where it is downloaded from, if it is.
    href: Option<String>,
}

pub(super) async fn snapshot(
    Caller(app, access): Caller,
    Params((job, snapshot)): Params<(JobId, u32)>,
) -> Result<Json<SnapshotBody>> {
    let job = with_snapshot(&app, &access.lab, job, snapshot).await?;
    let files = app.store.result_files(&job, Some(snapshot)).await?;
    let show = |file: ResultFile| FileBody { href: href(job.id, snapshot, &file.name), file };
    let ready = !files.is_empty();
    Ok(Json(SnapshotBody { snapshot, ready, files: files.into_iter().map(show).collect() }))
}

/// The address of a result file: the inverse of [`frame_file`] and of the routes.
fn href(job: JobId, snapshot: u32, name: &str) -> Option<String> {
    let base = format!("/v1/jobs/{job}/snapshots/{snapshot}");
    if let "stack.exr" | "frames.npy" | "mosaic.npy" | "error.npy" | "manifest.json" = name {
        return Some(format!("{base}/{name}"));
    }
    let (stem, kind) = name.rsplit_once('/')?.1.rsplit_once('.')?;
    let number: u32 = stem.strip_prefix("frame_")?.parse().ok()?;
    Some(format!("{base}/frames/{number}.{kind}"))
}

pub(super) async fn job_manifest(
    Caller(app, access): Caller,
    Params(job): Params<JobId>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let job = app.store.job(&access.lab, job).await?;
    send(&app, &job, None, "manifest.json", (&method, &headers)).await
}

/// `GET /v1/jobs/{job}/snapshots/{snapshot}/` and the name of a file: `manifest.json`, `frames.npy`,
/// `mosaic.npy` or `error.npy`, as the routes have them.
pub(super) async fn file(
    Caller(app, access): Caller,
    Params((job, snapshot)): Params<(JobId, u32)>,
    uri: Uri,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let job = with_snapshot(&app, &access.lab, job, snapshot).await?;
    let name = uri.path().rsplit('/').next().unwrap_or_default();
    if name == "mosaic.npy" && job.spec.shape.mosaic.is_none() {
        let detail = "the sensor of this job is grey: frames.npy has its frames";
        return Err(ApiError::new(Code::NotFound, detail));
    }
    send(&app, &job, Some(snapshot), name, (&method, &headers)).await
}

/// `GET /v1/jobs/{job}/snapshots/{snapshot}/frames/{frame}`, where the frame is `1.exr` or `1.png`.
pub(super) async fn frame(
    Caller(app, access): Caller,
    Params((job, snapshot, frame)): Params<(JobId, u32, String)>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let job = with_snapshot(&app, &access.lab, job, snapshot).await?;
    let frames = job.spec.shape.frames;
    let name = frame_file(&frame, frames).ok_or_else(|| {
        let detail = format!("frames are 1.exr to {frames}.exr, and the same with .png");
        ApiError::new(Code::NotFound, detail)
    })?;
    send(&app, &job, Some(snapshot), &name, (&method, &headers)).await
}

/// The result file that `1.exr` or `1.png` means, counted from 1 to `frames`.
fn frame_file(frame: &str, frames: usize) -> Option<String> {
    let (number, kind) = frame.split_once('.')?;
    let folder = match kind {
        "exr" => "frames",
        "png" => "png",
        _ => return None,
    };
    let number: usize = number.parse().ok().filter(|n: &usize| n.to_string() == number)?;
    (1..=frames).contains(&number).then(|| format!("{folder}/frame_{number:04}.{kind}"))
}

/// Answers with a result file, or the part of it that is asked for.
pub(super) async fn send(
    app: &App,
    job: &Job,
    snapshot: Option<u32>,
    name: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    let (file, _) = result_file(app, job, snapshot, name).await?;
    let download = Download {
        sha256: file.sha256,
        size: file.size,
        kind: media_type(name),
        disposition: format!("inline; {}", file_name(job.id, snapshot, name)),
        // Part of a JSON document would not be one.
        in_parts: media_type(name) != "application/json",
    };
    let open = async { Ok(app.store.open_result(job, snapshot, name).await?.2) };
    download.send(open, request).await
}

/// Why there is no `error.npy`.
const NO_PREDICTION: &str =
    "no error can be predicted for frames of this algorithm, schedule or sensor";

/// A result file as it is on record, and where it lies.
/// Errors: 404 if it is not there yet.
pub(super) async fn result_file(
    app: &App,
    job: &Job,
    snapshot: Option<u32>,
    name: &str,
) -> Result<(ResultFile, PathBuf)> {
    match app.store.result_file(job, snapshot, name).await {
        Err(StoreError::NotFound { .. })
            if name == "error.npy" && job.state == JobState::Succeeded =>
        {
            Err(ApiError::new(Code::NotFound, NO_PREDICTION))
        }
        Err(StoreError::NotFound { .. }) => {
            let detail = format!("{name} is not there yet; the job's state says how far it is");
            Err(ApiError::new(Code::NotReady, detail))
        }
        found => Ok(found?),
    }
}

pub(super) fn media_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map(|(_, kind)| kind) {
        Some("exr") => "image/x-exr",
        Some("png") => "image/png",
        Some("mp4") => "video/mp4",
        Some("json") => "application/json",
        _ => "application/octet-stream",
    }
}

/// That a browser saves the file, and under which name.
pub(super) fn attachment(job: JobId, snapshot: Option<u32>, name: &str) -> String {
    format!("attachment; {}", file_name(job, snapshot, name))
}

/// The name under which a browser saves the file: one that tells jobs and snapshots apart.
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
    use super::{frame_file, href};
    use engine::job::JobId;

    #[test]
    fn frames_are_named_by_number_and_kind() {
        assert_eq!(frame_file("1.exr", 8).unwrap(), "frames/frame_0001.exr");
        assert_eq!(frame_file("8.png", 8).unwrap(), "png/frame_0008.png");
        for bad in ["0.exr", "9.exr", "1.tiff", "01.exr", "+1.exr", "../1.exr", "1", "1.exr.png"] {
            assert_eq!(frame_file(bad, 8), None, "{bad}");
        }
    }

    #[test]
    fn every_file_is_shown_with_its_address() {
        let job = JobId::new();
        let address = |name| href(job, 3, name).map(|text| text.split_off_after("snapshots/"));
        assert_eq!(address("frames/frame_0012.exr").unwrap(), "3/frames/12.exr");
        assert_eq!(address("png/frame_0012.png").unwrap(), "3/frames/12.png");
        assert_eq!(address("stack.exr").unwrap(), "3/stack.exr");
        assert_eq!(address("notes.txt"), None);
    }

    trait SplitOffAfter {
        fn split_off_after(self, mark: &str) -> String;
    }

    impl SplitOffAfter for String {
        fn split_off_after(self, mark: &str) -> String {
            self.split_once(mark).unwrap().1.to_owned()
        }
    }
}
