//! From an upload to a calibration or measurement: the content is checked frame by frame and
//! written as a prepared array. Blocks; one at a time runs, where blocking is allowed.

use std::io::BufWriter;
use std::path::Path;

use super::app::App;
use super::error::{ApiError, Code};
use super::intake_check::{Exposed, average_dark, check};
use crate::formats::mat::{self, SceneArray};
use crate::formats::validate::{
    MaskCheck, MaskStatistics, MeasurementCheck, MeasurementStatistics,
};
use crate::formats::{
    self, FormatError, FrameReader, FullScale, Limits, StackInfo, StackWriter, planar,
};
use crate::job::{Finding, Sha256};
use crate::store::{BlobWriter, Calibration, StagedBlob, Store};

/// What is asked of a measurement beyond its data.
#[derive(Debug)]
pub(super) struct Exposure {
    /// The stored number that means 1.
    pub(super) full_scale: Option<f32>,
    /// Captures of the dark, to be averaged and subtracted.
    pub(super) dark: Vec<Sha256>,
    /// The stored number from which on a pixel is full.
    pub(super) saturation: Option<u32>,
}

/// A measurement that was taken in, and what was found in it.
pub(super) struct Measured {
    pub(super) prepared: Prepared<MeasurementStatistics>,
    pub(super) findings: Vec<Finding>,
}

/// What an upload turned out to be.
pub(super) struct Prepared<T> {
    pub(super) info: StackInfo,
    pub(super) statistics: T,
    pub(super) file: StagedBlob,
}

/// Runs a check where it may block, after those that came before it.
pub(super) async fn run<T, F>(app: &App, check: F) -> Result<T, ApiError>
where
    T: Send + 'static,
    F: FnOnce(&Store, &Limits) -> Result<T, ApiError> + Send + 'static,
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
) -> Result<Prepared<MaskStatistics>, ApiError> {
    let path = store.dir().blob(upload);
    let (mut reader, scale) = open(&path, limits, SceneArray::Masks, full_scale)?;
    let info = *reader.info();
    let mut writer = writer(store, &info)?;
    let statistics =
        MaskCheck::run(&mut *reader, scale, |mask| writer.write_frame(mask)).map_err(refused)?;
    Ok(Prepared { info, statistics, file: finish(writer)? })
}

/// Writes a measurement with its dark subtracted and its full scale divided out, and checks it
/// against the masks of its calibration.
pub(super) fn measurement(
    store: &Store,
    limits: &Limits,
    upload: &Sha256,
    exposure: &Exposure,
    calibration: &Calibration,
) -> Result<Measured, ApiError> {
    let path = store.dir().blob(upload);
    let (reader, scale) = open(&path, limits, SceneArray::Measurements, exposure.full_scale)?;
    let info = *reader.info();
    let masks = &calibration.facts;
    if (info.height, info.width) != (masks.height, masks.width) {
        let detail = format!(
            "the measurement is {}x{} (rows x columns), but the masks of calibration {} are {}x{}",
            info.height, info.width, calibration.id, masks.height, masks.width
        );
        return Err(ApiError::new(Code::SizeMismatch, detail).at("/data"));
    }
    let dark = average_dark(store, limits, &exposure.dark, (info.height, info.width))?;
    let mut reader = Exposed::new(reader, dark, exposure.saturation);
    let mut writer = writer(store, &info)?;
    let statistics =
        MeasurementCheck::run(&mut reader, scale, |snapshot| writer.write_frame(snapshot))
            .map_err(refused)?;
    let file = finish(writer)?;
    let masks = planar::Reader::open(&store.dir().blob(&calibration.prepared), limits)?;
    let snapshots = planar::Reader::open(file.path(), limits)?;
    let findings = check(&masks, &snapshots, reader.saturated().as_deref())?;
    Ok(Measured { prepared: Prepared { info, statistics, file }, findings })
}

/// Opens an upload; of a .mat file this array. Its full scale is the one given, or its type's.
pub(super) fn open(
    path: &Path,
    limits: &Limits,
    array: SceneArray,
    full_scale: Option<f32>,
) -> Result<(Box<dyn FrameReader + Send>, FullScale), ApiError> {
    let reader = match mat::is_mat(path)? {
        true => mat::open_array(path, array, limits),
        false => formats::open_stack(path, limits),
    };
    let reader = reader?;
    let scale = match full_scale {
        Some(value) => {
            FullScale::new(value).map_err(|error| ApiError::from(error).at("/full_scale"))?
        }
        None => reader.info().default_full_scale,
    };
    Ok((reader, scale))
}

type Writer = StackWriter<BufWriter<BlobWriter>>;

fn writer(store: &Store, info: &StackInfo) -> Result<Writer, ApiError> {
    let buffered = BufWriter::with_capacity(256 * 1024, store.blob_writer()?);
    Ok(planar::writer(buffered, info.frames, info.height, info.width)?)
}

fn finish(writer: Writer) -> Result<StagedBlob, ApiError> {
    let buffered = writer.finish()?;
    // `finish` has flushed, so this only unwraps.
    let inner = buffered.into_inner().map_err(|error| ApiError::internal(error.error()))?;
    Ok(inner.finish()?)
}

fn refused(error: FormatError) -> ApiError {
    error.into()
}
