//! Reading the user's files, each error with the file's name.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, s};

use super::{CliError, npz};
use crate::formats::mat::{self, SceneArray};
use crate::formats::validate::{MaskCheck, MeasurementCheck};
use crate::formats::{self, FormatError, FrameReader, FullScale, Limits};
use crate::pipeline::sha256_of;

/// An input file, which array of it is meant if it is a .mat scene, and its stated full scale.
#[derive(Debug, Clone, Copy)]
pub(super) struct Source<'a> {
    pub(super) path: &'a Path,
    pub(super) array: SceneArray,
    pub(super) full_scale: Option<f32>,
}

/// An array on its own scale, and the full scale that brought it there.
pub(super) struct Scaled<T> {
    pub(super) array: T,
    pub(super) full_scale: f32,
}

impl<'a> Source<'a> {
    /// What the array is called in messages.
    fn what(&self) -> &'static str {
        match self.array {
            SceneArray::Masks => "masks",
            SceneArray::Measurements => "measurement",
            SceneArray::Truth => "frames",
        }
    }

    fn refused(&self) -> impl Fn(FormatError) -> CliError + use<'a> {
        let (what, path) = (self.what(), self.path);
        move |error| CliError::format(what, path, &error)
    }

    fn open(&self) -> Result<Box<dyn FrameReader + Send>, CliError> {
        let limits = Limits::default();
        let opened = match mat::is_mat(self.path) {
            Ok(true) => mat::open_array(self.path, self.array, &limits),
            Ok(false) => formats::open_stack(self.path, &limits),
            Err(error) => Err(error),
        };
        opened.map_err(self.refused())
    }

    fn scale(&self, reader: &dyn FrameReader) -> Result<FullScale, CliError> {
        match self.full_scale {
            Some(value) => FullScale::new(value).map_err(self.refused()),
            None => Ok(reader.info().default_full_scale),
        }
    }

    /// Masks \[B,H,W\] on \[0,1\], checked.
    pub(super) fn masks(&self) -> Result<Scaled<Array3<f32>>, CliError> {
        let mut reader = self.open()?;
        let scale = self.scale(&*reader)?;
        let mut stack = Stack::default();
        MaskCheck::run(&mut *reader, scale, |mask| stack.push(mask)).map_err(self.refused())?;
        Ok(Scaled { array: stack.into_array().map_err(self.refused())?, full_scale: scale.value() })
    }

    /// Snapshot `index` \[H,W\] of a measurement, checked, and how many there are.
    pub(super) fn snapshot(&self, index: usize) -> Result<(Scaled<Array2<f32>>, usize), CliError> {
        let mut reader = self.open()?;
        let scale = self.scale(&*reader)?;
        let (mut next, mut found) = (0, None);
        let statistics = MeasurementCheck::run(&mut *reader, scale, |snapshot| {
            if next == index {
                found = Some(snapshot.to_owned());
            }
            next += 1;
            Ok::<(), FormatError>(())
        });
        let snapshots = statistics.map_err(self.refused())?.snapshots;
        let array = found.ok_or_else(|| {
            CliError::Input(format!(
                "measurement {} holds {snapshots} snapshots, counted from 0; there is no snapshot \
                 {index}",
                self.path.display()
            ))
        })?;
        Ok((Scaled { array, full_scale: scale.value() }, snapshots))
    }

    /// Frames \[T,H,W\] divided by the full scale, all finite.
    fn frames(&self) -> Result<Array3<f32>, CliError> {
        let mut reader = self.open()?;
        let scale = self.scale(&*reader)?;
        let mut stack = Stack::default();
        while let Some(frame) = reader.next_frame().map_err(self.refused())? {
            stack.push(frame.view()).map_err(self.refused())?;
        }
        let mut array = stack.into_array().map_err(self.refused())?;
        array /= scale.value();
        if let Some(((k, i, j), value)) = array.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(CliError::Input(format!(
                "frames {}: {value} at frame {k}, row {i}, column {j} (counted from 0); every \
                 value must be finite",
                self.path.display()
            )));
        }
        Ok(array)
    }

    /// As [`Source::frames`], or none if this is a .mat scene that goes without.
    fn frames_if_any(&self) -> Result<Option<Array3<f32>>, CliError> {
        let limits = Limits::default();
        if mat::is_mat(self.path).map_err(self.refused())?
            && let Err(FormatError::MissingArray { .. }) =
                mat::open_array(self.path, self.array, &limits)
        {
            return Ok(None);
        }
        self.frames().map(Some)
    }

    /// The frames \[B,H,W\] of one snapshot. A .mat scene may go without; another file may not.
    pub(super) fn truth(
        &self,
        (frames, height, width): (usize, usize, usize),
        snapshot: usize,
        snapshots: usize,
    ) -> Result<Option<Array3<f32>>, CliError> {
        let Some(truth) = self.frames_if_any()? else { return Ok(None) };
        let (count, rows, columns) = truth.dim();
        let first = match count {
            _ if (rows, columns) != (height, width) => None,
            _ if count == frames => Some(0),
            _ if count == frames * snapshots => Some(snapshot * frames),
            _ => None,
        };
        match first {
            Some(first) => Ok(Some(truth.slice(s![first..first + frames, .., ..]).to_owned())),
            None => Err(CliError::Input(format!(
                "the true frames {} are {count}x{rows}x{columns}; {frames}x{height}x{width} (of \
                 the snapshot) or {}x{height}x{width} (of all snapshots) would fit",
                self.path.display(),
                frames * snapshots
            ))),
        }
    }

    /// SHA-256 of the file.
    pub(super) fn sha256(&self) -> Result<String, CliError> {
        let hashed = File::open(self.path).and_then(|mut file| sha256_of(&mut file));
        hashed.map_err(|error| CliError::file("read", self.path, &error))
    }
}

