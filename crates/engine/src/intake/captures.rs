//! Computes masks from raw captures, and reports on masks.
//!
//! Captures are read one frame at a time and added to running sums, so memory does not grow with the number of repeats.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, Axis};

use super::IntakeError;
use super::bad_pixels::bad_pixels;
use crate::intake::error::Result;
use crate::job::{CalibrationReport, Captures, Finding, MAX_CALIBRATION_SECONDS, planned_seconds};
use formats::display::{Encoding, Picture};
use formats::planar::{self, Reader};
use formats::validate::MIN_OPEN;
use formats::{
    self, Channels, FormatError, FrameReader, FullScale, Limits, SampleType, StackInfo,
    StackWriter, read_stack,
};
use optics::{
    Average, Calibrator, CaptureFigures, Dispersion, MaskFigures, MaskStudy, PatternFigures,
    References, Repeats, check_patterns, judge_captures, judge_masks,
};

/// Bytes of masks that are analysed at a time.
const BAND_BYTES: usize = 64 << 20;
/// Longest side of the pictures of a report, in pixels.
const PICTURE_SIDE: usize = 640;
/// Share of averaging in the work. Writing and analysing the masks take a tenth each.
const AVERAGING_SHARE: f64 = 0.8;

/// The captures of a calibration as paths.
pub type CaptureFiles = Captures<PathBuf>;

/// Receives the finished share of the work on \[0,1\]. Returning false stops the work.
pub type Progress<'a> = dyn FnMut(f64) -> bool + 'a;

/// The result of a calibration from captures.
#[derive(Debug)]
pub struct Calibrated {
    pub report: Report,
    /// Data type of the captures.
    pub sample: SampleType,
    /// Number of mask values below 0 that were set to 0.
    pub clipped_negatives: u64,
}

/// A report with its pictures.
#[derive(Debug)]
pub struct Report {
    /// The report on the masks.
    pub report: CalibrationReport,
    /// Name and PNG content of each map.
    pub maps: Vec<(String, Vec<u8>)>,
}

/// Computes masks \[B,H,W\] on \[0,1\] from captures, and reports on them.
///
/// The masks' scale is known only after the last one, so they are first written to `scratch`, an existing file. Then
/// the normalised masks go to the writer that `open` returns, with NaN where the map `bad` is not 0. No statistic of the
/// report has these pixels. Returns the report and the output of the writer.
///
/// Errors: unreadable or unusable captures or patterns; I/O; [`IntakeError::Stopped`]; those of `open`.
pub fn calibrate<W: Write>(
    files: &CaptureFiles,
    bad: Option<&Path>,
    limits: &Limits,
    scratch: &Path,
    open: impl FnOnce(&StackInfo) -> Result<StackWriter<W>, FormatError>,
    progress: &mut Progress<'_>,
) -> Result<(Calibrated, W)> {
    // Patterns are checked before the averaging, which may take an hour.
    let patterns = read_patterns(files, limits)?;
    let bad = match (bad, files.white.first()) {
        (Some(bad), Some(white)) => {
            let white = formats::open_stack(white, limits).map_err(IntakeError::format("white"))?;
            let StackInfo { height, width, .. } = *white.info();
            Some(bad_pixels(bad, (height, width), limits)?)
        }
        _ => None,
    };
    let captured = average_masks(files, bad.as_ref(), limits, scratch, progress)?;
    let raw = Reader::open(scratch, limits)?;
    let to = open(raw.info())?;
    let masks = write_scaled(&raw, captured.scale, to, progress)?;
    let figures = study(&raw, captured.scale, progress)?;
    let findings = judge_masks(&figures, patterns.as_ref().map(|patterns| patterns.view()));
    let report = report_on(&figures, Some(&captured), findings)?;
    let Captured { sample, clipped_negatives, .. } = captured;
    Ok((Calibrated { report, sample, clipped_negatives }, masks))
}

/// Reports on uploaded masks \[B,H,W\] on \[0,1\]. `spectral` is true for the bands of one mask.
///
/// Errors: unreadable masks; [`IntakeError::Stopped`].
pub fn report(masks: &Reader, spectral: bool, progress: &mut Progress<'_>) -> Result<Report> {
    let figures = study(masks, 1.0, progress)?;
    let mut findings = judge_masks(&figures, None);
    findings.retain(|finding| !spectral || Dispersion::admits(finding.code));
    report_on(&figures, None, findings)
}

