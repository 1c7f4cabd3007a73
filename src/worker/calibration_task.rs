//! Calibrations as the worker does them: masks from captures, and reports.

use std::io::BufWriter;
use std::sync::Arc;
use std::time::Duration;

use tracing::Instrument;

use super::run::{HEARTBEAT, LEASE, Worker, WorkerError, said};
use super::task::Shared;
use crate::formats::planar::{Reader, Writer};
use crate::formats::{FormatError, Limits};
use crate::job::{CalibrationReport, Captures, Label, TaskProgress, without_paths};
use crate::store::{
    CalibrationDone, CalibrationLease, CalibrationWork, ClaimedCalibration, Heartbeat,
    NewCalibration, StagedBlob, Store, StoreError,
};
use crate::work::calibrate::{
    self, CalibrateError, CaptureFiles, MadeMasks, Report, average_masks, read_patterns,
    scale_masks,
};

/// How long the thread may take to come to the end of a frame when the worker is to end.
const GRACE: Duration = Duration::from_secs(5);

impl Worker {
    /// Works on the next calibration; says whether there was one.
    pub(super) async fn calibrate(&self) -> Result<bool, WorkerError> {
        let claimed = match self.store().claim_calibration(self.id(), LEASE).await {
            Ok(Some(claimed)) => claimed,
            Ok(None) => return Ok(false),
            Err(error) => {
                tracing::error!(%error, "no calibration can be claimed");
                return Ok(false);
            }
        };
        let lease = claimed.lease;
        let span = tracing::info_span!("calibration", calibration = %lease.calibration);
        let shared = Arc::new(Shared::new());
        let (store, heard, inner) = (self.store().clone(), shared.clone(), span.clone());
        let computing = tokio::task::spawn_blocking(move || {
            let _entered = inner.enter();
            perform(&store, &claimed, &heard)
        });
        self.attend(computing, &lease, &shared).instrument(span).await?;
        Ok(true)
    }

    /// Waits for the computing thread, with heartbeats, and tells the store how it ended.
    async fn attend(
        &self,
        mut computing: tokio::task::JoinHandle<Result<CalibrationDone, CalibrateError>>,
        lease: &CalibrationLease,
        shared: &Shared,
    ) -> Result<(), WorkerError> {
        let mut tick = tokio::time::interval(HEARTBEAT);
        let too_late = async {
            self.stopped().await;
            tokio::time::sleep(GRACE).await;
        };
        tokio::pin!(too_late);
        let outcome = loop {
            tokio::select! {
                computed = &mut computing => break computed.map_err(|_| WorkerError::Panicked)?,
                () = &mut too_late => {
                    said(self.store().release_calibration(lease).await);
                    return Err(WorkerError::Unfinished);
                }
                () = self.stopped(), if !shared.stopped() => shared.stop(),
                _ = tick.tick() => {
                    let fraction = shared.progress().fraction;
                    match self.store().calibration_heartbeat(lease, self.id(), fraction).await {
                        Ok(Heartbeat::Continue) => {}
                        // It was deleted, or is another worker's now.
                        Ok(_) => shared.stop(),
                        Err(error) => tracing::error!(%error, "a heartbeat is not recorded"),
                    }
                }
            }
        };
        match outcome {
            Ok(done) => self.calibrated(lease, done).await,
            Err(CalibrateError::Stopped) => said(self.store().release_calibration(lease).await),
            Err(error) => self.not_calibrated(lease, &error).await,
        }
        Ok(())
    }

    async fn calibrated(&self, lease: &CalibrationLease, done: CalibrationDone) {
        match self.store().calibration_done(lease, done).await {
            Ok(Heartbeat::Lost) => tracing::warn!("done, but nobody wants it any more"),
            Ok(_) => tracing::info!("done"),
            Err(error) => self.not_calibrated(lease, &error.into()).await,
        }
    }

    async fn not_calibrated(&self, lease: &CalibrationLease, error: &CalibrateError) {
        tracing::error!(%error, "the calibration failed");
        let reason = without_paths(&error.to_string());
        said(self.store().calibration_failed(lease, &reason, error.is_retryable()).await);
    }
}

/// Does the work. Blocks for as long as it takes.
fn perform(
    store: &Store,
    claimed: &ClaimedCalibration,
    shared: &Shared,
) -> Result<CalibrationDone, CalibrateError> {
    let limits = Limits::default();
    let mut progress = |fraction: f64| {
        shared.set_progress(TaskProgress { fraction, ..TaskProgress::START });
        !shared.stopped()
    };
    match &claimed.work {
        CalibrationWork::Report(masks) => {
            let masks = Reader::open(masks, &limits)?;
            let Report { report, maps } = calibrate::report(&masks, None, None, &mut progress)?;
            Ok(CalibrationDone { masks: None, report, maps })
        }
        CalibrationWork::Captures(captures) => {
            let files = files(store, captures);
            // Checked before hours of averaging.
            let patterns = read_patterns(files.patterns.as_ref(), &limits)?;
            let raw = store.staged_path()?;
            let file = std::fs::File::options().write(true).open(raw.path());
            let file = file.map_err(StoreError::io("open", raw.path()))?;
            let made = average_masks(&files, &limits, file, &mut progress)?;
            let masks = scaled(store, &Reader::open(raw.path(), &limits)?, &made, &mut progress)?;
            let reader = Reader::open(masks.path(), &limits)?;
            let Report { report, maps } =
                calibrate::report(&reader, Some(&made), patterns.as_ref(), &mut progress)?;
            let facts = facts(claimed.name.clone(), &made, &report, &masks);
            Ok(CalibrationDone { masks: Some((facts, masks)), report, maps })
        }
    }
}

fn files(store: &Store, captures: &Captures) -> CaptureFiles {
    let list = |uploads: &Vec<_>| uploads.iter().map(|upload| store.dir().blob(upload)).collect();
    CaptureFiles {
        masks: captures.masks.iter().map(list).collect(),
        white: list(&captures.white),
        black: list(&captures.black),
        black_with_mask: list(&captures.black_with_mask),
        patterns: captures.patterns.as_ref().map(|upload| store.dir().blob(upload)),
        saturation: captures.saturation,
    }
}

/// The masks as they are kept.
fn scaled(
    store: &Store,
    raw: &Reader,
    made: &MadeMasks,
    progress: &mut calibrate::Progress<'_>,
) -> Result<StagedBlob, CalibrateError> {
    let info = raw.info();
    let blob = BufWriter::with_capacity(256 * 1024, store.blob_writer()?);
    let mut writer = Writer::new(blob, info.frames, info.height, info.width)?;
    scale_masks(raw, made.scale, |mask| writer.write_frame(mask), progress)?;
    let blob = writer.finish()?.into_inner();
    let blob = blob.map_err(|error| FormatError::Io {
        action: "write the masks",
        source: error.into_error(),
    })?;
    Ok(blob.finish()?)
}

fn facts(
    name: Option<Label>,
    made: &MadeMasks,
    report: &CalibrationReport,
    masks: &StagedBlob,
) -> NewCalibration {
    NewCalibration {
        name,
        masks: masks.sha256(),
        format: "captures".into(),
        sample: made.sample.name().to_owned(),
        frames: report.frames,
        height: report.height,
        width: report.width,
        full_scale: 1.0,
        mask_mean: report.masks.mean,
        dead_pixels: report.masks.dead_pixels,
        clipped_negatives: made.clipped_negatives,
    }
}
