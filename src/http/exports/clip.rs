//! The frames of a snapshot, or of all snapshots of a job in order, as TIFF, array and Zarr: views onto the raw frames
//! of `frames.npy`.

use axum::body::Bytes;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method};
use axum::response::Response;
use serde::Deserialize;
use serde_json::json;

use super::super::app::App;
use super::super::conditional;
use super::super::error::{ApiError, Code, Result};
use super::super::extract::{Caller, Params};
use super::super::jobs::with_snapshot;
use super::super::results::{attachment, result_file};
use super::composed::{Composed, Part, Piece};
use super::format::Format;
use engine::job::JobId;
use engine::pipeline::manifest::CameraRecord;
use formats::{Channels, bigtiff, npy};
use store::Job;

const ARRAY: &str = "frames.npy";

/// The frames that a path names, and the format in which they are exported.
pub(in crate::http) struct Clip {
    pub(super) app: App,
    pub(super) job: Job,
    /// None for all snapshots of the job.
    pub(super) snapshot: Option<u32>,
    pub(super) format: Format,
}

#[derive(Deserialize)]
struct Place {
    job: JobId,
    snapshot: Option<u32>,
    format: Format,
}

impl FromRequestParts<App> for Clip {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self> {
        let Caller(app, access) = Caller::from_request_parts(parts, app).await?;
        let place = Params::from_request_parts(parts, &app).await?;
        let Params(Place { job, snapshot, format }) = place;
        let job = match snapshot {
            Some(snapshot) => with_snapshot(&app, &access.lab, job, snapshot).await?,
            None => app.store.job(&access.lab, job).await?,
        };
        Ok(Self { app, job, snapshot, format })
    }
}

/// `tiff`: a BigTIFF with the descriptions of OME and ImageJ.
pub(super) async fn tiff(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let times = clip.times().await?;
    let name = clip.snapshot.map_or(String::new(), |snapshot| format!(" snapshot {snapshot}"));
    let head = bigtiff::head(&bigtiff::Clip {
        name: &format!("{}{name}", clip.job.id),
        shape: clip.shape(),
        channels: clip.channels(),
        interval_s: times.interval_s,
        times_s: times.starts_s.as_deref(),
    });
    clip.behind(head, "image/tiff", "stack.tif", request).await
}

/// `npy` of all snapshots.
pub(super) async fn array(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let head = npy::stack_header(clip.shape(), clip.channels());
    clip.behind(head, "application/octet-stream", ARRAY, request).await
}

/// `zarr/zarr.json` and `zarr/c/FRAME/0/0`, for colours `zarr/c/FRAME/0/0/0`: a chunk is a frame, counted from 0.
pub(super) async fn zarr(
    clip: Clip,
    path: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    if path == "zarr.json" {
        return describe(clip, request.1).await;
    }
    let (frames, ..) = clip.shape();
    let end = if clip.channels() == Channels::Rgb { "/0/0/0" } else { "/0/0" };
    let number = path.strip_prefix("c/").and_then(|rest| rest.strip_suffix(end));
    let frame = number.and_then(plain).filter(|frame| *frame < frames);
    let frame = frame.ok_or_else(|| {
        let detail =
            format!("the array has zarr.json and the chunks c/0{end} to c/{}{end}", frames - 1);
        ApiError::new(Code::NotFound, detail)
    })?;
    let each = clip.job.spec.shape.frames;
    let first = clip.snapshot.unwrap_or(clip.job.spec.snapshots.first);
    let snapshot = first + u32::try_from(frame / each).unwrap_or(u32::MAX);
    let piece = clip.piece(snapshot).await?;
    let bytes = clip.frame_bytes();
    let start = clip.start(&piece)? + (frame % each) as u64 * bytes;
    let composed = Composed {
        parts: vec![Part::File { piece, start, length: bytes }],
        kind: "application/octet-stream",
        disposition: "inline".into(),
    };
    composed.send(&clip.app, clip.job, request).await
}

/// A number in the one form in which it is written.
pub(super) fn plain(text: &str) -> Option<usize> {
    text.parse().ok().filter(|number: &usize| number.to_string() == text)
}

