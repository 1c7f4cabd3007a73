//! Reads PNG with all bits, as a stack of one frame.

use std::io::{BufReader, ErrorKind, Read, Seek};

use ::png::{
    BitDepth, ColorType, Decoder, DecodingError, Limits as DecoderLimits, Transformations,
};

use super::samples::{self, ByteOrder};
use super::stack::one_frame;
use super::{Channels, Format, FormatError, Limits, Reader, SampleType, StackInfo};
use crate::error::Result;

/// Largest expansion of Deflate in bytes per compressed byte.
const MAX_EXPANSION: u64 = 1032;

/// Memory for the buffers of the decoder, and for chunks other than pixels.
const DECODER_BYTES: usize = 16 << 20;

/// Opens a grey PNG of `length` bytes, and checks its header against the limits and the length. Gamma and colour profiles
/// are ignored.
pub(super) fn open<R: Read + Seek + Send + 'static>(
    file: R,
    length: u64,
    limits: &Limits,
) -> Result<Reader> {
    let mut decoder = decoder(file);
    let header = decoder.read_header_info().map_err(decoding_error)?;
    let sample = match (header.color_type, header.bit_depth) {
        (ColorType::Grayscale, BitDepth::One) => SampleType::Bool,
        (ColorType::Grayscale, BitDepth::Eight) => SampleType::U8,
        (ColorType::Grayscale, BitDepth::Sixteen) => SampleType::U16,
        (color, depth) => return Err(unsupported(format!("{color:?}, {depth:?} bit"))),
    };
    reader(decoder, (sample, Channels::Grey), length, limits)
}

/// Opens an RGB PNG; `None` for a PNG in other colours.
pub(super) fn open_colours<R: Read + Seek + Send + 'static>(
    file: R,
    length: u64,
    limits: &Limits,
) -> Result<Option<Reader>> {
    let mut decoder = decoder(file);
    let header = decoder.read_header_info().map_err(decoding_error)?;
    let sample = match (header.color_type, header.bit_depth) {
        (ColorType::Rgb, BitDepth::Eight) => SampleType::U8,
        (ColorType::Rgb, BitDepth::Sixteen) => SampleType::U16,
        _ => return Ok(None),
    };
    reader(decoder, (sample, Channels::Rgb), length, limits).map(Some)
}

/// A decoder that returns the stored values.
fn decoder<R: Read + Seek>(file: R) -> Decoder<BufReader<R>> {
    let limits = DecoderLimits { bytes: DECODER_BYTES };
    let mut decoder = Decoder::new_with_limits(BufReader::new(file), limits);
    decoder.set_transformations(Transformations::IDENTITY);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    decoder
}

fn reader<R: Read + Seek + Send + 'static>(
    mut decoder: Decoder<BufReader<R>>,
    (sample, channels): (SampleType, Channels),
    length: u64,
    limits: &Limits,
) -> Result<Reader> {
    let header = decoder.read_header_info().map_err(decoding_error)?;
    let (height, width) = (header.height, header.width);
    limits.check_shape(Format::Png, 1, height.into(), width.into())?;
    let samples = width as usize * channels.count();
    let info = StackInfo::new(Format::Png, sample, 1, height as usize, samples);
    let promised = (row_bytes(&info) * info.height) as u64;
    if length.saturating_mul(MAX_EXPANSION) < promised {
        return Err(FormatError::Truncated {
            format: Format::Png,
            promised: format!("{height}x{width} {sample} ({promised} bytes of pixels)"),
            present: format!("{length} bytes, too few even for perfect compression"),
        });
    }
    let mut reader = decoder.read_info().map_err(decoding_error)?;
    if reader.info().animation_control.is_some() {
        return Err(FormatError::Unsupported {
            format: Format::Png,
            found: "an animation".to_owned(),
            accepted: "one image (to convert all frames: python -c \"import numpy; from PIL import Image, \
                       ImageSequence; numpy.save('out.npy', [numpy.array(p if p.mode == 'I;16' else p.convert('L')) for p in \
                       ImageSequence.Iterator(Image.open('in.png'))])\")",
        });
    }
    Ok(one_frame(info, move || {
        let StackInfo { height, width, sample, .. } = info;
        let mut bytes = vec![0; row_bytes(&info) * height];
        reader.next_frame(&mut bytes).map_err(decoding_error)?;
        if sample == SampleType::Bool {
            let row =
                |row: &[u8]| (0..width).map(|j| row[j / 8] >> (7 - j % 8) & 1).collect::<Vec<_>>();
            bytes = bytes.chunks_exact(row_bytes(&info)).flat_map(row).collect();
        }
        samples::frame(height, width, samples::decode(&bytes, sample, ByteOrder::Big))
    }))
}

/// Number of bytes of a stored row. Rows of 1-bit pixels start at whole bytes.
fn row_bytes(info: &StackInfo) -> usize {
    if info.sample == SampleType::Bool {
        info.width.div_ceil(8)
    } else {
        info.width * info.sample.bytes()
    }
}

fn unsupported(found: String) -> FormatError {
    FormatError::Unsupported {
        format: Format::Png,
        found,
        accepted: "Grayscale without alpha, One, Eight or Sixteen bit, one image (to convert other pictures to grey \
                   with all their bits: python -c \"import imagecodecs, numpy; a = imagecodecs.imread('in.png'); g = a if \
                   a.ndim == 2 else a[..., :3] @ [.299, .587, .114] if a.shape[2] > 2 else a[..., 0]; numpy.save('out.npy', \
                   g.round().astype(a.dtype))\")",
    }
}

fn decoding_error(error: DecodingError) -> FormatError {
    match error {
        DecodingError::IoError(source) if source.kind() == ErrorKind::UnexpectedEof => {
            FormatError::Truncated {
                format: Format::Png,
                promised: "a whole image".to_owned(),
                present: "only its beginning".to_owned(),
            }
        }
        DecodingError::IoError(source) => FormatError::Io { action: "read the PNG", source },
        other => FormatError::malformed(Format::Png, other.to_string()),
    }
}

#[cfg(test)]
mod tests;
