//! Masks from raw captures, and what is to be told of masks.
//!
//! Captures are read one frame at a time and added to running sums, so that memory holds a few planes
//! however many repeats there are.

use std::io::BufWriter;
use std::ops::Range;
use std::path::PathBuf;

use ndarray::{Array2, Array3, ArrayView2};

use crate::formats::planar::{Reader, Writer};
use crate::formats::{
    self, FormatError, FrameReader, FullScale, Limits, SampleType, png, read_stack,
};
use crate::job::{CalibrationReport, Finding};
use crate::optics::{
    Average, Calibrator, CaptureFigures, MaskFigures, MaskStudy, OpticsError, PatternFigures,
    References, Repeats, check_patterns, judge_captures, judge_masks,
};

/// Bytes of the masks that are looked at in one go.
const BAND_BYTES: usize = 64 << 20;
/// Longest side of a picture of a report, in pixels.
const PICTURE: usize = 640;
/// The share of the work that averaging is; looking at the masks is the rest.
const AVERAGING: f64 = 0.8;

/// The files of captures. Each has one frame or several; all of a list show the same.
#[derive(Debug, Clone, Default)]
pub struct CaptureFiles {
    /// For each pattern, the white board through the mask.
    pub masks: Vec<Vec<PathBuf>>,
    /// Without the mask, the LCoS all white.
    pub white: Vec<PathBuf>,
    /// Without the mask, the LCoS all black.
    pub black: Vec<PathBuf>,
    /// With the mask, the LCoS all black; empty for Eq. 7.
    pub black_with_mask: Vec<PathBuf>,
    /// The aperture patterns that were shown.
    pub patterns: Option<PathBuf>,
    /// The number from which on a pixel is full; none for the largest of the files' type.
    pub saturation: Option<u32>,
}

/// Why there are no masks.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// It was asked to stop.
    #[error("stopped")]
    Stopped,
    /// A file of captures.
    #[error("{place}: {source}")]
    File {
        /// Which one.
        place: String,
        /// What is wrong with it.
        source: FormatError,
    },
    /// Captures that can't be used.
    #[error("{place}: {source}")]
    Captures {
        /// Which ones.
        place: String,
        /// What is wrong with them.
        source: OpticsError,
    },
    /// The masks can't be written or read back.
    #[error(transparent)]
    Masks(#[from] FormatError),
    /// The service's disk.
    #[error(transparent)]
    Store(#[from] crate::store::StoreError),
}

impl CalibrateError {
    /// Whether another attempt may succeed: the machine failed, not the data.
    #[must_use]
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::File { source, .. } | Self::Masks(source) => !source.is_callers_fault(),
            Self::Captures { .. } => false,
            Self::Stopped | Self::Store(_) => true,
        }
    }
}

/// Hears how much of the work is done, on \[0,1\]; false asks to stop.
pub type Progress<'a> = dyn FnMut(f64) -> bool + 'a;

/// Masks that were written, and what their captures tell.
#[derive(Debug)]
pub struct MadeMasks {
    /// The masks' scale: the share of the white's light where a mask is 1.
    pub scale: f32,
    /// Of the captures.
    pub figures: CaptureFigures,
    /// `white - black`.
    pub illumination: Array2<f32>,
    /// How the captures are stored.
    pub sample: SampleType,
    /// Values below 0 that were set to 0.
    pub clipped_negatives: u64,
}

