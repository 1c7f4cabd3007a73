//! MATLAB level 5 files, the format of the public benchmark scenes, with the arrays `mask`, `meas` and `orig`. Level
//! 7.3 files are HDF5 (`hdf5.rs`).
//!
//! In MATLAB the frame axis usually comes last, here it comes first. MATLAB stores arrays column by column, so such a
//! frame is contiguous and can be read separately.
//!
//! This module parses the files, because the crate `matfile` decompresses arrays without a limit, keeps all of them in
//! memory, silently skips damaged ones, and can panic on hostile sizes. The tests use that crate as a reference.

mod element;
mod header;

use std::fs::File;
use std::io::BufReader;

use element::{Content, Element, Elements};
use header::{ArrayHeader, read_data_tag};

use super::array::{self, ArrayReader, Samples};
use super::axes::{Expected, Layout, Writer};
use super::hdf5::python_name;
use super::samples::{self, ByteOrder};
pub use super::scene::SceneArray;
use super::scene::list;
use super::{Format, FormatError, Limits, Reader, SampleType, StackInfo};
use crate::error::Result;

/// The names of the arrays of numbers. Errors: damaged files.
pub(super) fn names(file: File, length: u64) -> Result<Vec<String>> {
    let mut elements = Elements::new(BufReader::new(file), length)?;
    let mut names = Vec::new();
    while let Some(element) = elements.next()? {
        let header = ArrayHeader::read(&mut elements.content(element)?)?;
        if header.sample_type().is_ok() {
            names.push(header.name);
        }
    }
    Ok(names)
}

/// Opens the array with this name. Errors: [`FormatError::MissingArray`]; damaged files; [`FormatError::Unsupported`]
/// for other classes than double, single, logical and integers; [`FormatError::OverLimit`].
pub(super) fn open(
    file: File,
    length: u64,
    (array, name, expected): (SceneArray, &str, &Expected),
    limits: &Limits,
) -> Result<Reader> {
    let again = file.try_clone().map_err(FormatError::io("open the file"))?;
    let mut elements = Elements::new(BufReader::new(file), length)?;
    let mut present = Vec::new();
    while let Some(element) = elements.next()? {
        let header = ArrayHeader::read(&mut elements.content(element)?)?;
        if header.name == name {
            let order = elements.order();
            let content = elements.into_content(element)?;
            // Arrays with other names do not have the scales of the public scenes.
            let scene = (name == array.name()).then_some(array);
            let (samples, info, layout) =
                MatSamples::new((content, again), (element, order), (scene, expected), limits)?;
            return Ok(Box::new(ArrayReader::new(samples, info, layout)));
        }
        present.push((header.name, header.dimensions));
    }
    let (format, name) = (Format::Mat, name.to_owned());
    Err(FormatError::MissingArray { format, name, present: list(&present) })
}

/// The samples of one array.
struct MatSamples {
    content: Content<'static>,
    /// Another handle to the file, for further passes.
    file: File,
    element: Element,
    order: ByteOrder,
    storage: SampleType,
}

impl MatSamples {
    fn new(
        (mut content, file): (Content<'static>, File),
        (element, order): (Element, ByteOrder),
        (scene, expected): (Option<SceneArray>, &Expected),
        limits: &Limits,
    ) -> Result<(Self, StackInfo, Layout)> {
        let header = ArrayHeader::read(&mut content)?;
        let sample = header.sample_type()?;
        let arranged = expected.arrange((Format::Mat, Writer::Matlab), &header.dimensions)?;
        let arranged = arranged.ok_or_else(|| FormatError::Unsupported {
            format: Format::Mat,
            found: format!(
                "'{}' with {} dimensions (to convert it to a stack of pictures: python -c \"import numpy, scipy.io; \
                 a = scipy.io.loadmat('in.mat')['{}']; numpy.save('out.npy', \
                 numpy.moveaxis(a.reshape(*a.shape[:2], -1, order='F'), -1, 0))\")",
                header.name,
                header.dimensions.len(),
                python_name(&header.name)
            ),
            accepted: "(row, column, frame) or (row, column)",
        })?;
        let info = array::info(Format::Mat, sample, &arranged, limits)?;
        let (storage, bytes) = read_data_tag(&mut content, &header)?;
        content.check_can_hold(&header.name, bytes)?;
        let default_full_scale = match scene {
            Some(array) => Some(array.default_full_scale()),
            None => info.default_full_scale,
        };
        let info = StackInfo { default_full_scale, ..info };
        Ok((Self { content, file, element, order, storage }, info, arranged.layout))
    }
}

impl Samples for MatSamples {
    fn rewind(&mut self) -> Result<()> {
        let file = self.file.try_clone().map_err(FormatError::io("open the file"))?;
        self.content = Content::open(BufReader::new(file), self.element, self.order)?;
        let header = ArrayHeader::read(&mut self.content)?;
        read_data_tag(&mut self.content, &header).map(drop)
    }

    fn read(&mut self, count: usize) -> Result<Vec<f32>> {
        let mut bytes = vec![0; count * self.storage.bytes()];
        self.content.fill(&mut bytes)?;
        Ok(samples::decode(&bytes, self.storage, self.order))
    }

    fn finish(&mut self) -> Result<()> {
        self.content.finish()
    }
}

#[cfg(test)]
mod tests;