/// The planned cost of a calibration from captures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// Rows and columns of the captures.
    pub size: (usize, usize),
    /// Size of the masks in bytes.
    pub bytes: u64,
    /// CPU time in seconds.
    pub seconds: f64,
}

/// Plans a calibration from the headers of its captures. All must have one size, and averaging them must not take
/// longer than [`MAX_CALIBRATION_SECONDS`].
///
/// Errors: [`IntakeError::Format`] for unreadable files; [`IntakeError::Size`] for files that differ in size, or too
/// many captures. Places are JSON pointers into the request.
pub fn plan(files: &CaptureFiles, limits: &Limits) -> Result<Plan> {
    let (mut first, mut captured) = (None, 0);
    for (place, paths) in files.lists() {
        for (index, path) in paths.iter().enumerate() {
            let place = format!("{place}/{index}");
            let opened = formats::open_stack(path, limits);
            let info = *opened.map_err(IntakeError::format(&place))?.info();
            let (height, width) = *first.get_or_insert((info.height, info.width));
            if (info.height, info.width) != (height, width) {
                let detail = format!(
                    "this capture is {}x{} (rows x columns), but the earlier ones are {height}x{width}: all captures \
                     must have the same size",
                    info.height, info.width
                );
                return Err(IntakeError::Size { place, detail });
            }
            captured += info.frames as u64;
        }
    }
    let (height, width) = first.unwrap_or_default();
    let (masks, pixels) = (files.masks.len(), height * width);
    let seconds = planned_seconds(captured * pixels as u64, masks, pixels);
    if seconds > MAX_CALIBRATION_SECONDS {
        let detail = format!(
            "{captured} captures of {height}x{width} pixels would take {seconds:.0} s of CPU time; the limit is \
             {MAX_CALIBRATION_SECONDS} s: use fewer repeats"
        );
        return Err(IntakeError::Size { place: "/captures".into(), detail });
    }
    Ok(Plan { size: (height, width), bytes: (masks * pixels * size_of::<f32>()) as u64, seconds })
}

/// The results of averaging the captures.
struct Captured {
    /// Largest value of all masks before normalisation: the share of the white's light where a mask is 1.
    scale: f32,
    figures: CaptureFigures,
    /// `white - black` \[H,W\]; NaN at bad pixels.
    illumination: Array2<f32>,
    sample: SampleType,
    clipped_negatives: u64,
}

/// Averages captures frame by frame without the pixels of a map, and writes the masks \[B,H,W\] before normalisation to `raw`.
fn average_masks(
    files: &CaptureFiles,
    bad: Option<&Array2<bool>>,
    limits: &Limits,
    raw: &Path,
    progress: &mut Progress<'_>,
) -> Result<Captured> {
    let total = files.masks.len() + 3;
    let mut done = 0;
    let mut average = |name: &str, paths: &[PathBuf]| {
        let whole = |share: f64| (f64::from(done) + share) / total as f64 * AVERAGING_SHARE;
        let place = |index| format!("captures of {name}, file {}", index + 1);
        let mut report = |share| progress(whole(share));
        let open = |path: &Path| formats::open_stack(path, limits);
        let averaged = average(paths, bad, files.saturation, open, place, &mut report);
        done += 1;
        averaged
    };
    let (white, sample) = average("white", &files.white)?;
    let (black, _) = average("black", &files.black)?;
    let black_with_mask = match files.black_with_mask.as_slice() {
        [] => None,
        paths => Some(average("black_with_mask", paths)?.0),
    };
    let references = References { white, black, black_with_mask };
    let calibrator = Calibrator::new(references)
        .map_err(|error| IntakeError::content("reference images", &error))?;
    let (height, width) = calibrator.illumination().dim();
    let raw = File::options().write(true).open(raw).map_err(FormatError::io("open the file"))?;
    let mut writer = planar::writer(BufWriter::new(raw), files.masks.len(), height, width)?;
    let (mut patterns, mut scale, mut clipped) = (Vec::new(), 0.0f32, 0);
    for (index, paths) in files.masks.iter().enumerate() {
        let name = format!("pattern {index} (counted from 0)");
        let (capture, _) = average(&name, paths)?;
        let mask =
            calibrator.mask(&capture).map_err(|error| IntakeError::content(&name, &error))?;
        writer.write_frame(mask.values.view())?;
        scale = scale.max(mask.largest);
        clipped += mask.not_positive;
        patterns.push(PatternFigures::new(&mask, capture.saturated, capture.drift));
    }
    writer.finish()?;
    if scale < MIN_OPEN {
        return Err(IntakeError::content(
            "patterns",
            &"no pattern is brighter than the dark frames: check that the light was on and that the LCoS showed the \
              patterns",
        ));
    }
    let figures = CaptureFigures::new(&calibrator, patterns);
    let illumination = calibrator.illumination().to_owned();
    Ok(Captured { scale, figures, illumination, sample, clipped_negatives: clipped })
}

