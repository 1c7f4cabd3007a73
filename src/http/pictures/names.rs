//! Names of pictures in addresses, and the values that each name stands for.

use std::sync::Arc;

use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::source::{
    Dispersed, Files, FinishedTile, Stack, TrueFrame, Unfinished, expected_error, nth_frame,
    sent_frame,
};
use crate::http::app::App;
use crate::http::error::{ApiError, Code, Result};
use crate::http::extract::canonical_number;
use crate::http::intake;
use crate::http::jobs::with_snapshot;
use crate::http::rendering::Picture;
use crate::http::results::{result_file, white_level};
use crate::http::truth;
use engine::intake::IntakeError;
use engine::job::{CalibrationId, JobId, Lab, MeasurementId, SceneShape, Sha256};
use engine::pipeline::derived::STACK;
use engine::pipeline::records::TileTaskRecord;
use formats::mat::SceneArray;
use formats::{self, Channels, FormatError, Wanted};
use store::{Calibration, Job, Measurement, StoreError, TileResult};

/// The pictures of a job's snapshot:
/// - `frame-N`, from 1.
/// - `difference-N`: frame N minus frame N-1, from 2.
/// - `residual`: the difference between the measurement and the masked sum of the frames.
/// - `error-N`: the expected error of frame N, from 1.
/// - `deviation-N`: frame N minus its true frame, from 1.
/// - `colours`: all bands of a spectral camera in false colours.
/// - `slice-N`: row N of all frames, from 0.
const OF_JOB: &str =
    "pictures are frame-N, difference-N, error-N, deviation-N, slice-ROW, colours and residual";
/// The pictures of an uploaded file: `frame-N`, from 1, and the first frame of an array in a file of several.
const OF_BLOB: &str = "pictures are frame-N and array-NAME";
/// The pictures of a measurement, from 0.
const OF_MEASUREMENT: &str = "pictures are snapshot-N";
/// The pictures of a calibration: `mask-N`, from 1; `mean`, the mean of all masks; `gram`, the sum of their squares; and
/// `dead`, 1 at pixels that are dark in all masks, otherwise 0.
const OF_CALIBRATION: &str = "pictures are mask-N, mean, gram and dead";

/// Splits a text of the form NAME-NUMBER. Other texts are names without a number.
fn parts(text: &str) -> (&str, Option<usize>) {
    let numbered = text.rsplit_once('-').and_then(|(name, number)| {
        let number = canonical_number(number)?;
        Some((name, Some(number)))
    });
    numbered.unwrap_or((text, None))
}

/// Parameters of a path that name a picture.
pub(in crate::http) trait Named: DeserializeOwned + Send {
    /// Errors: 404 if the lab has no such picture, or not yet.
    fn find(self, app: &App, lab: &Lab) -> impl Future<Output = Result<Picture>> + Send;
}

#[derive(Debug, Deserialize)]
pub(in crate::http) struct OfJob {
    job: JobId,
    snapshot: u32,
    picture: String,
}

/// A picture of an uploaded file, a measurement or a calibration.
#[derive(Debug, Deserialize)]
pub(in crate::http) struct Of<Id> {
    #[serde(alias = "sha256", alias = "measurement", alias = "calibration")]
    id: Id,
    picture: String,
}

impl Named for OfJob {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let Self { job, snapshot, picture } = self;
        let picture = parts(&picture);
        if !matches!(
            picture,
            ("frame" | "difference" | "error" | "deviation" | "slice", Some(_))
                | ("colours" | "residual", None)
        ) {
            return Err(not_found(OF_JOB.into()));
        }
        let job = with_snapshot(app, lab, job, snapshot).await?;
        let SceneShape { frames, height, .. } = job.spec.frame_shape();
        let is_frame = |k: usize| (1..=frames).contains(&k);
        if let ("error", Some(k)) = picture
            && is_frame(k)
        {
            return error_picture(app, &job, snapshot, k - 1).await;
        }
        let stack = frames_stack(app, &job, snapshot).await?;
        match picture {
            ("frame", Some(k)) if is_frame(k) => Ok(stack.frame(k - 1)),
            ("difference", Some(k)) if is_frame(k) && k > 1 => Ok(stack.difference(k - 1)),
            ("slice", Some(row)) if row < height => Ok(stack.slice(row)),
            ("deviation", Some(k)) if is_frame(k) => {
                Ok(stack.deviation(k - 1, true_frame(app, &job, snapshot, k - 1).await?))
            }
            ("colours", None) => stack.false_colours().ok_or_else(|| {
                not_found(
                    "only the bands of a spectral camera with known wavelengths have false colours"
                        .into(),
                )
            }),
            ("residual", None) => {
                let masks = app.store.calibration(lab, job.spec.calibration).await?;
                let masks = masks_stack(app, &masks).await?;
                let measurement = app.store.measurement(lab, job.spec.measurement).await?;
                let measurement = snapshots_stack(app, &measurement).await?;
                Ok(stack.residual(&masks, &measurement, snapshot as usize))
            }
            _ => Err(not_found(format!(
                "frames are counted from 1 to {frames}, differences from 2, rows from 0 to {}",
                height.saturating_sub(1)
            ))),
        }
    }
}

