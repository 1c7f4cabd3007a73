//! What pictures are called, and which values that means.

use std::sync::Arc;

use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::source::{DoneTile, Files, Stack, Unfinished, errors, sent};
use crate::http::app::App;
use crate::http::error::{ApiError, Code, Result};
use crate::http::intake;
use crate::http::jobs::with_snapshot;
use crate::http::rendering::Picture;
use crate::http::results::{result_file, white_level};
use engine::job::{CalibrationId, JobId, Lab, MeasurementId, SceneShape, Sha256};
use engine::pipeline::records::TileTaskRecord;
use formats;
use store::{Calibration, Job, Measurement, StoreError, TileResult};

/// What can be seen of a job's snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
enum JobPicture {
    /// `frame-1` and so on.
    Frame(usize),
    /// `difference-2`: frame 2 without frame 1.
    Difference(usize),
    Residual,
    /// `error-1`: the expected error of frame 1.
    Error(usize),
    /// `slice-0`: all frames at row 0.
    Slice(usize),
}

/// A picture of a file that was sent: `frame-1` and so on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
struct BlobPicture(usize);

/// A picture of a measurement: `snapshot-0` and so on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
struct MeasurementPicture(usize);

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
enum CalibrationPicture {
    /// `mask-1` and so on.
    Mask(usize),
    /// `mean` of the masks.
    Mean,
    /// `gram`: sum of their squares.
    Gram,
    /// `dead`: 1 where all are dark.
    Dead,
}

/// The number after a name, in the one form that it is written in.
fn numbered(text: &str, name: &str) -> Option<usize> {
    let digits = text.strip_prefix(name)?.strip_prefix('-')?;
    digits.parse().ok().filter(|number: &usize| number.to_string() == digits)
}

impl TryFrom<String> for JobPicture {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let number = |name| numbered(&text, name);
        let found = match text.as_str() {
            "residual" => Some(Self::Residual),
            _ => (number("frame").map(Self::Frame))
                .or_else(|| number("difference").map(Self::Difference))
                .or_else(|| number("error").map(Self::Error))
                .or_else(|| number("slice").map(Self::Slice)),
        };
        let names = "pictures are frame-N, difference-N, error-N, slice-ROW and residual";
        found.ok_or_else(|| names.into())
    }
}

impl TryFrom<String> for BlobPicture {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        numbered(&text, "frame").map(Self).ok_or_else(|| "pictures are frame-N".into())
    }
}

impl TryFrom<String> for MeasurementPicture {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        numbered(&text, "snapshot").map(Self).ok_or_else(|| "pictures are snapshot-N".into())
    }
}

impl TryFrom<String> for CalibrationPicture {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        match text.as_str() {
            "mean" => Ok(Self::Mean),
            "gram" => Ok(Self::Gram),
            "dead" => Ok(Self::Dead),
            _ => numbered(&text, "mask")
                .map(Self::Mask)
                .ok_or_else(|| "pictures are mask-N, mean, gram and dead".into()),
        }
    }
}

/// The parameters of a path that name a picture.
pub(in crate::http) trait Named: DeserializeOwned + Send {
    fn find(self, app: &App, lab: &Lab) -> impl Future<Output = Result<Picture>> + Send;
}

/// A picture of a job's snapshot.
#[derive(Debug, Deserialize)]
pub(in crate::http) struct OfJob {
    job: JobId,
    snapshot: u32,
    picture: JobPicture,
}

#[derive(Debug, Deserialize)]
pub(in crate::http) struct OfBlob {
    sha256: Sha256,
    picture: BlobPicture,
}

#[derive(Debug, Deserialize)]
pub(in crate::http) struct OfMeasurement {
    measurement: MeasurementId,
    picture: MeasurementPicture,
}

#[derive(Debug, Deserialize)]
pub(in crate::http) struct OfCalibration {
    calibration: CalibrationId,
    picture: CalibrationPicture,
}

