//! The community's benchmark scenes: files with the arrays `mask`, `meas`, `orig`, as MATLAB saves them
//! (level 5; level 7.3 is HDF5, `hdf5.rs`).
//!
//! The frame axis is the last one in MATLAB and the first one here; rows and columns stay what they
//! are. MATLAB stores columns one after another, so a frame is contiguous and is read alone.
//!
//! The reader is our own: the crate `matfile` inflates compressed arrays without a bound, keeps
//! all of them in memory, passes over damaged ones in silence and can panic on hostile sizes.
//! It serves the tests as a second opinion.

mod array;
mod element;

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use ndarray::{Array2, Array3};

use array::ArrayHeader;
use element::{Content, Elements};

use super::open::open;
pub use super::scene::SceneArray;
use super::scene::list;
use super::{
    Format, FormatError, FrameReader, Limits, SampleType, StackInfo, collect, hdf5, samples,
};
use crate::formats::error::Result;

/// A whole scene in memory, axes (frame, row, column), values as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct MatScene {
    /// The masks, on `[0,1]` (not checked here).
    pub masks: Array3<f32>,
    /// The snapshots; 255 means 1.
    pub measurements: Array3<f32>,
    /// The frames that were measured, snapshot after snapshot; 255 means 1.
    pub truth: Option<Array3<f32>>,
}

/// True for a file of named arrays, .mat or HDF5, told by its first bytes. Errors: I/O.
pub fn is_scene(path: &Path) -> Result<bool> {
    match open(path) {
        Ok((_, _, format)) => Ok(matches!(format, Format::Mat | Format::Hdf5)),
        Err(FormatError::UnknownFormat { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Opens one array of a scene; its frames are read one at a time.
///
/// A two-dimensional array has one frame. [`StackInfo::default_full_scale`] is
/// [`SceneArray::default_full_scale`]. Errors: [`FormatError::MissingArray`]; a file that is no
/// .mat, is damaged or too large; an array of another class than double, single, uint8, uint16 or
/// logical.
pub fn open_array(
    path: &Path,
    array: SceneArray,
    limits: &Limits,
) -> Result<Box<dyn FrameReader + Send>> {
    open_named(path, (array, array.name()), limits)
}

/// The same for an array of another name.
pub fn open_named(
    path: &Path,
    (array, name): (SceneArray, &str),
    limits: &Limits,
) -> Result<Box<dyn FrameReader + Send>> {
    let (file, length, format) = open(path)?;
    limits.check_file(format, length)?;
    if format == Format::Hdf5 {
        return Ok(Box::new(hdf5::Hdf5Reader::open(file, (array, name), limits)?));
    }
    if format != Format::Mat {
        return Err(FormatError::UnknownFormat {
            found: format!("it is a {format} file"),
            accepted: "a .mat or HDF5 scene",
        });
    }
    let mut elements = Elements::new(BufReader::new(file), length)?;
    let mut present = Vec::new();
    while let Some(element) = elements.next()? {
        let header = ArrayHeader::read(&mut elements.look_into(element)?)?;
        if header.name == name {
            let content = elements.into_content(element)?;
            return Ok(Box::new(MatReader::new(content, array, limits)?));
        }
        present.push(header.name);
    }
    Err(FormatError::MissingArray { format, name: name.to_owned(), present: list(&present) })
}

/// Reads a scene: `mask` and `meas`, and `orig` where it is there.
///
/// For benchmark scenes, which are small; [`open_array`] reads frame by frame. Errors: as there.
pub fn read_scene_mat(path: &Path, limits: &Limits) -> Result<MatScene> {
    let read = |array| Ok(collect(&mut *open_array(path, array, limits)?)?.1);
    Ok(MatScene {
        masks: read(SceneArray::Masks)?,
        measurements: read(SceneArray::Measurements)?,
        truth: match read(SceneArray::Truth) {
            Ok(truth) => Some(truth),
            Err(FormatError::MissingArray { .. }) => None,
            Err(error) => return Err(error),
        },
    })
}

/// The frames of one array.
struct MatReader {
    content: Content<BufReader<File>>,
    info: StackInfo,
    storage: SampleType,
    next: usize,
    bytes: Vec<u8>,
}

impl MatReader {
    fn new(
        mut content: Content<BufReader<File>>,
        array: SceneArray,
        limits: &Limits,
    ) -> Result<Self> {
        let header = ArrayHeader::read(&mut content)?;
        let sample = header.sample_type()?;
        let (height, width, frames) = match *header.dimensions {
            [height, width] => (height, width, 1),
            [height, width, frames] => (height, width, frames),
            _ => {
                return Err(FormatError::Unsupported {
                    format: Format::Mat,
                    found: format!("'{}' with {} dimensions", header.name, header.dimensions.len()),
                    accepted: "(row, column, frame) or (row, column)",
                });
            }
        };
        limits.check_shape(Format::Mat, frames, height, width)?;
        let (storage, bytes) = array::read_data_tag(&mut content, &header)?;
        content.check_can_hold(&header.name, bytes)?;
        let [frames, height, width] =
            [frames, height, width].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let info = StackInfo {
            default_full_scale: Some(array.default_full_scale()),
            ..StackInfo::new(Format::Mat, sample, frames, height, width)
        };
        Ok(Self {
            content,
            info,
            storage,
            next: 0,
            bytes: vec![0; height * width * storage.bytes()],
        })
    }
}

impl FrameReader for MatReader {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        if self.next == self.info.frames {
            return Ok(None);
        }
        self.content.fill(&mut self.bytes)?;
        self.next += 1;
        if self.next == self.info.frames {
            self.content.finish()?;
        }
        let values = samples::decode(&self.bytes, self.storage, self.content.order());
        let columns = samples::frame(self.info.width, self.info.height, values)?;
        Ok(Some(columns.t().as_standard_layout().into_owned()))
    }
}

#[cfg(test)]
mod tests;
