//! Reads EXR files that this program has written: their parts are frames of one size.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use ::exr::block;
use ::exr::block::reader::ChunksReader;
use ::exr::error::Error as ExrError;
use ::exr::meta::attribute::{AttributeValue, ChannelDescription, SampleType, Text};
use ::exr::meta::header::Header;
use ndarray::Array3;

use super::{FRAME_TIME, Lines, names};
use crate::error::Result;
use crate::{Channels, Format, FormatError, Limits, StackInfo, WindowReader};

/// The attributes of a part.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Part {
    /// Name of the part; empty if it has none.
    pub name: String,
    /// String attributes that are not defined by OpenEXR.
    pub texts: BTreeMap<String, String>,
    /// Time of the frame in seconds.
    pub frame_time_s: Option<f64>,
    /// Frame rate as numerator and denominator.
    pub frames_per_second: Option<(i32, u32)>,
}

/// Opens a stack of this shape (frames, rows, columns) that this program has written, for reading windows. Colour frames
/// are three times as wide.
///
/// Errors: I/O; [`FormatError::Truncated`] for a file that is too short for its lines.
pub fn open_windows(
    path: &Path,
    (frames, height, width): (usize, usize, usize),
    channels: Channels,
) -> Result<WindowReader> {
    let file = File::open(path).map_err(FormatError::io("open the EXR file"))?;
    let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
    let lines = Lines::new(frames, width, channels);
    let promised = (frames * height * lines.stored_bytes()) as u64;
    let start = length.checked_sub(promised).ok_or_else(|| FormatError::Truncated {
        format: Format::Exr,
        promised: format!("{frames} frames of {height}x{width} ({promised} bytes)"),
        present: format!("{length} bytes"),
    })?;
    let info = StackInfo::new(
        Format::Exr,
        crate::SampleType::F32,
        frames,
        height,
        width * channels.count(),
    );
    let places = names(channels).iter().map(|(_, place)| *place).collect();
    let row = (start + lines.prefix_bytes() as u64, lines.stored_bytes() as u64);
    Ok(WindowReader::with_layout(file, info, row, places))
}

/// Reads the frames (frame, row, column) of all parts, with their attributes. Colour frames have red, green and blue of
/// each pixel in adjacent columns.
///
/// Errors: I/O; [`FormatError::Unsupported`] for parts of different sizes, or with channels other than float32 `Y`, or
/// `R`, `G` and `B`; [`FormatError::OverLimit`]; [`FormatError::Malformed`].
pub fn read_stack(path: &Path, limits: &Limits) -> Result<(Vec<Part>, Array3<f32>)> {
    let file = File::open(path).map_err(FormatError::io("open the EXR file"))?;
    let length = file.metadata().map_err(FormatError::io("read the file's length"))?.len();
    limits.check_file(Format::Exr, length)?;
    let strict = true;
    let reader = block::read(BufReader::new(file), strict).map_err(error)?;
    let headers = reader.headers().to_vec();
    let (height, width, channels) = common_layout(&headers)?;
    limits.check_shape(Format::Exr, headers.len() as u64, height as u64, width as u64)?;
    let count = channels.count();
    let mut stack = Array3::zeros((headers.len(), height, width * count));
    let mut blocks = reader.all_chunks(strict).map_err(error)?.sequential_decompressor(strict);
    while let Some(block) = blocks.decompress_next_block() {
        let block = block.map_err(error)?;
        let (samples, _) = block.data.as_chunks::<4>();
        let first = block.index.pixel_position.1;
        let mut frame = stack.index_axis_mut(ndarray::Axis(0), block.index.layer);
        // A block stores the channels of a row one after another.
        for (index, line) in samples.chunks(width).enumerate() {
            let (row, channel) = (first + index / count, names(channels)[index % count].1);
            let pixels = frame.row_mut(row).into_iter().skip(channel).step_by(count);
            for (pixel, sample) in pixels.zip(line) {
                *pixel = f32::from_ne_bytes(*sample);
            }
        }
    }
    Ok((headers.iter().map(part).collect(), stack))
}

/// Rows, columns and channels, which all parts must share.
fn common_layout(headers: &[Header]) -> Result<(usize, usize, Channels)> {
    let channels_of = |header: &Header| {
        let stored = &header.channels.list;
        let fits = |channels: &Channels| {
            let mut pairs = stored.iter().zip(names(*channels));
            let is_named = |c: &ChannelDescription, name: &str| {
                c.name.eq(name)
                    || (*channels == Channels::Grey && c.name.to_string().starts_with("S0."))
            };
            stored.len() == channels.count()
                && pairs.all(|(c, (name, _))| is_named(c, name) && c.sample_type == SampleType::F32)
        };
        [Channels::Grey, Channels::Rgb].into_iter().find(fits)
    };
    let mut layouts = headers.iter().map(|header| {
        let scan_lines = matches!(header.blocks, ::exr::meta::BlockDescription::ScanLines);
        let channels = channels_of(header).filter(|_| scan_lines)?;
        Some((header.layer_size.1, header.layer_size.0, channels))
    });
    match layouts.next() {
        Some(Some(first)) if layouts.all(|layout| layout == Some(first)) => Ok(first),
        _ => Err(FormatError::Unsupported {
            format: Format::Exr,
            found: "parts with other sizes, channels or blocks".to_owned(),
            accepted: "parts of one size with one float32 channel Y, or R, G and B, in scan lines",
        }),
    }
}

fn part(header: &Header) -> Part {
    let own = &header.own_attributes;
    let mut part = Part {
        name: own.layer_name.as_ref().map(text).unwrap_or_default(),
        frames_per_second: own.frames_per_second,
        ..Part::default()
    };
    for (name, value) in &own.other {
        match value {
            AttributeValue::Text(value) => {
                part.texts.insert(text(name), text(value));
            }
            AttributeValue::F64(seconds) if name.eq(FRAME_TIME) => {
                part.frame_time_s = Some(*seconds);
            }
            _ => {}
        }
    }
    part
}

fn text(text: &Text) -> String {
    String::from_utf8_lossy(text.as_slice()).into_owned()
}

fn error(error: ExrError) -> FormatError {
    match error {
        ExrError::Io(source) => FormatError::Io { action: "read the EXR file", source },
        other => FormatError::malformed(Format::Exr, other.to_string()),
    }
}
