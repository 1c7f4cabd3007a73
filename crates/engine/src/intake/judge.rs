//! Checks windows of some snapshots against the masks of their calibration.

use std::ops::Range;
use std::path::Path;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};

use crate::job::{Dispersion, Finding, FindingCode, Mosaic};
use formats::planar::Reader;
use formats::{FormatError, Limits};
use optics::{
    BLOCK_MARGIN, BlockStudy, Displacement, Magnified, MeasurementFigures, MeasurementStudy, REACH,
    central, displacement, judge_blocks, judge_dispersed, judge_measurement, magnification,
    magnified, with_means,
};

/// Side of a checked window without its margin, in pixels.
const WINDOW: usize = 64;
/// Number of checked windows along each side of a picture.
const WINDOWS: usize = 4;
/// Number of checked snapshots of a measurement.
const SNAPSHOTS: usize = 8;

/// Combines the findings of reading a measurement with those of its [check](judge), causes before their effects.
///
/// Masks of another place and a wrong dark make many pixels look like outliers. Pixels that were saturated leave the darker
/// ones, which looks like light that the masks do not explain.
pub fn combined(mut read: Vec<Finding>, mut judged: Vec<Finding>) -> Vec<Finding> {
    use FindingCode::{
        BadPixels, BinaryMeasurement, DriftedMasks, EmptySnapshot, ForeignMasks, InvertedMasks,
        Level, MaskScale, MaskValues, MissingMask, NegativeOffset, NoDark, PartlyMovedMasks,
        ResampledMasks, Saturated, ShiftedMasks, TurnedMasks, UnverifiedMasks, WrongDark,
    };
    let is_one_of =
        |finding: &Finding, codes: &[FindingCode]| codes.iter().any(|code| finding.is(*code));
    let snapshots_with = |findings: &[Finding], codes: &[FindingCode]| -> Vec<Option<u32>> {
        let found = findings.iter().filter(|finding| is_one_of(finding, codes));
        found.map(|finding| finding.snapshot).collect()
    };
    let wrong_masks = [
        BinaryMeasurement,
        InvertedMasks,
        PartlyMovedMasks,
        ResampledMasks,
        ShiftedMasks,
        TurnedMasks,
        ForeignMasks,
        MaskValues,
    ];
    let with_wrong_masks = snapshots_with(&judged, &wrong_masks);
    let copies = snapshots_with(&judged, &[BinaryMeasurement]);
    read.retain(|finding| match finding {
        _ if finding.is(BadPixels) => !with_wrong_masks.contains(&finding.snapshot),
        _ if is_one_of(finding, &[Saturated, BinaryMeasurement]) => {
            !copies.contains(&finding.snapshot)
        }
        _ => true,
    });
    let saturated = snapshots_with(&read, &[Saturated]);
    let empty = snapshots_with(&read, &[EmptySnapshot]);
    judged.retain(|finding| !(finding.is(UnverifiedMasks) && empty.contains(&finding.snapshot)));
    let offsets = [DriftedMasks, NoDark, NegativeOffset, WrongDark, Level, MaskValues, MissingMask];
    judged
        .retain(|finding| !(is_one_of(finding, &offsets) && saturated.contains(&finding.snapshot)));
    let (mut findings, others): (Vec<_>, Vec<_>) = judged
        .into_iter()
        .partition(|finding| finding.is(MaskScale) || is_one_of(finding, &wrong_masks));
    let (bad_pixels, read): (Vec<_>, Vec<_>) =
        read.into_iter().partition(|finding| finding.is(BadPixels));
    findings.extend(read);
    findings.extend(others);
    findings.extend(bad_pixels);
    // If masks were sent as the measurement, their scale is an effect.
    findings.sort_by_key(|finding| !finding.is(BinaryMeasurement));
    findings
}

/// Orders findings by cause: altered values of the masks make a calibration look bad.
pub fn causes_first(findings: &mut [Finding]) {
    findings.sort_by_key(|finding| !finding.is(FindingCode::MaskValues));
}