impl Named for Of<Sha256> {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let Self { id: sha256, picture } = self;
        let (frame, name) = match (picture.strip_prefix("array-"), parts(&picture)) {
            (Some(name), _) => (1, Some(name.to_owned())),
            (None, ("frame", Some(frame))) => (frame, None),
            _ => return Err(not_found(OF_BLOB.into())),
        };
        app.store.upload(lab, sha256).await?;
        let path = intake::upload(app, sha256).await?;
        let limits = app.limits;
        let identity = format!("{sha256} sent {frame} {}", name.as_deref().unwrap_or_default());
        let open = move || match &name {
            None => formats::open_shown(&path, &limits),
            Some(name) => {
                let wanted = Wanted { name: Some(name.as_str()), ..SceneArray::Masks.into() };
                formats::open_array(&path, wanted, &limits)
            }
        };
        let again = open.clone();
        let read_info = move || open().map(|reader| *reader.info());
        let info = tokio::task::spawn_blocking(read_info).await;
        let info = info.map_err(|error| ApiError::internal(&error))??;
        if !(1..=info.frames).contains(&frame) {
            return Err(not_found(format!("frames are counted from 1 to {}", info.frames)));
        }
        let size = (info.height, info.width);
        Ok(sent_frame(identity, size, Channels::Grey, move || {
            let mut reader = again()?;
            nth_frame(frame, || reader.next_frame())
        }))
    }
}

impl Named for Of<MeasurementId> {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let ("snapshot", Some(snapshot)) = parts(&self.picture) else {
            return Err(not_found(OF_MEASUREMENT.into()));
        };
        let measurement = app.store.measurement(lab, self.id).await?;
        let stack = snapshots_stack(app, &measurement).await?;
        let count = stack.shape.0;
        if snapshot < count {
            return Ok(stack.frame(snapshot));
        }
        Err(not_found(format!("snapshots are counted from 0 to {}", count.saturating_sub(1))))
    }
}

impl Named for Of<CalibrationId> {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let picture = parts(&self.picture);
        if !matches!(picture, ("mask", Some(_)) | ("mean" | "gram" | "dead", None)) {
            return Err(not_found(OF_CALIBRATION.into()));
        }
        let calibration = app.store.calibration(lab, self.id).await?;
        let stack = masks_stack(app, &calibration).await?;
        let count = stack.shape.0;
        match picture {
            ("mean", _) => Ok(stack.mean()),
            ("gram", _) => Ok(stack.gram()),
            ("dead", _) => Ok(stack.dead()),
            (_, Some(k)) if (1..=count).contains(&k) => Ok(stack.frame(k - 1)),
            _ => Err(not_found(format!("masks are counted from 1 to {count}"))),
        }
    }
}

fn not_found(detail: String) -> ApiError {
    ApiError::new(Code::NotFound, detail)
}

async fn masks_stack(app: &App, calibration: &Calibration) -> Result<Stack> {
    let facts = &calibration.facts;
    prepared_stack(app, calibration.prepared, (facts.frames, facts.height, facts.width)).await
}

async fn snapshots_stack(app: &App, measurement: &Measurement) -> Result<Stack> {
    let facts = &measurement.facts;
    let shape = (facts.snapshots as usize, facts.height, facts.width);
    prepared_stack(app, measurement.prepared, shape).await
}

async fn prepared_stack(app: &App, sha256: Sha256, shape: (usize, usize, usize)) -> Result<Stack> {
    let files = Files::Prepared(app.store.intact_blob(sha256).await?);
    let identity = sha256.to_string();
    Ok(Stack { shape, identity, files, mosaic: None, dispersion: None, white: None })
}

