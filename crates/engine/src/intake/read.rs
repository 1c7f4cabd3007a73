//! Reads whole arrays into memory, for commands: masks, snapshots and clips.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array3, ArrayView2, s};

use super::IntakeError;
use super::bad_pixels::bad_pixels;
use super::check::{Exposure, MaskLight, masks, measurement};
use super::open::{Opened, Source};
use crate::intake::error::Result;
use crate::job::Finding;
use formats::mat::SceneArray;
use formats::{Axes, Channels, FormatError, natural_key};

/// An array divided by its full scale.
#[derive(Debug)]
pub struct Scaled<T> {
    pub array: T,
    /// Stored value that means 1.
    pub full_scale: f32,
    /// Order in which the axes of the file were read; `None` for pictures.
    pub axes: Option<Axes>,
}

/// Reads and checks masks \[B,H,W\] on \[0,1\]. Pixels of the map of bad pixels, if there is one, become NaN.
///
/// Errors: as [`masks`].
pub fn read_masks(source: &Source<'_>, bad: Option<&Path>) -> Result<Scaled<Array3<f32>>> {
    let opened = source.open()?;
    let (full_scale, axes) = (opened.full_scale.value(), opened.info.axes);
    let size = (opened.info.height, opened.info.width);
    let bad = bad.map(|bad| bad_pixels(bad, size, &source.limits)).transpose()?;
    let mut stack = Stack::default();
    masks(opened, bad.as_ref(), |mask| stack.push(mask))?;
    Ok(Scaled { array: stack.into_array()?, full_scale, axes })
}

/// Some snapshots of a measurement, less their dark.
#[derive(Debug)]
pub struct Snapshots {
    /// \[S,H,W\].
    pub measurement: Scaled<Array3<f32>>,
    /// Number of snapshots in the file.
    pub count: usize,
    /// Findings on these snapshots.
    pub findings: Vec<Finding>,
}

/// Reads and checks the snapshots from `first` to `last`, both included, or to the end for `None`.
///
/// Errors: as [`measurement`]; [`IntakeError::Content`] for snapshots that do not exist.
pub fn read_snapshots(
    source: &Source<'_>,
    exposure: &Exposure,
    behind: &MaskLight,
    (first, last): (usize, Option<usize>),
) -> Result<Snapshots> {
    let opened = source.open()?;
    let (full_scale, axes) = (opened.full_scale.value(), opened.info.axes);
    let snapshots = opened.info.frames;
    let last = last.unwrap_or(snapshots.saturating_sub(1));
    if last >= snapshots || last < first {
        let requested =
            if first == last { first.to_string() } else { format!("{first} to {last}") };
        let detail = format!(
            "{} has {snapshots} snapshots, counted from 0; there is no snapshot {requested}",
            source.name
        );
        return Err(IntakeError::content("", &detail));
    }
    let (mut next, mut selected) = (0, Stack::default());
    let mut findings = measurement(opened, exposure, behind, &source.limits, |snapshot| {
        if (first..=last).contains(&next) {
            selected.push(snapshot)?;
        }
        next += 1;
        Ok(())
    })?;
    let selects = |snapshot: u32| (first..=last).contains(&(snapshot as usize));
    findings.retain(|finding| finding.snapshot.is_none_or(selects));
    let measurement = Scaled { array: selected.into_array()?, full_scale, axes };
    Ok(Snapshots { measurement, count: snapshots, findings })
}

/// Reads the true frames \[S B,H,W\] of the snapshots `which`, from a file that has those of these snapshots or of all
/// `snapshots`. `None` if a .mat scene has no truth. Behind a mosaic the truth may be in colour \[S B,H,3W\], as the
/// returned channels indicate.
///
/// Errors: as [`Source::open`]; [`IntakeError::Size`] for other sizes.
pub fn read_truth(
    source: &Source<'_>,
    (frames, height, width): (usize, usize, usize),
    mosaic: bool,
    which: Range<usize>,
    snapshots: usize,
) -> Result<Option<(Array3<f32>, Channels)>> {
    let colours = if mosaic { source.open_colours()? } else { None };
    let channels = if colours.is_some() { Channels::Rgb } else { Channels::Grey };
    let truth = match colours
        .map_or_else(|| source.open(), Ok)
        .and_then(|opened| collect_frames(source, opened))
    {
        Err(IntakeError::Format { source: FormatError::MissingArray { .. }, .. }) => {
            return Ok(None);
        }
        truth => truth?,
    };
    let width = width * channels.count();
    let (count, rows, columns) = truth.dim();
    let needed = frames * which.len();
    let first = match count {
        _ if (rows, columns) != (height, width) => None,
        _ if count == needed => Some(0),
        _ if count == frames * snapshots => Some(which.start * frames),
        _ => None,
    };
    let Some(first) = first else {
        let detail = format!(
            "the true frames {} are {count}x{rows}x{columns}, but {needed}x{height}x{width} (for the \
             reconstructed snapshots) or {}x{height}x{width} (for all snapshots) are needed",
            source.path.display(),
            frames * snapshots
        );
        return Err(IntakeError::Size { place: String::new(), detail });
    };
    Ok(Some((truth.slice(s![first..first + needed, .., ..]).to_owned(), channels)))
}

