//! Reads npy stacks frame by frame.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::header::{Header, MAX_HEADER_BYTES, unsupported};
use crate::array::{self, ArrayReader, RawSamples, Restart};
use crate::axes::{Expected, Layout, Writer};
use crate::error::Result;
use crate::format::NPY_MAGIC;
use crate::limits;
use crate::samples::{self, ByteOrder};
use crate::{Channels, Format, FormatError, Limits, SampleType, StackInfo, WindowReader};

/// Opens an npy stack for reading windows. It must have the layout in which this program writes frames: little-endian
/// float32 in C order, with the shape (frame, row, column) or (frame, row, column, 3). Frames of the latter are three
/// times as wide.
///
/// Errors: those of reading a header; [`FormatError::Unsupported`] for another layout.
pub fn open_windows(path: &Path, limits: &Limits) -> Result<WindowReader> {
    let mut file = File::open(path).map_err(FormatError::io("open the array"))?;
    let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
    limits.check_file(Format::Npy, length)?;
    let (header, start) = read_header(&mut file, length)?;
    let plain = (header.sample, header.order, header.fortran_order)
        == (SampleType::F32, ByteOrder::Little, false);
    let (shape, channels) = match *header.shape {
        [frames, height, width] if plain => ([frames, height, width], Channels::Grey),
        [frames, height, width, 3] if plain => ([frames, height, width], Channels::Rgb),
        _ => {
            let found = format!("{} of {} dimensions", header.sample, header.shape.len());
            return Err(unsupported(found));
        }
    };
    let info = checked_info(shape, channels, SampleType::F32, limits)?;
    check_length(&info, length.saturating_sub(start))?;
    Ok(WindowReader::new(file, info, start))
}

/// Opens an npy file of `length` bytes, which is positioned at its start. The header is checked against the limits, the
/// length and the expected shape. Errors name the file format `format`.
pub(crate) fn open<R: Restart>(
    mut file: R,
    length: u64,
    (format, expected): (Format, &Expected),
    limits: &Limits,
) -> Result<ArrayReader<RawSamples<R>>> {
    let (Header { sample, order, fortran_order, shape }, start) = read_header(&mut file, length)?;
    let writer = if fortran_order { Writer::Fortran } else { Writer::Rows };
    let arranged = expected.arrange((format, writer), &shape)?;
    let arranged = arranged.ok_or_else(|| {
        unsupported(format!(
            "an array of {} dimensions (to drop those of length 1: python -c \"import numpy; \
             numpy.save('out.npy', numpy.squeeze(numpy.load('in.npy')))\")",
            shape.len()
        ))
    })?;
    let info = array::info(format, sample, &arranged, limits)?;
    check_length(&info, length.saturating_sub(start))?;
    let samples = RawSamples::new(file, start, (sample, order), format);
    Ok(ArrayReader::new(samples, info, arranged.layout))
}

/// The shape in the header of an npy file of `length` bytes, which is positioned at its start.
///
/// Errors: those of reading a header.
pub(crate) fn shape(mut file: impl Read, length: u64) -> Result<Vec<u64>> {
    Ok(read_header(&mut file, length)?.0.shape)
}

/// Opens a colour clip (frame, row, column, 3) in C order; `None` for another shape.
pub(crate) fn open_colours<R: Restart>(
    mut file: R,
    length: u64,
    limits: &Limits,
) -> Result<Option<ArrayReader<RawSamples<R>>>> {
    let (Header { sample, order, fortran_order, shape }, start) = read_header(&mut file, length)?;
    let [frames, height, width, 3] = *shape else { return Ok(None) };
    if fortran_order {
        return Err(unsupported("colours in Fortran order".to_owned()));
    }
    let info = checked_info([frames, height, width], Channels::Rgb, sample, limits)?;
    check_length(&info, length.saturating_sub(start))?;
    let samples = RawSamples::new(file, start, (sample, order), Format::Npy);
    Ok(Some(ArrayReader::new(samples, info, Layout { interleaved: false, by_columns: false })))
}

/// The description of a stack after a check of the limits. Its width includes the channels.
fn checked_info(
    [frames, height, width]: [u64; 3],
    channels: Channels,
    sample: SampleType,
    limits: &Limits,
) -> Result<StackInfo> {
    limits.check_shape(Format::Npy, frames, height, width)?;
    let [frames, height, width] =
        [frames, height, width].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
    Ok(StackInfo::new(Format::Npy, sample, frames, height, width * channels.count()))
}

/// Reads the header, and returns it with the offset of the first sample.
fn read_header(file: &mut impl Read, length: u64) -> Result<(Header, u64)> {
    let mut start = [0u8; 8];
    fill(file, &mut start)?;
    let [magic @ .., major, minor] = start;
    if magic != NPY_MAGIC {
        return Err(FormatError::malformed(Format::Npy, "the signature is wrong"));
    }
    let (header_bytes, prefix) = match major {
        1 => {
            let mut size = [0; 2];
            fill(file, &mut size)?;
            (u64::from(u16::from_le_bytes(size)), 10)
        }
        2 | 3 => {
            let mut size = [0; 4];
            fill(file, &mut size)?;
            (u64::from(u32::from_le_bytes(size)), 12)
        }
        _ => {
            return Err(FormatError::Unsupported {
                format: Format::Npy,
                found: format!("npy version {major}.{minor}"),
                accepted: "versions 1.0, 2.0 and 3.0",
            });
        }
    };
    let data_start = prefix + header_bytes;
    if data_start > length {
        return Err(FormatError::Truncated {
            format: Format::Npy,
            promised: format!("a header of {header_bytes} bytes"),
            present: format!("{length} bytes in all"),
        });
    }
    let what = "the length of the header in bytes";
    limits::check(Format::Npy, what, header_bytes, MAX_HEADER_BYTES)?;
    let mut text = vec![0; header_bytes as usize];
    fill(file, &mut text)?;
    Ok((Header::parse(&text)?, data_start))
}

fn fill(file: &mut impl Read, bytes: &mut [u8]) -> Result<()> {
    file.read_exact(bytes).map_err(|source| {
        if source.kind() == io::ErrorKind::UnexpectedEof {
            FormatError::malformed(Format::Npy, "the file ends inside the header")
        } else {
            samples::read_error(Format::Npy, source)
        }
    })
}

/// Checks that the file has exactly the promised length.
fn check_length(info: &StackInfo, present: u64) -> Result<()> {
    let frame_bytes = (info.height as u64)
        .saturating_mul(info.width as u64)
        .saturating_mul(info.sample.bytes() as u64);
    let promised = frame_bytes.saturating_mul(info.frames as u64);
    if present < promised {
        return Err(FormatError::Truncated {
            format: Format::Npy,
            promised: format!(
                "{} frames of {}x{} {} ({promised} bytes)",
                info.frames, info.height, info.width, info.sample
            ),
            present: format!("{} whole frames ({present} bytes)", present / frame_bytes),
        });
    }
    if present > promised {
        return Err(FormatError::malformed(
            Format::Npy,
            format!(
                "{} bytes follow the {promised} bytes that the header promises",
                present - promised
            ),
        ));
    }
    Ok(())
}