/// Averages captures frame by frame and writes the masks \[B,H,W\], not yet divided by their largest
/// value, to `raw`.
///
/// # Errors
/// Captures that can't be read or used; a stop.
pub fn average_masks(
    files: &CaptureFiles,
    limits: &Limits,
    raw: impl std::io::Write,
    progress: &mut Progress<'_>,
) -> Result<MadeMasks, CalibrateError> {
    let total = files.masks.len() + 3;
    let mut done = 0;
    let mut average = |name: &str, paths: &[PathBuf]| {
        let whole = |share: f64| (f64::from(done) + share) / total as f64 * AVERAGING;
        let averaged =
            average(name, paths, files.saturation, limits, &mut |share| progress(whole(share)));
        done += 1;
        averaged
    };
    let (white, sample) = average("white", &files.white)?;
    let (black, _) = average("black", &files.black)?;
    let black_with_mask = match files.black_with_mask.as_slice() {
        [] => None,
        paths => Some(average("black_with_mask", paths)?.0),
    };
    let refused = |place: &str| {
        let place = place.to_owned();
        move |source| CalibrateError::Captures { place, source }
    };
    let references = References { white, black, black_with_mask };
    let calibrator = Calibrator::new(references).map_err(refused("reference images"))?;
    let (height, width) = calibrator.illumination().dim();
    let mut writer = Writer::new(BufWriter::new(raw), files.masks.len(), height, width)?;
    let (mut patterns, mut scale, mut clipped) = (Vec::new(), 0.0f32, 0);
    for (index, paths) in files.masks.iter().enumerate() {
        let name = format!("pattern {index} (counted from 0)");
        let (capture, _) = average(&name, paths)?;
        let mask = calibrator.mask(&capture).map_err(refused(&name))?;
        writer.write_frame(mask.values.view())?;
        scale = scale.max(mask.largest);
        clipped += mask.not_positive;
        patterns.push(PatternFigures::new(&mask, capture.saturated, capture.drift));
    }
    writer.finish()?;
    if scale <= 0.0 {
        let source = OpticsError::Captures("no pattern is brighter than the dark".into());
        return Err(CalibrateError::Captures { place: "patterns".into(), source });
    }
    let figures = CaptureFigures::new(&calibrator, patterns);
    let illumination = calibrator.illumination().to_owned();
    Ok(MadeMasks { scale, figures, illumination, sample, clipped_negatives: clipped })
}

/// The average of all frames of some files.
fn average(
    name: &str,
    paths: &[PathBuf],
    saturation: Option<u32>,
    limits: &Limits,
    progress: &mut Progress<'_>,
) -> Result<(Average, SampleType), CalibrateError> {
    let place = |index: usize| format!("captures of {name}, file {}", index + 1);
    let (mut repeats, mut sample) = (None, SampleType::F32);
    for (index, path) in paths.iter().enumerate() {
        let failed = |source| CalibrateError::File { place: place(index), source };
        let mut reader = formats::open_stack(path, limits).map_err(failed)?;
        let info = *reader.info();
        sample = info.sample;
        // Floats have no largest number: there it must be stated.
        let largest = (info.sample.default_full_scale() != FullScale::ONE)
            .then(|| info.sample.default_full_scale().value());
        #[allow(clippy::cast_precision_loss)] // cameras' numbers are small
        let full = saturation.map(|value| value as f32).or(largest);
        let repeats = repeats.get_or_insert_with(|| Repeats::new(info.height, info.width, full));
        let mut frame = 0;
        while let Some(capture) = reader.next_frame().map_err(failed)? {
            repeats
                .add(capture.view())
                .map_err(|source| CalibrateError::Captures { place: place(index), source })?;
            frame += 1;
            let share = frame as f64 / info.frames as f64;
            if !progress((index as f64 + share) / paths.len() as f64) {
                return Err(CalibrateError::Stopped);
            }
        }
    }
    let none = || Repeats::new(0, 0, None);
    let averaged = repeats.unwrap_or_else(none).average();
    let place = format!("captures of {name}");
    averaged
        .map(|average| (average, sample))
        .map_err(|source| CalibrateError::Captures { place, source })
}

/// Writes masks divided by their scale, so that the largest value is 1.
///
/// # Errors
/// I/O; a stop.
pub fn scale_masks(
    raw: &Reader,
    scale: f32,
    mut write: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
    progress: &mut Progress<'_>,
) -> Result<(), CalibrateError> {
    let info = raw.info();
    for frame in 0..info.frames {
        let mut mask = raw.read_window(frame..frame + 1, 0..info.height, 0..info.width)?;
        mask.mapv_inplace(|value| (value / scale).min(1.0));
        write(mask.index_axis(ndarray::Axis(0), 0))?;
        if !progress(AVERAGING + 0.1 * (frame + 1) as f64 / info.frames as f64) {
            return Err(CalibrateError::Stopped);
        }
    }
    Ok(())
}

