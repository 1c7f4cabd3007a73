//! Reads TIFF and BigTIFF stacks with one grey frame per page.

mod colours;
mod directory;
mod ome;
mod refusal;
mod tags;

use std::fmt;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use ::tiff::decoder::{ChunkType, Decoder, DecodingResult, Limits as DecoderLimits};
use ::tiff::tags::Tag;
use ndarray::Array2;

use super::array::{ArrayReader, RawSamples, Restart};
use super::axes::Layout;
use super::{Format, FormatError, FrameReader, Limits, Reader, SampleType, StackInfo, samples};
use crate::error::Result;
use directory::Pages;
use refusal::malformed;
use tags::{ACCEPTED_SAMPLES, Tags, UNCOMPRESSED, in_page};

const ACCEPTED_FORMATS: &str = "integers and floats (to convert others: python -c \"import imagecodecs, numpy, tifffile; numpy.save('out.npy', \
     [p.asarray() for p in tifffile.TiffFile('in.tif').pages])\")";
const ACCEPTED_COMPRESSION: &str = "no compression, LZW, Deflate, PackBits (to convert it: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const ACCEPTED_AS_STORED: &str = "rows from top to bottom and columns from left to right (to keep the pixels as they are stored: python -c \"import \
     imagecodecs, numpy, tifffile; numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const ACCEPTED_PREDICTOR: &str = "a predictor with LZW or Deflate only (to ignore it, as libtiff does: python -c \"import numpy; from PIL import Image, \
     ImageSequence; numpy.save('out.npy', [numpy.array(page) for page in ImageSequence.Iterator(Image.open('in.tif'))])\")";
const ACCEPTED_IMAGEJ: &str =
    "contiguous images of 8, 16, 32 or 64 bits that are not compressed, or one page per frame";

/// TIFF's number for PackBits.
const PACK_BITS: u16 = 32773;
/// TIFF's numbers for the supported compressions, all of them lossless.
const SUPPORTED_COMPRESSIONS: [u16; 5] = [UNCOMPRESSED, 5, 8, 32946, PACK_BITS];

/// Upper bound of the expansion of all compressions. LZW reaches at most 2560 bytes per compressed byte.
const MAX_EXPANSION: u64 = 4096;

/// Opens a TIFF file of `length` bytes. Its pages are frames of one size and type, or all frames follow one page
/// header, as ImageJ writes them above 4 GB and tifffile on request. All headers are checked against the limits, the
/// length and each other. Pixels are not read.
pub(super) fn open<R: Read + Seek + Send + 'static>(
    mut file: R,
    length: u64,
    limits: &Limits,
) -> Result<Reader> {
    let pages = directory::read_pages(&mut file, length, limits)?;
    file.rewind().map_err(FormatError::io("read the TIFF"))?;
    match pages.contiguous {
        Some(frames) => Ok(Box::new(open_contiguous(file, (frames, pages), length, limits)?)),
        None => Ok(Box::new(TiffReader::open(file, pages.frames, length, limits)?)),
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

/// Opens a stack with one page header, which describes the first frame. All other frames follow it.
fn open_contiguous<R: Read + Seek + Send>(
    file: R,
    (frames, pages): (u64, Pages),
    length: u64,
    limits: &Limits,
) -> Result<ArrayReader<RawSamples<DecoderFile<R>>>> {
    let mut decoder = Decoder::new(BufReader::new(file)).map_err(|e| in_page(0, e))?;
    let page = read_page(&mut decoder, 0, length, limits)?;
    let first = page.info;
    limits.check_shape(Format::Tiff, frames, first.height as u64, first.width as u64)?;
    let info = StackInfo { frames: frames as usize, ..first };
    let compression: Option<u16> =
        decoder.find_tag_unsigned(Tag::Compression).map_err(|e| in_page(0, e))?;
    let ranges = chunk_ranges(&mut decoder, 0)?;
    let contiguous = ranges.windows(2).all(|pair| pair[0].0 + pair[0].1 == pair[1].0);
    let plain = compression.unwrap_or(UNCOMPRESSED) == UNCOMPRESSED
        && decoder.get_chunk_type() == ChunkType::Strip
        && !page.is_packed()
        && !page.by_rows
        && !page.reversed;
    let (true, true, Some((start, _))) = (plain, contiguous, ranges.first()) else {
        return Err(FormatError::Unsupported {
            format: Format::Tiff,
            found: format!(
                "a stack of {frames} images after one page header, compressed or not contiguous"
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
    /// The number of each frame's page.
    pages: Vec<usize>,
    page: Page,
    info: StackInfo,
    next: usize,
}

impl<R: Read + Seek> TiffReader<R> {
    fn open(file: R, pages: Vec<usize>, length: u64, limits: &Limits) -> Result<Self> {
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(|e| in_page(0, e))?;
        // In this order the decoder finds all pages in one pass.
        let mut in_file: Vec<usize> = pages.clone();
        in_file.sort_unstable();
        let mut first: Option<(usize, Page)> = None;
        for number in in_file {
            decoder.seek_to_image(number).map_err(|e| in_page(number, e))?;
            let page = read_page(&mut decoder, number, length, limits)?;
            let (other, first) = *first.get_or_insert((number, page));
            if page != first {
                return Err(malformed(format!(
                    "page {number} is {page}, but page {other} is {first} (counted from 0); \
                     all pages must have the same size and type (to drop the others: python -c \"import numpy, tifffile; \
                     p = tifffile.TiffFile('in.tif').pages; numpy.save('out.npy', [a.asarray() for a in p if \
                     (a.shape, a.dtype) == (p[{other}].shape, p[{other}].dtype)])\")",
                )));
            }
        }
        let (_, page) = first.ok_or_else(|| malformed("the file has no pages".to_owned()))?;
        let info = StackInfo { frames: pages.len(), ..page.info };
        limits.check_info(&info)?;
        let mut decoder_limits = DecoderLimits::default();
        // The decoder also counts the values of a page header against this limit.
        let frame_bytes = info.height * info.width * info.sample.bytes();
        decoder_limits.decoding_buffer_size = decoder_limits.decoding_buffer_size.max(frame_bytes);
        decoder_limits.intermediate_buffer_size = usize::try_from(length).unwrap_or(usize::MAX);
        Ok(Self { decoder: decoder.with_limits(decoder_limits), pages, page, info, next: 0 })
    }

    /// Reads the stored rows of the current page. Bytes that a strip lacks are 0.
    fn read_rows(&mut self, page: usize) -> Result<Vec<u8>> {
        let row_bytes = self.page.row_bytes();
        let (_, strip_rows) = self.decoder.chunk_dimensions();
        let mut bytes = Vec::with_capacity(row_bytes * self.info.height);
        for (start, length) in chunk_ranges(&mut self.decoder, page)? {
            let rows = (self.info.height - bytes.len() / row_bytes).min(strip_rows as usize);
            let end = bytes.len() + rows * row_bytes;
            let file = self.decoder.inner();
            let length = length.min((rows * row_bytes) as u64);
            let read = file
                .seek(SeekFrom::Start(start))
                .and_then(|_| file.by_ref().take(length).read_to_end(&mut bytes));
            read.map_err(FormatError::io("read the TIFF page"))?;
            bytes.resize(end, 0);
        }
        bytes.resize(row_bytes * self.info.height, 0);
        Ok(bytes)
    }
}

impl<R: Read + Seek> FrameReader for TiffReader<R> {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let Some(&page) = self.pages.get(self.next) else { return Ok(None) };
        self.next += 1;
        self.decoder.seek_to_image(page).map_err(|e| in_page(page, e))?;
        let Page { bits, reversed, .. } = self.page;
        let values = if self.page.by_rows {
            unpack(&self.read_rows(page)?, self.page.row_bytes(), (self.info.width, bits))
        } else {
            match self.decoder.read_image().map_err(|e| in_page(page, e))? {
                DecodingResult::U8(mut bytes) => {
                    if reversed {
                        bytes.iter_mut().for_each(|byte| *byte = byte.reverse_bits());
                    }
                    unpack(&bytes, self.page.row_bytes(), (self.info.width, bits))
                }
                DecodingResult::U16(values) => {
                    let bytes_reversed = |value: u16| value.reverse_bits().swap_bytes();
                    let value = |value| if reversed { bytes_reversed(value) } else { value };
                    values.into_iter().map(|stored| f32::from(value(stored))).collect()
                }
                DecodingResult::U32(values) => values.into_iter().map(|v| v as f32).collect(),
                DecodingResult::U64(values) => values.into_iter().map(|v| v as f32).collect(),
                DecodingResult::I8(values) => values.into_iter().map(f32::from).collect(),
                DecodingResult::I16(values) => values.into_iter().map(f32::from).collect(),
                DecodingResult::I32(values) => values.into_iter().map(|v| v as f32).collect(),
                DecodingResult::I64(values) => values.into_iter().map(|v| v as f32).collect(),
                DecodingResult::F16(values) => values.into_iter().map(|v| v.to_f32()).collect(),
                DecodingResult::F32(values) => values,
                DecodingResult::F64(values) => values.into_iter().map(|v| v as f32).collect(),
            }
        };
        samples::frame(self.info.height, self.info.width, values).map(Some)
    }
}

/// Unpacks rows of samples of `bits` bits, most significant bit first. Each row starts at a whole byte.
fn unpack(bytes: &[u8], row_bytes: usize, (width, bits): (usize, u8)) -> Vec<f32> {
    if bits == 8 {
        return bytes.iter().map(|byte| f32::from(*byte)).collect();
    }
    let bits = usize::from(bits);
    let sample = |row: &[u8], column: usize| {
        let (first, last) = (column * bits, (column + 1) * bits);
        let word = row[first / 8..last.div_ceil(8)]
            .iter()
            .fold(0u32, |word, byte| word << 8 | u32::from(*byte));
        let unused = last.div_ceil(8) * 8 - last;
        ((word >> unused) & ((1 << bits) - 1)) as f32
    };
    let rows = bytes.chunks_exact(row_bytes.max(1));
    rows.flat_map(|row| (0..width).map(move |column| sample(row, column))).collect()
}

/// The description of a page.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Page {
    /// The page as a stack of one frame.
    info: StackInfo,
    /// Number of bits of a sample.
    bits: u8,
    /// True if the bits of each stored byte are in reverse order.
    reversed: bool,
    /// True if the stored rows are read without the decoder.
    by_rows: bool,
}

impl Page {
    /// True if samples do not fill whole bytes.
    fn is_packed(&self) -> bool {
        !self.bits.is_multiple_of(8)
    }

    fn row_bytes(&self) -> usize {
        (self.info.width * usize::from(self.bits)).div_ceil(8)
    }
}

impl fmt::Display for Page {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let StackInfo { height, width, sample, .. } = self.info;
        write!(f, "{height}x{width} {sample}")?;
        if self.is_packed() && self.bits > 1 {
            write!(f, " of {} bits", self.bits)?;
        }
        if self.reversed {
            write!(f, " in reverse order")?;
        }
        Ok(())
    }
}

/// Checks the header of the current page of the decoder.
fn read_page<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
    length: u64,
    limits: &Limits,
) -> Result<Page> {
    let (width, height) = decoder.dimensions().map_err(|e| in_page(page, e))?;
    limits.check_shape(Format::Tiff, 1, height.into(), width.into())?;
    let mut tags = Tags { decoder, page };
    let palette = colours::check(&mut tags)?;
    let (sample, bits) = sample_type(&mut tags)?;
    let reversed = check_storage(&mut tags, sample, bits)?;
    let mut info = StackInfo::new(Format::Tiff, sample, 1, height as usize, width as usize);
    if !bits.is_multiple_of(8) && bits > 1 {
        let largest = f32::from((1u16 << bits) - 1);
        info = info.with_largest(largest)?;
    }
    // The decoder supports neither palettes nor these bit depths.
    let by_rows = palette || (bits > 8 && !bits.is_multiple_of(8));
    let checked = Page { info, bits, reversed, by_rows };
    check_chunks(decoder, page, &checked, length, limits)?;
    Ok(checked)
}

/// The type of the samples, and their number of bits.
fn sample_type<R: Read + Seek>(tags: &mut Tags<'_, R>) -> Result<(SampleType, u8)> {
    let bits = tags.numbers(Tag::BitsPerSample)?.first().copied().unwrap_or(1);
    let bits = u8::try_from(bits).unwrap_or(u8::MAX);
    let format = tags.numbers(Tag::SampleFormat)?.first().copied().unwrap_or(1);
    let sample = match (format, bits) {
        (1, 1) => SampleType::Bool,
        (1, 2..=8) => SampleType::U8,
        (1, 9..=16) => SampleType::U16,
        (1, 32) => SampleType::U32,
        (1, 64) => SampleType::U64,
        (2, 8) => SampleType::I8,
        (2, 16) => SampleType::I16,
        (2, 32) => SampleType::I32,
        (2, 64) => SampleType::I64,
        (3, 16) => SampleType::F16,
        (3, 32) => SampleType::F32,
        (3, 64) => SampleType::F64,
        (1, _) => {
            return Err(tags.refused(format_args!("unsigned {bits}-bit samples"), ACCEPTED_SAMPLES));
        }
        (2, _) => {
            return Err(tags.refused(format_args!("signed {bits}-bit samples"), ACCEPTED_SAMPLES));
        }
        (3, _) => {
            return Err(tags.refused(format_args!("{bits}-bit float samples"), ACCEPTED_SAMPLES));
        }
        _ => return Err(tags.refused(format_args!("sample format {format}"), ACCEPTED_FORMATS)),
    };
    Ok((sample, bits))
}

/// Checks the tags that change the order of pixels or bits. Returns true if the bits of each byte are reversed.
fn check_storage<R: Read + Seek>(
    tags: &mut Tags<'_, R>,
    sample: SampleType,
    bits: u8,
) -> Result<bool> {
    let orientation = tags.number(Tag::Orientation, 1)?;
    if orientation > 1 {
        let found = format_args!("orientation {orientation}, which turns or mirrors the picture");
        return Err(tags.refused(found, ACCEPTED_AS_STORED));
    }
    let compression = tags.number(Tag::Compression, UNCOMPRESSED)?;
    if !SUPPORTED_COMPRESSIONS.contains(&compression) {
        let found = format_args!("compression number {compression}");
        return Err(tags.refused(found, ACCEPTED_COMPRESSION));
    }
    let predictor = tags.number(Tag::Predictor, 1)?;
    if predictor > 1 && [UNCOMPRESSED, PACK_BITS].contains(&compression) {
        let found = format_args!("predictor {predictor} with compression number {compression}");
        return Err(tags.refused(found, ACCEPTED_PREDICTOR));
    }
    if bits > 8 && !bits.is_multiple_of(8) && !tags.is_plain()? {
        let found = format_args!("{bits}-bit samples in tiles or compressed");
        return Err(tags.refused(found, ACCEPTED_SAMPLES));
    }
    let reversed = tags.number(Tag::FillOrder, 1)? == 2;
    let integers = [SampleType::Bool, SampleType::U8, SampleType::U16].contains(&sample);
    if reversed && (compression != UNCOMPRESSED || !integers || (bits > 8 && bits != 16)) {
        let found = format_args!(
            "reversed bits (FillOrder 2) of {bits}-bit {sample} with compression number {compression}"
        );
        return Err(tags.refused(found, ACCEPTED_SAMPLES));
    }
    Ok(reversed)
}

/// Checks that the strips or tiles of a page are inside the file, and can contain the page.
fn check_chunks<R: Read + Seek>(
    decoder: &mut Decoder<BufReader<R>>,
    page: usize,
    checked: &Page,
    length: u64,
    limits: &Limits,
) -> Result<()> {
    let compression: u16 = decoder
        .find_tag_unsigned(Tag::Compression)
        .map_err(|e| in_page(page, e))?
        .unwrap_or(UNCOMPRESSED);
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
    let needed = (checked.row_bytes() * checked.info.height) as u64;
    let expansion = if compression == UNCOMPRESSED { 1 } else { MAX_EXPANSION };
    if stored.saturating_mul(expansion) < needed {
        return Err(FormatError::Truncated {
            format: Format::Tiff,
            promised: format!("{checked} in page {page} ({needed} bytes)"),
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

#[cfg(test)]
mod tests;
