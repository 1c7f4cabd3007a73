//! Whole arrays in memory, for commands: a snapshot with its masks, and clips.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array3, ArrayView2, s};

use super::IntakeError;
use super::check::{Exposure, Passed, masks, measurement};
use super::open::{Opened, Source};
use crate::intake::error::Result;
use formats::mat::SceneArray;
use formats::{Axes, Channels, FormatError};

/// An array on its own scale, and the full scale that brought it there.
#[derive(Debug)]
pub struct Scaled<T> {
    pub array: T,
    pub full_scale: f32,
    /// How the axes of the file were read; none for pictures.
    pub axes: Option<Axes>,
}

/// Masks \[B,H,W\] on \[0,1\], checked.
pub fn read_masks(source: &Source<'_>) -> Result<Scaled<Array3<f32>>> {
    let opened = source.open()?;
    let (full_scale, axes) = (opened.full_scale.value(), opened.info.axes);
    let mut stack = Stack::default();
    masks(opened, |mask| stack.push(mask))?;
    Ok(Scaled { array: stack.into_array()?, full_scale, axes })
}

/// Some snapshots of a measurement, less their dark.
#[derive(Debug)]
pub struct Snapshots {
    /// \[S,H,W\].
    pub measurement: Scaled<Array3<f32>>,
    /// Number of snapshots in the file.
    pub count: usize,
    /// Findings and saturation of these snapshots.
    pub passed: Passed,
}

/// Snapshots of a measurement, checked. They are given by the indices of the first and the last; without a
/// last one, to its end.
pub fn read_snapshots(
    source: &Source<'_>,
    exposure: &Exposure,
    (first, last): (usize, Option<usize>),
) -> Result<Snapshots> {
    let opened = source.open()?;
    let (full_scale, axes) = (opened.full_scale.value(), opened.info.axes);
    let snapshots = opened.info.frames;
    let last = last.unwrap_or(snapshots.saturating_sub(1));
    if last >= snapshots || last < first {
        let asked = if first == last { first.to_string() } else { format!("{first} to {last}") };
        let detail = format!(
            "{} holds {snapshots} snapshots, counted from 0; there is no snapshot {asked}",
            source.name
        );
        return Err(IntakeError::content("", &detail));
    }
    let (mut next, mut found) = (0, Stack::default());
    let mut passed = measurement(opened, exposure, &source.limits, |snapshot| {
        if (first..=last).contains(&next) {
            found.push(snapshot)?;
        }
        next += 1;
        Ok(())
    })?;
    if let Some(shares) = &mut passed.saturated {
        *shares = shares.get(first..=last).unwrap_or_default().to_vec();
    }
    let measurement = Scaled { array: found.into_array()?, full_scale, axes };
    Ok(Snapshots { measurement, count: snapshots, passed })
}

/// The true frames \[S B,H,W\] of some snapshots of a measurement, of a file that has those of these
/// snapshots or of all. A .mat scene may go without; another file may not. Behind a mosaic they may have colours
/// \[S B,H,3W\], too, which is told.
/// Errors: a file that can't be read; other sizes.
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
        .and_then(|opened| frames_of(source, opened))
    {
        Err(IntakeError::Format { source: FormatError::MissingArray { .. }, .. }) => {
            return Ok(None);
        }
        truth => truth?,
    };
    let width = width * channels.count();
    let (count, rows, columns) = truth.dim();
    let wanted = frames * which.len();
    let first = match count {
        _ if (rows, columns) != (height, width) => None,
        _ if count == wanted => Some(0),
        _ if count == frames * snapshots => Some(which.start * frames),
        _ => None,
    };
    let Some(first) = first else {
        let detail = format!(
            "the true frames {} are {count}x{rows}x{columns}; {wanted}x{height}x{width} (of what is \
             reconstructed) or {}x{height}x{width} (of all snapshots) would fit",
            source.path.display(),
            frames * snapshots
        );
        return Err(IntakeError::Size { place: String::new(), detail });
    };
    Ok(Some((truth.slice(s![first..first + wanted, .., ..]).to_owned(), channels)))
}

/// Frames \[T,H,W\] of a file, or of a folder of pictures in the order of their names, divided by the full
/// scale; all finite.
/// Errors: files that can't be read; pictures of different sizes.
pub fn read_clip(path: &Path, full_scale: Option<f32>) -> Result<Array3<f32>> {
    clip(path, full_scale, read_frames)
}

/// The same of frames of colours \[T,H,3W\].
/// Errors: as [`read_clip`]; frames without colours.
pub fn read_colours(path: &Path, full_scale: Option<f32>) -> Result<Array3<f32>> {
    clip(path, full_scale, |source| match source.open_colours()? {
        Some(opened) => frames_of(source, opened),
        None => {
            let problem = "they have no colours; an array [frame, row, column, 3] or pictures of red, green and \
                           blue are needed (python -c \"import numpy as n; n.save('colours.npy', \
                           n.repeat(n.load('FILE.npy')[..., None], 3, -1))\" makes grey ones of the form)";
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
    let unreadable = |error| refused(format!("cannot read {}: {error}", path.display()));
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(path).map_err(unreadable)? {
        let file = entry.map_err(unreadable)?.path();
        if file.extension().is_some_and(|kind| kind.eq_ignore_ascii_case("png")) {
            files.push(file);
        }
    }
    files.sort();
    let mut stack = Stack::default();
    for file in &files {
        let picture = read_frames(&source(file))?;
        let (_, rows, columns) = picture.dim();
        let (height, width) = stack.size;
        if stack.frames > 0 && (rows, columns) != (height, width) {
            return Err(refused(format!(
                "{} is {rows}x{columns}, but the pictures before it are {height}x{width}",
                file.display(),
            )));
        }
        picture.outer_iter().try_for_each(|frame| stack.push(frame))?;
    }
    if files.is_empty() {
        return Err(refused(format!("the folder {} holds no .png pictures", path.display())));
    }
    stack.into_array()
}

/// Frames \[T,H,W\] divided by the full scale, all finite.
fn read_frames(source: &Source<'_>) -> Result<Array3<f32>> {
    frames_of(source, source.open()?)
}

/// All frames of what was opened of a source.
fn frames_of(source: &Source<'_>, mut opened: Opened) -> Result<Array3<f32>> {
    let mut stack = Stack::default();
    while let Some(frame) = opened.next_frame()? {
        if let Some(((row, column), value)) = frame.indexed_iter().find(|(_, v)| !v.is_finite()) {
            let problem = format!(
                "{value} at frame {}, row {row}, column {column} (counted from 0); every value must \
                 be finite",
                stack.frames
            );
            return Err(IntakeError::content(&source.name, &problem));
        }
        stack.push(frame.view())?;
    }
    stack.into_array()
}

/// Frames of one size as they arrive.
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
