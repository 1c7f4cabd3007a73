//! Checks uploads: opens the files, validates and scales them, and writes those that pass as prepared arrays. All
//! functions block.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ndarray::Array2;

use super::model_check;
use super::model_process::ModelCommand;
use super::transport::{Check, TaskError};
use engine::intake::{
    self, Exposure, IntakeError, MaskLight, Refusal, RefusalCode, Source, expected_size, plan,
    size_remedy,
};
use engine::job::{
    CalibrationRequest, Captures, CorrectedMasks, MeasurementRequest, ModelRequest, Mosaic,
    Registered, Sequence, Sha256, Submission, TaskStage, keeps_mosaic,
};
use engine::pipeline::progress::Monitor;
use engine::pipeline::registration;
use formats::mat::SceneArray;
use formats::{Channels, FormatError, Limits, Selection, StackInfo, StackWriter, npy, planar};
use store::{
    BlobWriter, Calibration, Checked, NewCalibration, NewMeasurement, NewModel, StoreError,
};

/// Why a check did not pass.
enum CheckError {
    Refused(Refusal),
    /// The machine failed, or the check was stopped.
    Failed(TaskError),
}

type Result<T, E = CheckError> = std::result::Result<T, E>;

impl From<Refusal> for CheckError {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl From<IntakeError> for CheckError {
    fn from(error: IntakeError) -> Self {
        Refusal::try_from(error).map_or_else(|error| Self::Failed(error.into()), Self::Refused)
    }
}

impl From<FormatError> for CheckError {
    fn from(error: FormatError) -> Self {
        IntakeError::from(error).into()
    }
}

impl From<StoreError> for CheckError {
    fn from(error: StoreError) -> Self {
        let refused = |code| Self::Refused(Refusal::new(code, error.to_string()));
        match &error {
            StoreError::Quota { .. } => refused(RefusalCode::QuotaExceeded),
            StoreError::NoRoom { .. } | StoreError::NoShare { .. } => {
                refused(RefusalCode::InsufficientStorage)
            }
            StoreError::Damaged { .. } => refused(RefusalCode::UploadDamaged),
            _ => match error.disk_trouble() {
                Some(trouble) => Self::Refused(Refusal::disk_trouble(trouble)),
                None => Self::Failed(TaskError::Transport(error.into())),
            },
        }
    }
}

/// Checks the uploads of a request.
/// Errors: the machine failed, or the check was stopped. A refusal is returned as [`Checked::Refused`].
pub(super) fn check(
    check: &Check,
    command: &ModelCommand,
    monitor: &Monitor,
) -> Result<Checked, TaskError> {
    let time = Duration::from_secs_f64(check.task.limits.seconds);
    let running = Running { check, monitor, deadline: Instant::now() + time };
    let calibration = check.task.calibration.as_ref();
    let checked = match (&check.task.request.submission, calibration) {
        (Submission::Calibration(request), _) => match (&request.captures, request.registration_of)
        {
            (Some(captures), _) => running.captures(captures, request),
            (None, Some(_)) => running.corrected(),
            (None, None) => running.masks(request),
        },
        (Submission::Measurement(request), Some(masks)) => running.measurement(request, masks),
        (Submission::Model(request), Some(masks)) => running.model(request, masks, command),
        (Submission::Measurement(_) | Submission::Model(_), None) => {
            let detail = "the calibration has been deleted";
            Err(Refusal::new(RefusalCode::InvalidRequest, detail).at("/calibration").into())
        }
    };
    match checked {
        Err(_) if monitor.stopped() => Err(IntakeError::Stopped.into()),
        Err(CheckError::Failed(error)) => Err(error),
        Err(CheckError::Refused(refusal)) => {
            tracing::info!(?refusal, "refused");
            Ok(Checked::Refused(refusal))
        }
        Ok(checked) => {
            monitor.reach(TaskStage::Writing, 1.0);
            Ok(checked)
        }
    }
}

/// A check in progress, with the context that all kinds of checks need.
struct Running<'a> {
    check: &'a Check,
    monitor: &'a Monitor,
    deadline: Instant,
}

