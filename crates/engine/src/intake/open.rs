//! Opens a file. Its content determines the format; the full scale is the stated one, or that of the data type.

use std::path::Path;

use ndarray::Array2;

use super::IntakeError;
use crate::intake::error::Result;
use crate::job::MAX_MASKS;
use formats::mat::SceneArray;
use formats::{
    self, Axes, Expected, FormatError, FrameReader, FullScale, Limits, StackInfo, Wanted,
};

/// A file, and the array in it if it has several.
#[derive(Debug, Clone)]
pub struct Source<'a> {
    pub path: &'a Path,
    pub array: SceneArray,
    /// Name of the array in the file; `None` for [`SceneArray::name`].
    pub named: Option<String>,
    /// Order of the axes; `None` for automatic detection.
    pub axes: Option<Axes>,
    /// Expected rows and columns of a frame, if known.
    pub size: Option<(usize, usize)>,
    /// Stored value that means 1; `None` for the default of the file.
    pub full_scale: Option<f32>,
    pub limits: Limits,
    /// Name of the file in errors; empty for an upload, whose path is internal.
    pub name: String,
}

/// An open stack, whose frames are read one at a time.
pub struct Opened {
    pub info: StackInfo,
    pub full_scale: FullScale,
    pub(super) reader: Box<dyn FrameReader + Send>,
    pub(super) name: String,
}

impl<'a> Source<'a> {
    /// A file on the user's machine.
    pub fn file(path: &'a Path, array: SceneArray, full_scale: Option<f32>) -> Self {
        let kind = match array {
            SceneArray::Masks => "masks",
            SceneArray::Measurements => "measurement",
            SceneArray::Truth => "frames",
        };
        let name = format!("{kind} {}", path.display());
        Self { name, ..Self::upload(path, array, full_scale, Limits::default()) }
    }

    /// An upload of the service.
    pub fn upload(
        path: &'a Path,
        array: SceneArray,
        full_scale: Option<f32>,
        limits: Limits,
    ) -> Self {
        let (named, axes, size, name) = (None, None, None, String::new());
        Self { path, array, named, axes, size, full_scale, limits, name }
    }

    /// Selects the array with this name.
    pub fn named(self, named: Option<String>) -> Self {
        Self { named, ..self }
    }

    /// States the order of the axes, or the rows and columns of a frame.
    pub fn arranged(self, axes: Option<Axes>, size: Option<(usize, usize)>) -> Self {
        Self { axes, size, ..self }
    }

    /// Opens the file.
    ///
    /// Errors: [`IntakeError::Format`] if the file is missing, unsupported or larger than the limits, if it does not
    /// have the array, if several orders of its axes fit, or if the full scale is unknown.
    pub fn open(&self) -> Result<Opened> {
        let max_frames = (self.array == SceneArray::Masks).then_some(MAX_MASKS);
        let expected = Expected { axes: self.axes, max_frames, size: self.size };
        let wanted = Wanted { array: self.array, name: self.named.as_deref(), expected };
        let opened = formats::open_array(self.path, wanted, &self.limits);
        self.with_full_scale(opened.map_err(IntakeError::format(&self.name))?)
    }

    /// Opens a colour clip with frames \[H,3W\], which interleave red, green and blue. `None` if the file is not in
    /// colour.
    ///
    /// Errors: as [`Self::open`].
    pub fn open_colours(&self) -> Result<Option<Opened>> {
        let opened = formats::open_colours(self.path, &self.limits);
        let reader = opened.map_err(IntakeError::format(&self.name))?;
        reader.map(|reader| self.with_full_scale(reader)).transpose()
    }

    fn with_full_scale(&self, reader: Box<dyn FrameReader + Send>) -> Result<Opened> {
        let info = *reader.info();
        let full_scale = match (self.full_scale, info.default_full_scale) {
            (Some(value), _) => FullScale::new(value),
            (None, Some(default)) => Ok(default),
            // Masks of 0 and 1. For larger values the check asks for the full scale.
            (None, None) if self.array == SceneArray::Masks => Ok(FullScale::ONE),
            (None, None) => Err(FormatError::FullScaleNeeded(info.sample.to_string())),
        };
        let full_scale = full_scale.map_err(IntakeError::format(&self.name))?;
        Ok(Opened { info, full_scale, reader, name: self.name.clone() })
    }
}

impl Opened {
    /// Returns the next frame \[H,W\] divided by the full scale; `None` after the last one.
    pub fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let frame = self.reader.next_frame().map_err(IntakeError::format(&self.name))?;
        Ok(frame.map(|frame| frame / self.full_scale.value()))
    }
}
