//! Reads TIFF and BigTIFF stacks with one grey frame per page.

mod directory;

use std::io::{self, BufReader, ErrorKind, Read, Seek, SeekFrom};

use ::tiff::decoder::{ChunkType, Decoder, DecodingResult, Limits as DecoderLimits};
use ::tiff::tags::{PhotometricInterpretation, Tag};
use ::tiff::{ColorType, TiffError};
use ndarray::Array2;

use super::array::{ArrayReader, RawSamples, Restart};
use super::axes::Layout;
use super::{Format, FormatError, FrameReader, Limits, SampleType, StackInfo, samples};
use crate::error::Result;
use directory::{Pages, malformed};

const ACCEPTED_SAMPLES: &str = "one grey sample per pixel (BlackIsZero): unsigned 1, 8 or 16 bit, or 32- or 64-bit float (to convert others: \
     python -c \"import numpy, tifffile; numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const ACCEPTED_COLOUR: &str = "grey, BlackIsZero (to convert colours to grey: python -c \"import numpy, tifffile; a = tifffile.imread('in.tif'); \
     tifffile.imwrite('out.tif', (a[..., :3] @ numpy.array([.299, .587, .114])).round().astype(a.dtype))\")";
const ACCEPTED_WHITE: &str = "BlackIsZero (to convert integers: python -c \"import tifffile; \
     tifffile.imwrite('out.tif', ~tifffile.imread('in.tif'), photometric='minisblack')\")";
const ACCEPTED_COMPRESSION: &str = "no compression, LZW, Deflate, PackBits (to convert it: python -c \"import numpy; from PIL import Image, \
     ImageSequence; numpy.save('out.npy', [numpy.array(page) for page in \
     ImageSequence.Iterator(Image.open('in.tif'))])\")";
const ACCEPTED_IMAGEJ: &str =
    "contiguous images of 8, 16 or 32 bits that are not compressed, or one page per frame";

/// TIFF's number for no compression.
const UNCOMPRESSED: u16 = 1;
/// TIFF's numbers for the supported compressions, all of them lossless.
const SUPPORTED_COMPRESSIONS: [u16; 5] = [UNCOMPRESSED, 5, 8, 32946, 32773];

/// Upper bound of the expansion of all compressions. LZW reaches at most 2560 bytes per compressed byte.
const MAX_EXPANSION: u64 = 4096;

/// Opens a TIFF file of `length` bytes. Its pages are frames of one size and type, or all frames follow one page
/// header, as ImageJ writes them above 4 GB. All headers are checked against the limits, the length and each other.
/// Pixels are not read.
pub(super) fn open<R: Read + Seek + Send + 'static>(
    mut file: R,
    length: u64,
    limits: &Limits,
) -> Result<Box<dyn FrameReader + Send>> {
    let pages = directory::count_pages(&mut file, length, limits)?;
    file.rewind().map_err(FormatError::io("read the TIFF"))?;
    match pages.imagej_frames {
        Some(frames) => Ok(Box::new(open_imagej(file, (frames, pages), length, limits)?)),
        None => Ok(Box::new(TiffReader::open(file, pages.count, length, limits)?)),
    }
}

/// The file of a decoder, read from its first byte.
struct DecoderFile<R: Read + Seek>(Decoder<BufReader<R>>);

impl<R: Read + Seek> Read for DecoderFile<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.0.inner().read(buffer)
    }
}

impl<R: Read + Seek + Send> Restart for DecoderFile<R> {
    fn restart(&mut self) -> io::Result<()> {
        self.0.inner().rewind()
    }
}

