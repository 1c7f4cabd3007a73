//! PSNR and SSIM of frames against true frames that the lab uploaded.

use std::path::Path;

use axum::http::HeaderMap;
use axum::response::Response;
use ndarray::Axis;
use serde::{Deserialize, Serialize};

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf};
use super::intake;
use super::jobs::with_snapshot;
use super::results::{result_file, white_level};
use super::truth::{frames_before, next_frame, open};
use engine::intake::Opened;
use engine::job::{JobId, SceneShape, Sha256};
use engine::pipeline::derived::STACK;
use engine::pipeline::quality::{FrameQuality, Quality};
use formats::{Axes, Channels, exr};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct QualityQuery {
    /// By default the truth of the job.
    truth: Option<Sha256>,
    full_scale: Option<f32>,
    axes: Option<Axes>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "QualityReport")]
pub(super) struct QualityBody {
    truth: Sha256,
    /// Value to which the PSNR is relative: the job's white level, as for the expected PSNR.
    peak: f32,
    #[serde(flatten)]
    quality: Quality,
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params((id, snapshot)): Params<(JobId, u32)>,
    QueryOf(query): QueryOf<QualityQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let job = with_snapshot(&app, &access.lab, id, snapshot).await?;
    let QualityQuery { truth, full_scale, axes } = query;
    let truth = truth.or(job.spec.truth).ok_or_else(|| {
        let detail = "the job has no true frames: state an upload as truth in the query, or attach it to \
                      the job with PATCH";
        ApiError::new(Code::InvalidQuery, detail)
    })?;
    app.store.upload(&access.lab, truth).await?;
    result_file(&app, &job, Some(snapshot), STACK).await?;
    let (file, path, _) = app.store.open_result(&job, Some(snapshot), STACK).await?;
    let measure = async {
        let upload = intake::upload(&app, truth).await.map_err(|error| error.at("/truth"))?;
        let (shape, limits) = (job.spec.frame_shape(), app.limits);
        let frames = intake::run(&app, &access.lab, move || {
            let (truth, channels) = open(&upload, full_scale, axes, limits, shape)?;
            compare(&path, channels, truth, snapshot as usize, shape)
        });
        Ok::<_, ApiError>(frames.await?.into())
    };
    let key = format!("{} {snapshot} {truth} {full_scale:?} {axes:?}", file.sha256);
    let quality = app.qualities.get_or_insert_async(&key, measure).await?;
    let peak = white_level(&app, id).await?.unwrap_or(1.0);
    conditional::json(&QualityBody { truth, peak, quality: quality.relative_to(peak) }, &headers)
}

/// Compares the frames of a snapshot with true frames, of this snapshot or of all snapshots of the measurement. Memory holds
/// one frame of each.
fn compare(
    path: &Path,
    channels: Channels,
    mut truth: Opened,
    snapshot: usize,
    shape: SceneShape,
) -> Result<Vec<FrameQuality>> {
    let SceneShape { frames, height, mosaic, .. } = shape;
    let skipped = frames_before(&truth, snapshot, shape);
    for frame in 0..skipped {
        next_frame(&mut truth, frame)?;
    }
    let result = exr::open_windows(path, (frames, height, shape.width), shape.channels())?;
    let frame_quality = |k: usize| -> Result<FrameQuality> {
        let truth = next_frame(&mut truth, skipped + k)?;
        let frame = result.read_window(k..k + 1, 0..height, 0..result.info().width)?;
        let mut frame = frame.index_axis_move(Axis(0), 0);
        if let (Channels::Grey, Some(mosaic)) = (channels, mosaic) {
            frame = mosaic.sample(frame.view(), (0, 0));
        }
        let quality = FrameQuality::of(k, frame.view(), truth.view(), channels);
        quality.map_err(|error| ApiError::internal(&error))
    };
    (0..frames).map(frame_quality).collect()
}
