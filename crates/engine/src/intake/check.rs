//! Checks masks and measurements while they are read.
//!
//! Frames are scaled one at a time, and dark frames are subtracted from a measurement.

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2, Axis};

use super::IntakeError;
use super::captures::{average, saturation_level};
use super::open::Opened;
use crate::intake::error::Result;
use crate::job::{Finding, FindingCode, MAX_MASKS, Mosaic, Reading};
use formats::mat::SceneArray;
use formats::planar::Reader;
use formats::validate::{MaskStatistics, check_masks, check_snapshots};
use formats::{
    self, Expected, FormatError, FrameReader, Limits, SampleType, Selection, StackInfo, Wanted,
};
use optics::{BitUsage, Defects, closed_pixels, judge_closed, judge_defects};

/// Number of snapshots that findings of one kind name.
const SNAPSHOTS: usize = 8;

/// The conditions of a measurement's exposure.
#[derive(Debug, Default)]
pub struct Exposure {
    /// Dark frames, which are averaged and subtracted.
    pub dark: Vec<PathBuf>,
    /// Stored value from which a pixel is saturated; `None` for the largest one, if pixels pile up there.
    pub saturation: Option<u32>,
}

/// The masks behind which a measurement was taken.
#[derive(Debug)]
pub struct MaskLight {
    /// Sum of the masks \[H,W\]; NaN where the calibration has none.
    light: Array2<f32>,
    /// True for pixels without an open mask.
    is_closed: Array2<bool>,
    mosaic: Option<Mosaic>,
}

impl MaskLight {
    /// The light of masks \[B,H,W\] in a prepared file, read one by one.
    ///
    /// Errors: a file that can't be read.
    pub fn stored(masks: &Path, mosaic: Option<Mosaic>, limits: &Limits) -> Result<Self> {
        let masks = Reader::open(masks, limits)?;
        let (height, width) = (masks.info().height, masks.info().width);
        let frames = (0..masks.info().frames).map(|frame| {
            let mask = masks.read_window(frame..frame + 1, 0..height, 0..width)?;
            Ok(mask.index_axis_move(Axis(0), 0))
        });
        Self::of(frames, (height, width), mosaic)
    }

    /// The light of masks of a size.
    ///
    /// Errors: the first one of `masks`.
    pub fn of(
        masks: impl IntoIterator<Item = Result<Array2<f32>>>,
        size: (usize, usize),
        mosaic: Option<Mosaic>,
    ) -> Result<Self> {
        let (mut light, mut largest) = (Array2::zeros(size), Array2::zeros(size));
        for mask in masks {
            let mask = mask?;
            light += &mask;
            largest.zip_mut_with(&mask, |largest: &mut f32, mask| *largest = largest.max(*mask));
        }
        ndarray::Zip::from(&mut largest).and(&light).for_each(|largest, light| {
            if light.is_nan() {
                *largest = f32::NAN;
            }
        });
        Ok(Self { light, is_closed: closed_pixels(largest.view()), mosaic })
    }
}

/// Reads masks and passes each one \[H,W\] on \[0,1\] to `sink`. Pixels of `bad` \[H,W\] become NaN.
///
/// Errors: [`IntakeError::Size`] for more than [`MAX_MASKS`] masks; [`IntakeError::Format`] for unreadable files,
/// values outside the scale and masks without an open pixel, and for errors of `sink`. After an error the output of
/// `sink` is invalid.
pub fn masks(
    opened: Opened,
    bad: Option<&Array2<bool>>,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<MaskStatistics> {
    check_count(&opened)?;
    let mut measured = WithoutBad { reader: opened.reader, bad };
    check_masks(&mut measured, opened.full_scale, sink).map_err(IntakeError::format(opened.name))
}

/// A reader that replaces the pixels of a map \[H,W\] by NaN.
struct WithoutBad<'a> {
    reader: Box<dyn FrameReader + Send>,
    bad: Option<&'a Array2<bool>>,
}

impl FrameReader for WithoutBad<'_> {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let mut frame = self.reader.next_frame()?;
        if let (Some(frame), Some(bad)) = (&mut frame, self.bad)
            && frame.dim() == bad.dim()
        {
            frame.zip_mut_with(bad, |value, &bad| {
                if bad {
                    *value = f32::NAN;
                }
            });
        }
        Ok(frame)
    }
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
         {MAX_MASKS}: state the first and the last one of an exposure as `frames`, or the order as `axes`"
    );
    Err(IntakeError::Size { place: opened.name.clone(), detail })
}

