//! Uploads on their way to a calibration or measurement: what passes the checks of [`engine::intake`] is
//! written as a prepared array. Blocks; of each lab one at a time runs, where blocking is allowed, and no longer
//! than `--check-seconds`.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Instant;

use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use super::access::Owner;
use super::admission::Reservation;
use super::app::App;
use super::error::{ApiError, Code, Result, too_slow};
use engine::intake::{self, Exposure, Source};
use engine::job::{Finding, Label, Sha256};
use formats::mat::SceneArray;
use formats::validate::MaskStatistics;
use formats::{Axes, FormatError, Limits, StackInfo, StackWriter, planar};
use store::{BlobWriter, Calibration, StagedBlob, Store, StoreError};

/// What an upload turned out to be.
pub(super) struct Prepared<T> {
    pub(super) info: StackInfo,
    pub(super) full_scale: f32,
    pub(super) found: T,
    pub(super) file: StagedBlob,
    /// Room on the disk, held until the file is on record.
    pub(super) room: Reservation,
}

/// What is said of an upload.
pub(super) struct Upload {
    /// What the array is called in a file of several.
    pub(super) array: Option<Label>,
    pub(super) axes: Option<Axes>,
    pub(super) full_scale: Option<f32>,
}

/// For whom a check is made, where it may block.
pub(super) struct Desk {
    app: App,
    owner: Owner,
    runtime: Handle,
    /// When nobody wants the check any more, or the service ends.
    stop: CancellationToken,
    /// When the check is to give up.
    deadline: Instant,
}

/// Runs a check where it may block, when it is the lab's turn, until `stop`.
/// Errors: 503 if it takes too long or is stopped; it ends with its next frame then, and so does the lab's turn.
pub(super) async fn run<T, F>(
    app: &App,
    owner: &Owner,
    stop: &CancellationToken,
    check: F,
) -> Result<T>
where
    T: Send + 'static,
    F: FnOnce(&Desk) -> Result<T> + Send + 'static,
{
    let turn = stop.run_until_cancelled(app.intake.take(&owner.lab)).await;
    let turn = turn.unwrap_or_else(|| Err(StoreError::Interrupted.into()))?;
    let (time, runtime) = (app.settings.check_time(), Handle::current());
    let (app, owner, deadline) = (app.clone(), owner.clone(), Instant::now() + time);
    let desk = Desk { app, owner, runtime, stop: stop.clone(), deadline };
    let checked = tokio::task::spawn_blocking(move || {
        // Held until the check ends, also if the user does not wait for it.
        let _turn = turn;
        check(&desk)
    });
    let checked = tokio::time::timeout(time, checked).await.map_err(|_| too_slow())?;
    checked.map_err(|error| ApiError::internal(&error))?
}

impl Desk {
    pub(super) fn store(&self) -> &Store {
        &self.app.store
    }

    pub(super) fn limits(&self) -> &Limits {
        &self.app.limits
    }

    /// Ends a check that has taken too long. Who waited for it has been told.
    fn go_on(&self) -> Result<(), FormatError> {
        if self.stop.is_cancelled() {
            return Err(FormatError::io("check the file to its end")(
                ErrorKind::Interrupted.into(),
            ));
        }
        if Instant::now() < self.deadline {
            return Ok(());
        }
        Err(FormatError::io("check the file in time")(ErrorKind::TimedOut.into()))
    }

    /// A prepared array to be written, if the disk has room for it, and the lab and its token may keep it.
    fn writer(&self, info: &StackInfo) -> Result<(StackWriter<BlobWriter>, Reservation)> {
        let bytes = planar::bytes(info);
        let Owner { lab, token } = &self.owner;
        let room = self.runtime.block_on(async {
            self.app.store.check_quota(lab, *token, bytes).await?;
            self.app.admission.reserve(bytes).await
        })?;
        let writer = self.app.store.blob_writer()?;
        Ok((planar::writer(writer, info.frames, info.height, info.width)?, room))
    }
}

/// Where an upload lies, whose bytes are those that were sent.
/// Errors: 410 if they are not any more.
pub(super) async fn upload(app: &App, sha256: Sha256) -> Result<PathBuf> {
    app.store.intact_blob(sha256).await.map_err(|error| match error {
        StoreError::Damaged { .. } => ApiError::new(Code::UploadDamaged, error.to_string()),
        error => error.into(),
    })
}

/// Checks masks and writes them on [0, 1].
pub(super) fn masks(desk: &Desk, file: &Path, of: Upload) -> Result<Prepared<MaskStatistics>> {
    let source = Source::upload(file, SceneArray::Masks, of.full_scale, *desk.limits());
    let source = source.named(of.array.map(|name| name.to_string())).arranged(of.axes, None);
    let opened = source.open()?;
    let (info, full_scale) = (opened.info, opened.full_scale.value());
    let (mut writer, room) = desk.writer(&info)?;
    let found = intake::masks(opened, |mask| {
        desk.go_on()?;
        writer.write_frame(mask)
    })?;
    Ok(Prepared { info, full_scale, found, file: writer.finish()?.finish()?, room })
}

/// Writes a measurement with its dark subtracted and its full scale divided out, and checks it
/// against the masks of its calibration.
pub(super) fn measurement(
    desk: &Desk,
    file: &Path,
    of: Upload,
    exposure: &Exposure,
    calibration: &Calibration,
) -> Result<Prepared<Vec<Finding>>> {
    let masks = &calibration.facts;
    let source = Source::upload(file, SceneArray::Measurements, of.full_scale, *desk.limits());
    let source = source.named(of.array.map(|name| name.to_string()));
    let opened = source.arranged(of.axes, Some((masks.height, masks.width))).open()?;
    let (info, full_scale) = (opened.info, opened.full_scale.value());
    if (info.height, info.width) != (masks.height, masks.width) {
        let detail = format!(
            "the measurement is {}x{} (rows x columns), but the masks of calibration {} are {}x{}",
            info.height, info.width, calibration.id, masks.height, masks.width
        );
        return Err(ApiError::new(Code::SizeMismatch, detail).at("/data"));
    }
    let (mut writer, room) = desk.writer(&info)?;
    let limits = desk.limits();
    let passed = intake::measurement(opened, exposure, limits, |y| {
        desk.go_on()?;
        writer.write_frame(y)
    })?;
    let file = writer.finish()?.finish()?;
    let masks = desk.app.store.dir().blob(&calibration.prepared);
    let darkened = !exposure.dark.is_empty();
    let both = (masks.as_path(), file.path());
    let mosaic = calibration.facts.mosaic;
    let mut found = passed.findings;
    found.extend(intake::judge(both, mosaic, passed.saturated.as_deref(), darkened, limits)?);
    Ok(Prepared { info, full_scale, found, file, room })
}