/// Opens an ImageJ stack of more than 4 GB. Its page header describes the first frame; all other frames follow it.
fn open_imagej<R: Read + Seek + Send>(
    file: R,
    (frames, pages): (u64, Pages),
    length: u64,
    limits: &Limits,
) -> Result<ArrayReader<RawSamples<DecoderFile<R>>>> {
    let mut decoder = Decoder::new(BufReader::new(file)).map_err(|e| in_page(0, e))?;
    let first = read_page(&mut decoder, 0, length, limits)?;
    limits.check_shape(Format::Tiff, frames, first.height as u64, first.width as u64)?;
    let info = StackInfo { frames: frames as usize, ..first };
    let compression: Option<u16> =
        decoder.find_tag_unsigned(Tag::Compression).map_err(|e| in_page(0, e))?;
    let ranges = chunk_ranges(&mut decoder, 0)?;
    let contiguous = ranges.windows(2).all(|pair| pair[0].0 + pair[0].1 == pair[1].0);
    let plain = compression.unwrap_or(UNCOMPRESSED) == UNCOMPRESSED
        && decoder.get_chunk_type() == ChunkType::Strip
        && first.sample != SampleType::Bool;
    let (true, true, Some((start, _))) = (plain, contiguous, ranges.first()) else {
        return Err(FormatError::Unsupported {
            format: Format::Tiff,
            found: format!(
                "an ImageJ stack of {frames} images after one page header, compressed or not contiguous"
            ),
            accepted: ACCEPTED_IMAGEJ,
        });
    };
    let bytes = info.voxels() * info.sample.bytes() as u64;
    if start.saturating_add(bytes) > length {
        return Err(FormatError::Truncated {
            format: Format::Tiff,
            promised: format!(
                "{frames} images of {}x{} {} from byte {start} on ({bytes} bytes)",
                info.height, info.width, info.sample
            ),
            present: format!("{length} bytes in all"),
        });
    }
    let seek = decoder.inner().seek(SeekFrom::Start(*start));
    seek.map_err(FormatError::io("read the TIFF"))?;
    let file = DecoderFile(decoder);
    let samples = RawSamples::new(file, *start, (info.sample, pages.order), Format::Tiff);
    Ok(ArrayReader::new(samples, info, Layout { interleaved: false, by_columns: false }))
}

/// Reads a TIFF file whose pages are frames of one size and type.
struct TiffReader<R: Read + Seek> {
    decoder: Decoder<BufReader<R>>,
    info: StackInfo,
    next: usize,
}

impl<R: Read + Seek> TiffReader<R> {
    fn open(file: R, frames: usize, length: u64, limits: &Limits) -> Result<Self> {
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(|e| in_page(0, e))?;
        let first = read_page(&mut decoder, 0, length, limits)?;
        for number in 1..frames {
            decoder.next_image().map_err(|e| in_page(number, e))?;
            let page = read_page(&mut decoder, number, length, limits)?;
            if page != first {
                return Err(malformed(format!(
                    "page {number} is {}x{} {}, but page 0 is {}x{} {} (counted from 0); \
                     all pages must have the same size and type (to drop the others: python -c \"import numpy, tifffile; \
                     p = tifffile.TiffFile('in.tif').pages; numpy.save('out.npy', [a.asarray() for a in p if \
                     a.shape == p[0].shape])\")",
                    page.height, page.width, page.sample, first.height, first.width, first.sample
                )));
            }
        }
        let info = StackInfo { frames, ..first };
        limits.check_info(&info)?;
        let mut decoder_limits = DecoderLimits::default();
        // The decoder also counts the values of a page header against this limit.
        let frame_bytes = info.height * info.width * info.sample.bytes();
        decoder_limits.decoding_buffer_size = decoder_limits.decoding_buffer_size.max(frame_bytes);
        decoder_limits.intermediate_buffer_size = usize::try_from(length).unwrap_or(usize::MAX);
        Ok(Self { decoder: decoder.with_limits(decoder_limits), info, next: 0 })
    }
}

