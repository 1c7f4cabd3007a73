//! Reads one array of an HDF5 file (MATLAB level 7.3, h5py and others) frame by frame.
//!
//! Most files have the axes (frame, row, column) or (row, column). MATLAB writes its axes, usually (row, column,
//! frame), in reverse, so its frames are stored as (column, row).
//!
//! The crate `hdf5-reader` is pure Rust and reads only the given file. A binding to libhdf5 would follow references to
//! external files, so an upload could read files of the server. Ranges are read and not mapped, so a file that is
//! truncated while it is read gives an error and not a signal.

mod lz4;
mod lzf;

use std::collections::HashSet;
use std::fs::File;
use std::sync::Arc;

use hdf5_reader::error::Error;
use hdf5_reader::group::Group;
use hdf5_reader::storage::{DynStorage, FileStorage};
use hdf5_reader::{
    ByteOrder as StoredOrder, Dataset, Datatype, FilterRegistry, H5Type, Hdf5File, OpenOptions,
    SliceInfo, SliceInfoElem,
};

use super::array::{self, ArrayReader, Samples};
use super::axes::{Expected, Writer};
use super::samples::{self, ByteOrder};
use super::scene::{MAX_NAMES, SceneArray, list};
use super::{Format, FormatError, Limits, Reader, SampleType, limits};
use crate::error::Result;

/// Size of the cache of decoded chunks, in bytes. If the chunks of a frame fit, each chunk is decoded once for all its
/// frames.
const CHUNK_CACHE_BYTES: usize = 128 << 20;

/// The samples of one array of an HDF5 file.
struct Hdf5Samples {
    dataset: Dataset,
    /// Number of samples per entry of the first axis; all samples for an array of two dimensions.
    entry_samples: usize,
    /// Index of the next entry.
    next: u64,
    is_bool: bool,
    advice: Advice,
}

/// Makes errors with lines of Python that convert the array.
#[derive(Debug, Clone)]
struct Advice {
    /// The path of the array for a line of Python.
    name: String,
}

/// Largest depth of groups, and largest numbers of groups and arrays, that are listed in an error.
const MAX_DEPTH: usize = 16;
const MAX_GROUPS: usize = 256;
const MAX_LISTED: usize = 1024;

/// The paths of the arrays in the file; a variable of Octave is one array. Errors: as [`open`].
pub(super) fn names(file: File) -> Result<Vec<String>> {
    let advice = Advice { name: python_name("array") };
    let error = |source| advice.error(source);
    let file = open_file(file).map_err(error)?;
    let mut paths = array_paths(&file.root_group().map_err(error)?);
    let values = paths.iter().filter_map(|path| path.strip_suffix("/value"));
    let variables: Vec<String> = values
        .filter(|group| paths.iter().any(|path| path.strip_suffix("/type") == Some(group)))
        .map(str::to_owned)
        .collect();
    let is_part = |path: &String| {
        path.rsplit_once('/').is_some_and(|(group, _)| variables.iter().any(|name| name == group))
    };
    paths.retain(|path| !is_part(path));
    paths.extend(variables);
    Ok(paths)
}

/// Opens a file with the filters that it may need.
fn open_file(file: File) -> std::result::Result<Hdf5File, Error> {
    let storage: DynStorage = Arc::new(FileStorage::from_file(file)?);
    let mut filters = FilterRegistry::new();
    let max_bytes = CHUNK_CACHE_BYTES;
    filters.register(
        lzf::FILTER,
        Box::new(move |filter, bytes, _| lzf::decompress(bytes, &filter.client_data, max_bytes)),
    );
    filters.register(lz4::FILTER, Box::new(move |_, bytes, _| lz4::decompress(bytes, max_bytes)));
    let options = OpenOptions {
        chunk_cache_bytes: CHUNK_CACHE_BYTES,
        max_chunk_bytes: CHUNK_CACHE_BYTES,
        filter_registry: Some(filters),
        ..OpenOptions::default()
    };
    Hdf5File::from_storage_with_options(storage, options)
}

