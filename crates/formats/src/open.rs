//! Opens files of any supported format as stacks of frames.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;

use ndarray::Array3;

use super::format::{HDF5_MAGIC, HEAD_BYTES, describe};
use super::mat::{self, SceneArray};
use super::photo::{self, read_picture};
use super::pictures::Pictures;
use super::scene::list;
use super::{
    Axes, Expected, Format, FormatError, FrameReader, Limits, Packing, Reader, Selection,
    StackInfo, hdf5, npy, npz, png, tar, tiff, zip,
};
use crate::error::Result;

const ACCEPTED: &str =
    "npy, npz, TIFF, PNG (1, 8 or 16 bit grey), .mat, HDF5, and a ZIP or tar of numbered pictures";

/// Selects an array of a file, with prior knowledge about its shape.
#[derive(Debug, Clone, Copy)]
pub struct Wanted<'a> {
    /// The role of the array in the scene.
    pub array: SceneArray,
    /// Name of the array in the file; `None` for [`SceneArray::name`], or for the only array.
    pub name: Option<&'a str>,
    /// Prior knowledge about its shape.
    pub expected: Expected,
    /// The part that is read.
    pub part: Selection,
    /// How the pixels are packed; `None` for one sample per value.
    pub packing: Option<Packing>,
}

impl From<SceneArray> for Wanted<'_> {
    fn from(array: SceneArray) -> Self {
        Self {
            array,
            name: None,
            expected: Expected::default(),
            part: Selection::default(),
            packing: None,
        }
    }
}

/// Opens a stack of frames. The first bytes of the file determine the format, not its name.
///
/// - npy, or npz with one array: (frame, row, column) or (row, column) of integers, floats or bool
/// - TIFF and BigTIFF: grey pages of one size and type
/// - PNG: one grey frame of 1, 8 or 16 bits
/// - ZIP and tar: numbered pictures
///
/// Errors: [`FormatError`].
pub fn open_stack(path: &Path, limits: &Limits) -> Result<Reader> {
    open_any(path, None, false, limits)
}

/// Opens a stack of frames to be looked at: as [`open_stack`], or 8-bit pictures in JPEG, BMP or PNM.
///
/// Errors: [`FormatError`].
pub fn open_shown(path: &Path, limits: &Limits) -> Result<Reader> {
    open_any(path, None, true, limits)
}

/// Opens a stack of frames like [`open_stack`], or one array of a .mat, HDF5 or npz file. For MATLAB files
/// [`StackInfo::default_full_scale`] is [`SceneArray::default_full_scale`].
///
/// True frames may also be 8-bit pictures in JPEG, BMP or PNM.
///
/// Packed pixels may also be in a file without a header, if the size of its pictures is known.
///
/// Errors: as [`open_stack`]; [`FormatError::MissingArray`], [`FormatError::NoNames`], [`FormatError::AxesAmbiguous`],
/// [`FormatError::NoAxes`] and [`FormatError::Part`].
pub fn open_array<'a>(
    path: &Path,
    wanted: impl Into<Wanted<'a>>,
    limits: &Limits,
) -> Result<Reader> {
    let mut wanted = wanted.into();
    let photos = wanted.array == SceneArray::Truth;
    let Some(packing) = wanted.packing else {
        return wanted.part.of(open_any(path, Some(wanted), photos, limits)?);
    };
    let size = wanted.expected.size;
    wanted.expected.size = size.map(|(height, width)| (height, packing.stored_width(width)));
    let unpacked = match open_any(path, Some(wanted), photos, limits) {
        Err(FormatError::UnknownFormat { .. }) => {
            let file = File::open(path).map_err(FormatError::io("open the file"))?;
            let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
            packing.raw(BufReader::new(file), length, size, limits)?
        }
        opened => packing.rows_of(opened?)?,
    };
    wanted.part.of(unpacked)
}