impl<R: Read + Seek> FrameReader for TiffReader<R> {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let page = self.next;
        if page == self.info.frames {
            return Ok(None);
        }
        self.next += 1;
        self.decoder.seek_to_image(page).map_err(|e| in_page(page, e))?;
        let values = match self.decoder.read_image().map_err(|e| in_page(page, e))? {
            DecodingResult::U8(bytes) if self.info.sample == SampleType::Bool => {
                bits(&bytes, self.info.width)
            }
            DecodingResult::U8(values) => values.into_iter().map(f32::from).collect(),
            DecodingResult::U16(values) => values.into_iter().map(f32::from).collect(),
            DecodingResult::F32(values) => values,
            DecodingResult::F64(values) => values.into_iter().map(|value| value as f32).collect(),
            _ => {
                return Err(FormatError::Internal(format!(
                    "TIFF page {page} has unexpected samples"
                )));
            }
        };
        samples::frame(self.info.height, self.info.width, values).map(Some)
    }
}

/// Unpacks rows of single bits, most significant bit first. Each row starts at a whole byte.
fn bits(bytes: &[u8], width: usize) -> Vec<f32> {
    let rows = bytes.chunks_exact(width.div_ceil(8).max(1));
    let bit = |row: &[u8], column: usize| f32::from(row[column / 8] >> (7 - column % 8) & 1);
    rows.flat_map(|row| (0..width).map(move |column| bit(row, column))).collect()
}

/// Checks the header of the current page of the decoder. The result has one frame.
fn read_page<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
    length: u64,
    limits: &Limits,
) -> Result<StackInfo> {
    let (width, height) = decoder.dimensions().map_err(|e| in_page(page, e))?;
    limits.check_shape(Format::Tiff, 1, height.into(), width.into())?;
    let sample = sample_type(decoder, page)?;
    let info = StackInfo::new(Format::Tiff, sample, 1, height as usize, width as usize);
    check_chunks(decoder, page, &info, length, limits)?;
    Ok(info)
}

fn sample_type<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
) -> Result<SampleType> {
    let tag = |decoder: &mut Decoder<_>, tag, default: u16| {
        decoder.find_tag_unsigned(tag).map(|v| v.unwrap_or(default)).map_err(|e| in_page(page, e))
    };
    let refused = |found: String, accepted| FormatError::Unsupported {
        format: Format::Tiff,
        found: format!("{found} (page {page})"),
        accepted,
    };
    let unsupported = |found| refused(found, ACCEPTED_SAMPLES);
    let black_is_zero = PhotometricInterpretation::BlackIsZero.to_u16();
    let photometric = tag(decoder, Tag::PhotometricInterpretation, black_is_zero)?;
    if photometric != black_is_zero {
        if photometric == PhotometricInterpretation::WhiteIsZero.to_u16() {
            return Err(refused("WhiteIsZero".to_owned(), ACCEPTED_WHITE));
        }
        let found = match PhotometricInterpretation::from_u16(photometric) {
            Some(name) => format!("{name:?} colours"),
            None => format!("photometric interpretation {photometric}"),
        };
        return Err(refused(found, ACCEPTED_COLOUR));
    }
    let bits = match decoder.colortype().map_err(|e| in_page(page, e))? {
        ColorType::Gray(bits) => bits,
        other => return Err(refused(format!("{other:?}"), ACCEPTED_COLOUR)),
    };
    let formats: Vec<u16> = decoder
        .find_tag_unsigned_vec(Tag::SampleFormat)
        .map_err(|e| in_page(page, e))?
        .unwrap_or_else(|| vec![1]);
    match (formats.first().copied(), bits) {
        (Some(1), 1) => Ok(SampleType::Bool),
        (Some(1), 8) => Ok(SampleType::U8),
        (Some(1), 16) => Ok(SampleType::U16),
        (Some(3), 32) => Ok(SampleType::F32),
        (Some(3), 64) => Ok(SampleType::F64),
        (Some(1), _) => Err(unsupported(format!("unsigned {bits}-bit samples"))),
        (Some(2), _) => Err(unsupported(format!("signed {bits}-bit samples"))),
        (Some(3), _) => Err(unsupported(format!("{bits}-bit float samples"))),
        _ => Err(unsupported(format!("sample format {formats:?}"))),
    }
}