impl Running<'_> {
    fn limits(&self) -> Limits {
        Limits { max_file_bytes: self.check.task.limits.max_file_bytes, ..Limits::default() }
    }

    /// The path of an upload, after its bytes were compared with its hash.
    fn upload(&self, sha256: Sha256, pointer: &str) -> Result<PathBuf> {
        let path = self.check.runtime.block_on(self.check.store.intact_blob(sha256));
        path.map_err(|error| match CheckError::from(error) {
            CheckError::Refused(refusal) => refusal.at(pointer).into(),
            failed => failed,
        })
    }

    /// Records the share that was read, on \[0,1\]. Fails if the check was stopped or has passed its deadline.
    fn proceed(&self, share: f64) -> Result<(), FormatError> {
        self.monitor.reach(TaskStage::Reading, share);
        let stop = |action, kind: ErrorKind| Err(FormatError::io(action)(kind.into()));
        if self.monitor.stopped() {
            return stop("check the file to its end", ErrorKind::Interrupted);
        }
        if Instant::now() >= self.deadline {
            return stop("check the file in time", ErrorKind::TimedOut);
        }
        Ok(())
    }

    /// Reserves disk space for `bytes` bytes. While it works, the task needs room for `copies` of them.
    fn reserve(&self, bytes: u64, copies: u64) -> Result<()> {
        let Check { store, lease, runtime, task } = self.check;
        let room = (copies, task.limits.min_free_bytes);
        Ok(runtime.block_on(store.promise(lease, bytes, room))?)
    }

    /// Creates a prepared array, if the disk and the quotas of the lab and its token have room for it.
    fn writer(&self, info: &StackInfo) -> Result<StackWriter<BlobWriter>> {
        self.reserve(planar::bytes(info), 1)?;
        let writer = self.check.store.blob_writer()?;
        Ok(planar::writer(writer, info.frames, info.height, info.width)?)
    }

    /// Checks the headers of captures.
    fn captures(&self, captures: &Captures, request: &CalibrationRequest) -> Result<Checked> {
        for (pointer, upload) in captures.uploads() {
            self.upload(upload, &pointer)?;
            self.proceed(0.0)?;
        }
        let dir = self.check.store.dir();
        let plan = plan(&captures.map(|upload| dir.blob(upload)), &self.limits())?;
        check_mosaic(request.mosaic, plan.size)?;
        self.bad_pixels(request, plan.size)?;
        // Two copies: as measured, and scaled.
        self.reserve(plan.bytes, 2)?;
        Ok(Checked::Captures(plan.seconds))
    }

    /// The map of bad pixels of a calibration with masks of this size.
    fn bad_pixels(
        &self,
        request: &CalibrationRequest,
        size: (usize, usize),
    ) -> Result<Option<Array2<bool>>> {
        let Some(map) = request.bad_pixels else { return Ok(None) };
        let map = self.upload(map, "/bad_pixels")?;
        Ok(Some(intake::bad_pixels(&map, size, &self.limits())?))
    }

    /// Checks masks and writes them on \[0,1\].
    fn masks(&self, request: &CalibrationRequest) -> Result<Checked> {
        let CalibrationRequest { array, axes, crop, frames, packing, mosaic, dispersion, .. } =
            request.clone();
        let wrong = || Refusal::new(RefusalCode::InvalidRequest, "name the masks").at("/masks");
        let masks = request.masks.ok_or_else(wrong)?;
        let file = self.upload(masks, "/masks")?;
        let source = Source::upload(&file, SceneArray::Masks, request.full_scale, self.limits())
            .named(array.map(|name| name.to_string()))
            .arranged(axes, None)
            .part(Selection { crop, frames }, packing)
            .dispersed(dispersion.clone());
        let opened = source.open()?;
        let (info, full_scale, reading) = (opened.info, opened.full_scale.value(), opened.reading);
        let mut writer = self.writer(&info)?;
        let mut done = 0.0;
        let bad = self.bad_pixels(request, (info.height, info.width))?;
        let statistics = intake::masks(opened, bad.as_ref(), |mask| {
            done += 1.0;
            self.proceed(done / info.frames as f64)?;
            writer.write_frame(mask)
        })?;
        check_mosaic(mosaic, (info.height, info.width))?;
        let facts = NewCalibration {
            masks,
            format: info.format.to_string(),
            sample: info.sample.to_string(),
            axes: info.axes.map(|axes| axes.to_string()),
            frames: info.frames,
            height: info.height,
            width: info.width,
            full_scale,
            mask_mean: statistics.mean,
            dead_pixels: statistics.dead_pixels,
            clipped_negatives: statistics.clipped_negative,
            mosaic,
            reading: Some(reading),
            dispersion,
            corrected: None,
        };
        Ok(Checked::Masks(Box::new(facts), writer.finish()?.finish()?))
    }

    /// Writes masks as the registration of a job has corrected them.
    fn corrected(&self) -> Result<Checked> {
        let task = &self.check.task;
        let correction = task.registered.as_ref().and_then(Registered::correction);
        let job = task.request.submission.registration_of();
        let (Some(calibration), Some(correction), Some(job)) = (&task.calibration, correction, job)
        else {
            let detail = "the job has been deleted";
            let refusal = Refusal::new(RefusalCode::InvalidRequest, detail);
            return Err(refusal.at("/registration_of").into());
        };
        let stored = self.upload(calibration.prepared, "/registration_of")?;
        let stored = planar::Reader::open(&stored, &Limits::default())?;
        let info = *stored.info();
        // Two copies: in bands, and whole.
        self.reserve(planar::bytes(&info), 2)?;
        let scratch = self.check.store.staged_path()?;
        let writer = self.check.store.blob_writer()?;
        let mut writer = planar::writer(writer, info.frames, info.height, info.width)?;
        let statistics =
            registration::correct(&stored, correction, scratch.path(), |share, mask| {
                self.proceed(share)?;
                mask.map_or(Ok(()), |mask| writer.write_frame(mask))
            })?;
        let masks = writer.finish()?.finish()?;
        let facts = NewCalibration {
            masks: npy_sha256(masks.path(), &info)?,
            format: "registration".into(),
            sample: info.sample.to_string(),
            axes: None,
            frames: info.frames,
            height: info.height,
            width: info.width,
            full_scale: 1.0,
            mask_mean: statistics.mean,
            dead_pixels: statistics.dead_pixels,
            clipped_negatives: 0,
            mosaic: None,
            reading: None,
            dispersion: None,
            corrected: Some(CorrectedMasks {
                job,
                correction,
                masks_full_scale: calibration.facts.full_scale,
                masks: calibration.inputs(),
            }),
        };
        Ok(Checked::Masks(Box::new(facts), masks))
    }

    /// Subtracts the dark from a measurement, divides by its full scale, and checks it against the masks of its
    /// calibration.
    fn measurement(
        &self,
        request: &MeasurementRequest,
        calibration: &Calibration,
    ) -> Result<Checked> {
        let request = request.clone();
        let file = self.upload(request.data, "/data")?;
        let mut dark = Vec::with_capacity(request.dark.len());
        for (index, upload) in request.dark.iter().enumerate() {
            dark.push(self.upload(*upload, &format!("/dark/{index}"))?);
        }
        let (masks, limits) = (&calibration.facts, self.limits());
        if masks.mosaic.is_some() && !keeps_mosaic(request.crop) {
            let detail = "the window of a mosaic starts at an even row and an even column";
            return Err(Refusal::new(RefusalCode::InvalidRequest, detail).at("/crop").into());
        }
        if masks.dispersion.is_some() && request.sequence == Some(Sequence::Contiguous) {
            let detail = "the bands of two spectral snapshots do not continue one another: leave the sequence out";
            return Err(Refusal::new(RefusalCode::InvalidRequest, detail).at("/sequence").into());
        }
        let source = Source::upload(&file, SceneArray::Measurements, request.full_scale, limits)
            .named(request.array.map(|name| name.to_string()))
            .arranged(request.axes, Some((masks.height, masks.width)))
            .part(Selection { crop: request.crop, frames: None }, request.packing);
        let opened = source.open()?;
        let (info, full_scale, reading) = (opened.info, opened.full_scale.value(), opened.reading);
        if (info.height, info.width) != (masks.height, masks.width) {
            let remedy = match &masks.dispersion {
                Some(dispersion) => expected_size(dispersion, (masks.height, masks.width)),
                None => size_remedy(
                    (masks.height, masks.width),
                    (info.height, info.width),
                    "state the window that both have in common as `crop`, with the calibration if the masks are larger",
                ),
            };
            let detail = format!(
                "the measurement is {}x{} (rows x columns), but the masks of calibration {} are {}x{}: {remedy}",
                info.height, info.width, calibration.id, masks.height, masks.width
            );
            return Err(Refusal::new(RefusalCode::SizeMismatch, detail).at("/data").into());
        }
        let mut writer = self.writer(&info)?;
        let exposure = Exposure { dark, saturation: request.saturation };
        let prepared = self.check.store.dir().blob(&calibration.prepared);
        let behind = MaskLight::stored(&prepared, masks.mosaic, &limits)?;
        let mut done = 0.0;
        let findings = intake::measurement(opened, &exposure, &behind, &limits, |y| {
            done += 1.0;
            self.proceed(done / info.frames as f64)?;
            writer.write_frame(y)
        })?;
        let staged = writer.finish()?.finish()?;
        let prepared = self.check.store.dir().blob(&calibration.prepared);
        let (mosaic, dispersion) = (masks.mosaic, masks.dispersion.as_ref());
        let has_dark = !exposure.dark.is_empty();
        let judged =
            intake::judge(&prepared, staged.path(), mosaic, dispersion, has_dark, &limits)?;
        let warnings = intake::combined(findings, judged);
        let estimated = match masks.dispersion {
            // The last band of a snapshot and the first of the next one do not resemble one another.
            Some(_) => Sequence::Separate,
            None => Sequence::from_camera(request.camera_fps, request.exposure_s, masks.frames),
        };
        let facts = NewMeasurement {
            calibration: request.calibration,
            data: request.data,
            format: info.format.to_string(),
            sample: info.sample.to_string(),
            axes: info.axes.map(|axes| axes.to_string()),
            // The limits on uploads keep the count far below this.
            snapshots: u32::try_from(info.frames).unwrap_or(u32::MAX),
            height: info.height,
            width: info.width,
            full_scale,
            camera_fps: request.camera_fps,
            exposure_s: request.exposure_s,
            sequence: request.sequence.unwrap_or(estimated),
            dark: request.dark,
            warnings,
            reading,
        };
        Ok(Checked::Measurement(Box::new(facts), staged))
    }

    /// Runs a network once, in a separate process.
    fn model(
        &self,
        request: &ModelRequest,
        masks: &Calibration,
        command: &ModelCommand,
    ) -> Result<Checked> {
        let file = self.upload(request.file, "/file")?;
        let facts = model_check::run(command, &file, &masks.facts, self.deadline, self.monitor);
        let facts = facts.map_err(CheckError::Failed)??;
        let ModelRequest { calibration, file, .. } = *request;
        Ok(Checked::Model(NewModel { calibration, file, facts }))
    }
}

/// Hash of the npy file that the service sends for a prepared array.
pub(super) fn npy_sha256(prepared: &Path, info: &StackInfo) -> Result<Sha256, FormatError> {
    let hash = || {
        let mut values = File::open(prepared)?;
        values.seek(SeekFrom::Start(planar::HEADER_BYTES))?;
        let head = npy::stack_header((info.frames, info.height, info.width), Channels::Grey);
        Sha256::of_reader(&mut head.as_slice().chain(values))
    };
    Ok(hash().map_err(FormatError::io("hash the masks"))?.0)
}

/// Refuses a mosaic on pictures with an odd number of rows or columns.
fn check_mosaic(mosaic: Option<Mosaic>, (height, width): (usize, usize)) -> Result<()> {
    if mosaic.is_none() || (height.is_multiple_of(2) && width.is_multiple_of(2)) {
        return Ok(());
    }
    let detail = format!(
        "the pictures are {height}x{width} (rows x columns); a mosaic has an even number of both: crop them so \
         that they begin with the first pixel of a cell"
    );
    Err(Refusal::new(RefusalCode::InvalidRequest, detail).at("/mosaic").into())
}