/// `zarr.json`.
async fn describe(clip: Clip, headers: &HeaderMap) -> Result<Response> {
    // A missing chunk is read as zeros, so the array is announced once all chunks exist.
    clip.pieces().await?;
    let (frames, height, width) = clip.shape();
    let times = clip.times().await?;
    let (mut shape, mut names) = (vec![frames, height, width], vec!["frame", "row", "column"]);
    if clip.channels() == Channels::Rgb {
        shape.push(clip.channels().count());
        names.push("colour");
    }
    let chunk: Vec<usize> = [1].into_iter().chain(shape[1..].iter().copied()).collect();
    let array = json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": "float32",
        "chunk_grid": {
            "name": "regular",
            "configuration": { "chunk_shape": chunk },
        },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
        "codecs": [{ "name": "bytes", "configuration": { "endian": "little" } }],
        "fill_value": 0.0,
        "dimension_names": names,
        "attributes": {
            "job": clip.job.id,
            "frame_interval_s": times.interval_s,
            "frame_times_s": times.starts_s,
        },
    });
    conditional::json(&array, headers)
}

/// When frames were taken, as far as it is known.
struct Times {
    interval_s: Option<f64>,
    starts_s: Option<Vec<f64>>,
}

impl Clip {
    fn snapshots(&self) -> Vec<u32> {
        match self.snapshot {
            Some(snapshot) => vec![snapshot],
            None => self.job.spec.snapshots.indices().collect(),
        }
    }

    /// Frames, rows, columns.
    fn shape(&self) -> (usize, usize, usize) {
        let shape = self.job.spec.shape;
        (self.snapshots().len() * shape.frames, shape.height, shape.width)
    }

    fn channels(&self) -> Channels {
        self.job.spec.shape.channels()
    }

    fn frame_bytes(&self) -> u64 {
        let shape = self.job.spec.shape;
        (shape.height * shape.width * self.channels().count() * size_of::<f32>()) as u64
    }

    /// The raw frames of a snapshot.
    async fn piece(&self, snapshot: u32) -> Result<Piece> {
        let (file, _) = result_file(&self.app, &self.job, Some(snapshot), ARRAY).await?;
        Ok(Piece { snapshot: Some(snapshot), file })
    }

    pub(super) async fn pieces(&self) -> Result<Vec<Piece>> {
        let mut pieces = Vec::new();
        for snapshot in self.snapshots() {
            pieces.push(self.piece(snapshot).await?);
        }
        Ok(pieces)
    }

    /// Where the frames of a snapshot begin in its file: behind its header.
    fn start(&self, piece: &Piece) -> Result<u64> {
        behind_header(piece, self.job.spec.shape.frames as u64 * self.frame_bytes())
    }

    /// Answers with these bytes and all frames behind them.
    async fn behind(
        self,
        head: Vec<u8>,
        kind: &'static str,
        name: &str,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let mut parts = vec![Part::Bytes(Bytes::from(head))];
        for piece in self.pieces().await? {
            let start = self.start(&piece)?;
            let length = piece.file.size - start;
            parts.push(Part::File { piece, start, length });
        }
        let disposition = attachment(self.job.id, self.snapshot, name);
        Composed { parts, kind, disposition }.send(&self.app, self.job, request).await
    }

    async fn times(&self) -> Result<Times> {
        let measurement =
            self.app.store.measurement(&self.job.lab, self.job.spec.measurement).await?;
        let camera = (measurement.facts.camera_fps, measurement.facts.exposure_s);
        let frames = self.job.spec.shape.frames;
        let records: Option<Vec<CameraRecord>> = self
            .snapshots()
            .into_iter()
            .map(|snapshot| CameraRecord::new(camera, snapshot as usize, frames))
            .collect();
        Ok(records.map_or(Times { interval_s: None, starts_s: None }, |records| {
            let starts = records.iter().map(|record| record.frame_times_s.clone());
            let starts_s: Option<Vec<f64>> =
                starts.collect::<Option<Vec<_>>>().map(|all| all.concat());
            let each = records.first().and_then(|record| record.frame_exposure_s(frames));
            let interval_s = each.filter(|each| match (&starts_s, records.len()) {
                (_, 1) => true,
                (Some(starts), _) => is_even(starts, *each),
                (None, _) => false,
            });
            Times { interval_s, starts_s }
        }))
    }
}

/// Where the values of an array begin, which end its file and have so many bytes.
pub(super) fn behind_header(piece: &Piece, values: u64) -> Result<u64> {
    piece.file.size.checked_sub(values).ok_or_else(|| {
        ApiError::internal(&std::io::Error::other("an array has fewer frames than its job"))
    })
}

/// True if frames follow one another at this interval, without a pause.
fn is_even(starts: &[f64], interval: f64) -> bool {
    starts.windows(2).all(|pair| ((pair[1] - pair[0]) / interval - 1.0).abs() < 1e-3)
}