/// Opens the array with this name; `array` is its role. Errors: malformed files; [`FormatError::MissingArray`];
/// [`FormatError::OverLimit`]; [`FormatError::Unsupported`]; [`FormatError::AxesAmbiguous`].
pub(super) fn open(
    file: File,
    (array, name, expected): (SceneArray, &str, &Expected),
    limits: &Limits,
) -> Result<Reader> {
    let mut advice = Advice { name: python_name(name) };
    let error = |source| advice.error(source);
    let file = open_file(file).map_err(error)?;
    let root = file.root_group().map_err(error)?;
    let Found { dataset, octave } = find(&root, name).map_err(error)?.ok_or_else(|| {
        let (format, name) = (Format::Hdf5, name.to_owned());
        FormatError::MissingArray { format, name, present: list(&shapes(&root)) }
    })?;
    if octave.is_some() && !name.ends_with("/value") {
        advice.name = python_name(&format!("{name}/value"));
    }
    let error = |source| advice.error(source);
    let class = dataset.attribute("MATLAB_class").ok();
    let class = class.map(|class| class.read_string().map_err(error)).transpose()?;
    let is_bool = class.as_deref() == Some("logical")
        || octave.as_ref().is_some_and(|kind| kind.starts_with("bool"));
    let sample = match (sample_type(dataset.dtype()), class.as_deref()) {
        (Some(_), Some("char")) => return Err(unsupported("text".to_owned())),
        (Some(_), _) if is_bool => SampleType::Bool,
        (Some((sample, _)), _) => sample,
        (None, _) => return Err(unsupported(advice.describe(dataset.dtype()))),
    };
    let mut shape = dataset.shape().to_vec();
    let writer = if class.is_some() || octave.is_some() { Writer::Matlab } else { Writer::Rows };
    if writer == Writer::Matlab {
        shape.reverse();
    }
    let arranged = expected.arrange((Format::Hdf5, writer), &shape)?;
    let arranged = arranged.ok_or_else(|| advice.many_axes(shape.len(), writer))?;
    let mut info = array::info(Format::Hdf5, sample, &arranged, limits)?;
    check_chunks(&dataset, sample)?;
    if writer == Writer::Matlab && name == array.name() {
        info.default_full_scale = Some(array.default_full_scale());
    }
    let entries = match *dataset.shape() {
        [first, _, _] => usize::try_from(first).unwrap_or(usize::MAX),
        _ => 1,
    };
    let entry_samples = info.frames * info.height * info.width / entries;
    let is_bool = sample == SampleType::Bool;
    let samples = Hdf5Samples { dataset, entry_samples, next: 0, is_bool, advice };
    Ok(Box::new(ArrayReader::new(samples, info, arranged.layout)))
}

/// An array of a file.
struct Found {
    dataset: Dataset,
    /// The type of the variable in files of Octave; `None` in other files.
    octave: Option<String>,
}

/// Finds the array at a path. Octave stores a variable as a group with the arrays `type` and `value`; the path of the
/// group stands for its value. `None` if there is no array at this path. Errors: those of reading the array.
fn find(root: &Group, path: &str) -> Result<Option<Found>, Error> {
    let mut group = root.clone();
    let mut parts = path.split('/').filter(|part| !part.is_empty()).peekable();
    if parts.peek().is_none() {
        return Ok(None);
    }
    while let Some(part) = parts.next() {
        let (groups, arrays) = group.member_names()?;
        if parts.peek().is_none() && arrays.iter().any(|name| name == part) {
            let octave = if part == "value" { octave_type(&group) } else { None };
            return Ok(Some(Found { dataset: group.dataset(part)?, octave }));
        }
        if !groups.iter().any(|name| name == part) {
            return Ok(None);
        }
        group = group.group(part)?;
    }
    let octave = octave_type(&group);
    let has_value = group.member_names()?.1.iter().any(|name| name == "value");
    if octave.is_none() || !has_value {
        return Ok(None);
    }
    Ok(Some(Found { dataset: group.dataset("value")?, octave }))
}

/// The type of the variable that Octave stores in a group.
fn octave_type(group: &Group) -> Option<String> {
    group.dataset("type").ok()?.read_string().ok()
}

/// The paths of the arrays of a file, up to some limits. Groups that MATLAB uses internally are left out.
fn array_paths(root: &Group) -> Vec<String> {
    let (mut paths, mut seen) = (Vec::new(), HashSet::new());
    let mut waiting = vec![(String::new(), 0, root.clone())];
    while let Some((prefix, depth, group)) = waiting.pop() {
        if depth > MAX_DEPTH || seen.len() >= MAX_GROUPS || !seen.insert(group.address()) {
            continue;
        }
        // Damaged groups are not listed.
        let Ok((groups, arrays)) = group.member_names() else { continue };
        paths.extend(arrays.into_iter().map(|name| format!("{prefix}{name}")));
        if paths.len() >= MAX_LISTED {
            break;
        }
        for name in groups.into_iter().filter(|name| !name.starts_with('#')).rev() {
            if let Ok(child) = group.group(&name) {
                waiting.push((format!("{prefix}{name}/"), depth + 1, child));
            }
        }
    }
    paths
}