/// Checks a few snapshots \[S,H,W\] against masks \[B,H,W\], both in prepared files. Behind a mosaic only
/// the first green sub-image is checked. `dark_subtracted` is true if dark frames were subtracted.
///
/// Errors: files that can't be read.
pub fn judge(
    masks: &Path,
    snapshots: &Path,
    mosaic: Option<Mosaic>,
    dispersion: Option<&Dispersion>,
    dark_subtracted: bool,
    limits: &Limits,
) -> Result<Vec<Finding>, FormatError> {
    let files = Files {
        masks: &Reader::open(masks, limits)?,
        snapshots: &Reader::open(snapshots, limits)?,
    };
    let count = files.snapshots.info().frames;
    let mut findings = Vec::new();
    for sample in 0..count.min(SNAPSHOTS) {
        let snapshot = sample * count / count.min(SNAPSHOTS);
        let studied = study(files, snapshot, mosaic, Turn::default())?;
        let number = u32::try_from(snapshot).ok();
        let Some(mut figures) = studied.finish() else {
            let detail = "the picture is too small, too little of it was measured, or the masks have no structure";
            let finding = optics::Finding::new(FindingCode::UnverifiedMasks, detail);
            findings.push(Finding { snapshot: number, ..Finding::from(finding) });
            continue;
        };
        if let Some(part) = figures.unmodulated.as_mut().filter(|_| mosaic.is_some()) {
            part.place = part.place.map(|at| 2 * at);
        }
        let mut judged = match dispersion {
            Some(_) => judge_dispersed(&figures, dark_subtracted),
            None => judge_measurement(&figures, dark_subtracted),
        };
        let explained =
            [FindingCode::InvertedMasks, FindingCode::ResampledMasks, FindingCode::ShiftedMasks];
        // Masks at another place explain some of the light by chance, above all in small pictures.
        if mosaic.is_none()
            && !figures.is_flat
            && figures.explained_unshifted < MIN_EXPLAINED
            && !judged.iter().any(|finding| explained.contains(&finding.code))
            && let Some(misplaced) = misplaced_masks(files, snapshot, &figures)?
            // Blocks show the other places of the masks of a spectral camera.
            && (dispersion.is_none() || misplaced.code == FindingCode::TurnedMasks)
        {
            let places = [FindingCode::DriftedMasks, FindingCode::ForeignMasks];
            judged.retain(|finding| !places.contains(&finding.code));
            judged.insert(0, misplaced);
        }
        // The user has stated the mosaic.
        judged.retain(|finding| mosaic.is_none() || finding.code != FindingCode::Mosaic);
        let named = [FindingCode::TurnedMasks, FindingCode::InvertedMasks];
        if let Some(dispersion) = dispersion
            && !judged.iter().any(|finding| named.contains(&finding.code))
        {
            let fit = block_study(files, snapshot)?.finish(dispersion.axis);
            judged.splice(0..0, judge_blocks(fit.as_ref()));
        }
        let judged = judged.into_iter();
        findings
            .extend(judged.map(|finding| Finding { snapshot: number, ..Finding::from(finding) }));
    }
    Ok(findings)
}

/// Prepared files.
#[derive(Clone, Copy)]
struct Files<'a> {
    /// \[B,H,W\]
    masks: &'a Reader,
    /// \[S,H,W\]
    snapshots: &'a Reader,
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

/// Masks fit at another place if they explain this many times more there.
const MISPLACED_GAIN: f64 = 4.0;
/// Smallest share of the fine structure that masks explain at the right place.
const MIN_EXPLAINED: f64 = 0.08;
/// Smallest number of measured pixels per frame. With fewer, a search finds masks that explain [`MIN_EXPLAINED`] by chance.
const PIXELS_PER_FRAME: f64 = 50.0;
/// Largest displacement that is searched, in pixels along each axis.
const LARGEST_DISPLACEMENT: usize = 32;

/// Looks for a displacement or an orientation of the masks that explains a snapshot, which the given one does not.
fn misplaced_masks(
    files: Files<'_>,
    snapshot: usize,
    given: &MeasurementFigures,
) -> Result<Option<optics::Finding>, FormatError> {
    // Each search finds something by chance in a small picture, so the one that explains most decides.
    let mut best: Option<Misplaced> = None;
    for search in [displaced_masks, turned_masks, magnified_masks] {
        let found = search(files, snapshot, given)?;
        if let Some(found) = found.filter(|found| found.is_better_than(given))
            && best.as_ref().is_none_or(|best| found.explained > best.explained)
        {
            best = Some(found);
        }
    }
    Ok(best.map(|best| best.finding))
}

