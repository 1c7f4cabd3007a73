//! The frames of a snapshot, or of all snapshots of a job in order, as TIFF, NPY, OME-Zarr and single EXR frames. All are
//! composed of the lines of the stored stacks.

use std::ops::Range;
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method};
use axum::response::Response;
use serde::Deserialize;
use serde_json::{Value, json};

use super::super::app::App;
use super::super::conditional;
use super::super::error::{ApiError, Code, Result};
use super::super::extract::{Caller, Params, canonical_number};
use super::super::jobs::with_snapshot;
use super::super::results::{attachment, file_name, media_type, result_file};
use super::composed::{Composed, Content, FileRange, Part, Piece, Source};
use super::format::Format;
use super::lines::{Compose, Lines};
use engine::job::{JobId, WrittenFile};
use engine::pipeline::derived::{Derived, STACK};
use engine::pipeline::manifest::CameraRecord;
use formats::exr;
use formats::{Channels, clip_tiff, npy};
use store::Job;

/// Metadata of the Zarr group, and of its only array.
const GROUP: &str = "zarr.json";
const ARRAY_METADATA: &str = "0/zarr.json";

/// The frames that a path names, and the format in which they are exported.
pub(in crate::http) struct Clip {
    pub(super) app: App,
    pub(super) job: Job,
    /// The index of a snapshot; `None` stands for all snapshots of the job.
    pub(super) snapshot: Option<u32>,
    pub(super) format: Format,
}

#[derive(Deserialize)]
struct ClipPath {
    job: JobId,
    snapshot: Option<u32>,
    format: Format,
}

impl FromRequestParts<App> for Clip {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self> {
        let Caller(app, access) = Caller::from_request_parts(parts, app).await?;
        let params = Params::from_request_parts(parts, &app).await?;
        let Params(ClipPath { job, snapshot, format }) = params;
        let job = match snapshot {
            Some(snapshot) => with_snapshot(&app, &access.lab, job, snapshot).await?,
            None => app.store.job(&access.lab, job).await?,
        };
        Ok(Self { app, job, snapshot, format })
    }
}

/// `tiff`: an OME-TIFF; a BigTIFF if it is larger than 4 GiB.
pub(super) async fn tiff(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let times = clip.times().await?;
    let name = clip.snapshot.map_or(String::new(), |snapshot| format!(" snapshot {snapshot}"));
    let head = clip_tiff::head(&clip_tiff::Clip {
        name: &format!("{}{name}", clip.job.id),
        shape: clip.shape(),
        channels: clip.channels(),
        interval_s: times.interval_s,
        times_s: times.starts_s.as_deref(),
        bands: clip.job.spec.dispersion.as_ref().map(|dispersion| clip_tiff::Bands {
            count: dispersion.bands(),
            wavelengths_nm: dispersion.wavelengths.as_deref(),
        }),
    });
    clip.send_with_head(head, "image/tiff", "stack.tif", request).await
}

/// `npy`: the frames of all snapshots as one array.
pub(super) async fn array(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let head = npy::stack_header(clip.shape(), clip.channels());
    clip.send_with_head(head, "application/octet-stream", "frames.npy", request).await
}

/// `zarr`: a file of the OME-Zarr group.
pub(super) async fn zarr(
    clip: Clip,
    path: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    let chunk = match path {
        GROUP => return conditional::json(&clip.zarr_group().await?, request.1),
        ARRAY_METADATA => return conditional::json(&clip.zarr_array().await?, request.1),
        chunk => clip.chunk(chunk).await?,
    };
    let composed = Composed {
        parts: vec![Part::Piece(chunk)],
        sha256: None,
        kind: "application/octet-stream",
        disposition: "inline".into(),
    };
    composed.send(&clip.app, clip.job, request).await
}

/// Sends a result file, stored or derived.
pub(super) async fn result(
    clip: Clip,
    name: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    let (file, _) = result_file(&clip.app, &clip.job, clip.snapshot, name).await?;
    let sha256 = Some(file.file.sha256);
    let stack = match clip.snapshot.filter(|_| file.is_derived) {
        Some(snapshot) => Some(clip.source(snapshot).await?),
        None => None,
    };
    let pieces = clip.content(clip.snapshot, file, stack.as_ref())?.pieces;
    let composed = Composed {
        parts: pieces.into_iter().map(Part::Piece).collect(),
        sha256,
        kind: media_type(name),
        disposition: format!("inline; {}", file_name(clip.job.id, clip.snapshot, name)),
    };
    composed.send(&clip.app, clip.job, request).await
}

/// Times of the frames in seconds.
struct Times {
    /// `None` if it is unknown, or not the same between all frames.
    interval_s: Option<f64>,
    /// Start of each frame; `None` if unknown.
    starts_s: Option<Vec<f64>>,
}

impl Clip {
    fn snapshots(&self) -> Vec<u32> {
        match self.snapshot {
            Some(snapshot) => vec![snapshot],
            None => self.job.spec.snapshots.indices().collect(),
        }
    }

