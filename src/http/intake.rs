//! Uploads on their way to a calibration or measurement: what passes the checks of [`crate::intake`] is
//! written as a prepared array. Blocks; one at a time runs, where blocking is allowed.

use super::app::App;
use super::error::{ApiError, Code, Result};
use crate::formats::mat::SceneArray;
use crate::formats::validate::MaskStatistics;
use crate::formats::{Limits, StackInfo, StackWriter, planar};
use crate::intake::{self, Exposure, Source};
use crate::job::{Finding, Sha256};
use crate::store::{BlobWriter, Calibration, StagedBlob, Store};

/// What an upload turned out to be.
pub(super) struct Prepared<T> {
    pub(super) info: StackInfo,
    pub(super) full_scale: f32,
    pub(super) found: T,
    pub(super) file: StagedBlob,
}

/// Runs a check where it may block, after those that came before it.
pub(super) async fn run<T, F>(app: &App, check: F) -> Result<T>
where
    T: Send + 'static,
    F: FnOnce(&Store, &Limits) -> Result<T> + Send + 'static,
{
    let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
    let permit = app.intake.clone().acquire_owned().await.map_err(stopped)?;
    let (store, limits) = (app.store.clone(), app.limits);
    let checked = tokio::task::spawn_blocking(move || {
        // Held until the check ends, also if the user does not wait for it.
        let _permit = permit;
        check(&store, &limits)
    });
    checked.await.map_err(|error| ApiError::internal(&error))?
}

/// Checks masks and writes them on [0, 1].
pub(super) fn masks(
    store: &Store,
    limits: &Limits,
    upload: &Sha256,
    full_scale: Option<f32>,
) -> Result<Prepared<MaskStatistics>> {
    let path = store.dir().blob(upload);
    let opened = Source::upload(&path, SceneArray::Masks, full_scale, *limits).open()?;
    let (info, full_scale) = (opened.info, opened.full_scale.value());
    let mut writer = writer(store, &info)?;
    let found = intake::masks(opened, |mask| writer.write_frame(mask))?;
    Ok(Prepared { info, full_scale, found, file: writer.finish()?.finish()? })
}

/// Writes a measurement with its dark subtracted and its full scale divided out, and checks it
/// against the masks of its calibration.
pub(super) fn measurement(
    store: &Store,
    limits: &Limits,
    upload: &Sha256,
    full_scale: Option<f32>,
    exposure: &Exposure,
    calibration: &Calibration,
) -> Result<Prepared<Vec<Finding>>> {
    let path = store.dir().blob(upload);
    let opened = Source::upload(&path, SceneArray::Measurements, full_scale, *limits).open()?;
    let (info, full_scale) = (opened.info, opened.full_scale.value());
    let masks = &calibration.facts;
    if (info.height, info.width) != (masks.height, masks.width) {
        let detail = format!(
            "the measurement is {}x{} (rows x columns), but the masks of calibration {} are {}x{}",
            info.height, info.width, calibration.id, masks.height, masks.width
        );
        return Err(ApiError::new(Code::SizeMismatch, detail).at("/data"));
    }
    let mut writer = writer(store, &info)?;
    let saturated = intake::measurement(opened, exposure, limits, |y| writer.write_frame(y))?;
    let file = writer.finish()?.finish()?;
    let masks = store.dir().blob(&calibration.prepared);
    let darkened = !exposure.dark.is_empty();
    let both = (masks.as_path(), file.path());
    let found = intake::judge(both, saturated.as_deref(), darkened, limits)?;
    Ok(Prepared { info, full_scale, found, file })
}

fn writer(store: &Store, info: &StackInfo) -> Result<StackWriter<BlobWriter>> {
    Ok(planar::writer(store.blob_writer()?, info.frames, info.height, info.width)?)
}
