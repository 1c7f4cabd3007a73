//! Checks the page headers of a TIFF before the decoder reads them.
//!
//! The `tiff` crate allocates memory for as many values as an entry claims, up to a limit that must be as large as a
//! frame. This module checks each claim against the length of the file first.

use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

use crate::error::Result;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, Limits};

/// The tag of the description.
const IMAGE_DESCRIPTION: u16 = 270;
/// First tag that is reserved for applications. The decoder does not read these tags.
const FIRST_PRIVATE_TAG: u16 = 32768;
/// Largest number of values of one entry: tiles of 16x16 pixels of a page of 8192x8192.
const MAX_VALUES: u64 = 1 << 18;
/// Largest number of entries of one page. Pages usually have about twenty.
const MAX_ENTRIES: u64 = 1000;
/// Length of the part of a description that is searched. ImageJ states the number of images in the first lines.
const DESCRIPTION_BYTES: u64 = 1024;

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
}

/// The summary of all page headers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pages {
    /// Number of pages.
    pub(super) count: usize,
    /// Number of images that ImageJ has written after a single page header, as it does above 4 GB.
    pub(super) imagej_frames: Option<u64>,
    /// Byte order of the file.
    pub(super) order: ByteOrder,
}

/// Reads all page headers.
///
/// Errors: values outside the file; a cycle of pages; more pages than the limits allow.
pub(super) fn count_pages<R: Read + Seek>(
    file: &mut R,
    length: u64,
    limits: &Limits,
) -> Result<Pages> {
    let (mut layout, mut next) = Layout::open(file, length)?;
    let mut offsets = HashSet::new();
    let mut description = None;
    while next != 0 {
        let page = offsets.len();
        if !offsets.insert(next) {
            return Err(malformed(format!("page {page} refers back to an earlier page")));
        }
        limits.check_shape(Format::Tiff, offsets.len() as u64, 1, 1)?;
        let (entries, following) = layout.page(page, next)?;
        if page == 0 {
            description = entries.into_iter().find(|entry| entry.tag == IMAGE_DESCRIPTION);
        }
        next = following;
    }
    let imagej_frames = match (description, offsets.len()) {
        (Some(entry), 1) => layout.imagej_images(&entry)?,
        _ => None,
    };
    Ok(Pages { count: offsets.len(), imagej_frames, order: layout.order })
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
        let entry = Entry { tag, count, bytes, offset: self.number(offset) };
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
        if count > MAX_VALUES && tag < FIRST_PRIVATE_TAG && tag != IMAGE_DESCRIPTION {
            return Err(FormatError::OverLimit {
                format: Format::Tiff,
                what: "the number of values of a tag (strips, tiles)",
                value: count,
                limit: MAX_VALUES,
            });
        }
        Ok(entry)
    }

    /// The number of images in an ImageJ description; `None` for one image.
    fn imagej_images(&mut self, description: &Entry) -> Result<Option<u64>> {
        if description.bytes <= 8 {
            return Ok(None);
        }
        let text = self.read(description.offset, description.bytes.min(DESCRIPTION_BYTES))?;
        let text = String::from_utf8_lossy(&text);
        let images = text.lines().find_map(|line| line.strip_prefix("images="));
        let images = images.and_then(|count| count.trim().parse::<u64>().ok());
        Ok(images.filter(|count| *count > 1 && text.starts_with("ImageJ=")))
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

pub(super) fn malformed(problem: String) -> FormatError {
    FormatError::malformed(Format::Tiff, problem)
}