    /// Numbers of frames, rows and columns.
    fn shape(&self) -> (usize, usize, usize) {
        let shape = self.job.spec.frame_shape();
        (self.snapshots().len() * shape.frames, shape.height, shape.width)
    }

    fn channels(&self) -> Channels {
        self.job.spec.shape.channels()
    }

    /// The stored frames of a snapshot.
    async fn source(&self, snapshot: u32) -> Result<Source> {
        let (stack, _) = result_file(&self.app, &self.job, Some(snapshot), STACK).await?;
        Ok(Source { snapshot: Some(snapshot), file: stack.file })
    }

    pub(super) async fn sources(&self) -> Result<Vec<Source>> {
        let mut sources = Vec::new();
        for snapshot in self.snapshots() {
            sources.push(self.source(snapshot).await?);
        }
        Ok(sources)
    }

    /// The content of a result file of a snapshot (or, with none, of the whole job). A derived file needs the stack.
    pub(super) fn content(
        &self,
        snapshot: Option<u32>,
        WrittenFile { file, crc32, is_derived }: WrittenFile,
        stack: Option<&Source>,
    ) -> Result<Content> {
        let shape = self.job.spec.frame_shape();
        let derived = Derived::named(&file.name, shape).filter(|_| is_derived);
        let pieces = match (derived, stack) {
            (Some(derived), Some(source)) => {
                let lines = self.derived(source, derived, derived.frames(shape.frames))?;
                let length = values_offset(file.size, lines.length())?;
                let make = Arc::new(move |stack: &exr::Stack| derived.head(stack));
                vec![Piece::Head { source: source.clone(), shape, length, make }, lines]
            }
            _ => vec![Piece::File(FileRange::whole(Source { snapshot, file }))],
        };
        Ok(Content { pieces, crc32: Some(crc32) })
    }

    /// The lines of a derived file that belong to these frames of a snapshot.
    fn derived(&self, source: &Source, derived: Derived, frames: Range<usize>) -> Result<Piece> {
        let (stored, height) = (self.stored_lines(), self.job.spec.frame_shape().height);
        let compose: Compose = Arc::new(move |_, number, line, composed| {
            derived.line(stored, number % height, line, composed);
        });
        self.lines(source, frames, None, (derived.line_bytes(stored), compose))
    }

    /// The layout of the lines in a stored stack.
    fn stored_lines(&self) -> exr::Lines {
        let shape = self.job.spec.frame_shape();
        exr::Lines::new(shape.frames, shape.width, shape.channels())
    }

    /// The lines of some frames of a snapshot, each composed into this number of bytes.
    pub(super) fn lines(
        &self,
        source: &Source,
        frames: Range<usize>,
        shared: Option<FileRange>,
        (composed_bytes, compose): (usize, Compose),
    ) -> Result<Piece> {
        let shape = self.job.spec.frame_shape();
        let stored_bytes = self.stored_lines().stored_bytes() as u64;
        let bytes = |frames: usize| (frames * shape.height) as u64 * stored_bytes;
        let start = values_offset(source.file.size, bytes(shape.frames))? + bytes(frames.start);
        let count = (frames.len() * shape.height) as u64;
        let composed_bytes = composed_bytes as u64;
        let lines = Lines { start, count, stored_bytes, composed_bytes, compose };
        Ok(Piece::Lines { source: source.clone(), shared, lines })
    }

    /// All files of the OME-Zarr group, with their paths in it.
    pub(super) async fn zarr_files(&self) -> Result<Vec<(String, Content)>> {
        let content = |piece| Content { pieces: vec![piece], crc32: None };
        let json = |value: Value| content(Piece::Bytes(Bytes::from(value.to_string())));
        let mut files = vec![
            (GROUP.to_owned(), json(self.zarr_group().await?)),
            (ARRAY_METADATA.to_owned(), json(self.zarr_array().await?)),
        ];
        let frames = self.job.spec.shape.frames;
        for (index, source) in self.sources().await?.into_iter().enumerate() {
            for k in 0..frames {
                let name = format!("0/c/{}{}", index * frames + k, self.chunk_suffix());
                files.push((name, content(self.derived(&source, Derived::Array, k..k + 1)?)));
            }
        }
        Ok(files)
    }

    /// The metadata of the OME-Zarr group (NGFF 0.5): axes, and seconds and pixels per step.
    async fn zarr_group(&self) -> Result<Value> {
        // Readers take a missing chunk for zeros, so the metadata exist only once all chunks do.
        self.sources().await?;
        let interval_s = self.times().await?.interval_s;
        let mut time = match self.job.spec.dispersion {
            Some(_) => json!({ "name": "c", "type": "channel" }),
            None => json!({ "name": "t", "type": "time" }),
        };
        if interval_s.is_some() {
            time["unit"] = "second".into();
        }
        let space = |name| json!({ "name": name, "type": "space" });
        let mut axes = vec![time, space("y"), space("x")];
        let mut scale = vec![interval_s.unwrap_or(1.0), 1.0, 1.0];
        if self.channels() == Channels::Rgb {
            axes.insert(1, json!({ "name": "c", "type": "channel" }));
            scale.insert(1, 1.0);
        }
        Ok(json!({
            "zarr_format": 3,
            "node_type": "group",
            "attributes": {
                "ome": {
                    "version": "0.5",
                    "multiscales": [{
                        "name": self.job.id,
                        "axes": axes,
                        "datasets": [{
                            "path": "0",
                            "coordinateTransformations": [{ "type": "scale", "scale": scale }],
                        }],
                    }],
                },
            },
        }))
    }