/// Masks that fit after a change.
struct Misplaced {
    /// Share of the fine structure that a fit of all frames explains then.
    explained: f64,
    finding: optics::Finding,
}

impl Misplaced {
    fn is_better_than(&self, given: &MeasurementFigures) -> bool {
        self.explained > MIN_EXPLAINED
            && self.explained > MISPLACED_GAIN * given.explained_unshifted
    }
}

/// Share of the fine structure of `y` \[H,W\] that `masks` \[B,H,W\] explain when they are moved by a displacement.
fn explained_after(
    masks: ArrayView3<'_, f32>,
    y: ArrayView2<'_, f32>,
    displacement: &Displacement,
) -> f64 {
    let cut = |length: usize, moved: i32| {
        let by = (moved.unsigned_abs() as usize).min(length);
        let (early, late) = (0..length - by, by..length);
        if moved > 0 { (early, late) } else { (late, early) }
    };
    let (frames, height, width) = masks.dim();
    let (mask_rows, y_rows) = cut(height, displacement.rows);
    let (mask_columns, y_columns) = cut(width, displacement.columns);
    let mut study = MeasurementStudy::new(frames);
    study.add(masks.slice(s![.., mask_rows, mask_columns]), y.slice(s![y_rows, y_columns]), (0, 0));
    // A flat measurement fits any masks with a constant sum.
    let figures = study
        .finish()
        .filter(|figures| figures.pixels > PIXELS_PER_FRAME * frames as f64 && !figures.is_flat);
    figures.map_or(0.0, |figures| figures.explained)
}

/// Looks for a displacement by more pixels than a fit of the frames covers, as after a wrong crop.
fn displaced_masks(
    Files { masks, snapshots }: Files<'_>,
    snapshot: usize,
    given: &MeasurementFigures,
) -> Result<Option<Misplaced>, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let reach = LARGEST_DISPLACEMENT.min(height.min(width) / 4);
    let side = WINDOW + 2 * reach;
    let window = |length: usize| length.saturating_sub(side) / 2..length.min((length + side) / 2);
    let (rows, columns) = (window(height), window(width));
    let y = snapshots.read_window(snapshot..snapshot + 1, rows.clone(), columns.clone())?;
    let band = masks.read_window(0..frames, rows, columns)?;
    let y = y.index_axis(Axis(0), 0);
    let found = displacement(band.sum_axis(Axis(0)).view(), y, reach);
    let found = found.filter(|found| found.explained > MIN_EXPLAINED && !found.is_none());
    Ok(found.map(|found| {
        let explained = explained_after(band.view(), y, &found);
        let detail = format!(
            "the masks explain {:.0} % of the fine structure of the measurement when shifted by {} rows and {} columns, \
             but only {:.1} % without a shift. The measurement is probably a crop that begins at another place than the \
             masks",
            100.0 * explained,
            found.rows,
            found.columns,
            100.0 * given.explained_unshifted
        );
        Misplaced { explained, finding: optics::Finding::new(FindingCode::ShiftedMasks, detail) }
    }))
}

/// Smallest change of the magnification that is reported. The search for shifts finds smaller ones.
const SMALLEST_GROWTH: f64 = 0.005;

/// Side of the window in which other magnifications are searched, in pixels.
const MAGNIFIED_WINDOW: usize = 256;