/// The frames of a snapshot. Before they are assembled, the finished tiles are shown on top of the preview. The hashes of
/// these files are not checked here, but when the frames are assembled.
async fn frames_stack(app: &App, job: &Job, snapshot: u32) -> Result<Stack> {
    let spec = &job.spec;
    let SceneShape { frames, height, width, .. } = spec.frame_shape();
    let shape = (frames, height, width);
    let dispersion = || {
        let bands = spec.dispersion.clone()?;
        Some(Arc::new(Dispersed { bands, sensor: (spec.shape.height, spec.shape.width) }))
    };
    match app.store.open_result(job, Some(snapshot), STACK).await {
        Ok((file, path, _)) => {
            return Ok(Stack {
                shape,
                identity: file.sha256.to_string(),
                files: Files::Frames(path),
                mosaic: spec.shape.mosaic,
                dispersion: dispersion(),
                white: white_level(app, job.id).await?,
            });
        }
        Err(StoreError::NotFound { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    let results = app.store.tile_results(job.id, snapshot).await?;
    let preview = app.store.preview(job.id, snapshot).await?;
    if results.is_empty() && preview.is_none() {
        let detail = "neither the preview nor a tile of this snapshot is finished yet; try again later, or \
                      look at the state of the job";
        return Err(ApiError::new(Code::NotReady, detail));
    }
    let files = preview.iter().map(|(sha256, _)| sha256);
    let files = files.chain(results.iter().map(|result| &result.sha256));
    let hashes: String = files.map(ToString::to_string).collect();
    let plan = spec.tile_plan().map_err(|error| ApiError::internal(&error))?;
    let finished_tile = |result: TileResult| {
        let tile = plan.tile(result.tile as usize)?;
        let index_in_run = (snapshot - result.run) as usize;
        // The pilot may have assigned this snapshot to another run. Then this result lacks it.
        let record: TileTaskRecord = serde_json::from_value(result.record).ok()?;
        if !record.solved.contains(&index_in_run) {
            return None;
        }
        let window = tile.window();
        let (rows, columns, step) = (window.rows, window.columns, window.step);
        let first_frame = index_in_run * spec.shape.frames;
        let path = app.store.dir().blob(&result.sha256);
        Some(FinishedTile { rows, columns, step, first_frame, path })
    };
    let tiles = results.into_iter().filter_map(finished_tile).collect();
    let unfinished = Unfinished { preview: preview.map(|(_, path)| path), tiles };
    let identity = Sha256::of(hashes.as_bytes()).to_string();
    let files = Files::Tiles(Arc::new(unfinished));
    let (mosaic, dispersion) = (spec.shape.mosaic, dispersion());
    Ok(Stack { shape, identity, files, mosaic, dispersion, white: None })
}

/// The true frame of frame `k`, from 0.
///
/// Errors: 404 if the job has no true frames.
async fn true_frame(app: &App, job: &Job, snapshot: u32, k: usize) -> Result<TrueFrame> {
    let truth = job
        .spec
        .truth
        .ok_or_else(|| not_found("the job has no true frames; attach them with PATCH".into()))?;
    let (path, limits) = (intake::upload(app, truth).await?, app.limits);
    let (shape, snapshot) = (job.spec.frame_shape(), snapshot as usize);
    let open = move || truth::open(&path, None, None, limits, shape);
    let opened = tokio::task::spawn_blocking(open).await;
    let (mut opened, channels) = opened.map_err(|error| ApiError::internal(&error))??;
    let index = truth::frames_before(&opened, snapshot, shape) + k;
    let identity = format!("{truth} true {index}");
    let size = (shape.height, shape.width);
    let picture = sent_frame(identity.clone(), size, channels, move || {
        nth_frame(index + 1, || {
            opened.next_frame().map_err(|error| match error {
                IntakeError::Format { source, .. } => source,
                error => FormatError::Internal(error.to_string()),
            })
        })
    });
    let whole = picture.whole(0);
    let values = app.pictures.reduced(Arc::new(picture), whole).await?;
    Ok(TrueFrame { identity, channels, values })
}

/// A picture of the expected error of frame `k`, from 0.
async fn error_picture(app: &App, job: &Job, snapshot: u32, k: usize) -> Result<Picture> {
    let SceneShape { height, width, .. } = job.spec.frame_shape();
    // Reports the reason if the file does not exist.
    result_file(app, job, Some(snapshot), "error.npy").await?;
    let (file, path, _) = app.store.open_result(job, Some(snapshot), "error.npy").await?;
    Ok(expected_error(path, height, width, file.sha256, k))
}

#[cfg(test)]
mod tests {
    use super::parts;

    #[test]
    fn every_picture_has_one_name() {
        assert_eq!(parts("frame-12"), ("frame", Some(12)));
        assert_eq!(parts("slice-0"), ("slice", Some(0)));
        assert_eq!(parts("residual"), ("residual", None));
        let long = "frame-99999999999999999999999";
        for bad in ["frame-01", "frame-+1", "frame", "frame-", "../x", "slice--1", "", long] {
            let (name, number) = parts(bad);
            assert!(number.is_none() || name.ends_with('-'), "{bad}");
            assert!(!matches!((name, number), ("frame" | "slice", Some(_))), "{bad}");
        }
    }
}
