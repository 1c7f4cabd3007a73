//! Calibrations as the worker does them: masks from captures, and reports.

use std::io::BufWriter;
use std::sync::Arc;
use std::time::Duration;

use tracing::Instrument;

use super::run::{HEARTBEAT, LEASE, Worker, WorkerError, said};
use super::task::Shared;
use crate::formats::planar::{self, Reader};
use crate::formats::{FormatError, Limits, StackInfo};
use crate::intake::{self, Calibrated, IntakeError, Report, calibrate};
use crate::job::{Label, TaskProgress, without_paths};
use crate::store::{
    CalibrationDone, CalibrationLease, CalibrationWork, ClaimedCalibration, Heartbeat,
    NewCalibration, StagedBlob, Store, StoreError,
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
        mut computing: tokio::task::JoinHandle<Result<CalibrationDone, Failure>>,
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
            Err(Failure::Intake(IntakeError::Stopped)) => {
                said(self.store().release_calibration(lease).await)
            }
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

    async fn not_calibrated(&self, lease: &CalibrationLease, error: &Failure) {
        tracing::error!(%error, "the calibration failed");
        let reason = without_paths(&error.to_string());
        said(self.store().calibration_failed(lease, &reason, error.is_retryable()).await);
    }
}

/// Why a calibration failed.
#[derive(Debug, thiserror::Error)]
enum Failure {
    /// The captures or masks.
    #[error(transparent)]
    Intake(#[from] IntakeError),
    /// The service's disk or database.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl Failure {
    /// Whether another attempt may succeed.
    fn is_retryable(&self) -> bool {
        match self {
            Self::Intake(error) => error.is_retryable(),
            Self::Store(_) => true,
        }
    }
}

/// Does the work. Blocks for as long as it takes.
fn perform(
    store: &Store,
    claimed: &ClaimedCalibration,
    shared: &Shared,
) -> Result<CalibrationDone, Failure> {
    let limits = Limits::default();
    let mut progress = |fraction: f64| {
        shared.set_progress(TaskProgress { fraction, ..TaskProgress::START });
        !shared.stopped()
    };
    match &claimed.work {
        CalibrationWork::Report(masks) => {
            let masks = Reader::open(masks, &limits).map_err(IntakeError::from)?;
            let Report { report, maps } = intake::report(&masks, &mut progress)?;
            Ok(CalibrationDone { masks: None, report, maps })
        }
        CalibrationWork::Captures(captures) => {
            let files = captures.map(|upload| store.dir().blob(upload));
            let scratch = store.staged_path()?;
            let blob = BufWriter::with_capacity(256 * 1024, store.blob_writer()?);
            let open =
                |info: &StackInfo| planar::writer(blob, info.frames, info.height, info.width);
            let (made, blob) = calibrate(&files, &limits, scratch.path(), open, &mut progress)?;
            let blob = blob.into_inner().map_err(|error| FormatError::Io {
                action: "write the masks",
                source: error.into_error(),
            });
            let blob = blob.map_err(IntakeError::from)?.finish()?;
            let facts = facts(claimed.name.clone(), &made, &blob);
            let Report { report, maps } = made.report;
            Ok(CalibrationDone { masks: Some((facts, blob)), report, maps })
        }
    }
}

fn facts(name: Option<Label>, made: &Calibrated, masks: &StagedBlob) -> NewCalibration {
    let report = &made.report.report;
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
