//! Opening a file: its format is told by its content, its full scale is the one stated or its type's.

use std::path::Path;

use ndarray::Array2;

use super::IntakeError;
use crate::intake::error::Result;
use crate::job::MOST_MASKS;
use formats::mat::SceneArray;
use formats::{
    self, Axes, Expected, FormatError, FrameReader, FullScale, Limits, StackInfo, Wanted,
};

/// A file, and which array of it is meant if it has several.
#[derive(Debug, Clone)]
pub struct Source<'a> {
    pub path: &'a Path,
    pub array: SceneArray,
    /// What that array is called there; none for the field's own name.
    pub named: Option<String>,
    /// The order of its axes; none for the one that fits.
    pub axes: Option<Axes>,
    /// Rows and columns of a frame, where they are known.
    pub size: Option<(usize, usize)>,
    /// The stored number that means 1; none for the file's own.
    pub full_scale: Option<f32>,
    pub limits: Limits,
    /// What errors call it; empty for an upload, of which there is one, and whose path is ours.
    pub name: String,
}

/// A stack whose frames are read one at a time.
pub struct Opened {
    pub info: StackInfo,
    pub full_scale: FullScale,
    pub(super) reader: Box<dyn FrameReader + Send>,
    pub(super) name: String,
}

impl<'a> Source<'a> {
    /// A file that the user has named.
    pub fn file(path: &'a Path, array: SceneArray, full_scale: Option<f32>) -> Self {
        let what = match array {
            SceneArray::Masks => "masks",
            SceneArray::Measurements => "measurement",
            SceneArray::Truth => "frames",
        };
        let name = format!("{what} {}", path.display());
        Self { name, ..Self::upload(path, array, full_scale, Limits::default()) }
    }

    /// A file of the service.
    pub fn upload(
        path: &'a Path,
        array: SceneArray,
        full_scale: Option<f32>,
        limits: Limits,
    ) -> Self {
        let (named, axes, size, name) = (None, None, None, String::new());
        Self { path, array, named, axes, size, full_scale, limits, name }
    }

    /// The same file, of which the array with this name is meant.
    pub fn named(self, named: Option<String>) -> Self {
        Self { named, ..self }
    }

    /// The same file, whose axes are stated, or whose frames have these rows and columns.
    pub fn arranged(self, axes: Option<Axes>, size: Option<(usize, usize)>) -> Self {
        Self { axes, size, ..self }
    }

    /// Opens it.
    /// Errors: no file, or none of a format that is read; larger than the limits; no such array; axes in
    /// several orders that fit; no full scale.
    pub fn open(&self) -> Result<Opened> {
        let most_frames = (self.array == SceneArray::Masks).then_some(MOST_MASKS);
        let expected = Expected { axes: self.axes, most_frames, size: self.size };
        let wanted = Wanted { array: self.array, name: self.named.as_deref(), expected };
        let opened = formats::open_array(self.path, wanted, &self.limits);
        self.opened(opened.map_err(IntakeError::format(&self.name))?)
    }

    /// The same of a clip of colours: frames \[H,3W\], red, green and blue of each pixel. None if the file is of
    /// another kind.
    pub fn open_colours(&self) -> Result<Option<Opened>> {
        let opened = formats::open_colours(self.path, &self.limits);
        let reader = opened.map_err(IntakeError::format(&self.name))?;
        reader.map(|reader| self.opened(reader)).transpose()
    }

    fn opened(&self, reader: Box<dyn FrameReader + Send>) -> Result<Opened> {
        let info = *reader.info();
        let full_scale = match (self.full_scale, info.default_full_scale) {
            (Some(value), _) => FullScale::new(value),
            (None, Some(own)) => Ok(own),
            // Of 0 and 1; a larger value is refused with the question for the scale.
            (None, None) if self.array == SceneArray::Masks => Ok(FullScale::ONE),
            (None, None) => Err(FormatError::FullScaleNeeded(info.sample.to_string())),
        };
        let full_scale = full_scale.map_err(IntakeError::format(&self.name))?;
        Ok(Opened { info, full_scale, reader, name: self.name.clone() })
    }
}

impl Opened {
    /// The next frame \[H,W\] divided by the full scale; none after the last.
    pub fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let frame = self.reader.next_frame().map_err(IntakeError::format(&self.name))?;
        Ok(frame.map(|frame| frame / self.full_scale.value()))
    }
}
