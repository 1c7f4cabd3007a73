//! Checks masks and measurements while they are read.
//!
//! Frames are scaled one at a time, and dark frames are subtracted from a measurement. Afterwards windows of some
//! snapshots are checked against the masks of the calibration.

use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, ArrayView2, Axis};

use super::IntakeError;
use super::captures::{average, saturation_level};
use super::open::Opened;
use crate::intake::error::Result;
use crate::job::{Finding, FindingCode, MAX_MASKS, Mosaic, Reading};
use formats::mat::SceneArray;
use formats::planar::Reader;
use formats::validate::{MaskStatistics, check_masks, check_snapshots};
use formats::{
    self, Expected, FormatError, FrameReader, Limits, Part, SampleType, StackInfo, Wanted,
};
use optics::{
    BitUsage, Defects, MeasurementFigures, MeasurementStudy, REACH, judge_defects,
    judge_measurement,
};
use reconstruction::unmeasured::filled;

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
    /// Stored value from which a pixel is saturated; `None` for the largest one, if pixels pile up there.
    pub saturation: Option<u32>,
}

/// The masks behind which a measurement was taken.
#[derive(Debug)]
pub struct Behind {
    /// Sum of the masks \[H,W\]; NaN where the calibration has none.
    pub light: Array2<f32>,
    pub mosaic: Option<Mosaic>,
}

impl Behind {
    /// The sum of masks \[B,H,W\] in a prepared file, read one by one.
    ///
    /// Errors: a file that can't be read.
    pub fn stored(masks: &Path, mosaic: Option<Mosaic>, limits: &Limits) -> Result<Self> {
        let masks = Reader::open(masks, limits)?;
        let (height, width) = (masks.info().height, masks.info().width);
        let mut light = Array2::zeros((height, width));
        for frame in 0..masks.info().frames {
            let mask = masks.read_window(frame..frame + 1, 0..height, 0..width)?;
            light += &mask.index_axis(Axis(0), 0);
        }
        Ok(Self { light, mosaic })
    }
}

/// The results of reading a measurement.
#[derive(Debug)]
pub struct Passed {
    /// Findings on the bit depth, and on snapshots with pixels that carry no information.
    pub findings: Vec<Finding>,
}

/// Reads masks and passes each one \[H,W\] on \[0,1\] to `sink`. Pixels of `bad` \[H,W\] become NaN.
///
/// Errors: [`IntakeError::Size`] for more than [`MAX_MASKS`] masks; [`IntakeError::Format`] for unreadable files,
/// values outside the scale and masks without an open pixel, and for errors of `sink`. After an error the output of
/// `sink` is invalid.
pub fn masks(
    mut opened: Opened,
    bad: Option<&Array2<bool>>,
    mut sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<MaskStatistics> {
    check_count(&opened)?;
    let without_bad = |mask: ArrayView2<'_, f32>| match bad {
        None => sink(mask),
        Some(bad) => {
            let value = |(&mask, &bad): (&f32, &bool)| if bad { f32::NAN } else { mask };
            let values = mask.iter().zip(bad).map(value).collect();
            let masked = Array2::from_shape_vec(mask.dim(), values);
            sink(masked.map_err(|error| FormatError::Internal(error.to_string()))?.view())
        }
    };
    check_masks(&mut *opened.reader, opened.full_scale, without_bad)
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
         {MAX_MASKS}: state the first and the last one of an exposure as `frames`, or the order as `axes`"
    );
    Err(IntakeError::Size { place: opened.name.clone(), detail })
}

/// Reads a measurement, subtracts the dark frames, divides by the full scale, and passes each snapshot \[H,W\] to
/// `sink`. Pixels that are saturated, bad or not measured become NaN.
///
/// Errors: [`IntakeError::Size`] for dark frames of another size; [`IntakeError::Format`] for unreadable files and
/// measurements that are 0 everywhere, and for errors of `sink`. After an error the output of `sink` is invalid.
pub fn measurement(
    opened: Opened,
    exposure: &Exposure,
    behind: &Behind,
    limits: &Limits,
    sink: impl FnMut(ArrayView2<'_, f32>) -> Result<(), FormatError>,
) -> Result<Passed> {
    let Opened { info, full_scale, reading, reader, name } = opened;
    let dark = average_dark(&exposure.dark, (info.height, info.width), reading, limits)?;
    let saturation = saturation_level(&info, exposure.saturation);
    let bits = (info.sample == SampleType::U16).then(BitUsage::default);
    #[allow(clippy::cast_precision_loss)] // camera values are small
    let stated = exposure.saturation.map(|level| level as f32);
    let mut exposed = Exposed { reader, dark, stated, behind, defects: Vec::new(), bits };
    let empty =
        check_snapshots(&mut exposed, full_scale, sink).map_err(IntakeError::format(name))?;
    let judge = |bits: BitUsage| bits.judge(full_scale.value(), saturation.unwrap_or(f32::MAX));
    let mut findings: Vec<_> =
        exposed.bits.and_then(judge).map(Finding::from).into_iter().collect();
    findings.extend(defect_findings(&exposed.defects, info.height * info.width));
    findings.extend(empty.into_iter().take(SNAPSHOTS).map(|snapshot| {
        let finding = Finding::new(FindingCode::EmptySnapshot, "the snapshot is 0 everywhere");
        Finding { snapshot: u32::try_from(snapshot).ok(), ..finding }
    }));
    Ok(Passed { findings })
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
    let part = Part { crop: reading.crop, frames: None };
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
    Ok(Some(average(dark, None, open, place, &mut |_| true)?.0.mean))
}

/// A reader that subtracts dark frames and marks pixels without information with NaN.
struct Exposed<'a> {
    reader: Box<dyn FrameReader + Send>,
    dark: Option<Array2<f32>>,
    /// Stated value from which a pixel is saturated.
    stated: Option<f32>,
    behind: &'a Behind,
    /// The defects of each snapshot so far.
    defects: Vec<Defects>,
    /// Bit usage of 16-bit values; `None` for other data types.
    bits: Option<BitUsage>,
}