/// Averages all frames of some files, which `open` opens, without the pixels of a map. `place` names a file in errors, by its index.
pub(super) fn average(
    paths: &[PathBuf],
    bad: Option<&Array2<bool>>,
    saturation: Option<u32>,
    open: impl Fn(&Path) -> Result<Box<dyn FrameReader + Send>, FormatError>,
    place: impl Fn(usize) -> String,
    progress: &mut Progress<'_>,
) -> Result<(Average, SampleType)> {
    let (mut repeats, mut sample) = (None, SampleType::F32);
    for (index, path) in paths.iter().enumerate() {
        let failed = |source| IntakeError::format(place(index))(source);
        let mut reader = open(path).map_err(failed)?;
        let info = *reader.info();
        sample = info.sample;
        let level = saturation_level(&info, saturation);
        let repeats = repeats.get_or_insert_with(|| {
            let repeats = Repeats::new(info.height, info.width, level);
            match bad {
                Some(bad) => repeats.without(bad),
                None => repeats,
            }
        });
        let mut frame = 0;
        while let Some(capture) = reader.next_frame().map_err(failed)? {
            let added = repeats.add(capture.view());
            added.map_err(|error| IntakeError::content(place(index), &error))?;
            frame += 1;
            let share = frame as f64 / info.frames as f64;
            report_progress(progress, (index as f64 + share) / paths.len() as f64)?;
        }
    }
    let average = repeats.unwrap_or_else(|| Repeats::new(0, 0, None)).average();
    Ok((average.map_err(|error| IntakeError::content(place(0), &error))?, sample))
}

/// Stored value from which a pixel is saturated: the stated one, or the largest of the file. Floats have no such
/// default.
#[allow(clippy::cast_precision_loss)] // camera values are small
pub(super) fn saturation_level(info: &StackInfo, stated: Option<u32>) -> Option<f32> {
    stated.map(|value| value as f32).or(info.largest)
}

/// Reports the finished share of the work. Errors: [`IntakeError::Stopped`].
fn report_progress(progress: &mut Progress<'_>, share: f64) -> Result<()> {
    if progress(share) { Ok(()) } else { Err(IntakeError::Stopped) }
}

/// Divides masks by their largest value.
fn normalise(masks: &mut Array3<f32>, scale: f32) {
    masks.mapv_inplace(|value| (value / scale).clamp(0.0, 1.0));
}

/// Writes the normalised masks.
fn write_scaled<W: Write>(
    raw: &Reader,
    scale: f32,
    mut to: StackWriter<W>,
    progress: &mut Progress<'_>,
) -> Result<W> {
    let StackInfo { frames, height, width, .. } = *raw.info();
    for frame in 0..frames {
        let mut mask = raw.read_window(frame..frame + 1, 0..height, 0..width)?;
        normalise(&mut mask, scale);
        to.write_frame(mask.index_axis(Axis(0), 0))?;
        report_progress(progress, AVERAGING_SHARE + 0.1 * (frame + 1) as f64 / frames as f64)?;
    }
    Ok(to.finish()?)
}