    /// The metadata of the array `0` in the group: float32 \[t, y, x\], or \[t, c, y, x\] for colours. A chunk is a
    /// frame.
    async fn zarr_array(&self) -> Result<Value> {
        self.sources().await?;
        let (frames, height, width) = self.shape();
        let times = self.times().await?;
        let bytes = json!({ "name": "bytes", "configuration": { "endian": "little" } });
        let (shape, names, codecs) = match self.channels() {
            Channels::Grey => {
                let bands = self.job.spec.dispersion.is_some();
                let names = if bands { &["c", "y", "x"] } else { &["t", "y", "x"] };
                (vec![frames, height, width], &names[..], vec![bytes])
            }
            channels @ Channels::Rgb => {
                // The stored frames are [row, column, colour]; NGFF wants channels before space.
                let transpose =
                    json!({ "name": "transpose", "configuration": { "order": [0, 2, 3, 1] } });
                let shape = vec![frames, channels.count(), height, width];
                (shape, &["t", "c", "y", "x"][..], vec![transpose, bytes])
            }
        };
        let chunk: Vec<usize> = [1].into_iter().chain(shape[1..].iter().copied()).collect();
        Ok(json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": shape,
            "data_type": "float32",
            "chunk_grid": {
                "name": "regular",
                "configuration": { "chunk_shape": chunk },
            },
            "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
            "codecs": codecs,
            "fill_value": 0.0,
            "dimension_names": names,
            "attributes": {
                "job": self.job.id,
                "frame_interval_s": times.interval_s,
                "frame_times_s": times.starts_s,
                "dispersion": self.job.spec.dispersion,
            },
        }))
    }

    /// The indices of a chunk after that of its frame.
    fn chunk_suffix(&self) -> &'static str {
        if self.channels() == Channels::Rgb { "/0/0/0" } else { "/0/0" }
    }

    /// The chunk at this path: a frame, counted from 0.
    async fn chunk(&self, path: &str) -> Result<Piece> {
        let (frames, ..) = self.shape();
        let suffix = self.chunk_suffix();
        let number = path.strip_prefix("0/c/").and_then(|rest| rest.strip_suffix(suffix));
        let frame = number.and_then(canonical_number).filter(|frame| *frame < frames);
        let frame = frame.ok_or_else(|| {
            let detail = format!(
                "the group has {GROUP}, {ARRAY_METADATA} and the chunks 0/c/0{suffix} to 0/c/{}{suffix}",
                frames - 1
            );
            ApiError::new(Code::NotFound, detail)
        })?;
        let per_snapshot = self.job.spec.shape.frames;
        let first = self.snapshot.unwrap_or(self.job.spec.snapshots.first);
        let snapshot = first + u32::try_from(frame / per_snapshot).unwrap_or(u32::MAX);
        let source = self.source(snapshot).await?;
        let k = frame % per_snapshot;
        self.derived(&source, Derived::Array, k..k + 1)
    }

    /// Answers with a file of these first bytes and all frames.
    async fn send_with_head(
        self,
        head: Vec<u8>,
        kind: &'static str,
        name: &str,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let mut parts = vec![Part::Piece(Piece::Bytes(Bytes::from(head)))];
        for source in self.sources().await? {
            let frames = 0..self.job.spec.shape.frames;
            parts.push(Part::Piece(self.derived(&source, Derived::Array, frames)?));
        }
        let disposition = attachment(self.job.id, self.snapshot, name);
        Composed { parts, sha256: None, kind, disposition }.send(&self.app, self.job, request).await
    }

    async fn times(&self) -> Result<Times> {
        let measurement =
            self.app.store.measurement(&self.job.lab, self.job.spec.measurement).await?;
        if self.job.spec.dispersion.is_some() {
            // All bands are exposed at the same time.
            return Ok(Times { interval_s: None, starts_s: None });
        }
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
            let exposure = records.first().and_then(|record| record.frame_exposure_s(frames));
            let interval_s = exposure.filter(|exposure| match (&starts_s, records.len()) {
                (_, 1) => true,
                (Some(starts), _) => is_regular(starts, *exposure),
                (None, _) => false,
            });
            Times { interval_s, starts_s }
        }))
    }
}

/// Offset of the values in a file of this size. `values` is their length in bytes; they end the file.
pub(super) fn values_offset(size: u64, values: u64) -> Result<u64> {
    size.checked_sub(values).ok_or_else(|| {
        ApiError::internal(&std::io::Error::other("a file has fewer frames than its job"))
    })
}

/// True if all frames follow each other at this interval, within 0.1 %.
fn is_regular(starts: &[f64], interval: f64) -> bool {
    starts.windows(2).all(|pair| ((pair[1] - pair[0]) / interval - 1.0).abs() < 1e-3)
}
