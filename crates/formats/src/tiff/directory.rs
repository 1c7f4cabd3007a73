//! Checks the page headers of a TIFF before the decoder reads them.
//!
//! The `tiff` crate allocates memory for as many values as an entry claims, up to a limit that must be as large as a
//! frame. This module checks each claim against the length of the file first.

use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

use super::ome;
use super::refusal::{malformed, refused};
use crate::error::Result;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, Limits, limits};

/// Tags that this module reads.
const NEW_SUBFILE_TYPE: u16 = 254;
const SUBFILE_TYPE: u16 = 255;
const IMAGE_DESCRIPTION: u16 = 270;
const SUB_IFDS: u16 = 330;
/// A tag of MetaMorph, with a value for each plane behind one page header.
const UIC2: u16 = 33629;
/// Bits of `NewSubfileType`: a smaller copy of another page, and a mask of transparency.
const REDUCED_OR_MASK: u64 = 0b101;
/// Value of the older `SubfileType` for a smaller copy of another page.
const REDUCED: u64 = 2;
/// Largest number of sub-images of a page. Pyramids have about ten.
const MAX_SUB_IMAGES: u64 = 64;
/// First tag that is reserved for applications. The decoder does not read these tags.
const FIRST_PRIVATE_TAG: u16 = 32768;
/// Largest number of values of one entry: tiles of 16x16 pixels of a page of 8192x8192.
const MAX_VALUES: u64 = 1 << 18;
/// Largest number of entries of one page. Pages usually have about twenty.
const MAX_ENTRIES: u64 = 1000;
/// Longest description that is read. OME-XML has about 150 bytes per plane.
const MAX_DESCRIPTION_BYTES: u64 = 8 << 20;

/// Access to the numbers in page headers.
struct Layout<'a, R> {
    file: &'a mut R,
    length: u64,
    order: ByteOrder,
    big: bool,
}

/// One entry of a page header.
struct Entry {
    tag: u16,
    count: u64,
    bytes: u64,
    offset: u64,
    /// The field of the entry that holds either small values or the offset.
    inline: Vec<u8>,
}

/// The summary of all page headers.
#[derive(Debug, Clone)]
pub(super) struct Pages {
    /// The pages of the frames, in the order of the frames. Smaller copies and transparency masks are left out.
    pub(super) frames: Vec<usize>,
    /// Number of frames behind a single page header, as ImageJ and tifffile write them.
    pub(super) contiguous: Option<u64>,
    /// Byte order of the file.
    pub(super) order: ByteOrder,
}

/// Reads all page headers.
///
/// Errors: values outside the file; a cycle of pages; more pages than the limits allow; frames in sub-images, or in an
/// order that can't be determined.
pub(super) fn read_pages<R: Read + Seek>(
    file: &mut R,
    length: u64,
    limits: &Limits,
) -> Result<Pages> {
    let (mut layout, mut next) = Layout::open(file, length)?;
    let mut offsets = HashSet::new();
    let (mut description, mut planes) = (None, 0);
    let mut frames = Vec::new();
    while next != 0 {
        let page = offsets.len();
        if !offsets.insert(next) {
            return Err(malformed(format!("page {page} refers back to an earlier page")));
        }
        limits.check_shape(Format::Tiff, offsets.len() as u64, 1, 1)?;
        let (mut entries, following) = layout.page(page, next)?;
        if !layout.is_auxiliary(&entries)? {
            frames.push(page);
        }
        layout.check_sub_images(page, &entries)?;
        if page == 0 {
            planes = entries.iter().find(|entry| entry.tag == UIC2).map_or(0, |entry| entry.count);
            let found = entries.iter().position(|entry| entry.tag == IMAGE_DESCRIPTION);
            description = found.map(|place| entries.swap_remove(place));
        }
        next = following;
    }
    let pages = offsets.len();
    if frames.is_empty() {
        frames = (0..pages).collect();
    }
    if planes > 1 && pages == 1 {
        return Err(refused(
            format!("a MetaMorph stack of {planes} planes after one page header"),
            "one page per frame (to convert it: python -c \"import numpy, tifffile; numpy.save('out.npy', \
             tifffile.imread('in.tif'))\")",
        ));
    }
    let mut contiguous = None;
    if let Some(entry) = description {
        let text = layout.text(&entry)?;
        check_scale(&text)?;
        if pages == 1 {
            contiguous = contiguous_frames(&text);
        }
        if let Some(order) = ome::order(&text, frames.len())? {
            frames = order.into_iter().map(|plane| frames[plane]).collect();
        }
    }
    Ok(Pages { frames, contiguous, order: layout.order })
}