/// Opens a file. `photos`: 8-bit pictures in JPEG, BMP and PNM are accepted.
fn open_any(
    path: &Path,
    wanted: Option<Wanted<'_>>,
    photos: bool,
    limits: &Limits,
) -> Result<Reader> {
    let name = wanted.map_or("mask", |wanted| wanted.name.unwrap_or(wanted.array.name()));
    let (mut file, length, format) = open(path, name)?;
    limits.check_file(format, length)?;
    if format == Format::Zip {
        return open_zip(file, length, (wanted, photos), limits);
    }
    let expected = wanted.map(|wanted| wanted.expected).unwrap_or_default();
    if matches!(format, Format::Mat | Format::Hdf5) {
        let (array, name) = choose(path, (format, length), wanted)?;
        let chosen = (array, name.as_str(), &expected);
        return match format {
            Format::Mat => mat::open(file, length, chosen, limits),
            _ => hdf5::open(file, chosen, limits),
        };
    }
    if wanted.is_some_and(|wanted| wanted.name.is_some()) {
        return Err(FormatError::NoNames);
    }
    if format == Format::Npy {
        return Ok(Box::new(npy::open(file, length, (format, &expected), limits)?));
    }
    let reader: Reader = match format {
        Format::Tiff => tiff::open(file, length, limits)?,
        Format::Png => png::open(file, length, limits)?,
        Format::Tar => {
            let members = (format, tar::members(&file, length)?);
            Box::new(Pictures::open(Arc::new(file), members, photos, limits)?)
        }
        Format::Jpeg | Format::Bmp | Format::Pnm if photos => {
            photo::open(&read_picture(file, (format, length))?, format, limits)?
        }
        Format::Jpeg | Format::Bmp | Format::Pnm => {
            return Err(unknown(describe(&head(&mut file)?, name)));
        }
        Format::Exr => {
            let found = "it is an EXR file (to convert channel Y of each part: python -c \"import numpy, OpenEXR; f = \
                         OpenEXR.File('in.exr', separate_channels=True); numpy.save('out.npy', \
                         [part.channels['Y'].pixels for part in f.parts])\")";
            return Err(unknown(found.to_owned()));
        }
        Format::Npy
        | Format::Zip
        | Format::Npz
        | Format::Mat
        | Format::Hdf5
        | Format::Planar
        | Format::Raw => {
            return Err(unknown(format!("it is a {format} file")));
        }
    };
    check_picture_axes(reader, &expected)
}

/// The role and the name of the array to read from a .mat or HDF5 file: the stated name, else the usual one of its role,
/// else that of the only array.
fn choose(
    path: &Path,
    (format, length): (Format, u64),
    wanted: Option<Wanted<'_>>,
) -> Result<(SceneArray, String)> {
    if let Some(Wanted { array, name: Some(name), .. }) = wanted {
        return Ok((array, name.to_owned()));
    }
    let file = File::open(path).map_err(FormatError::io("open the file"))?;
    let mut names = match format {
        Format::Mat => mat::names(file, length)?,
        _ => hdf5::names(file)?,
    };
    match wanted {
        Some(Wanted { array, .. }) => {
            // A file of masks is not taken for a measurement.
            let roles = [SceneArray::Masks, SceneArray::Measurements, SceneArray::Truth];
            let only = names.len() == 1 && roles.iter().all(|role| role.name() != names[0]);
            Ok((array, if only { names.remove(0) } else { array.name().to_owned() }))
        }
        None if names.len() == 1 => {
            // The usual names imply scales, which an array without a role does not have.
            let is_truth = names[0] == SceneArray::Truth.name();
            let role = if is_truth { SceneArray::Masks } else { SceneArray::Truth };
            Ok((role, names.remove(0)))
        }
        None => Err(several_arrays(format, &names)),
    }
}