/// Reads a measurement, subtracts the dark frames, divides by the full scale, and passes each snapshot \[H,W\] to
/// `sink`. Pixels that are saturated, bad, not measured, or hardly lit by any mask become NaN. Returns findings on the bit
/// depth, and on snapshots with pixels that carry no information.
///
/// Errors: [`IntakeError::Size`] for dark frames of another size; [`IntakeError::Format`] for unreadable files and
/// measurements without light, and for errors of `sink`. After an error the output of `sink` is invalid.
pub fn measurement(
    opened: Opened,
    exposure: &Exposure,
    behind: &MaskLight,
    limits: &Limits,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<Vec<Finding>> {
    let Opened { info, full_scale, reading, reader, name } = opened;
    let dark = average_dark(&exposure.dark, (info.height, info.width), reading, limits)?;
    let saturation = saturation_level(&info, exposure.saturation);
    let bits = (info.sample == SampleType::U16).then(BitUsage::default);
    #[allow(clippy::cast_precision_loss)] // camera values are small
    let stated = exposure.saturation.map(|level| level as f32);
    let mut exposed = CorrectedReader { reader, dark, stated, behind, defects: Vec::new(), bits };
    let dark =
        check_snapshots(&mut exposed, full_scale, sink).map_err(IntakeError::format(name))?;
    let judge = |bits: BitUsage| bits.judge(full_scale.value(), saturation.unwrap_or(f32::MAX));
    // Saturation explains why no value is larger, so it comes first.
    let mut findings = defect_findings(&exposed.defects, info.height * info.width);
    findings.extend(judge_closed(behind.is_closed.view()).map(Finding::from));
    findings.extend(exposed.bits.and_then(judge).map(Finding::from));
    findings.extend(dark.into_iter().take(SNAPSHOTS).map(|(snapshot, state)| {
        let finding = Finding::new(FindingCode::EmptySnapshot, format!("the snapshot {state}"));
        Finding { snapshot: u32::try_from(snapshot).ok(), ..finding }
    }));
    Ok(findings)
}

/// Findings on the snapshots with the most defects, at most [`SNAPSHOTS`] of each kind, in the order of the snapshots.
fn defect_findings(defects: &[Defects], pixels: usize) -> Vec<Finding> {
    let mut order: Vec<usize> = (0..defects.len()).collect();
    let mut worst = |count: fn(&Defects) -> usize| {
        order.sort_by_key(|&snapshot| std::cmp::Reverse(count(&defects[snapshot])));
        let mut worst: Vec<_> = order.iter().copied().take(SNAPSHOTS).collect();
        worst.sort_unstable();
        worst
    };
    let kinds = [
        (worst(|defects| usize::from(defects.is_binary)), FindingCode::BinaryMeasurement),
        (worst(|defects| defects.saturated), FindingCode::Saturated),
        (worst(|defects| defects.outliers + defects.missing), FindingCode::BadPixels),
    ];
    let findings = kinds.iter().flat_map(|(snapshots, code)| {
        snapshots.iter().flat_map(move |&snapshot| {
            let found = judge_defects(&defects[snapshot], pixels).into_iter();
            let found = found.filter(|finding| finding.code == *code).map(Finding::from);
            found.map(move |finding| Finding { snapshot: u32::try_from(snapshot).ok(), ..finding })
        })
    });
    findings.collect()
}

/// Averages dark frames \[H,W\], as stored. They are cropped and packed like the measurement. `None` if there are none.
fn average_dark(
    dark: &[PathBuf],
    (height, width): (usize, usize),
    reading: Reading,
    limits: &Limits,
) -> Result<Option<Array2<f32>>> {
    if dark.is_empty() {
        return Ok(None);
    }
    let place = |index| format!("/dark/{index}");
    let part = Selection { crop: reading.crop, frames: None };
    let open = |path: &Path| match (reading.crop, reading.packing) {
        (None, None) => formats::open_stack(path, limits),
        (crop, packing) => {
            let size = crop.is_none().then_some((height, width));
            let expected = Expected { size, ..Expected::default() };
            let wanted = Wanted { part, packing, expected, ..SceneArray::Measurements.into() };
            formats::open_array(path, wanted, limits)
        }
    };
    for (index, path) in dark.iter().enumerate() {
        let info = *open(path).map_err(IntakeError::format(place(index)))?.info();
        if (info.height, info.width) != (height, width) {
            let detail = format!(
                "the dark frames are {}x{} (rows x columns), but the measurement is {height}x{width}: both must have \
                 the same size",
                info.height, info.width
            );
            return Err(IntakeError::Size { place: place(index), detail });
        }
    }
    Ok(Some(average(dark, None, None, open, place, &mut |_| true)?.0.mean))
}

/// A reader that subtracts dark frames and marks pixels without information with NaN.
struct CorrectedReader<'a> {
    reader: Box<dyn FrameReader + Send>,
    dark: Option<Array2<f32>>,
    /// Stated value from which a pixel is saturated.
    stated: Option<f32>,
    behind: &'a MaskLight,
    /// The defects of each snapshot so far.
    defects: Vec<Defects>,
    /// Bit usage of 16-bit values; `None` for other data types.
    bits: Option<BitUsage>,
}

impl FrameReader for CorrectedReader<'_> {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let Some(mut frame) = self.reader.next_frame()? else { return Ok(None) };
        if let Some(bits) = &mut self.bits {
            bits.add(&frame);
        }
        let MaskLight { light, is_closed, mosaic } = self.behind;
        if frame.dim() == light.dim() {
            let step = if mosaic.is_some() { 2 } else { 1 };
            let how = (step, self.stated);
            self.defects.push(Defects::mark(&mut frame, self.dark.as_ref(), light.view(), how));
            // Masks of 0 are ignored by the solver, those that leak are not.
            let leaks = ndarray::Zip::from(is_closed).and(light);
            leaks.and(&mut frame).for_each(|closed, light, value| {
                if *closed && *light > 0.0 {
                    *value = f32::NAN;
                }
            });
        }
        if let Some(dark) = &self.dark {
            frame -= dark;
        }
        Ok(Some(frame))
    }
}