/// A report with its pictures.
#[derive(Debug)]
pub struct Report {
    /// What is known of the masks.
    pub report: CalibrationReport,
    /// Pictures by name, as PNG.
    pub maps: Vec<(String, Vec<u8>)>,
}

/// The report on masks \[B,H,W\], with its pictures by name, as PNG. `made` is known if they were
/// made of captures, `patterns` if somebody told the patterns that were meant.
///
/// # Errors
/// Masks that can't be read; patterns that can't be; a stop.
pub fn report(
    masks: &Reader,
    made: Option<&MadeMasks>,
    patterns: Option<&Array3<f32>>,
    progress: &mut Progress<'_>,
) -> Result<Report, CalibrateError> {
    let figures = study(masks, progress)?;
    if let Some(patterns) = patterns {
        let place = || "patterns".to_owned();
        check_patterns(patterns.view(), figures.frame_means.len())
            .map_err(|source| CalibrateError::Captures { place: place(), source })?;
    }
    let mut findings = judge_masks(&figures, patterns.map(|patterns| patterns.view()));
    if let Some(made) = made {
        findings.extend(judge_captures(&made.figures));
    }
    let mut maps = vec![
        ("mean".to_owned(), picture(&figures.mean)?),
        ("deviation".to_owned(), picture(&figures.deviation)?),
        ("gram".to_owned(), picture(&figures.gram)?),
    ];
    if let Some(made) = made {
        maps.push(("illumination".to_owned(), picture(&made.illumination)?));
    }
    let findings = findings.into_iter().map(Finding::from).collect();
    let captures = made.map(|made| (&made.figures, made.scale));
    let names = maps.iter().map(|(name, _)| name.clone()).collect();
    Ok(Report { report: CalibrationReport::new(&figures, captures, findings, names), maps })
}

/// Looks at masks band by band.
fn study(masks: &Reader, progress: &mut Progress<'_>) -> Result<MaskFigures, CalibrateError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let refused = |source| CalibrateError::Captures { place: "masks".into(), source };
    let rows = (BAND_BYTES / (frames * width * size_of::<f32>())).clamp(1, height);
    let mut study = MaskStudy::new(frames, height, width);
    for start in (0..height).step_by(rows) {
        let band: Range<usize> = start..(start + rows).min(height);
        let share = 0.9 + 0.1 * band.end as f64 / height as f64;
        study.add(masks.read_window(0..frames, band, 0..width)?.view()).map_err(refused)?;
        if !progress(share) {
            return Err(CalibrateError::Stopped);
        }
    }
    study.finish().map_err(refused)
}

/// The patterns of a file, if there is one.
///
/// # Errors
/// A file that can't be read.
pub fn read_patterns(
    path: Option<&PathBuf>,
    limits: &Limits,
) -> Result<Option<Array3<f32>>, CalibrateError> {
    let Some(path) = path else { return Ok(None) };
    let failed = |source| CalibrateError::File { place: "patterns".into(), source };
    let (info, patterns) = read_stack(path, limits).map_err(failed)?;
    Ok(Some(patterns / info.default_full_scale.value()))
}

/// A picture of a map, small enough to look at: block means, black at 0, white at the largest.
fn picture(map: &Array2<f32>) -> Result<Vec<u8>, FormatError> {
    let (height, width) = map.dim();
    let side = height.max(width).div_ceil(PICTURE).max(1);
    let small = Array2::from_shape_fn((height.div_ceil(side), width.div_ceil(side)), |(i, j)| {
        let rows = i * side..((i + 1) * side).min(height);
        let columns = j * side..((j + 1) * side).min(width);
        map.slice(ndarray::s![rows, columns]).mean().unwrap_or(0.0)
    });
    let largest = small.fold(0.0f32, |largest, &value| largest.max(value));
    png::encode_u8(small.view(), 0.0, if largest > 0.0 { largest } else { 1.0 })
}