/// Opens a ZIP of arrays or of pictures.
fn open_zip(
    file: File,
    length: u64,
    (wanted, photos): (Option<Wanted<'_>>, bool),
    limits: &Limits,
) -> Result<Reader> {
    let members = zip::members(&file, length)?;
    let arrays = members.iter().filter(|member| member.name.ends_with(npz::EXTENSION)).count();
    match wanted {
        Some(Wanted { array, name, expected, .. }) if arrays > 0 => {
            npz::open(Arc::new(file), members, (array, name, &expected), limits)
        }
        None if arrays == 1 => {
            let only = (SceneArray::Truth, None, &Expected::default());
            npz::open(Arc::new(file), members, only, limits)
        }
        None if arrays > 1 => {
            let names: Vec<String> = members.into_iter().map(|member| member.name).collect();
            Err(several_arrays(Format::Npz, &names))
        }
        Some(Wanted { name: Some(_), .. }) => Err(FormatError::NoNames),
        _ => {
            let pictures = Pictures::open(Arc::new(file), (Format::Zip, members), photos, limits)?;
            let expected = wanted.map(|wanted| wanted.expected).unwrap_or_default();
            check_picture_axes(Box::new(pictures), &expected)
        }
    }
}

/// Returns a reader of pictures unless other axes are stated. Errors: [`FormatError::NoAxes`].
fn check_picture_axes(reader: Reader, expected: &Expected) -> Result<Reader> {
    match expected.axes {
        None | Some(Axes::FrameRowColumn) => Ok(reader),
        Some(_) => Err(FormatError::NoAxes(reader.info().format)),
    }
}

fn several_arrays(format: Format, names: &[String]) -> FormatError {
    FormatError::Unsupported {
        format,
        found: list(&names.iter().map(|name| (name.clone(), Vec::new())).collect::<Vec<_>>()),
        accepted: "a single array, since this role has no `array`: save the array alone",
    }
}

/// Reads a whole stack (frame, row, column) into memory. Values are as stored. Use [`open_stack`] for large files.
///
/// Errors: [`FormatError`].
pub fn read_stack(path: &Path, limits: &Limits) -> Result<(StackInfo, Array3<f32>)> {
    collect(&mut *open_stack(path, limits)?)
}

/// Reads the remaining frames of a reader into one array (frame, row, column).
///
/// Errors: those of the reader.
pub fn collect(reader: &mut (dyn FrameReader + Send)) -> Result<(StackInfo, Array3<f32>)> {
    let info = *reader.info();
    // The array grows frame by frame, because a compressed file may claim more than it contains.
    let mut values = Vec::new();
    let mut frames = 0;
    while let Some(frame) = reader.next_frame()? {
        values.extend(frame.iter());
        frames += 1;
    }
    let stack = Array3::from_shape_vec((frames, info.height, info.width), values)
        .map_err(|error| FormatError::Internal(error.to_string()))?;
    Ok((info, stack))
}

/// Opens a regular file. Opening a pipe would wait for its writer.
///
/// Errors: I/O; [`FormatError::UnknownFormat`] for folders, pipes and devices.
pub fn open_file(path: &Path) -> Result<File> {
    let kind = path.metadata().map_err(FormatError::io("open the file"))?.file_type();
    if kind.is_dir() {
        let found = "it is a folder; pack its pictures into a zip or tar archive";
        return Err(unknown(found.to_owned()));
    }
    if !kind.is_file() {
        return Err(unknown("it is not a regular file".to_owned()));
    }
    File::open(path).map_err(FormatError::io("open the file"))
}

/// Opens a file, and determines its length and format. `name` is the array that an error mentions.
pub(super) fn open(path: &Path, name: &str) -> Result<(File, u64, Format)> {
    let mut file = open_file(path)?;
    let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
    if length == 0 {
        return Err(unknown("it is empty".to_owned()));
    }
    let head = head(&mut file)?;
    let format = match Format::sniff(&head) {
        Some(format) => format,
        None if has_user_block(&file, length)? => Format::Hdf5,
        None => return Err(unknown(describe(&head, &hdf5::python_name(name)))),
    };
    Ok((file, length, format))
}

/// The first bytes of a file.
fn head(file: &mut File) -> Result<Vec<u8>> {
    let mut head = Vec::new();
    file.take(HEAD_BYTES).read_to_end(&mut head).map_err(FormatError::io("read the file"))?;
    file.rewind().map_err(FormatError::io("read the file"))?;
    Ok(head)
}

fn unknown(found: String) -> FormatError {
    FormatError::UnknownFormat { found, accepted: ACCEPTED }
}

/// True if the file is HDF5 after a user block, which has 512 bytes or a larger power of 2.
fn has_user_block(file: &File, length: u64) -> Result<bool> {
    let mut start = HEAD_BYTES;
    while start + HDF5_MAGIC.len() as u64 <= length {
        let mut magic = [0; HDF5_MAGIC.len()];
        file.read_exact_at(&mut magic, start).map_err(FormatError::io("read the file"))?;
        if magic == *HDF5_MAGIC {
            return Ok(true);
        }
        start *= 2;
    }
    Ok(false)
}
