//! The frames of a snapshot, or of all snapshots of a job in order, as TIFF, NPY and OME-Zarr. These exports are composed of
//! the raw frames in `frames.npy`.

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
use super::super::results::{attachment, result_file};
use super::composed::{Composed, Content, Part, Section, Source};
use super::format::Format;
use engine::job::JobId;
use engine::pipeline::manifest::CameraRecord;
use formats::{Channels, clip_tiff, npy};
use store::Job;

const ARRAY: &str = "frames.npy";
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
    clip.send_with_head(head, "application/octet-stream", ARRAY, request).await
}

/// `zarr`: a file of the OME-Zarr group.
pub(super) async fn zarr(
    clip: Clip,
    path: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    let content = match path {
        GROUP => return conditional::json(&clip.zarr_group().await?, request.1),
        ARRAY_METADATA => return conditional::json(&clip.zarr_array().await?, request.1),
        chunk => clip.chunk(chunk).await?,
    };
    let composed = Composed {
        parts: vec![Part::Content(Content::File(content))],
        kind: "application/octet-stream",
        disposition: "inline".into(),
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

    fn frame_bytes(&self) -> u64 {
        let shape = self.job.spec.frame_shape();
        (shape.height * shape.width * self.channels().count() * size_of::<f32>()) as u64
    }

    /// The raw frames of a snapshot.
    async fn source(&self, snapshot: u32) -> Result<Source> {
        let (file, _) = result_file(&self.app, &self.job, Some(snapshot), ARRAY).await?;
        Ok(Source { snapshot: Some(snapshot), file })
    }

    pub(super) async fn sources(&self) -> Result<Vec<Source>> {
        let mut sources = Vec::new();
        for snapshot in self.snapshots() {
            sources.push(self.source(snapshot).await?);
        }
        Ok(sources)
    }

    /// Offset of the frames in the file of a snapshot.
    fn start(&self, source: &Source) -> Result<u64> {
        values_offset(source, self.job.spec.shape.frames as u64 * self.frame_bytes())
    }

    /// All files of the OME-Zarr group, with their paths in it.
    pub(super) async fn zarr_files(&self) -> Result<Vec<(String, Content)>> {
        let json = |value: Value| Content::Bytes(Bytes::from(value.to_string()));
        let mut files = vec![
            (GROUP.to_owned(), json(self.zarr_group().await?)),
            (ARRAY_METADATA.to_owned(), json(self.zarr_array().await?)),
        ];
        let (length, frames) = (self.frame_bytes(), self.job.spec.shape.frames);
        for (index, source) in self.sources().await?.into_iter().enumerate() {
            let start = self.start(&source)?;
            for k in 0..frames {
                let name = format!("0/c/{}{}", index * frames + k, self.chunk_suffix());
                let start = start + k as u64 * length;
                let section = Section { source: source.clone(), start, length };
                files.push((name, Content::File(section)));
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
    async fn chunk(&self, path: &str) -> Result<Section> {
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
        let length = self.frame_bytes();
        let start = self.start(&source)? + (frame % per_snapshot) as u64 * length;
        Ok(Section { source, start, length })
    }

    /// Answers with a file of these first bytes and all frames.
    async fn send_with_head(
        self,
        head: Vec<u8>,
        kind: &'static str,
        name: &str,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let mut parts = vec![Part::Content(Content::Bytes(Bytes::from(head)))];
        for source in self.sources().await? {
            let start = self.start(&source)?;
            let length = source.file.size - start;
            parts.push(Part::Content(Content::File(Section { source, start, length })));
        }
        let disposition = attachment(self.job.id, self.snapshot, name);
        Composed { parts, kind, disposition }.send(&self.app, self.job, request).await
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

/// Offset of the values in the file of an array. `values` is their length in bytes; they end the file.
pub(super) fn values_offset(source: &Source, values: u64) -> Result<u64> {
    source.file.size.checked_sub(values).ok_or_else(|| {
        ApiError::internal(&std::io::Error::other("an array has fewer frames than its job"))
    })
}

/// True if all frames follow each other at this interval, within 0.1 %.
fn is_regular(starts: &[f64], interval: f64) -> bool {
    starts.windows(2).all(|pair| ((pair[1] - pair[0]) / interval - 1.0).abs() < 1e-3)
}
