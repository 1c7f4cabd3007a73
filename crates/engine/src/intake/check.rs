//! Checks masks and measurements while they are read.
//!
//! Frames are scaled one at a time, and dark frames are subtracted from a measurement. Afterwards windows of some
//! snapshots are checked against the masks of the calibration.

use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2};

use super::IntakeError;
use super::captures::{average, saturation_level};
use super::open::Opened;
use crate::intake::error::Result;
use crate::job::{Finding, FindingCode, MAX_MASKS, Mosaic};
use formats::planar::Reader;
use formats::validate::{MaskStatistics, check_masks, check_snapshots};
use formats::{self, FormatError, FrameReader, Limits, SampleType, StackInfo};
use optics::{BitUsage, MeasurementStudy, REACH, judge_measurement};

/// Side of a checked window without its margin, in pixels.
const WINDOW: usize = 64;
/// Number of checked windows along each side of a picture.
const WINDOWS: usize = 4;
/// Number of checked snapshots of a measurement.
const SNAPSHOTS: usize = 8;

/// The conditions of a measurement's exposure.
#[derive(Debug, Default)]
pub struct Exposure {
    /// Dark frames, which are averaged and subtracted.
    pub dark: Vec<PathBuf>,
    /// Stored value from which a pixel is saturated; `None` for the largest of the data type.
    pub saturation: Option<u32>,
}

/// The results of reading a measurement.
#[derive(Debug)]
pub struct Passed {
    /// Share of saturated pixels of each snapshot; `None` if the saturation level is unknown.
    pub saturated: Option<Vec<f64>>,
    /// Findings on the bit depth.
    pub findings: Vec<Finding>,
}