/// The number of frames behind one page header according to a description of ImageJ or tifffile; `None` for one frame.
fn contiguous_frames(text: &str) -> Option<u64> {
    let frames = if text.starts_with("ImageJ=") {
        text.lines().find_map(|line| line.strip_prefix("images="))?.trim().parse().ok()?
    } else {
        let (_, shape) = text.strip_suffix('}')?.split_once("{\"shape\": [")?;
        let (shape, _) =
            shape.split_once(']').filter(|(_, rest)| rest.contains("\"truncated\": true"))?;
        let axes: Vec<u64> =
            shape.split(',').map(|axis| axis.trim().parse().ok()).collect::<Option<_>>()?;
        let (frames, _) = axes.split_at(axes.len().saturating_sub(2));
        frames.iter().fold(1u64, |product, axis| product.saturating_mul(*axis))
    };
    (frames > 1).then_some(frames)
}

/// Refuses stacks whose values ImageJ converts by `c0 + c1 x`, as it does for signed integers.
fn check_scale(text: &str) -> Result<()> {
    let coefficient = |name: &str, default: f64| {
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        line.and_then(|value| value.trim().parse().ok()).unwrap_or(default)
    };
    let (offset, factor) = (coefficient("c0=", 0.0), coefficient("c1=", 1.0));
    if !text.starts_with("ImageJ=") || (offset == 0.0 && factor == 1.0) {
        return Ok(());
    }
    Err(refused(
        format!("stored numbers that ImageJ converts to {offset} + {factor} x"),
        "stored numbers without a conversion (to apply it: python -c \"import numpy, tifffile; f = \
         tifffile.TiffFile('in.tif'); m = f.imagej_metadata; numpy.save('out.npy', (f.asarray() * m['c1'] + \
         m['c0']).astype('f4'))\")",
    ))
}

impl<'a, R: Read + Seek> Layout<'a, R> {
    /// Reads the header of the file. The second value is the offset of the first page header.
    fn open(file: &'a mut R, length: u64) -> Result<(Self, u64)> {
        let mut layout = Self { file, length, order: ByteOrder::Little, big: false };
        let head = layout.read(0, 8)?;
        if head.starts_with(b"MM") {
            layout.order = ByteOrder::Big;
        }
        layout.big = layout.number(&head[2..4]) == 43;
        let first = if layout.big { layout.read(8, 8)? } else { head[4..].to_vec() };
        let first = layout.number(&first);
        Ok((layout, first))
    }

    /// Reads the entries of the page header at `offset`, and the offset of the next one.
    fn page(&mut self, page: usize, offset: u64) -> Result<(Vec<Entry>, u64)> {
        let (count_bytes, entry_bytes, pointer_bytes) =
            if self.big { (8, 20, 8) } else { (2, 12, 4) };
        let count = self.read(offset, count_bytes)?;
        let count = self.number(&count);
        if count > MAX_ENTRIES {
            return Err(malformed(format!(
                "page {page} claims {count} entries, but at most {MAX_ENTRIES} are accepted"
            )));
        }
        let start = offset + count_bytes;
        let table = self.read(start, count * entry_bytes)?;
        let entries = table
            .chunks_exact(entry_bytes as usize)
            .map(|entry| self.entry(page, entry))
            .collect::<Result<_, _>>()?;
        let next = self.read(start + count * entry_bytes, pointer_bytes)?;
        Ok((entries, self.number(&next)))
    }