impl FrameReader for Exposed<'_> {
    fn info(&self) -> &StackInfo {
        self.reader.info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>, FormatError> {
        let Some(mut frame) = self.reader.next_frame()? else { return Ok(None) };
        if let Some(bits) = &mut self.bits {
            bits.add(&frame);
        }
        let Behind { light, mosaic } = self.behind;
        if frame.dim() == light.dim() {
            let step = if mosaic.is_some() { 2 } else { 1 };
            let how = (step, self.stated);
            self.defects.push(Defects::mark(&mut frame, self.dark.as_ref(), light.view(), how));
        }
        if let Some(dark) = &self.dark {
            frame -= dark;
        }
        Ok(Some(frame))
    }
}

/// Combines the findings of reading a measurement with those of its [check](judge), causes before their effects.
///
/// Masks of another place make many pixels look like outliers. Pixels that were saturated leave the darker ones, which
/// looks like light that the masks do not explain.
pub fn combined(mut read: Vec<Finding>, mut judged: Vec<Finding>) -> Vec<Finding> {
    use FindingCode::{
        BadPixels, DriftedMasks, ForeignMasks, Level, NegativeOffset, NoDark, Saturated,
        ShiftedMasks, TurnedMasks, WrongDark,
    };
    let is_one_of =
        |finding: &Finding, codes: &[FindingCode]| codes.iter().any(|code| finding.is(*code));
    let snapshots_with = |findings: &[Finding], codes: &[FindingCode]| -> Vec<Option<u32>> {
        let found = findings.iter().filter(|finding| is_one_of(finding, codes));
        found.map(|finding| finding.snapshot).collect()
    };
    let wrong_masks = [ShiftedMasks, TurnedMasks, ForeignMasks];
    let with_wrong_masks = snapshots_with(&judged, &wrong_masks);
    read.retain(|finding| !(finding.is(BadPixels) && with_wrong_masks.contains(&finding.snapshot)));
    let saturated = snapshots_with(&read, &[Saturated]);
    let offsets = [DriftedMasks, NoDark, NegativeOffset, WrongDark, Level];
    judged
        .retain(|finding| !(is_one_of(finding, &offsets) && saturated.contains(&finding.snapshot)));
    let (mut findings, others): (Vec<_>, Vec<_>) =
        judged.into_iter().partition(|finding| is_one_of(finding, &wrong_masks));
    findings.extend(read);
    findings.extend(others);
    findings
}

/// Checks a few snapshots \[S,H,W\] against masks \[B,H,W\], both in prepared files. Behind a mosaic only
/// the first green sub-image is checked. `dark_subtracted` is true if dark frames were subtracted.
///
/// Errors: files that can't be read.
pub fn judge(
    (masks, snapshots): (&Path, &Path),
    mosaic: Option<Mosaic>,
    dark_subtracted: bool,
    limits: &Limits,
) -> Result<Vec<Finding>, FormatError> {
    let (masks, snapshots) = (Reader::open(masks, limits)?, Reader::open(snapshots, limits)?);
    let count = snapshots.info().frames;
    let mut findings = Vec::new();
    for sample in 0..count.min(SNAPSHOTS) {
        let snapshot = sample * count / count.min(SNAPSHOTS);
        let studied = study((&masks, &snapshots), snapshot, mosaic, Turn::default())?;
        let Some(figures) = studied.finish() else { continue };
        let number = u32::try_from(snapshot).ok();
        let mut judged = judge_measurement(&figures, dark_subtracted);
        if judged.iter().any(|finding| finding.code == FindingCode::ForeignMasks)
            && let Some(turned) = turned_masks((&masks, &snapshots), snapshot, mosaic, &figures)?
        {
            judged.retain(|finding| finding.code != FindingCode::ForeignMasks);
            judged.push(turned);
        }
        // The user has stated the mosaic.
        judged.retain(|finding| mosaic.is_none() || finding.code != FindingCode::Mosaic);
        let judged = judged.into_iter();
        findings
            .extend(judged.map(|finding| Finding { snapshot: number, ..Finding::from(finding) }));
    }
    Ok(findings)
}