/// Reads masks and passes each one \[H,W\] on \[0,1\] to `sink`.
///
/// Errors: [`IntakeError::Size`] for more than [`MAX_MASKS`] masks; [`IntakeError::Format`] for unreadable files,
/// values outside the scale and masks without an open pixel, and for errors of `sink`. After an error the output of
/// `sink` is invalid.
pub fn masks(
    mut opened: Opened,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<MaskStatistics> {
    check_count(&opened)?;
    check_masks(&mut *opened.reader, opened.full_scale, sink)
        .map_err(IntakeError::format(opened.name))
}

/// Checks the number of masks.
fn check_count(opened: &Opened) -> Result<()> {
    let StackInfo { frames, height, width, axes, .. } = opened.info;
    if frames <= MAX_MASKS {
        return Ok(());
    }
    let order = axes.map(|axes| format!(", read as {axes}")).unwrap_or_default();
    let detail = format!(
        "the file has {frames} masks of {height}x{width} (rows x columns{order}); a calibration has at most \
         {MAX_MASKS}: send one mask per frame of an exposure, or state `axes`"
    );
    Err(IntakeError::Size { place: opened.name.clone(), detail })
}

/// Reads a measurement, subtracts the dark frames, divides by the full scale, and passes each snapshot \[H,W\] to
/// `sink`.
///
/// Errors: [`IntakeError::Size`] for dark frames of another size; [`IntakeError::Format`] for unreadable files and
/// snapshots that are 0 everywhere, and for errors of `sink`. After an error the output of `sink` is invalid.
pub fn measurement(
    opened: Opened,
    exposure: &Exposure,
    limits: &Limits,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<Passed> {
    let Opened { info, full_scale, reader, name } = opened;
    let dark = average_dark(&exposure.dark, (info.height, info.width), limits)?;
    let saturation = saturation_level(info.sample, exposure.saturation);
    let bits = (info.sample == SampleType::U16).then(BitUsage::default);
    let mut exposed = DarkCorrected { reader, dark, saturation, saturated: Vec::new(), bits };
    check_snapshots(&mut exposed, full_scale, sink).map_err(IntakeError::format(name))?;
    let judge = |bits: BitUsage| bits.judge(full_scale.value(), saturation.unwrap_or(f32::MAX));
    let findings = exposed.bits.and_then(judge).map(Finding::from).into_iter().collect();
    Ok(Passed { saturated: saturation.map(|_| exposed.saturated), findings })
}

/// Averages dark frames \[H,W\], as stored. `None` if there are none.
fn average_dark(
    dark: &[PathBuf],
    (height, width): (usize, usize),
    limits: &Limits,
) -> Result<Option<Array2<f32>>> {
    if dark.is_empty() {
        return Ok(None);
    }
    let place = |index| format!("/dark/{index}");
    for (index, path) in dark.iter().enumerate() {
        let opened = formats::open_stack(path, limits);
        let info = *opened.map_err(IntakeError::format(place(index)))?.info();
        if (info.height, info.width) != (height, width) {
            let detail = format!(
                "the dark frames are {}x{} (rows x columns), but the measurement is {height}x{width}: both must have \
                 the same size",
                info.height, info.width
            );
            return Err(IntakeError::Size { place: place(index), detail });
        }
    }
    Ok(Some(average(dark, None, limits, place, &mut |_| true)?.0.mean))
}

/// A reader that subtracts dark frames and counts saturated pixels.
struct DarkCorrected {
    reader: Box<dyn FrameReader + Send>,
    dark: Option<Array2<f32>>,
    saturation: Option<f32>,
    /// Share of saturated pixels of each snapshot so far.
    saturated: Vec<f64>,
    /// Bit usage of 16-bit values; `None` for other data types.
    bits: Option<BitUsage>,
}

impl FrameReader for DarkCorrected {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let Some(mut frame) = self.reader.next_frame()? else { return Ok(None) };
        if let Some(bits) = &mut self.bits {
            bits.add(&frame);
        }
        if let Some(saturation) = self.saturation {
            let saturated = frame.iter().filter(|value| **value >= saturation).count();
            self.saturated.push(saturated as f64 / frame.len().max(1) as f64);
        }
        if let Some(dark) = &self.dark {
            frame -= dark;
        }
        Ok(Some(frame))
    }
}

/// Checks a few snapshots \[S,H,W\] against masks \[B,H,W\], both in prepared files. Behind a mosaic only
/// the first green sub-image is checked. `saturated` is the share of saturated pixels of each snapshot;
/// `dark_subtracted` is true if dark frames were subtracted.
///
/// Errors: files that can't be read.
pub fn judge(
    (masks, snapshots): (&Path, &Path),
    mosaic: Option<Mosaic>,
    saturated: Option<&[f64]>,
    dark_subtracted: bool,
    limits: &Limits,
) -> Result<Vec<Finding>, FormatError> {
    let (masks, snapshots) = (Reader::open(masks, limits)?, Reader::open(snapshots, limits)?);
    let count = snapshots.info().frames;
    let mut findings = Vec::new();
    for sample in 0..count.min(SNAPSHOTS) {
        let snapshot = sample * count / count.min(SNAPSHOTS);
        let share = saturated.and_then(|shares| shares.get(snapshot)).copied();
        let Some(figures) = study(&masks, &snapshots, snapshot, mosaic)?.finish() else { continue };
        let number = u32::try_from(snapshot).ok();
        let mut judged = judge_measurement(&figures, share, dark_subtracted);
        // The user has stated the mosaic.
        judged.retain(|finding| mosaic.is_none() || finding.code != FindingCode::Mosaic);
        let judged = judged.into_iter();
        findings
            .extend(judged.map(|finding| Finding { snapshot: number, ..Finding::from(finding) }));
    }
    Ok(findings)
}

/// Computes the statistics of windows that are spread evenly over a snapshot.
fn study(
    masks: &Reader,
    snapshots: &Reader,
    snapshot: usize,
    mosaic: Option<Mosaic>,
) -> Result<MeasurementStudy, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let ((row, column), step) = mosaic.map_or(((0, 0), 1), |mosaic| (mosaic.green(), 2));
    // Sensor pixels of a window of the sub-image.
    let sensor_pixels = |window: &Range<usize>, first: usize| {
        first + window.start * step..first + (window.end * step + 1).saturating_sub(step)
    };
    let mut study = MeasurementStudy::new(frames);
    for rows in windows(height / step) {
        for columns in windows(width / step) {
            let sensor_pixels = (sensor_pixels(&rows, row), sensor_pixels(&columns, column));
            let band = masks.read_lattice(0..frames, sensor_pixels.clone(), step)?;
            let y = snapshots.read_lattice(snapshot..snapshot + 1, sensor_pixels, step)?;
            study.add(band.view(), y.index_axis(ndarray::Axis(0), 0));
        }
    }
    Ok(study)
}

/// Windows with their margins along one side. All start at even pixels. A short side has one window.
fn windows(length: usize) -> Vec<Range<usize>> {
    let side = WINDOW + 2 * REACH;
    let count = (length / side).clamp(1, WINDOWS);
    let side = if count == 1 { length.min(2 * side) } else { side };
    let start = |index: usize| match count {
        1 => ((length - side) / 2) & !1,
        // Even starts keep the phases of a mosaic.
        _ => (index * (length - side) / (count - 1)) & !1,
    };
    (0..count).map(|index| start(index)..start(index) + side).collect()
}

#[cfg(test)]
mod tests {
    use super::windows;

    #[test]
    fn windows_are_spread_over_sides_of_any_length() {
        assert_eq!(windows(48).first(), Some(&(0..48)));
        assert_eq!(windows(143).first(), Some(&(0..143)));
        assert_eq!(windows(144), [0..72, 72..144]);
        assert_eq!(windows(3200).last(), Some(&(3128..3200)));
        assert!((1..4000).all(|length| windows(length).iter().all(|window| window.end <= length)));
    }
}