/// The arrays of a file with their sizes, as the program that wrote the file shows them. The size is empty if it can't be
/// read, and after the arrays that a message lists.
fn shapes(root: &Group) -> Vec<(String, Vec<u64>)> {
    let shape = |path: &str| -> Option<Vec<u64>> {
        let Found { dataset, octave } = find(root, path).ok()??;
        let mut shape = dataset.shape().to_vec();
        if octave.is_some() || dataset.attribute("MATLAB_class").is_ok() {
            shape.reverse();
        }
        Some(shape)
    };
    let paths = array_paths(root).into_iter().enumerate();
    let listed = paths.map(|(index, path)| {
        let shape = if index < MAX_NAMES { shape(&path) } else { None };
        (path, shape.unwrap_or_default())
    });
    listed.collect()
}

/// A name as it may stand in a line of Python that a user copies into a shell.
pub(super) fn python_name(name: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "_-./ #".contains(c);
    if name.chars().all(plain) { name.to_owned() } else { "NAME".to_owned() }
}

impl Samples for Hdf5Samples {
    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn read(&mut self, count: usize) -> Result<Vec<f32>> {
        let all = SliceInfoElem::Slice { start: 0, end: u64::MAX, step: 1 };
        let mut selections = vec![all; self.dataset.ndim()];
        if let [first, _, _] = &mut *selections {
            let (start, end) = (self.next, self.next + (count / self.entry_samples) as u64);
            *first = SliceInfoElem::Slice { start, end, step: 1 };
            self.next = end;
        }
        let values = self.dataset.read_slice::<Value>(&SliceInfo { selections });
        let values = values.map_err(|source| self.advice.error(source))?;
        let mut values: Vec<f32> = values.into_iter().map(|Value(value)| value).collect();
        if self.is_bool {
            values.iter_mut().for_each(|value| *value = f32::from(u8::from(*value != 0.0)));
        }
        Ok(values)
    }
}

/// A sample of any accepted type, converted to float32.
#[derive(Clone)]
struct Value(f32);

impl H5Type for Value {
    fn hdf5_type() -> Datatype {
        f32::hdf5_type()
    }

    fn from_bytes(bytes: &[u8], dtype: &Datatype) -> hdf5_reader::error::Result<Self> {
        let decoded = Self::decode_vec(bytes, dtype, 1).and_then(|values| values.ok()?.pop());
        decoded.ok_or_else(|| Error::InvalidData("a sample is cut short".to_owned()))
    }

    fn element_size(dtype: &Datatype) -> usize {
        // Unsupported types are refused before anything is read.
        sample_type(dtype).map_or(1, |(sample, _)| sample.bytes())
    }

    fn decode_vec(
        raw: &[u8],
        dtype: &Datatype,
        count: usize,
    ) -> Option<hdf5_reader::error::Result<Vec<Self>>> {
        let (sample, order) = sample_type(dtype)?;
        let bytes = raw.get(..count.checked_mul(sample.bytes())?)?;
        Some(Ok(samples::decode(bytes, sample, order).into_iter().map(Value).collect()))
    }
}

/// The data type and byte order of samples; `None` for unsupported types.
fn sample_type(dtype: &Datatype) -> Option<(SampleType, ByteOrder)> {
    let (sample, order) = match dtype {
        Datatype::FixedPoint { size, signed, byte_order } => {
            let sample = match (size, signed) {
                (1, false) => SampleType::U8,
                (1, true) => SampleType::I8,
                (2, false) => SampleType::U16,
                (2, true) => SampleType::I16,
                (4, false) => SampleType::U32,
                (4, true) => SampleType::I32,
                (8, false) => SampleType::U64,
                (8, true) => SampleType::I64,
                _ => return None,
            };
            (sample, byte_order)
        }
        Datatype::FloatingPoint { size, byte_order } => {
            let sample = match size {
                2 => SampleType::F16,
                4 => SampleType::F32,
                8 => SampleType::F64,
                _ => return None,
            };
            (sample, byte_order)
        }
        // h5py stores booleans as an enumeration of FALSE and TRUE.
        Datatype::Enum { base, members } if members.len() == 2 => {
            return match sample_type(base)? {
                (SampleType::I8 | SampleType::U8, order) => Some((SampleType::Bool, order)),
                _ => None,
            };
        }
        _ => return None,
    };
    let order = match order {
        StoredOrder::LittleEndian => ByteOrder::Little,
        StoredOrder::BigEndian => ByteOrder::Big,
    };
    Some((sample, order))
}