impl Named for OfJob {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let Self { job, snapshot, picture } = self;
        let job = with_snapshot(app, lab, job, snapshot).await?;
        let (frames, height) = (job.spec.shape.frames, job.spec.shape.height);
        if let JobPicture::Error(k) = picture
            && (1..=frames).contains(&k)
        {
            return errors_of(app, &job, snapshot, k - 1).await;
        }
        let stack = frames_of(app, &job, snapshot).await?;
        match picture {
            JobPicture::Frame(k) if (1..=frames).contains(&k) => Ok(stack.frame(k - 1)),
            JobPicture::Difference(k) if (2..=frames).contains(&k) => Ok(stack.difference(k - 1)),
            JobPicture::Slice(row) if row < height => Ok(stack.slice(row)),
            JobPicture::Residual => {
                let masks = app.store.calibration(lab, job.spec.calibration).await?;
                let masks = masks_of(app, &masks).await?;
                let measurement = app.store.measurement(lab, job.spec.measurement).await?;
                let measurement = snapshots_of(app, &measurement).await?;
                Ok(stack.residual(&masks, &measurement, snapshot as usize))
            }
            _ => Err(outside(format!(
                "frames are counted from 1 to {frames}, differences from 2, rows from 0 to {}",
                height.saturating_sub(1)
            ))),
        }
    }
}

impl Named for OfBlob {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let Self { sha256, picture: BlobPicture(frame) } = self;
        app.store.upload(lab, sha256).await?;
        let path = intake::upload(app, sha256).await?;
        let (limits, opened) = (app.limits, path.clone());
        let opening = move || formats::open_stack(&opened, &limits).map(|reader| *reader.info());
        let info = tokio::task::spawn_blocking(opening).await;
        let info = info.map_err(|error| ApiError::internal(&error))??;
        if !(1..=info.frames).contains(&frame) {
            return Err(outside(format!("frames are counted from 1 to {}", info.frames)));
        }
        Ok(sent(path, limits, &info, (sha256, frame)))
    }
}

impl Named for OfMeasurement {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let measurement = app.store.measurement(lab, self.measurement).await?;
        let stack = snapshots_of(app, &measurement).await?;
        let (MeasurementPicture(snapshot), count) = (self.picture, stack.shape.0);
        if snapshot < count {
            return Ok(stack.frame(snapshot));
        }
        Err(outside(format!("snapshots are counted from 0 to {}", count.saturating_sub(1))))
    }
}

impl Named for OfCalibration {
    async fn find(self, app: &App, lab: &Lab) -> Result<Picture> {
        let calibration = app.store.calibration(lab, self.calibration).await?;
        let stack = masks_of(app, &calibration).await?;
        let count = stack.shape.0;
        match self.picture {
            CalibrationPicture::Mask(k) if (1..=count).contains(&k) => Ok(stack.frame(k - 1)),
            CalibrationPicture::Mask(_) => {
                Err(outside(format!("masks are counted from 1 to {count}")))
            }
            CalibrationPicture::Mean => Ok(stack.mean()),
            CalibrationPicture::Gram => Ok(stack.gram()),
            CalibrationPicture::Dead => Ok(stack.dead()),
        }
    }
}

fn outside(detail: String) -> ApiError {
    ApiError::new(Code::NotFound, detail)
}

async fn masks_of(app: &App, calibration: &Calibration) -> Result<Stack> {
    let facts = &calibration.facts;
    prepared(app, calibration.prepared, (facts.frames, facts.height, facts.width)).await
}

async fn snapshots_of(app: &App, measurement: &Measurement) -> Result<Stack> {
    let facts = &measurement.facts;
    let shape = (facts.snapshots as usize, facts.height, facts.width);
    prepared(app, measurement.prepared, shape).await
}

async fn prepared(app: &App, sha256: Sha256, shape: (usize, usize, usize)) -> Result<Stack> {
    let files = Files::Prepared(app.store.intact_blob(sha256).await?);
    Ok(Stack { shape, identity: sha256.to_string(), files, mosaic: None, white: None })
}

