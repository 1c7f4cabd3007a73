//! `/v1/calibrations`: masks of optical setups.

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, Method};
use axum::response::Response;
use futures_util::stream::{self, StreamExt};
use serde::{Deserialize, Serialize};

use super::context::RequestContext;
use super::download::{Download, stream_range};
use super::error::{Problem, Result};
use super::extract::{Caller, Params, QueryOf};
use super::page::{Cursor, Limit};
use super::submissions::{ResourceApi, ResourceState, page, pending};
use engine::job::{
    CalibrationId, CalibrationRequest, Dispersion, JobId, Label, Mosaic, Reading, Sha256,
    Submission, Timestamp,
};
use formats::{Channels, npy, planar};
use store::{Filter, FoundResource, Span};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<Cursor<CalibrationId>>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// A calibration. Facts about masks are null until the masks are ready.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Calibration")]
pub(super) struct CalibrationBody {
    id: CalibrationId,
    state: ResourceState,
    /// Share of the work that is done, in percent.
    percent: f64,
    /// The failure in words.
    error: Option<String>,
    /// The failure, as an answer to the request would have stated it.
    problem: Option<Problem>,
    created_at: Timestamp,
    name: Option<Label>,
    #[serde(flatten)]
    facts: CalibrationFacts,
}

#[derive(Debug, Default, Serialize, schemars::JsonSchema)]
struct CalibrationFacts {
    /// SHA-256 of the uploaded file, or, if the service has made the masks, of the npy file at `masks` of the calibration.
    masks: Option<Sha256>,
    /// Format of the file.
    format: Option<String>,
    /// Type of the samples in the file.
    sample: Option<String>,
    /// Order of the axes of the array; null for pictures.
    axes: Option<String>,
    /// Number of masks, the compression ratio B.
    frames: Option<usize>,
    height: Option<usize>,
    width: Option<usize>,
    /// The stored number that means 1.
    full_scale: Option<f32>,
    /// Mean of all masks, on [0, 1].
    mask_mean: Option<f64>,
    /// Pixels that are dark in all masks.
    dead_pixels: Option<u64>,
    /// Values at or below 0 that were set to 0.
    clipped_negatives: Option<u64>,
    /// Colours of the pixels of the sensor; null for a grey sensor.
    mosaic: Option<Mosaic>,
    /// Displacement of the bands of a spectral camera; null for other cameras. Height and width are those of the measurement.
    dispersion: Option<Dispersion>,
    reading: Option<Reading>,
    /// The map of bad pixels.
    bad_pixels: Option<Sha256>,
    /// The job whose registration has corrected the masks.
    registration_of: Option<JobId>,
}

impl ResourceApi for CalibrationId {
    const PATH: &'static str = "/v1/calibrations";
    const SUBMISSION: fn(CalibrationRequest) -> Submission = Submission::Calibration;
    type Body = CalibrationBody;

    fn body(found: FoundResource<Self>) -> Result<CalibrationBody> {
        let request = match found {
            FoundResource::Pending(request) => *request,
            FoundResource::Ready(calibration) => {
                let facts = calibration.facts;
                return Ok(CalibrationBody {
                    id: calibration.id,
                    state: ResourceState::Ready,
                    percent: 100.0,
                    error: None,
                    problem: None,
                    created_at: calibration.created_at,
                    name: calibration.name,
                    facts: CalibrationFacts {
                        masks: Some(facts.masks),
                        format: Some(facts.format),
                        sample: Some(facts.sample),
                        axes: facts.axes,
                        frames: Some(facts.frames),
                        height: Some(facts.height),
                        width: Some(facts.width),
                        full_scale: Some(facts.full_scale),
                        mask_mean: Some(facts.mask_mean),
                        dead_pixels: Some(facts.dead_pixels),
                        clipped_negatives: Some(facts.clipped_negatives),
                        mosaic: facts.mosaic,
                        dispersion: facts.dispersion,
                        reading: facts.reading,
                        bad_pixels: calibration.request.bad_pixels,
                        registration_of: calibration.request.registration_of,
                    },
                });
            }
        };
        let (state, error, problem) = pending(&request);
        let mut facts = CalibrationFacts::default();
        if let Submission::Calibration(submission) = request.submission {
            facts.frames = submission.captures.map(|captures| captures.masks.len());
            (facts.mosaic, facts.dispersion) = (submission.mosaic, submission.dispersion);
            facts.bad_pixels = submission.bad_pixels;
            facts.registration_of = submission.registration_of;
        }
        Ok(CalibrationBody {
            id: request.id.into(),
            state,
            percent: (request.fraction * 1000.0).round() / 10.0,
            error,
            problem,
            created_at: request.created_at,
            name: request.name,
            facts,
        })
    }
}

pub(super) async fn list(
    caller: Caller,
    QueryOf(query): QueryOf<ListQuery>,
    request: RequestContext,
) -> Result<Response> {
    let created = Span { from: query.created_after, before: query.created_before };
    let after = query.cursor.map(|Cursor(id)| id);
    page(caller, query.limit, Filter { calibration: None, created, after }, &request).await
}

/// `GET /v1/calibrations/{calibration}/masks`: the masks on \[0,1\] as npy. Bad pixels are NaN.
pub(super) async fn masks(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let calibration = app.store.calibration(&access.lab, id).await?;
    let (facts, prepared) = (calibration.facts, calibration.prepared);
    let shape = (facts.frames, facts.height, facts.width);
    let head = Bytes::from(npy::stack_header(shape, Channels::Grey));
    let (frames, height, width) = shape;
    let head_bytes = head.len() as u64;
    let download = Download {
        // The head follows from the shape, which the prepared file states too.
        sha256: Sha256::of(format!("npy {prepared}").as_bytes()),
        size: head_bytes + (frames * height * width * size_of::<f32>()) as u64,
        kind: "application/octet-stream",
        disposition: format!("attachment; filename=\"{id}-masks.npy\""),
        accepts_ranges: true,
    };
    #[allow(clippy::cast_possible_truncation)] // within the head
    let read = async |start: u64, length: u64| {
        let file = app.store.open_blob(prepared).await?;
        let (from, to) = (start.min(head_bytes), (start + length).min(head_bytes));
        let head = head.slice(from as usize..to as usize);
        let values = planar::HEADER_BYTES + start.saturating_sub(head_bytes);
        let values = stream_range(file, values, length - (to - from)).await?;
        Ok(Body::from_stream(stream::iter([Ok(head)]).chain(values)))
    };
    download.answer(read, (&method, &headers)).await
}
