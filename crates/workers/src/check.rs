//! The check of uploads: files are opened, validated, brought onto their scale and studied, and what passes becomes a
//! prepared array. Blocks.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use ndarray::Array2;

use super::model_check;
use super::model_process::ModelCommand;
use super::transport::{Check, TaskError};
use engine::intake::{self, Behind, Exposure, IntakeError, Refusal, RefusalCode, Source, plan};
use engine::job::{
    CalibrationRequest, Captures, Label, MeasurementRequest, ModelRequest, Mosaic, Sequence,
    Sha256, Submission, TaskStage,
};
use engine::pipeline::progress::Monitor;
use formats::mat::SceneArray;
use formats::{Axes, FormatError, Limits, StackInfo, StackWriter, planar};
use store::{BlobWriter, Calibration, Checked, NewCalibration, NewMeasurement, StoreError};

/// Why a check has no good end.
enum End {
    Refused(Refusal),
    /// The machine failed, or the check was stopped.
    Failed(TaskError),
}

type Result<T, E = End> = std::result::Result<T, E>;

impl From<Refusal> for End {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl From<IntakeError> for End {
    fn from(error: IntakeError) -> Self {
        Refusal::try_from(error).map_or_else(|error| Self::Failed(error.into()), Self::Refused)
    }
}

impl From<FormatError> for End {
    fn from(error: FormatError) -> Self {
        IntakeError::from(error).into()
    }
}

impl From<StoreError> for End {
    fn from(error: StoreError) -> Self {
        let refused = |code| Self::Refused(Refusal::new(code, error.to_string()));
        match &error {
            StoreError::Quota { .. } => refused(RefusalCode::QuotaExceeded),
            StoreError::NoRoom { .. } => refused(RefusalCode::InsufficientStorage),
            StoreError::Damaged { .. } => refused(RefusalCode::UploadDamaged),
            full if full.is_disk_full() => Self::Refused(Refusal::disk_full()),
            _ => Self::Failed(TaskError::Transport(error.into())),
        }
    }
}

/// Checks the uploads of a request.
/// Errors: the machine failed, or the check was stopped; a refusal is an outcome like others.
pub(super) fn check(
    check: &Check,
    command: &ModelCommand,
    monitor: &Monitor,
) -> Result<Checked, TaskError> {
    let time = Duration::from_secs_f64(check.task.limits.seconds);
    let desk = Desk { check, monitor, deadline: Instant::now() + time };
    let calibration = check.task.calibration.as_ref();
    let checked = match (&check.task.request.submission, calibration) {
        (Submission::Calibration(request), _) => match &request.captures {
            Some(captures) => desk.captures(captures, request),
            None => desk.masks(request),
        },
        (Submission::Measurement(request), Some(masks)) => desk.measurement(request, masks),
        (Submission::Model(request), Some(masks)) => desk.model(request, masks, command),
        (Submission::Measurement(_) | Submission::Model(_), None) => {
            let detail = "the calibration is not there any more";
            Err(Refusal::new(RefusalCode::InvalidRequest, detail).at("/calibration").into())
        }
    };
    match checked {
        Err(_) if monitor.stopped() => Err(IntakeError::Stopped.into()),
        Err(End::Failed(error)) => Err(error),
        Err(End::Refused(refusal)) => {
            tracing::info!(?refusal, "refused");
            Ok(Checked::Refused(refusal))
        }
        Ok(checked) => {
            monitor.reach(TaskStage::Writing, 1.0);
            Ok(checked)
        }
    }
}

/// What checks of all kinds need.
struct Desk<'a> {
    check: &'a Check,
    monitor: &'a Monitor,
    deadline: Instant,
}

