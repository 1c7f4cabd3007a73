//! True frames that a lab uploaded for a job.

use std::path::Path;

use ndarray::Array2;

use super::app::App;
use super::error::{ApiError, Result};
use super::intake;
use engine::intake::{IntakeError, Opened, Source};
use engine::job::{Lab, SceneShape, Sha256};
use formats::mat::SceneArray;
use formats::{Axes, Channels, FormatError, Limits};

/// Checks that an upload can be the true frames of a job with this shape.
///
/// Errors: those of the file, at `/truth`.
pub(super) async fn check(app: &App, lab: &Lab, truth: Sha256, shape: SceneShape) -> Result<()> {
    let found = app.store.upload(lab, truth).await;
    found.map_err(|error| ApiError::reference("/truth", error))?;
    let upload = intake::upload(app, truth).await.map_err(|error| error.at("/truth"))?;
    let limits = app.limits;
    let read = intake::run(app, lab, move || {
        let (mut truth, _) = open(&upload, None, None, limits, shape)?;
        (0..truth.info.frames).try_for_each(|frame| next_frame(&mut truth, frame).map(drop))
    });
    read.await.map_err(|error| error.at("/truth"))
}

/// Reads the next true frame, which has this number.
///
/// Errors: 422 for values that are not finite. They would make a PSNR that is no number.
pub(super) fn next_frame(truth: &mut Opened, frame: usize) -> Result<Array2<f32>> {
    let missing = || FormatError::Internal("a stack has fewer frames than it says".into());
    let values = truth.next_frame()?.ok_or_else(missing)?;
    let odd = values.indexed_iter().find(|(_, value)| !value.is_finite());
    if let Some(((row, column), &value)) = odd {
        return Err(
            FormatError::NotFinite { subject: "true frames", value, frame, row, column }.into()
        );
    }
    Ok(values)
}

/// Opens true frames, of one snapshot or of all, and checks their number and size. The truth of a colour sensor may have
/// colours, or one colour for each pixel, as the sensor records it.
///
/// Errors: those of the file; [`IntakeError::Size`] for other frames than those of the job.
pub(super) fn open(
    path: &Path,
    full_scale: Option<f32>,
    axes: Option<Axes>,
    limits: Limits,
    shape: SceneShape,
) -> Result<(Opened, Channels), IntakeError> {
    let source = Source::upload(path, SceneArray::Truth, full_scale, limits);
    let colours = if shape.mosaic.is_some() { source.open_colours()? } else { None };
    let (truth, channels) = match colours {
        Some(colours) => (colours, Channels::Rgb),
        None => {
            let source = source.arranged(axes, Some((shape.height, shape.width)));
            (source.open()?, Channels::Grey)
        }
    };
    let SceneShape { frames, height, width, snapshots, .. } = shape;
    let (all, info) = (frames * snapshots as usize, &truth.info);
    let (rows, columns) = (info.height, info.width / channels.count());
    if (rows, columns) == (height, width) && [frames, all].contains(&info.frames) {
        return Ok((truth, channels));
    }
    let detail = format!(
        "the truth has {} frames of {rows}x{columns}; it should have {frames} of {height}x{width} for one \
         snapshot, or {all} for all",
        info.frames
    );
    Err(IntakeError::Size { place: String::new(), detail })
}

/// Number of true frames before those of a snapshot.
pub(super) fn frames_before(truth: &Opened, snapshot: usize, shape: SceneShape) -> usize {
    let SceneShape { frames, snapshots, .. } = shape;
    let has_all = truth.info.frames == frames * snapshots as usize;
    if has_all { snapshot * frames } else { 0 }
}