/// Reads frames \[T,H,W\], divided by the full scale, from a file, or from a folder of PNG pictures in the natural order
/// of their names.
///
/// Errors: as [`Source::open`]; [`IntakeError::Content`] for values that are not finite, and for pictures of different
/// sizes.
pub fn read_clip(path: &Path, full_scale: Option<f32>) -> Result<Array3<f32>> {
    clip(path, full_scale, read_frames)
}

/// Reads colour frames \[T,H,3W\] like [`read_clip`].
///
/// Errors: as [`read_clip`]; [`IntakeError::Content`] for frames without colours.
pub fn read_colours(path: &Path, full_scale: Option<f32>) -> Result<Array3<f32>> {
    clip(path, full_scale, |source| match source.open_colours()? {
        Some(opened) => collect_frames(source, opened),
        None => {
            let problem = "the frames are not in colour; an array [frame, row, column, 3] or RGB pictures are needed \
                           (python -c \"import numpy as n; n.save('colours.npy', \
                           n.repeat(n.load('FILE.npy')[..., None], 3, -1))\" converts grey frames)";
            Err(IntakeError::content(&source.name, &problem))
        }
    })
}

fn clip(
    path: &Path,
    full_scale: Option<f32>,
    read_frames: impl Fn(&Source<'_>) -> Result<Array3<f32>>,
) -> Result<Array3<f32>> {
    let source = |path| Source::file(path, SceneArray::Truth, full_scale);
    if !path.is_dir() {
        return read_frames(&source(path));
    }
    let refused = |detail: String| IntakeError::content("", &detail);
    let unreadable = |error| refused(format!("can't read {}: {error}", path.display()));
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(path).map_err(unreadable)? {
        let file = entry.map_err(unreadable)?.path();
        if file.extension().is_some_and(|kind| kind.eq_ignore_ascii_case("png")) {
            files.push(file);
        }
    }
    let name = |file: &PathBuf| file.file_name().map(|name| name.to_string_lossy().into_owned());
    files.sort_by_cached_key(|file| natural_key(&name(file).unwrap_or_default()));
    let mut stack = Stack::default();
    for file in &files {
        let picture = read_frames(&source(file))?;
        let (_, rows, columns) = picture.dim();
        let (height, width) = stack.size;
        if stack.frames > 0 && (rows, columns) != (height, width) {
            return Err(refused(format!(
                "{} is {rows}x{columns}, but the earlier pictures are {height}x{width}: all must have the same size",
                file.display(),
            )));
        }
        picture.outer_iter().try_for_each(|frame| stack.push(frame))?;
    }
    if files.is_empty() {
        return Err(refused(format!("the folder {} contains no .png pictures", path.display())));
    }
    stack.into_array()
}

/// Reads frames \[T,H,W\] divided by the full scale.
fn read_frames(source: &Source<'_>) -> Result<Array3<f32>> {
    collect_frames(source, source.open()?)
}

/// Collects all frames of an open source. All values must be finite.
fn collect_frames(source: &Source<'_>, mut opened: Opened) -> Result<Array3<f32>> {
    let mut stack = Stack::default();
    while let Some(frame) = opened.next_frame()? {
        if let Some(((row, column), value)) = frame.indexed_iter().find(|(_, v)| !v.is_finite()) {
            let problem = format!(
                "the value at frame {}, row {row}, column {column} (counted from 0) is {value}; all values must \
                 be finite",
                stack.frames
            );
            return Err(IntakeError::content(&source.name, &problem));
        }
        stack.push(frame.view())?;
    }
    stack.into_array()
}

/// Collects frames of one size.
#[derive(Default)]
struct Stack {
    values: Vec<f32>,
    frames: usize,
    size: (usize, usize),
}

impl Stack {
    fn push(&mut self, frame: ArrayView2<'_, f32>) -> Result<(), FormatError> {
        self.values.extend(frame.iter());
        self.frames += 1;
        self.size = frame.dim();
        Ok(())
    }

    fn into_array(self) -> Result<Array3<f32>> {
        let shape = (self.frames, self.size.0, self.size.1);
        Array3::from_shape_vec(shape, self.values)
            .map_err(|error| FormatError::Internal(error.to_string()).into())
    }
}