impl Desk<'_> {
    fn limits(&self) -> Limits {
        Limits { max_file_bytes: self.check.task.limits.max_file_bytes, ..Limits::default() }
    }

    /// Where an upload lies, if its bytes are those that were sent.
    fn upload(&self, sha256: Sha256, pointer: &str) -> Result<PathBuf> {
        let found = self.check.runtime.block_on(self.check.store.intact_blob(sha256));
        found.map_err(|error| match End::from(error) {
            End::Refused(refusal) => refusal.at(pointer).into(),
            failed => failed,
        })
    }

    /// The path of an upload, opened as a stack.
    fn open(
        &self,
        file: &std::path::Path,
        array: SceneArray,
        (named, axes, full_scale): (Option<&Label>, Option<Axes>, Option<f32>),
        size: Option<(usize, usize)>,
    ) -> Result<intake::Opened> {
        let source = Source::upload(file, array, full_scale, self.limits());
        let source = source.named(named.map(ToString::to_string)).arranged(axes, size);
        Ok(source.open()?)
    }

    /// Notes which share is read, on \[0,1\], and ends a check that was stopped or takes too long.
    fn go_on(&self, share: f64) -> Result<(), FormatError> {
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

    /// Reserves disk space for `bytes` bytes, with room for `copies` of them for a while.
    fn promise(&self, bytes: u64, copies: u64) -> Result<()> {
        let Check { store, lease, runtime, task } = self.check;
        let room = (copies, task.limits.min_free_bytes);
        Ok(runtime.block_on(store.promise(lease, bytes, room))?)
    }

    /// The writer of a prepared array, if the disk has room for it and the lab and its token may keep it.
    fn writer(&self, info: &StackInfo) -> Result<StackWriter<BlobWriter>> {
        self.promise(planar::bytes(info), 1)?;
        let writer = self.check.store.blob_writer()?;
        Ok(planar::writer(writer, info.frames, info.height, info.width)?)
    }

    /// Looks at the headers of captures.
    fn captures(&self, captures: &Captures, request: &CalibrationRequest) -> Result<Checked> {
        for (place, upload) in captures.uploads() {
            self.upload(upload, &place)?;
            self.go_on(0.0)?;
        }
        let dir = self.check.store.dir();
        let plan = plan(&captures.map(|upload| dir.blob(upload)), &self.limits())?;
        check_mosaic(request.mosaic, plan.size)?;
        self.bad_pixels(request, plan.size)?;
        // Two copies: as measured, and scaled.
        self.promise(plan.bytes, 2)?;
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
        let CalibrationRequest { name, array, axes, full_scale, mosaic, .. } = request.clone();
        let wrong = || Refusal::new(RefusalCode::InvalidRequest, "name the masks").at("/masks");
        let masks = request.masks.ok_or_else(wrong)?;
        let file = self.upload(masks, "/masks")?;
        let opened =
            self.open(&file, SceneArray::Masks, (array.as_ref(), axes, full_scale), None)?;
        let (info, full_scale) = (opened.info, opened.full_scale.value());
        let mut writer = self.writer(&info)?;
        let mut done = 0.0;
        let bad = self.bad_pixels(request, (info.height, info.width))?;
        let found = intake::masks(opened, bad.as_ref(), |mask| {
            done += 1.0;
            self.go_on(done / info.frames as f64)?;
            writer.write_frame(mask)
        })?;
        check_mosaic(mosaic, (info.height, info.width))?;
        let facts = NewCalibration {
            name,
            masks,
            format: info.format.to_string(),
            sample: info.sample.to_string(),
            axes: info.axes.map(|axes| axes.to_string()),
            frames: info.frames,
            height: info.height,
            width: info.width,
            full_scale,
            mask_mean: found.mean,
            dead_pixels: found.dead_pixels,
            clipped_negatives: found.clipped_negative,
            mosaic,
        };
        Ok(Checked::Masks(facts, writer.finish()?.finish()?))
    }

    /// Writes a measurement with its dark subtracted and its full scale divided out, and checks it against the
    /// masks of its calibration.
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
        let how = (request.array.as_ref(), request.axes, request.full_scale);
        let size = Some((masks.height, masks.width));
        let opened = self.open(&file, SceneArray::Measurements, how, size)?;
        let (info, full_scale) = (opened.info, opened.full_scale.value());
        if (info.height, info.width) != (masks.height, masks.width) {
            let detail = format!(
                "the measurement is {}x{} (rows x columns), but the masks of calibration {} are {}x{}",
                info.height, info.width, calibration.id, masks.height, masks.width
            );
            return Err(Refusal::new(RefusalCode::SizeMismatch, detail).at("/data").into());
        }
        let mut writer = self.writer(&info)?;
        let exposure = Exposure { dark, saturation: request.saturation };
        let prepared = self.check.store.dir().blob(&calibration.prepared);
        let behind = Behind::stored(&prepared, masks.mosaic, &limits)?;
        let mut done = 0.0;
        let passed = intake::measurement(opened, &exposure, &behind, &limits, |y| {
            done += 1.0;
            self.go_on(done / info.frames as f64)?;
            writer.write_frame(y)
        })?;
        let staged = writer.finish()?.finish()?;
        let both = (prepared.as_path(), staged.path());
        let darkened = !exposure.dark.is_empty();
        let judged = intake::judge(both, masks.mosaic, darkened, &limits)?;
        let warnings = intake::combined(passed.findings, judged);
        let by_times = Sequence::from_camera(request.camera_fps, request.exposure_s, masks.frames);
        let facts = NewMeasurement {
            name: request.name,
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
            sequence: request.sequence.unwrap_or(by_times),
            dark: request.dark,
            warnings,
        };
        Ok(Checked::Measurement(facts, staged))
    }

    /// Tries a network in a separate process.
    fn model(
        &self,
        request: &ModelRequest,
        masks: &Calibration,
        command: &ModelCommand,
    ) -> Result<Checked> {
        let file = self.upload(request.file, "/file")?;
        let facts = model_check::run(command, &file, &masks.facts, self.deadline, self.monitor);
        Ok(Checked::Model(facts.map_err(End::Failed)??))
    }
}

/// Refuses the mosaic of a sensor with an odd number of rows or columns.
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
