//! Checks of masks and measurements as they pass: brought onto their scale frame by frame, a measurement
//! less its dark, and samples of it held against the masks of its calibration.

use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2};

use super::IntakeError;
use super::captures::{average, full_number};
use super::open::Opened;
use crate::intake::error::Result;
use crate::job::{Finding, MOST_MASKS, Mosaic};
use formats::planar::Reader;
use formats::validate::{MaskStatistics, check_masks, check_snapshots};
use formats::{self, FormatError, FrameReader, Limits, SampleType, StackInfo};
use optics::{Digits, MeasurementStudy, REACH, judge_measurement};

/// Side of a window that is looked at, without its margin.
const WINDOW: usize = 64;
/// Windows along each side of a picture.
const WINDOWS: usize = 4;
/// Snapshots of a sequence that are looked at.
const SNAPSHOTS: usize = 8;

/// How a measurement was taken.
#[derive(Debug, Default)]
pub struct Exposure {
    /// Captures of the dark, to be averaged and subtracted.
    pub dark: Vec<PathBuf>,
    /// The stored number from which on a pixel is full; none for the largest of its type.
    pub saturation: Option<u32>,
}

/// What was seen of a measurement as it passed.
#[derive(Debug)]
pub struct Passed {
    /// The share of full pixels of each snapshot; none if nobody knows when they are.
    pub saturated: Option<Vec<f64>>,
    pub findings: Vec<Finding>,
}

/// Hands each mask on \[0,1\] to `sink`.
/// Errors: whatever is wrong with the file; a shape that masks don't have; values outside the scale; masks
/// without an open pixel; those of `sink`. What it received must be thrown away then.
pub fn masks(
    mut opened: Opened,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<MaskStatistics> {
    check_count(&opened)?;
    check_masks(&mut *opened.reader, opened.full_scale, sink)
        .map_err(IntakeError::format(opened.name))
}

/// Refuses what has more frames than one exposure can tell apart.
fn check_count(opened: &Opened) -> Result<()> {
    let StackInfo { frames, height, width, axes, .. } = opened.info;
    if frames <= MOST_MASKS {
        return Ok(());
    }
    let read = axes.map(|axes| format!(", read as {axes}")).unwrap_or_default();
    let detail = format!(
        "{frames} masks of {height}x{width} (rows x columns{read}); a calibration has at most {MOST_MASKS}: \
         send one mask for each frame of an exposure, or state axes"
    );
    Err(IntakeError::Size { place: opened.name.clone(), detail })
}

/// Hands each snapshot, less its dark and divided by the full scale, to `sink`, and tells what was seen.
/// Errors: whatever is wrong with the file; a dark of another size; snapshots that are 0
/// everywhere; those of `sink`. What it received must be thrown away then.
pub fn measurement(
    opened: Opened,
    exposure: &Exposure,
    limits: &Limits,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<Passed> {
    let Opened { info, full_scale, reader, name } = opened;
    let dark = average_dark(&exposure.dark, (info.height, info.width), limits)?;
    let saturation = full_number(info.sample, exposure.saturation);
    let digits = (info.sample == SampleType::U16).then(Digits::default);
    let mut exposed = Exposed { reader, dark, saturation, full: Vec::new(), digits };
    check_snapshots(&mut exposed, full_scale, sink).map_err(IntakeError::format(name))?;
    let judge = |digits: Digits| digits.judge(full_scale.value(), saturation.unwrap_or(f32::MAX));
    let findings = exposed.digits.and_then(judge).map(Finding::from).into_iter().collect();
    Ok(Passed { saturated: saturation.map(|_| exposed.full), findings })
}

/// The average \[H,W\] of dark captures, as stored.
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
                "the dark is {}x{} (rows x columns), but the measurement is {height}x{width}",
                info.height, info.width
            );
            return Err(IntakeError::Size { place: place(index), detail });
        }
    }
    Ok(Some(average(dark, None, limits, place, &mut |_| true)?.0.mean))
}