/// The frames of a snapshot: those of the result, or the tiles that are done, on the preview. The bytes of
/// these are compared with the record when they are assembled.
async fn frames_of(app: &App, job: &Job, snapshot: u32) -> Result<Stack> {
    let spec = &job.spec;
    let shape = (spec.shape.frames, spec.shape.height, spec.shape.width);
    match app.store.open_result(job, Some(snapshot), "frames.npy").await {
        Ok((file, path, _)) => {
            return Ok(Stack {
                shape,
                identity: file.sha256.to_string(),
                files: Files::Frames(path),
                mosaic: spec.shape.mosaic,
                white: white_level(app, job.id).await?,
            });
        }
        Err(StoreError::NotFound { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    let done = app.store.tile_results(job.id, snapshot).await?;
    let preview = app.store.preview(job.id, snapshot).await?;
    if done.is_empty() && preview.is_none() {
        let detail = "neither the preview nor a tile of this snapshot is done yet; the job's state \
                      says how far it is";
        return Err(ApiError::new(Code::NotReady, detail));
    }
    let parts = preview.iter().map(|(sha256, _)| sha256).chain(done.iter().map(|t| &t.sha256));
    let hashes: String = parts.map(ToString::to_string).collect();
    let plan = spec.tile_plan().map_err(|error| ApiError::internal(&error))?;
    let place = |done: TileResult| {
        let tile = plan.tile(done.tile as usize)?;
        let place = (snapshot - done.run) as usize;
        // What the pilot has left to another run is not here.
        let record: TileTaskRecord = serde_json::from_value(done.record).ok()?;
        if !record.solved.contains(&place) {
            return None;
        }
        let window = tile.window();
        let (rows, columns, step) = (window.rows, window.columns, window.step);
        let first = place * spec.shape.frames;
        Some(DoneTile { rows, columns, step, first, path: app.store.dir().blob(&done.sha256) })
    };
    let tiles = done.into_iter().filter_map(place).collect();
    let unfinished = Unfinished { preview: preview.map(|(_, path)| path), tiles };
    let identity = Sha256::of(hashes.as_bytes()).to_string();
    let files = Files::Tiles(Arc::new(unfinished));
    Ok(Stack { shape, identity, files, mosaic: spec.shape.mosaic, white: None })
}

/// The expected error of frame `k`, from 0.
async fn errors_of(app: &App, job: &Job, snapshot: u32, k: usize) -> Result<Picture> {
    let SceneShape { height, width, .. } = job.spec.shape;
    result_file(app, job, Some(snapshot), "error.npy").await?;
    let (file, path, _) = app.store.open_result(job, Some(snapshot), "error.npy").await?;
    Ok(errors(path, (height, width), (file.sha256, k)))
}

#[cfg(test)]
mod tests {
    use super::{CalibrationPicture, JobPicture, MeasurementPicture};

    #[test]
    fn every_picture_has_one_name() {
        let job = |text: &str| JobPicture::try_from(text.to_owned());
        assert_eq!(job("frame-12"), Ok(JobPicture::Frame(12)));
        assert_eq!(job("difference-2"), Ok(JobPicture::Difference(2)));
        assert_eq!(job("slice-0"), Ok(JobPicture::Slice(0)));
        assert_eq!(job("residual"), Ok(JobPicture::Residual));
        assert_eq!(job("error-3"), Ok(JobPicture::Error(3)));
        for bad in ["frame-01", "frame-+1", "frame", "frame-", "../x", "residual-1", "slice--1", ""]
        {
            assert!(job(bad).is_err(), "{bad}");
        }
        let long = "frame-99999999999999999999999";
        assert!(job(long).is_err());
        assert!(MeasurementPicture::try_from("snapshot-3".to_owned()).is_ok());
        assert_eq!(
            CalibrationPicture::try_from("mask-1".to_owned()),
            Ok(CalibrationPicture::Mask(1))
        );
        assert!(CalibrationPicture::try_from("masks".to_owned()).is_err());
    }
}
