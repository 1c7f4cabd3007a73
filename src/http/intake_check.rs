//! What is done to a measurement on its way in: the dark is subtracted, full pixels are counted, and
//! samples of it are held against the masks of its calibration. Blocks.

use ndarray::Array2;

use super::error::{ApiError, Code};
use crate::formats::planar::Reader;
use crate::formats::{self, FormatError, FrameReader, FullScale, Limits, StackInfo};
use crate::job::{Finding, Sha256};
use crate::optics::{MeasurementStudy, REACH, Repeats, judge_measurement};
use crate::store::Store;

/// Side of a window that is looked at, without its margin.
const WINDOW: usize = 64;
/// Windows along each side of a picture.
const WINDOWS: usize = 4;
/// Snapshots of a sequence that are looked at.
const SNAPSHOTS: usize = 8;

/// The average \[H,W\] of dark captures, as stored.
pub(super) fn average_dark(
    store: &Store,
    limits: &Limits,
    dark: &[Sha256],
    size: (usize, usize),
) -> Result<Option<Array2<f32>>, ApiError> {
    let mut repeats = Repeats::new(size.0, size.1, None);
    for (index, upload) in dark.iter().enumerate() {
        let place = format!("/dark/{index}");
        let refused = |error: FormatError| ApiError::from(error).at(&place);
        let opened = formats::open_stack(&store.dir().blob(upload), limits);
        let mut reader = opened.map_err(refused)?;
        let info = *reader.info();
        if (info.height, info.width) != size {
            let detail = format!(
                "the dark is {}x{} (rows x columns), but the measurement is {}x{}",
                info.height, info.width, size.0, size.1
            );
            return Err(ApiError::new(Code::SizeMismatch, detail).at(&place));
        }
        while let Some(frame) = reader.next_frame().map_err(refused)? {
            let added = repeats.add(frame.view());
            added.map_err(|error| {
                ApiError::new(Code::InvalidContent, error.to_string()).at(&place)
            })?;
        }
    }
    Ok(if dark.is_empty() { None } else { repeats.average().ok().map(|average| average.mean) })
}

/// A measurement less its dark, of which the full pixels are counted.
pub(super) struct Exposed<R> {
    reader: R,
    dark: Option<Array2<f32>>,
    saturation: Option<f32>,
    /// Share of full pixels of each snapshot so far.
    full: Vec<f64>,
}

impl<R: FrameReader> Exposed<R> {
    /// Without a stated number, pixels of whole numbers are full at the largest of their type.
    #[allow(clippy::cast_precision_loss)] // cameras' numbers are small
    pub(super) fn new(reader: R, dark: Option<Array2<f32>>, saturation: Option<u32>) -> Self {
        let largest = reader.info().sample.default_full_scale();
        let largest = (largest != FullScale::ONE).then(|| largest.value());
        let saturation = saturation.map(|value| value as f32).or(largest);
        Self { reader, dark, saturation, full: Vec::new() }
    }

    /// Share of full pixels of each snapshot; none if nobody knows when they are.
    pub(super) fn saturated(self) -> Option<Vec<f64>> {
        self.saturation.map(|_| self.full)
    }
}

impl<R: FrameReader> FrameReader for Exposed<R> {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let Some(mut frame) = self.reader.next_frame()? else { return Ok(None) };
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

/// Holds samples of snapshots \[S,H,W\] against masks \[B,H,W\], both as prepared.
pub(super) fn check(
    masks: &Reader,
    snapshots: &Reader,
    saturated: Option<&[f64]>,
) -> Result<Vec<Finding>, FormatError> {
    let count = snapshots.info().frames;
    let mut findings = Vec::new();
    for sample in 0..count.min(SNAPSHOTS) {
        let snapshot = sample * count / count.min(SNAPSHOTS);
        let share = saturated.and_then(|shares| shares.get(snapshot)).copied();
        let Some(figures) = study(masks, snapshots, snapshot)?.finish() else { continue };
        let number = u32::try_from(snapshot).ok();
        let judged = judge_measurement(&figures, share).into_iter();
        findings.extend(judged.map(|found| Finding { snapshot: number, ..Finding::from(found) }));
    }
    Ok(findings)
}

/// Looks at windows spread evenly over a snapshot.
fn study(
    masks: &Reader,
    snapshots: &Reader,
    snapshot: usize,
) -> Result<MeasurementStudy, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let mut study = MeasurementStudy::new(frames);
    for rows in windows(height) {
        for columns in windows(width) {
            let band = masks.read_window(0..frames, rows.clone(), columns.clone())?;
            let y = snapshots.read_window(snapshot..snapshot + 1, rows.clone(), columns)?;
            study.add(band.view(), y.index_axis(ndarray::Axis(0), 0));
        }
    }
    Ok(study)
}

/// Windows with their margins along a side: all of it if it is short.
fn windows(length: usize) -> Vec<std::ops::Range<usize>> {
    let side = WINDOW + 2 * REACH;
    let count = (length / side).clamp(1, WINDOWS);
    let side = if count == 1 { length.min(2 * side) } else { side };
    let start = |index: usize| match count {
        1 => (length - side) / 2,
        _ => index * (length - side) / (count - 1),
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