/// A measurement less its dark, of which the full pixels are counted.
struct Exposed {
    reader: Box<dyn FrameReader + Send>,
    dark: Option<Array2<f32>>,
    saturation: Option<f32>,
    /// Share of full pixels of each snapshot so far.
    full: Vec<f64>,
    /// Of 16-bit numbers.
    digits: Option<Digits>,
}

impl FrameReader for Exposed {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let Some(mut frame) = self.reader.next_frame()? else { return Ok(None) };
        if let Some(digits) = &mut self.digits {
            digits.add(&frame);
        }
        if let Some(saturation) = self.saturation {
            let full = frame.iter().filter(|value| **value >= saturation).count();
            self.full.push(full as f64 / frame.len().max(1) as f64);
        }
        if let Some(dark) = &self.dark {
            frame -= dark;
        }
        Ok(Some(frame))
    }
}

/// Holds samples of snapshots \[S,H,W\] against masks \[B,H,W\], both as prepared files; of a mosaic its first green
/// sub-image, as colours differ from pixel to pixel. `saturated` is the share of full pixels of each snapshot,
/// `darkened` whether a dark was subtracted.
pub fn judge(
    (masks, snapshots): (&Path, &Path),
    mosaic: Option<Mosaic>,
    saturated: Option<&[f64]>,
    darkened: bool,
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
        let mut judged = judge_measurement(&figures, share, darkened);
        // Told by whoever sent them.
        judged.retain(|found| mosaic.is_none() || found.code != "mosaic");
        let judged = judged.into_iter();
        findings.extend(judged.map(|found| Finding { snapshot: number, ..Finding::from(found) }));
    }
    Ok(findings)
}

/// Looks at windows spread evenly over a snapshot.
fn study(
    masks: &Reader,
    snapshots: &Reader,
    snapshot: usize,
    mosaic: Option<Mosaic>,
) -> Result<MeasurementStudy, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let ((row, column), step) = mosaic.map_or(((0, 0), 1), |mosaic| (mosaic.green(), 2));
    // From the first pixel to the one behind the last that is looked at.
    let place = |window: &Range<usize>, first: usize| {
        first + window.start * step..first + (window.end * step + 1).saturating_sub(step)
    };
    let mut study = MeasurementStudy::new(frames);
    for rows in windows(height / step) {
        for columns in windows(width / step) {
            let place = (place(&rows, row), place(&columns, column));
            let band = masks.read_lattice(0..frames, place.clone(), step)?;
            let y = snapshots.read_lattice(snapshot..snapshot + 1, place, step)?;
            study.add(band.view(), y.index_axis(ndarray::Axis(0), 0));
        }
    }
    Ok(study)
}

/// Windows with their margins along a side, from even pixels on: all of it if it is short.
fn windows(length: usize) -> Vec<Range<usize>> {
    let side = WINDOW + 2 * REACH;
    let count = (length / side).clamp(1, WINDOWS);
    let side = if count == 1 { length.min(2 * side) } else { side };
    let start = |index: usize| match count {
        1 => ((length - side) / 2) & !1,
        // Even, so that the phases of a mosaic are the same in all.
        _ => (index * (length - side) / (count - 1)) & !1,
    };
    (0..count).map(|index| start(index)..start(index) + side).collect()
}

#[cfg(test)]
mod tests {
    use super::windows;

    #[test]
    fn windows_spread_over_a_side_of_any_length() {
        assert_eq!(windows(48).first(), Some(&(0..48)));
        assert_eq!(windows(143).first(), Some(&(0..143)));
        assert_eq!(windows(144), [0..72, 72..144]);
        assert_eq!(windows(3200).last(), Some(&(3128..3200)));
        assert!((1..4000).all(|length| windows(length).iter().all(|window| window.end <= length)));
    }
}
