//! Writes EXR frames and stacks.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use ::exr::block::UncompressedBlock;
use ::exr::block::writer::{ChunkWriter, ChunksWriter};
use ::exr::block::{self, BlockIndex};
use ::exr::compression::Compression;
use ::exr::error::Error as ExrError;
use ::exr::math::Vec2;
use ::exr::meta::BlockDescription;
use ::exr::meta::attribute::{AttributeValue, ChannelDescription, LineOrder, SampleType, Text};
use ::exr::meta::header::{Header, LayerAttributes};
use ndarray::{Array2, ArrayView2, s};

use super::order::sort_attributes;
use super::{FRAME_TIME, names};
use crate::error::Result;
use crate::{Channels, FormatError};

/// Frames are not compressed, because the low bits of reconstructed floats are noise. On a camera clip with a little
/// added noise, ZIP saves 3 % and takes about 0.2 s per megapixel, no compression 0.02 s.
const COMPRESSION: Compression = Compression::Uncompressed;

/// The attributes of a frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Attributes {
    /// Names and values of string attributes (provenance). Names have up to 255 bytes and differ from those that
    /// OpenEXR defines. Values are UTF-8.
    pub texts: Vec<(String, String)>,
    /// Time of the frame in seconds after the start of the sequence: `frameTime` (double).
    pub frame_time_s: Option<f64>,
    /// Frames per second: OpenEXR's `framesPerSecond` (rational, rounded to thousandths).
    pub frames_per_second: Option<f64>,
    /// Exposure time in seconds: OpenEXR's `expTime` (float).
    pub exposure_s: Option<f32>,
    /// Wavelength of a grey frame in nanometres, which names its channel.
    pub wavelength_nm: Option<f64>,
}

/// Writes one frame (row, column), and replaces an existing file. All channels of a pixel are in adjacent columns.
///
/// Errors: I/O; [`FormatError::Internal`] for an empty frame, and for attributes that can't be written.
pub fn write_frame(
    path: &Path,
    frame: ArrayView2<'_, f32>,
    channels: Channels,
    attributes: &Attributes,
) -> Result<()> {
    let (height, samples) = frame.dim();
    let size = (height, samples / channels.count());
    let parts = vec![header(size, channels, attributes, None)?];
    write_parts(path, parts, |writer, headers| write_part(writer, (headers, 0), channels, frame))
}

/// Writes a file with one part per element of `parts`, named `frame_0001` and so on, and replaces an existing file.
///
/// `frame(k)` is called in order from 0, and must return frames of this size (rows, columns). One frame at a time is in
/// memory.
///
/// Errors: those of `frame`; as [`write_frame`].
pub fn write_stack<E: From<FormatError>>(
    path: &Path,
    size: (usize, usize),
    channels: Channels,
    parts: &[Attributes],
    mut frame: impl FnMut(usize) -> Result<Array2<f32>, E>,
) -> Result<(), E> {
    let headers = parts
        .iter()
        .enumerate()
        .map(|(k, attributes)| header(size, channels, attributes, Some(part_name(k))))
        .collect::<Result<Vec<_>, _>>()?;
    // The closure can only return errors of the EXR crate, so an error of `frame` is kept here.
    let mut failure = None;
    let written = write_parts(path, headers, |writer, headers| {
        for part in 0..headers.len() {
            match frame(part) {
                Ok(frame) => write_part(writer, (headers, part), channels, frame.view())?,
                Err(error) => {
                    failure = Some(error);
                    return Err(ExrError::Aborted);
                }
            }
        }
        Ok(())
    });
    match failure {
        Some(error) => Err(error),
        None => Ok(written?),
    }
}

fn part_name(index: usize) -> String {
    format!("frame_{:04}", index + 1)
}

/// Name of the channel of a wavelength in the layout of spectral EXR images (Fichet, Pacanowski and Wilkie 2021), with a
/// decimal comma because dots separate layers. Rounding errors are left out, but bands that differ have different names.
fn spectral_name(wavelength_nm: f64) -> String {
    let rounded = (wavelength_nm * 1000.0).round() / 1000.0;
    let is_exact = (rounded - wavelength_nm).abs() <= 1e-12 * wavelength_nm;
    let shown = if is_exact { rounded } else { wavelength_nm };
    format!("S0.{}nm", shown.to_string().replace('.', ","))
}

