//! Opens a file. Its content determines the format; the full scale is the stated one, or that of the data type.

use std::path::Path;

use ndarray::Array2;

use super::IntakeError;
use super::spectral::sheared;
use crate::intake::error::Result;
use crate::job::{Dispersion, MAX_MASKS, Reading, ScaleBasis};
use formats::mat::SceneArray;
use formats::{
    self, Axes, Expected, FormatError, FrameReader, FullScale, Limits, Packing, SampleType,
    Selection, StackInfo, Wanted,
};

/// A file, and the array in it if it has several.
#[derive(Debug, Clone)]
pub struct Source<'a> {
    pub path: &'a Path,
    pub array: SceneArray,
    /// Name of the array in the file; `None` for [`SceneArray::name`], or for the only array.
    pub named: Option<String>,
    /// Order of the axes; `None` for automatic detection.
    pub axes: Option<Axes>,
    /// Expected rows and columns of a frame, if known.
    pub size: Option<(usize, usize)>,
    /// The part that is read.
    pub part: Selection,
    /// How pixels are packed; `None` for one number per pixel.
    pub packing: Option<Packing>,
    /// Makes the masks of all bands from the only mask of the file.
    pub dispersion: Option<Dispersion>,
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
    /// The part of the file and the reason for the full scale.
    pub reading: Reading,
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
        let (part, packing, dispersion) = (Selection::default(), None, None);
        Self { path, array, named, axes, size, part, packing, dispersion, full_scale, limits, name }
    }

    /// Selects the array with this name.
    pub fn named(self, named: Option<String>) -> Self {
        Self { named, ..self }
    }

    /// States the order of the axes, or the rows and columns of a frame.
    pub fn arranged(self, axes: Option<Axes>, size: Option<(usize, usize)>) -> Self {
        Self { axes, size, ..self }
    }

    /// Selects a part of the file, and states how its pixels are packed.
    pub fn part(self, part: Selection, packing: Option<Packing>) -> Self {
        Self { part, packing, ..self }
    }

    /// Makes the masks of the bands of a spectral camera from the only mask of the file.
    pub fn dispersed(self, dispersion: Option<Dispersion>) -> Self {
        Self { dispersion, ..self }
    }

    /// Opens the file. Masks of integers that are all 0 or 1 are closed and open, whatever their type.
    ///
    /// Errors: [`IntakeError::Format`] if the file is missing, unsupported or larger than the limits, if it does not
    /// have the array, if several orders of its axes fit, or if the full scale is unknown;
    /// [`IntakeError::Content`] if the masks of bands can't be made from the file.
    pub fn open(&self) -> Result<Opened> {
        let mut opened = self.with_full_scale(self.open_array()?)?;
        let is_default = opened.reading.scale_basis == ScaleBasis::Type;
        let integers = !matches!(
            opened.info.sample,
            SampleType::Bool | SampleType::F16 | SampleType::F32 | SampleType::F64
        );
        // Too many masks are refused without a look at their values.
        let masks = self.array == SceneArray::Masks && opened.info.frames <= MAX_MASKS;
        if masks && is_default && integers && self.is_binary()? {
            opened.full_scale = FullScale::ONE;
            opened.reading.scale_basis = ScaleBasis::Values;
        }
        if let Some(dispersion) = &self.dispersion {
            opened.reader = sheared(opened.reader, dispersion, &self.limits, &self.name)?;
            opened.info = *opened.reader.info();
        }
        Ok(opened)
    }

    fn open_array(&self) -> Result<Box<dyn FrameReader + Send>> {
        // A larger file may have the selected frames.
        let limited = self.array == SceneArray::Masks && self.part.frames.is_none();
        let size = self.size.filter(|_| self.part.crop.is_none());
        let expected = Expected { axes: self.axes, max_frames: limited.then_some(MAX_MASKS), size };
        let wanted = Wanted {
            array: self.array,
            name: self.named.as_deref(),
            expected,
            part: self.part,
            packing: self.packing,
        };
        let opened = formats::open_array(self.path, wanted, &self.limits);
        opened.map_err(IntakeError::format(&self.name))
    }

    /// True if all values are 0 or 1. Reads the file up to the first other value.
    fn is_binary(&self) -> Result<bool> {
        let mut reader = self.open_array()?;
        while let Some(frame) = reader.next_frame().map_err(IntakeError::format(&self.name))? {
            if frame.iter().any(|value| *value != 0.0 && *value != 1.0) {
                return Ok(false);
            }
        }
        Ok(true)
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
        let basis = self.full_scale.map_or(ScaleBasis::Type, |_| ScaleBasis::Stated);
        let reading = Reading {
            scale_basis: basis,
            crop: self.part.crop,
            frames: self.part.frames,
            packing: self.packing,
        };
        let full_scale = match (self.full_scale, info.default_full_scale) {
            (Some(value), _) => FullScale::new(value),
            (None, Some(default)) => Ok(default),
            // Masks of 0 and 1. For larger values the check asks for the full scale.
            (None, None) if self.array == SceneArray::Masks => Ok(FullScale::ONE),
            (None, None) => Err(FormatError::FullScaleNeeded(info.sample.to_string())),
        };
        let full_scale = full_scale.map_err(IntakeError::format(&self.name))?;
        Ok(Opened { info, full_scale, reading, reader, name: self.name.clone() })
    }
}

impl Opened {
    /// Returns the next frame \[H,W\] divided by the full scale; `None` after the last one.
    pub fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let frame = self.reader.next_frame().map_err(IntakeError::format(&self.name))?;
        Ok(frame.map(|frame| frame / self.full_scale.value()))
    }
}