/// Frames \[T,H,W\] of a file, or of a folder of pictures in the order of their names.
pub(super) fn read_clip(path: &Path, full_scale: Option<f32>) -> Result<Array3<f32>, CliError> {
    let source = |path| Source { path, array: SceneArray::Truth, full_scale };
    if npz::is_npz(path) {
        return source(npz::extract(path)?.path()).frames();
    }
    if !path.is_dir() {
        return source(path).frames();
    }
    let unreadable = |error| CliError::Input(format!("cannot read {}: {error}", path.display()));
    let entries = fs::read_dir(path).map_err(unreadable)?;
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in entries {
        let file = entry.map_err(unreadable)?.path();
        if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")) {
            files.push(file);
        }
    }
    files.sort();
    let mut stack = Stack::default();
    let mut first = None;
    for file in &files {
        let picture = source(file).frames()?;
        let size = (picture.dim().1, picture.dim().2);
        let (height, width) = *first.get_or_insert(size);
        if size != (height, width) {
            return Err(CliError::Input(format!(
                "{} is {}x{}, but the pictures before it are {height}x{width}",
                file.display(),
                size.0,
                size.1
            )));
        }
        picture.outer_iter().try_for_each(|frame| stack.push(frame))?;
    }
    if files.is_empty() {
        let path = path.display();
        return Err(CliError::Input(format!("the folder {path} holds no .png pictures")));
    }
    Ok(stack.into_array()?)
}

/// Frames of one size as they arrive.
#[derive(Default)]
struct Stack {
    values: Vec<f32>,
    frames: usize,
    size: (usize, usize),
}

impl Stack {
    fn push(&mut self, frame: ndarray::ArrayView2<'_, f32>) -> Result<(), FormatError> {
        self.values.extend(frame.iter());
        self.frames += 1;
        self.size = frame.dim();
        Ok(())
    }

    fn into_array(self) -> Result<Array3<f32>, FormatError> {
        let shape = (self.frames, self.size.0, self.size.1);
        Array3::from_shape_vec(shape, self.values)
            .map_err(|error| FormatError::Internal(error.to_string()))
    }
}
