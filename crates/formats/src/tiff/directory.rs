//! The page headers of a TIFF, checked before the decoder sees them.
//!
//! The `tiff` crate makes room for as many values as an entry claims, up to a limit that has to be
//! as large as a frame. Here each claim is held against the file's length first.

use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

use crate::error::Result;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, Limits};

/// The tag of free text.
const IMAGE_DESCRIPTION: u16 = 270;
/// Tags from here on belong to applications; the decoder does not read them.
const FIRST_PRIVATE_TAG: u16 = 32768;
/// The most values of one entry: the tiles of 16x16 pixels of a page of 8192x8192.
const MAX_VALUES: u64 = 1 << 18;
/// Entries of one page. Pages have some twenty.
const MAX_ENTRIES: u64 = 1000;
/// An ImageJ description says what is needed in its first lines.
const DESCRIPTION_BYTES: u64 = 1024;

/// Where the numbers of a page header stand.
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

/// What the page headers say.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pages {
    pub(super) count: usize,
    /// Images that ImageJ has put behind the only page header, as it does above 4 GB: to read one frame of many
    /// would be a silent loss.
    pub(super) behind: Option<u64>,
    pub(super) order: ByteOrder,
}

/// Walks over all page headers.
///
/// Errors: values that lie outside the file, pages in a circle, more pages than the limits allow.
pub(super) fn count_pages<R: Read + Seek>(
    file: &mut R,
    length: u64,
    limits: &Limits,
) -> Result<Pages> {
    let (mut layout, mut next) = Layout::open(file, length)?;
    let mut seen = HashSet::new();
    let mut description = None;
    while next != 0 {
        let page = seen.len();
        if !seen.insert(next) {
            return Err(malformed(format!("page {page} is one of the pages before it")));
        }
        limits.check_shape(Format::Tiff, seen.len() as u64, 1, 1)?;
        let (entries, following) = layout.page(page, next)?;
        if page == 0 {
            description = entries.into_iter().find(|entry| entry.tag == IMAGE_DESCRIPTION);
        }
        next = following;
    }
    let behind = match (description, seen.len()) {
        (Some(entry), 1) => layout.imagej_images(&entry)?,
        _ => None,
    };
    Ok(Pages { count: seen.len(), behind, order: layout.order })
}

impl<'a, R: Read + Seek> Layout<'a, R> {
    /// Reads the file's header; the second value is the place of the first page header.
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

    /// The entries of the page header at `at`, and the place of the next one.
    fn page(&mut self, page: usize, at: u64) -> Result<(Vec<Entry>, u64)> {
        let (count_bytes, entry_bytes, pointer_bytes) =
            if self.big { (8, 20, 8) } else { (2, 12, 4) };
        let count = self.read(at, count_bytes)?;
        let count = self.number(&count);
        if count > MAX_ENTRIES {
            return Err(malformed(format!(
                "page {page} claims {count} entries, at most {MAX_ENTRIES} are read"
            )));
        }
        let start = at + count_bytes;
        let table = self.read(start, count * entry_bytes)?;
        let entries = table
            .chunks_exact(entry_bytes as usize)
            .map(|entry| self.entry(page, entry))
            .collect::<Result<_, _>>()?;
        let next = self.read(start + count * entry_bytes, pointer_bytes)?;
        Ok((entries, self.number(&next)))
    }

    /// Parses one entry and checks that its values lie in the file.
    fn entry(&self, page: usize, bytes: &[u8]) -> Result<Entry> {
        let inline = if self.big { 8 } else { 4 };
        let (head, offset) = bytes.split_at(bytes.len() - inline);
        let tag = self.number(&head[..2]) as u16;
        let count = self.number(&head[4..]);
        // Of a type that nobody knows nothing is read.
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

    /// The images that ImageJ tells of, if they are several.
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

    fn read(&mut self, at: u64, count: u64) -> Result<Vec<u8>> {
        if at.saturating_add(count) > self.length {
            return Err(FormatError::Truncated {
                format: Format::Tiff,
                promised: format!("a page header of at least {count} bytes at byte {at}"),
                present: format!("{} bytes in all", self.length),
            });
        }
        let mut bytes = vec![0; count as usize];
        let place = self.file.seek(SeekFrom::Start(at));
        place
            .and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(FormatError::io("read the TIFF page header"))?;
        Ok(bytes)
    }

    /// A number of 2, 4 or 8 bytes.
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