/// Looks for a magnification of the masks that explains a snapshot, which the given one does not.
fn magnified_masks(
    Files { masks, snapshots }: Files<'_>,
    snapshot: usize,
    given: &MeasurementFigures,
) -> Result<Option<Misplaced>, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let window = |length: usize| {
        let side = length.min(MAGNIFIED_WINDOW);
        (length - side) / 2..(length - side) / 2 + side
    };
    let (rows, columns) = (window(height), window(width));
    let y = snapshots.read_window(snapshot..snapshot + 1, rows.clone(), columns.clone())?;
    let y = y.index_axis(Axis(0), 0);
    let band = with_means(masks.read_window(0..frames, rows, columns)?.view());
    let found = magnification(band.sum_axis(Axis(0)).view(), y);
    let found = found.filter(|found| (found.factor - 1.0).abs() > SMALLEST_GROWTH);
    let Some(Magnified { factor, displacement }) = found else { return Ok(None) };
    // The search compares the sum of the masks; the fit of all frames decides.
    let mut enlarged = Vec::new();
    for mask in band.outer_iter() {
        enlarged.extend(magnified(mask, factor));
    }
    let Some(size) = enlarged.first().map(Array2::dim) else { return Ok(None) };
    let views: Vec<_> = enlarged.iter().map(|mask| mask.view()).collect();
    let Ok(enlarged) = ndarray::stack(Axis(0), &views) else { return Ok(None) };
    let y = central(y, size);
    let explained = explained_after(enlarged.view(), y, &displacement);
    let change = match factor > 1.0 {
        true => format!("enlarged by a factor of about {factor:.2}"),
        false => format!("reduced by a factor of about {:.2}", factor.recip()),
    };
    let detail = format!(
        "the masks explain {:.0} % of the fine structure of the measurement when {change}, but only {:.1} % in \
         their size. Most likely masks or measurement were resized or binned after their recording: compare the sizes of \
         the raw files. Otherwise the lens was changed since the calibration",
        100.0 * explained,
        100.0 * given.explained_unshifted
    );
    let finding = optics::Finding::new(FindingCode::ResampledMasks, detail);
    Ok(Some(Misplaced { explained, finding }))
}

/// Looks for an orientation of the masks that explains a snapshot, which the given one does not.
fn turned_masks(
    files: Files<'_>,
    snapshot: usize,
    given: &MeasurementFigures,
) -> Result<Option<Misplaced>, FormatError> {
    let (height, width) = (files.masks.info().height, files.masks.info().width);
    let mut best: Option<(f64, Turn)> = None;
    for turn in Turn::others(height, width) {
        let figures = study(files, snapshot, None, turn)?.finish();
        let explained = figures.map_or(0.0, |figures| figures.explained_unshifted);
        if best.is_none_or(|(most, _)| explained > most) {
            best = Some((explained, turn));
        }
    }
    Ok(best.map(|(explained, turn)| {
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
        Misplaced { explained, finding: optics::Finding::new(FindingCode::TurnedMasks, detail) }
    }))
}

/// Computes the statistics of windows that are spread evenly over a snapshot, with turned masks.
fn study(
    Files { masks, snapshots }: Files<'_>,
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
            let first = (rows.start, columns.start);
            study.add(band.view(), y.index_axis(Axis(0), 0), first);
        }
    }
    Ok(study)
}

/// Side of a window of blocks without its margin, in pixels, and largest number of these windows along each side.
const BLOCK_WINDOW: usize = 256;
const BLOCK_WINDOWS: usize = 3;

/// Fits the blocks of windows that are spread evenly over a snapshot.
fn block_study(
    Files { masks, snapshots }: Files<'_>,
    snapshot: usize,
) -> Result<BlockStudy, FormatError> {
    let (frames, height, width) = (masks.info().frames, masks.info().height, masks.info().width);
    let windows = |length: usize| {
        let inner = length.saturating_sub(2 * BLOCK_MARGIN);
        let count = inner.div_ceil(BLOCK_WINDOW).clamp(1, BLOCK_WINDOWS);
        spread(
            length,
            (inner.div_ceil(count).min(BLOCK_WINDOW) + 2 * BLOCK_MARGIN).min(length),
            count,
        )
    };
    let mut study = BlockStudy::default();
    for rows in windows(height) {
        for columns in windows(width) {
            let band = masks.read_window(0..frames, rows.clone(), columns.clone())?;
            let y = snapshots.read_window(snapshot..snapshot + 1, rows.clone(), columns)?;
            study.add(band.view(), y.index_axis(Axis(0), 0));
        }
    }
    Ok(study)
}

/// Windows with their margins along one side. A short side has one window.
fn windows(length: usize) -> Vec<Range<usize>> {
    let side = WINDOW + 2 * REACH;
    let count = (length / side).clamp(1, WINDOWS);
    spread(length, if count == 1 { length.min(2 * side) } else { side }, count)
}

/// Ranges of `side` pixels that are spread evenly over a length. They start at even pixels, which keeps the phases of a mosaic.
fn spread(length: usize, side: usize, count: usize) -> Vec<Range<usize>> {
    let start = |index: usize| match count {
        1 => ((length - side) / 2) & !1,
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
