//! Reading npy stacks frame by frame.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
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
    layout: Layout,
    next: usize,
    bytes: Vec<u8>,
}

/// How the samples lie one after another.
#[derive(Debug)]
enum Layout {
    Rows,
    /// Two dimensions in Fortran order: column by column.
    Columns,
    /// Three dimensions in Fortran order: all frames of a pixel, then those of the pixel below it. Several
    /// frames are kept of each reading of the file.
    Pixels {
        start: u64,
        kept: Vec<f32>,
        /// The first frame that is kept, and the one behind the last.
        range: Range<usize>,
    },
}

/// Bytes of the frames that are kept, unless one takes more.
const KEPT_BYTES: usize = if cfg!(test) { 200 } else { 64 << 20 };
/// Bytes that are read at a time, unless the frames of a pixel take more.
const BLOCK_BYTES: usize = if cfg!(test) { 100 } else { 1 << 20 };

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
        let layout = match (header.fortran_order, header.shape.len()) {
            (false, _) => Layout::Rows,
            (true, 2) => Layout::Columns,
            (true, _) => Layout::Pixels { start: data_start, kept: Vec::new(), range: 0..0 },
        };
        let [frames, height, width] =
            [frames, height, width].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let info = StackInfo::new(Format::Npy, header.sample, frames, height, width);
        check_length(&info, length.saturating_sub(data_start))?;
        Ok(Self {
            file,
            info,
            order: header.order,
            layout,
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
        let frame = self.next;
        if !matches!(self.layout, Layout::Pixels { .. }) {
            self.file.read_exact(&mut self.bytes).map_err(FormatError::io("read the frame"))?;
        } else if !self.keeps(frame) {
            self.gather(frame)?;
        }
        self.next += 1;
        let (height, width) = (self.info.height, self.info.width);
        let decode = || samples::decode(&self.bytes, self.info.sample, self.order);
        match &self.layout {
            Layout::Rows => samples::frame(height, width, decode()).map(Some),
            Layout::Columns => {
                let columns = samples::frame(width, height, decode())?;
                Ok(Some(columns.t().as_standard_layout().into_owned()))
            }
            Layout::Pixels { kept, range, .. } => {
                let size = height * width;
                let values = kept[(frame - range.start) * size..][..size].to_vec();
                samples::frame(height, width, values).map(Some)
            }
        }
    }
}

impl NpyReader {
    fn keeps(&self, frame: usize) -> bool {
        matches!(&self.layout, Layout::Pixels { range, .. } if range.contains(&frame))
    }

    /// Reads the file from the front and keeps frames from this one on.
    fn gather(&mut self, first: usize) -> Result<()> {
        let Layout::Pixels { start, kept, range } = &mut self.layout else { return Ok(()) };
        let StackInfo { frames, height, width, sample, .. } = self.info;
        let pixels = height * width;
        let count = (KEPT_BYTES / (pixels * size_of::<f32>())).clamp(1, frames - first);
        kept.clear();
        kept.resize(count * pixels, 0.0);
        *range = first..first + count;
        let failed = || FormatError::io("read the frames");
        self.file.seek(SeekFrom::Start(*start)).map_err(failed())?;
        let each = frames * sample.bytes();
        let block = (BLOCK_BYTES / each).clamp(1, pixels);
        let mut bytes = vec![0; block * each];
        for begin in (0..pixels).step_by(block) {
            let bytes = &mut bytes[..block.min(pixels - begin) * each];
            self.file.read_exact(bytes).map_err(failed())?;
            let values = samples::decode(bytes, sample, self.order);
            for (pixel, values) in (begin..).zip(values.chunks_exact(frames)) {
                let (column, row) = (pixel / height, pixel % height);
                for (frame, value) in values[range.clone()].iter().enumerate() {
                    kept[frame * pixels + row * width + column] = *value;
                }
            }
        }
        Ok(())
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
