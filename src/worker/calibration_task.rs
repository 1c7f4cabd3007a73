//! The task of a calibration: masks from captures, and the report on them.

use std::io::BufWriter;

use super::prepare::to_record;
use super::task::{Shared, TaskError};
use crate::formats::planar::{self, Reader};
use crate::formats::{FormatError, Limits, StackInfo};
use crate::intake::{self, Calibrated, Report, calibrate};
use crate::job::{Label, TaskProgress};
use crate::store::{
    CalibrationDone, CalibrationInputs, CalibrationTask, Completion, NewCalibration, Product,
    StagedBlob, Store,
};

/// Makes masks of captures, or takes those that are there, and reports on them.
pub(super) fn run(
    store: &Store,
    task: &CalibrationTask,
    shared: &Shared,
) -> Result<Completion, TaskError> {
    let limits = Limits::default();
    let mut progress = |fraction: f64| {
        shared.set_progress(TaskProgress { fraction, ..TaskProgress::START });
        !shared.stopped()
    };
    let done = match &task.inputs {
        CalibrationInputs::Masks(masks) => {
            let masks = Reader::open(masks, &limits)?;
            let Report { report, maps } = intake::report(&masks, &mut progress)?;
            CalibrationDone { masks: None, report, maps }
        }
        CalibrationInputs::Captures(captures) => {
            let files = captures.map(|upload| store.dir().blob(upload));
            let scratch = store.staged_path()?;
            let blob = BufWriter::with_capacity(256 * 1024, store.blob_writer()?);
            let open =
                |info: &StackInfo| planar::writer(blob, info.frames, info.height, info.width);
            let (made, blob) = calibrate(&files, &limits, scratch.path(), open, &mut progress)?;
            let blob = blob.into_inner().map_err(|error| FormatError::Io {
                action: "write the masks",
                source: error.into_error(),
            })?;
            let masks = blob.finish()?;
            let facts = facts(task.name.clone(), &made, &masks);
            let Report { report, maps } = made.report;
            CalibrationDone { masks: Some((facts, masks)), report, maps }
        }
    };
    Ok(Completion {
        progress: TaskProgress { fraction: 1.0, ..shared.progress() },
        record: to_record(&())?,
        product: Product::Calibration(Box::new(done)),
    })
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