/// Checks that the strips or tiles of a page are inside the file, and can contain the page.
fn check_chunks<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
    info: &StackInfo,
    length: u64,
    limits: &Limits,
) -> Result<()> {
    let compression: u16 = decoder
        .find_tag_unsigned(Tag::Compression)
        .map_err(|e| in_page(page, e))?
        .unwrap_or(UNCOMPRESSED);
    if !SUPPORTED_COMPRESSIONS.contains(&compression) {
        return Err(FormatError::Unsupported {
            format: Format::Tiff,
            found: format!("compression number {compression} (page {page})"),
            accepted: ACCEPTED_COMPRESSION,
        });
    }
    // The decoder allocates memory for a row of a tile, including the part outside the page.
    let (chunk_width, _) = decoder.chunk_dimensions();
    if u64::from(chunk_width) > 2 * limits.max_side as u64 {
        return Err(malformed(format!("page {page} has tiles of width {chunk_width}")));
    }
    let mut stored = 0u64;
    for (index, (offset, bytes)) in chunk_ranges(decoder, page)?.into_iter().enumerate() {
        let end = offset.saturating_add(bytes);
        if end > length {
            return Err(FormatError::Truncated {
                format: Format::Tiff,
                promised: format!(
                    "strip or tile {index} of page {page} at bytes {offset} to {end}"
                ),
                present: format!("{length} bytes in all"),
            });
        }
        stored = stored.saturating_add(bytes);
    }
    let needed = match info.sample {
        SampleType::Bool => (info.width.div_ceil(8) * info.height) as u64,
        sample => info.voxels() * sample.bytes() as u64,
    };
    let expansion = if compression == UNCOMPRESSED { 1 } else { MAX_EXPANSION };
    if stored.saturating_mul(expansion) < needed {
        return Err(FormatError::Truncated {
            format: Format::Tiff,
            promised: format!(
                "{}x{} {} in page {page} ({needed} bytes)",
                info.height, info.width, info.sample
            ),
            present: format!("{stored} stored bytes for it"),
        });
    }
    Ok(())
}

/// Offset and length of each strip or tile.
fn chunk_ranges<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
) -> Result<Vec<(u64, u64)>> {
    let mut find = |tag| decoder.find_tag_unsigned_vec::<u64>(tag).map_err(|e| in_page(page, e));
    let (offsets, counts) = match find(Tag::StripOffsets)? {
        Some(offsets) => (Some(offsets), find(Tag::StripByteCounts)?),
        None => (find(Tag::TileOffsets)?, find(Tag::TileByteCounts)?),
    };
    match (offsets, counts) {
        (Some(offsets), Some(counts)) if offsets.len() == counts.len() => {
            Ok(offsets.into_iter().zip(counts).collect())
        }
        _ => Err(malformed(format!("page {page} does not state the position of its pixels"))),
    }
}

fn in_page(page: usize, error: TiffError) -> FormatError {
    match error {
        // Decompressors report invalid data as I/O errors, too; only errors of the operating system have a number.
        TiffError::IoError(source) if source.raw_os_error().is_some() => {
            FormatError::Io { action: "read the TIFF page", source }
        }
        TiffError::IoError(source) if source.kind() == ErrorKind::UnexpectedEof => {
            FormatError::Truncated {
                format: Format::Tiff,
                promised: format!("page {page} (counted from 0)"),
                present: "only a part of it".to_owned(),
            }
        }
        TiffError::UnsupportedError(feature) => FormatError::Unsupported {
            format: Format::Tiff,
            found: format!("page {page}: {feature}"),
            accepted: ACCEPTED_SAMPLES,
        },
        other => malformed(format!("page {page}: {other}")),
    }
}

#[cfg(test)]
mod tests;