    /// Parses one entry, and checks that its values are inside the file.
    fn entry(&self, page: usize, bytes: &[u8]) -> Result<Entry> {
        let inline = if self.big { 8 } else { 4 };
        let (head, offset) = bytes.split_at(bytes.len() - inline);
        let tag = self.number(&head[..2]) as u16;
        let count = self.number(&head[4..]);
        // Values of unknown types are not read.
        let value_bytes = match self.number(&head[2..4]) {
            1 | 2 | 6 | 7 => 1,
            3 | 8 => 2,
            4 | 9 | 11 | 13 => 4,
            5 | 10 | 12 | 16 | 17 | 18 => 8,
            _ => 0,
        };
        let bytes = count.saturating_mul(value_bytes);
        let (inline_bytes, offset) = (offset.to_vec(), self.number(offset));
        let entry = Entry { tag, count, bytes, offset, inline: inline_bytes };
        if bytes > inline as u64 && entry.offset.saturating_add(bytes) > self.length {
            return Err(FormatError::Truncated {
                format: Format::Tiff,
                promised: format!(
                    "{} values for tag {tag} of page {page} ({bytes} bytes at {})",
                    entry.count, entry.offset
                ),
                present: format!("{} bytes in all", self.length),
            });
        }
        if tag < FIRST_PRIVATE_TAG && tag != IMAGE_DESCRIPTION {
            let what = "the number of values of a tag (strips, tiles)";
            limits::check(Format::Tiff, what, count, MAX_VALUES)?;
        }
        Ok(entry)
    }

    /// True for a smaller copy of another page, and for a mask of transparency.
    fn is_auxiliary(&mut self, entries: &[Entry]) -> Result<bool> {
        for entry in entries {
            let auxiliary = |value: u64| match entry.tag {
                NEW_SUBFILE_TYPE => value & REDUCED_OR_MASK != 0,
                _ => value == REDUCED,
            };
            if [NEW_SUBFILE_TYPE, SUBFILE_TYPE].contains(&entry.tag)
                && self.numbers(entry, 1)?.into_iter().any(auxiliary)
            {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Refuses pages with sub-images that are not smaller copies of the page: they may be the frames.
    fn check_sub_images(&mut self, page: usize, entries: &[Entry]) -> Result<()> {
        let Some(entry) = entries.iter().find(|entry| entry.tag == SUB_IFDS) else { return Ok(()) };
        for offset in self.numbers(entry, MAX_SUB_IMAGES)? {
            let (entries, _) = self.page(page, offset)?;
            if !self.is_auxiliary(&entries)? {
                return Err(refused(
                    format!("sub-images that are not smaller copies of their page (page {page})"),
                    "one page per frame (to convert the sub-images: python -c \"import numpy, tifffile; \
                     numpy.save('out.npy', [s.asarray() for p in tifffile.TiffFile('in.tif').pages for s in p.pages or \
                     []])\")",
                ));
            }
        }
        Ok(())
    }

    /// The numbers of an entry, at most `limit`.
    fn numbers(&mut self, entry: &Entry, limit: u64) -> Result<Vec<u64>> {
        let size = entry.bytes.checked_div(entry.count).unwrap_or(0);
        if size == 0 {
            return Ok(Vec::new());
        }
        let bytes = self.values(entry, entry.count.min(limit) * size)?;
        Ok(bytes.chunks_exact(size as usize).map(|number| self.number(number)).collect())
    }

    /// The first `bytes` bytes of the values of an entry.
    fn values(&mut self, entry: &Entry, bytes: u64) -> Result<Vec<u8>> {
        if entry.bytes <= entry.inline.len() as u64 {
            return Ok(entry.inline[..bytes as usize].to_vec());
        }
        self.read(entry.offset, bytes)
    }

    /// The description of a page. Errors: a too long one.
    fn text(&mut self, entry: &Entry) -> Result<String> {
        let what = "the length of the description in bytes";
        limits::check(Format::Tiff, what, entry.bytes, MAX_DESCRIPTION_BYTES)?;
        let bytes = self.values(entry, entry.bytes)?;
        let text = String::from_utf8_lossy(&bytes);
        Ok(text.trim_end_matches('\0').trim().to_owned())
    }

    fn read(&mut self, offset: u64, count: u64) -> Result<Vec<u8>> {
        if offset.saturating_add(count) > self.length {
            return Err(FormatError::Truncated {
                format: Format::Tiff,
                promised: format!("a page header of at least {count} bytes at byte {offset}"),
                present: format!("{} bytes in all", self.length),
            });
        }
        let mut bytes = vec![0; count as usize];
        let seek = self.file.seek(SeekFrom::Start(offset));
        seek.and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(FormatError::io("read the TIFF page header"))?;
        Ok(bytes)
    }

    /// Decodes a number of 2, 4 or 8 bytes.
    fn number(&self, bytes: &[u8]) -> u64 {
        let shift = |number: u64, byte: &u8| number << 8 | u64::from(*byte);
        match self.order {
            ByteOrder::Little => bytes.iter().rev().fold(0, shift),
            ByteOrder::Big => bytes.iter().fold(0, shift),
        }
    }
}