/// Checks that all chunks of one entry of the first axis fit into the cache.
fn check_chunks(dataset: &Dataset, sample: SampleType) -> Result<()> {
    let Some(chunk) = dataset.chunks() else { return Ok(()) };
    let ([.., height, width], Some(depth)) = (dataset.shape(), chunk.first()) else {
        return Ok(());
    };
    let depth = if chunk.len() == 3 { u64::from(*depth) } else { 1 };
    let round = |side: u64, chunk: Option<&u32>| {
        side.next_multiple_of(chunk.map_or(1, |n| u64::from(*n).max(1)))
    };
    let plane =
        round(*height, chunk.iter().rev().nth(1)).saturating_mul(round(*width, chunk.last()));
    let bytes = plane.saturating_mul(depth).saturating_mul(sample.bytes() as u64);
    let what = "the size in bytes of the chunks for one entry of the first axis (save the array with one entry per chunk, \
                in h5py chunks=(1, height, width))";
    limits::check(Format::Hdf5, what, bytes, CHUNK_CACHE_BYTES as u64)
}

impl Advice {
    /// The common name of an unsupported type, with a conversion if there is one.
    fn describe(&self, dtype: &Datatype) -> String {
        let name = &self.name;
        match dtype {
            Datatype::String { .. } | Datatype::VarLen { .. } => "text".to_owned(),
            Datatype::Compound { .. } => format!(
                "records, perhaps complex numbers (to convert to absolute values: python -c \"import h5py, numpy; a = \
                 h5py.File('in.h5')['{name}'][()]; numpy.save('out.npy', abs(a['real'] + 1j * a['imag'] if a.dtype.names \
                 else a))\")"
            ),
            Datatype::Reference { .. } => format!(
                "references, perhaps a cell array (to convert cells with one frame each: python -c \"import h5py, numpy; f = \
                 h5py.File('in.mat'); numpy.save('out.npy', [f[cell][()].T for cell in f['{name}'][()].ravel()])\")"
            ),
            Datatype::Enum { .. } => "an enumeration".to_owned(),
            _ => "numbers of an unknown type".to_owned(),
        }
    }

    /// The error for an array with another number of dimensions than two or three.
    fn many_axes(&self, count: usize, writer: Writer) -> FormatError {
        let name = &self.name;
        if count < 2 {
            return unsupported(format!("an array of {count} dimensions"));
        }
        let line = match writer {
            Writer::Matlab => format!(
                "a = h5py.File('in.mat')['{name}'][()]; numpy.save('out.npy', \
                 a.reshape(-1, *a.shape[-2:]).transpose(0, 2, 1))"
            ),
            Writer::Rows | Writer::Fortran => format!(
                "a = h5py.File('in.h5')['{name}'][()]; numpy.save('out.npy', a.reshape(-1, *a.shape[-2:]))"
            ),
        };
        let line = format!("python -c \"import h5py, numpy; {line}\"");
        unsupported(format!(
            "an array of {count} dimensions (to convert it to a stack of pictures: {line})"
        ))
    }

    fn error(&self, error: Error) -> FormatError {
        let name = &self.name;
        match error {
            Error::Context { source, .. } => self.error(*source),
            Error::Io(source) => FormatError::Io { action: "read the HDF5 file", source },
            Error::UnexpectedEof { offset, needed, available } => FormatError::Truncated {
                format: Format::Hdf5,
                promised: format!("{needed} bytes at {offset}"),
                present: format!("{available} bytes"),
            },
            Error::UnsupportedFilter(filter) => FormatError::Unsupported {
                format: Format::Hdf5,
                found: format!(
                    "chunks that are compressed by {filter} (to convert them: python -c \"import hdf5plugin, h5py, numpy; \
                     numpy.save('out.npy', h5py.File('in.h5')['{name}'][()])\")"
                ),
                accepted: "no compression, deflate, LZF, LZ4, szip, shuffle, scale-offset, n-bit and Fletcher-32",
            },
            other => FormatError::malformed(
                Format::Hdf5,
                format!(
                    "{other} (to convert it with h5py: python -c \"import hdf5plugin, h5py, numpy; \
                     numpy.save('out.npy', h5py.File('in.h5')['{name}'][()])\")"
                ),
            ),
        }
    }
}

fn unsupported(found: String) -> FormatError {
    FormatError::Unsupported {
        format: Format::Hdf5,
        found,
        accepted: "integers and floats of 8 to 64 bits and booleans, in 2 or 3 dimensions",
    }
}

#[cfg(test)]
mod tests;
