//! Reading npy stacks frame by frame.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use ndarray::Array2;

use super::header::{Header, MAX_HEADER_BYTES, unsupported};
use crate::formats::error::Result;
use crate::formats::format::NPY_MAGIC;
use crate::formats::samples::{self, ByteOrder};
use crate::formats::{
    Format, FormatError, FrameReader, Limits, SampleType, StackInfo, WindowReader,
};

/// Opens an npy stack of shape (frame, row, column), float32, little-endian and in C order, of which
/// windows are then read: the form in which this program writes frames.
/// Errors: those of reading a header, and [`FormatError::Unsupported`] for another form.
pub fn open_windows(path: &Path, limits: &Limits) -> Result<WindowReader> {
    let mut file = File::open(path).map_err(FormatError::io("open the array"))?;
    let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
    limits.check_file(Format::Npy, length)?;
    let (header, start) = read_header(&mut file, length)?;
    let plain = (header.sample, header.order, header.fortran_order)
        == (SampleType::F32, ByteOrder::Little, false);
    let (true, [frames, height, width]) = (plain, &*header.shape) else {
        return Err(unsupported(format!("{} of {} dimensions", header.sample, header.shape.len())));
    };
    limits.check_shape(Format::Npy, *frames, *height, *width)?;
    let [frames, height, width] =
        [frames, height, width].map(|n| usize::try_from(*n).unwrap_or(usize::MAX));
    let info = StackInfo::new(Format::Npy, SampleType::F32, frames, height, width);
    check_length(&info, length.saturating_sub(start))?;
    Ok(WindowReader::new(file, info, start))
}

/// An npy file of shape (frame, row, column) or (row, column).
#[derive(Debug)]
pub(in crate::formats) struct NpyReader {
    file: File,
    info: StackInfo,
    order: ByteOrder,
    /// A two-dimensional array in Fortran order: its columns lie one after another.
    by_columns: bool,
    next: usize,
    bytes: Vec<u8>,
}

impl NpyReader {
    /// Reads the header of `file` (positioned at its start, `length` bytes long) and checks it
    /// against the limits and the length.
    pub(in crate::formats) fn open(mut file: File, length: u64, limits: &Limits) -> Result<Self> {
        let (header, data_start) = read_header(&mut file, length)?;
        let (frames, height, width) = match *header.shape {
            [height, width] => (1, height, width),
            [frames, height, width] => (frames, height, width),
            _ => {
                return Err(unsupported(format!("an array of {} dimensions", header.shape.len())));
            }
        };
        limits.check_shape(Format::Npy, frames, height, width)?;
        let by_columns = header.fortran_order;
        if by_columns && header.shape.len() == 3 {
            // Its frames are scattered over the whole file: no way to read one at a time.
            return Err(FormatError::Unsupported {
                format: Format::Npy,
                found: "a three-dimensional array in Fortran order".to_owned(),
                accepted: "C order: python -c \"import numpy; numpy.save('out.npy', \
                           numpy.ascontiguousarray(numpy.load('in.npy')))\"",
            });
        }
        // The limits bound each axis below 2^32 only where they are sane; they are settings.
        let [frames, height, width] =
            [frames, height, width].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let info = StackInfo::new(Format::Npy, header.sample, frames, height, width);
        check_length(&info, length.saturating_sub(data_start))?;
        Ok(Self {
            file,
            info,
            order: header.order,
            by_columns,
            next: 0,
            bytes: vec![0; height * width * header.sample.bytes()],
        })
    }
}

impl FrameReader for NpyReader {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        if self.next == self.info.frames {
            return Ok(None);
        }
        self.file.read_exact(&mut self.bytes).map_err(FormatError::io("read the frame"))?;
        self.next += 1;
        let values = samples::decode(&self.bytes, self.info.sample, self.order);
        let (height, width) = (self.info.height, self.info.width);
        if self.by_columns {
            let columns = samples::frame(width, height, values)?;
            return Ok(Some(columns.t().as_standard_layout().into_owned()));
        }
        samples::frame(height, width, values).map(Some)
    }
}

/// The header and the offset of the first sample.
fn read_header(file: &mut File, length: u64) -> Result<(Header, u64)> {
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
    if header_bytes > MAX_HEADER_BYTES {
        return Err(FormatError::OverLimit {
            format: Format::Npy,
            what: "the header's length in bytes",
            value: header_bytes,
            limit: MAX_HEADER_BYTES,
        });
    }
    let mut text = vec![0; header_bytes as usize];
    fill(file, &mut text)?;
    Ok((Header::parse(&text)?, data_start))
}

fn fill(file: &mut File, bytes: &mut [u8]) -> Result<()> {
    file.read_exact(bytes).map_err(|source| {
        if source.kind() == io::ErrorKind::UnexpectedEof {
            FormatError::malformed(Format::Npy, "the file ends inside the header")
        } else {
            FormatError::Io { action: "read the header", source }
        }
    })
}

/// The file must hold exactly what the header promises.
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