/// Reports on masks with these findings. `captured` is given for masks from captures.
fn report_on(
    figures: &MaskFigures,
    captured: Option<&Captured>,
    mut findings: Vec<optics::Finding>,
) -> Result<Report> {
    let mut maps = vec![
        ("mean".to_owned(), picture(&figures.mean)?),
        ("deviation".to_owned(), picture(&figures.deviation)?),
        ("gram".to_owned(), picture(&figures.gram)?),
    ];
    if let Some(captured) = captured {
        findings.extend(judge_captures(&captured.figures));
        maps.push(("illumination".to_owned(), picture(&captured.illumination)?));
    }
    let findings = findings.into_iter().map(Finding::from).collect();
    let captures = captured.map(|captured| (&captured.figures, captured.scale));
    let names = maps.iter().map(|(name, _)| name.clone()).collect();
    let report = CalibrationReport::new(figures, captures, findings, names);
    // JSON writes a number that is not finite as null, which no reader takes for a number.
    serde_json::to_string(&report)
        .and_then(|text| serde_json::from_str::<CalibrationReport>(&text))
        .map_err(|error| {
            let detail = format!(
                "a figure of the report is not finite ({error}): check the scale of the files"
            );
            IntakeError::content("the masks", &detail)
        })?;
    Ok(Report { report, maps })
}

/// Computes the statistics of masks, normalised by `scale`, band by band.
fn study(masks: &Reader, scale: f32, progress: &mut Progress<'_>) -> Result<MaskFigures> {
    let StackInfo { frames, height, width, .. } = *masks.info();
    let refused = |error| IntakeError::content("masks", &error);
    let rows = (BAND_BYTES / (frames * width * size_of::<f32>())).clamp(1, height);
    let mut study = MaskStudy::new(frames, height, width);
    for start in (0..height).step_by(rows) {
        let rows: Range<usize> = start..(start + rows).min(height);
        let end = rows.end;
        let mut band = masks.read_window(0..frames, rows, 0..width)?;
        normalise(&mut band, scale);
        study.add(band.view()).map_err(refused)?;
        report_progress(progress, 0.9 + 0.1 * end as f64 / height as f64)?;
    }
    study.finish().map_err(refused)
}

/// Reads the intended patterns \[B,h,w\] on \[0,1\], if there is a file of them.
fn read_patterns(files: &CaptureFiles, limits: &Limits) -> Result<Option<Array3<f32>>> {
    let Some(path) = &files.patterns else { return Ok(None) };
    let (info, patterns) = read_stack(path, limits).map_err(IntakeError::format("patterns"))?;
    let patterns = patterns / info.default_full_scale.unwrap_or(FullScale::ONE).value();
    check_patterns(patterns.view(), files.masks.len())
        .map_err(|error| IntakeError::content("patterns", &error))?;
    Ok(Some(patterns))
}

/// Encodes a map \[H,W\] as a PNG of at most [`PICTURE_SIDE`] pixels, from black at 0 to white at the largest value.
fn picture(map: &Array2<f32>) -> Result<Vec<u8>, FormatError> {
    let largest = map.fold(0.0f32, |largest, &value| largest.max(value));
    let white = if largest > 0.0 { largest } else { 1.0 };
    let picture = Picture::new(map.view(), Channels::Grey, (0.0, white))?;
    picture.within(PICTURE_SIDE).encode(Encoding::Png)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::{CaptureFiles, plan};
    use crate::job::MAX_CALIBRATION_SECONDS;
    use formats::Limits;

    #[test]
    fn calibrations_beyond_the_time_limit_are_refused_when_planned() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("repeats.npy");
        let mut header = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        header.extend(b"{'descr': '|u1', 'fortran_order': False, 'shape': (20, 3000, 3000), }");
        header.resize(127, b' ');
        header.push(b'\n');
        let mut file = std::fs::File::create(&path).unwrap();
        file.write_all(&header).unwrap();
        // A sparse file suffices, because only the header is read.
        file.set_len(128 + 20 * 3000 * 3000).unwrap();
        let files = |masks: usize, repeats: usize| CaptureFiles {
            masks: vec![vec![path.clone(); repeats]; masks],
            white: vec![path.clone()],
            black: vec![path.clone()],
            black_with_mask: Vec::new(),
            patterns: None,
            saturation: None,
        };
        let planned = plan(&files(10, 2), &Limits::default()).unwrap();
        assert_eq!(planned.bytes, 10 * 3000 * 3000 * 4);
        assert!((20.0..60.0).contains(&planned.seconds), "{planned:?}");
        let refused = plan(&files(64, 60), &Limits::default()).unwrap_err().to_string();
        assert!(refused.contains("76840 captures"), "{refused}");
        assert!(
            refused.contains(&format!("the limit is {MAX_CALIBRATION_SECONDS} s")),
            "{refused}"
        );
    }
}