/// Another orientation of masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Turn {
    /// Rows and columns are exchanged, before flips.
    transposed: bool,
    rows_flipped: bool,
    columns_flipped: bool,
}

impl Turn {
    /// All orientations of masks of this size other than the given one.
    fn others(height: usize, width: usize) -> Vec<Self> {
        let turn = |code: usize| Self {
            transposed: code & 1 == 1,
            rows_flipped: code & 2 == 2,
            columns_flipped: code & 4 == 4,
        };
        (1..8).map(turn).filter(|turn| height == width || !turn.transposed).collect()
    }

    /// Reads the window of the turned masks \[B,h,w\].
    fn read(
        self,
        masks: &Reader,
        (rows, columns): (&Range<usize>, &Range<usize>),
    ) -> Result<Array3<f32>, FormatError> {
        let (frames, height, width) =
            (masks.info().frames, masks.info().height, masks.info().width);
        let mirrored = |range: &Range<usize>, length: usize, flipped: bool| {
            if flipped { length - range.end..length - range.start } else { range.clone() }
        };
        let mut place = (
            mirrored(rows, height, self.rows_flipped),
            mirrored(columns, width, self.columns_flipped),
        );
        if self.transposed {
            place = (place.1, place.0);
        }
        let mut band = masks.read_window(0..frames, place.0, place.1)?;
        if self.transposed {
            band.swap_axes(1, 2);
        }
        if self.rows_flipped {
            band.invert_axis(Axis(1));
        }
        if self.columns_flipped {
            band.invert_axis(Axis(2));
        }
        Ok(band.as_standard_layout().into_owned())
    }

    fn describe(self) -> String {
        let parts = [
            (self.transposed, "their rows and columns are exchanged"),
            (self.rows_flipped, "they are flipped upside down"),
            (self.columns_flipped, "they are flipped from left to right"),
        ];
        let parts: Vec<_> = parts.iter().filter(|(is, _)| *is).map(|(_, text)| *text).collect();
        parts.join(" and ")
    }
}

/// Largest share of the explanation by turned masks that given masks have, if the turned ones are right.
const TURNED_GAIN: f64 = 4.0;
/// Smallest share of the fine structure that masks explain in the right orientation.
const MIN_EXPLAINED: f64 = 0.08;

/// Looks for an orientation of the masks that explains a snapshot, which the given one does not.
fn turned_masks(
    files: (&Reader, &Reader),
    snapshot: usize,
    mosaic: Option<Mosaic>,
    given: &MeasurementFigures,
) -> Result<Option<optics::Finding>, FormatError> {
    if mosaic.is_some() {
        return Ok(None);
    }
    let (height, width) = (files.0.info().height, files.0.info().width);
    let mut best: Option<(f64, Turn)> = None;
    for turn in Turn::others(height, width) {
        let figures = study(files, snapshot, None, turn)?.finish();
        let explained = figures.map_or(0.0, |figures| figures.explained_unshifted);
        if best.is_none_or(|(most, _)| explained > most) {
            best = Some((explained, turn));
        }
    }
    let right = best.filter(|(explained, _)| {
        *explained > MIN_EXPLAINED && *explained > TURNED_GAIN * given.explained_unshifted
    });
    Ok(right.map(|(explained, turn)| {
        let axes = if turn == (Turn { transposed: true, ..Turn::default() }) {
            ". The masks were probably read with a wrong order of axes: state `frame-column-row` as `axes` where \
             `frame-row-column` was taken, and the other way round"
        } else {
            ""
        };
        let detail = format!(
            "the masks explain {:.0} % of the fine structure of the measurement when {}, but only {:.1} % as they are\
             {axes}",
            100.0 * explained,
            turn.describe(),
            100.0 * given.explained_unshifted
        );
        optics::Finding::new(FindingCode::TurnedMasks, detail)
    }))
}

/// Computes the statistics of windows that are spread evenly over a snapshot, with turned masks.
fn study(
    (masks, snapshots): (&Reader, &Reader),
    snapshot: usize,
    mosaic: Option<Mosaic>,
    turn: Turn,
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
            let place = (sensor_pixels(&rows, row), sensor_pixels(&columns, column));
            let band = match turn == Turn::default() {
                true => masks.read_lattice(0..frames, place.clone(), step)?,
                false => turn.read(masks, (&place.0, &place.1))?,
            };
            let y = snapshots.read_lattice(snapshot..snapshot + 1, place, step)?;
            let band = band.mapv_into(|mask| if mask.is_nan() { 0.0 } else { mask });
            study.add(band.view(), filled(y.index_axis(Axis(0), 0)).view());
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