fn header(
    (height, width): (usize, usize),
    channels: Channels,
    attributes: &Attributes,
    name: Option<String>,
) -> Result<Header> {
    if height == 0 || width == 0 {
        return Err(FormatError::Internal(format!("an EXR frame of {height}x{width} is empty")));
    }
    let names = match (channels, attributes.wavelength_nm) {
        (Channels::Grey, Some(wavelength)) => vec![spectral_name(wavelength)],
        _ => names(channels).iter().map(|(name, _)| (*name).to_owned()).collect(),
    };
    let channels = names.iter().map(|name| ChannelDescription::named(&**name, SampleType::F32));
    let header = Header::new(Text::from(""), Vec2(width, height), channels.collect());
    let mut own = LayerAttributes {
        layer_name: name.as_deref().map(Text::from),
        exposure: attributes.exposure_s,
        frames_per_second: attributes.frames_per_second.map(rational),
        ..LayerAttributes::default()
    };
    if let Some(seconds) = attributes.frame_time_s {
        own.other.insert(Text::from(FRAME_TIME), AttributeValue::F64(seconds));
    }
    for (name, value) in &attributes.texts {
        // OpenEXR strings are bytes, which readers interpret as UTF-8.
        let value = AttributeValue::Text(Text::from_slice_unchecked(value.as_bytes()));
        let name = Text::from_slice_unchecked(name.as_bytes());
        if own.other.insert(name, value).is_some() {
            return Err(FormatError::Internal("two EXR attributes have the same name".to_owned()));
        }
    }
    Ok(header.with_attributes(own).with_encoding(
        COMPRESSION,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    ))
}

/// A frame rate as numerator and denominator.
fn rational(frames_per_second: f64) -> (i32, u32) {
    if frames_per_second.fract() == 0.0 {
        (frames_per_second as i32, 1)
    } else {
        ((frames_per_second * 1000.0).round() as i32, 1000)
    }
}

type PartWriter = ChunkWriter<BufWriter<File>>;

fn write_parts(
    path: &Path,
    headers: Vec<Header>,
    write: impl FnOnce(&mut PartWriter, &[Header]) -> Result<(), ExrError>,
) -> Result<()> {
    let file = File::create(path).map_err(FormatError::io("create the EXR file"))?;
    let strict = true;
    block::write(BufWriter::new(file), headers.into_iter().collect(), strict, |meta, writer| {
        write(writer, &meta.headers)
    })
    .map_err(|error| match error {
        ExrError::Io(source) => FormatError::Io { action: "write the EXR file", source },
        other => FormatError::Internal(format!("EXR: {other}")),
    })?;
    sort_attributes(path).map_err(FormatError::io("write the EXR file"))
}

/// Compresses and writes one part, block by block.
fn write_part(
    writer: &mut PartWriter,
    (headers, part): (&[Header], usize),
    channels: Channels,
    frame: ArrayView2<'_, f32>,
) -> Result<(), ExrError> {
    let size = headers[part].layer_size;
    if frame.dim() != (size.1, size.0 * channels.count()) {
        let message = format!("frame {part} is {:?}, its part {}x{}", frame.dim(), size.1, size.0);
        return Err(ExrError::Invalid(message.into()));
    }
    let lines = COMPRESSION.scan_lines_per_block();
    for (index, rows) in frame.axis_chunks_iter(ndarray::Axis(0), lines).enumerate() {
        let block = UncompressedBlock {
            index: BlockIndex {
                layer: part,
                pixel_position: Vec2(0, index * lines),
                pixel_size: Vec2(size.0, rows.nrows()),
                level: Vec2(0, 0),
            },
            data: block_bytes(rows, channels),
        };
        writer.write_chunk(index, block.compress_to_chunk(headers)?)?;
    }
    Ok(())
}

/// The bytes of a block: each row stores its channels one after another.
fn block_bytes(rows: ArrayView2<'_, f32>, channels: Channels) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(rows.len() * size_of::<f32>());
    for row in rows.rows() {
        for &(_, place) in names(channels) {
            let values = row.slice(s![place..;channels.count().cast_signed()]);
            bytes.extend(values.iter().flat_map(|value| value.to_ne_bytes()));
        }
    }
    bytes
}
