//! The outer structure of a level 5 file: a header, followed by plain or compressed elements.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};

use flate2::bufread::ZlibDecoder;

use crate::error::Result;
use crate::samples::{self, ByteOrder};
use crate::{Format, FormatError};

const FILE_HEADER_BYTES: u64 = 128;
const TAG_BYTES: u64 = 8;
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;

/// Largest number of elements. A scene has three arrays.
const MAX_ELEMENTS: usize = 1000;

/// Largest expansion of Deflate in bytes per compressed byte.
const MAX_EXPANSION: u64 = 1032;

/// Iterates over the elements of a file.
pub(super) struct Elements {
    file: BufReader<File>,
    length: u64,
    order: ByteOrder,
    /// Offset of the next element.
    offset: u64,
    count: usize,
}

/// Position of an array in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Element {
    start: u64,
    bytes: u64,
    compressed: bool,
}

impl Elements {
    /// Reads the header of a file of `length` bytes, which is positioned at its start.
    pub(super) fn new(mut file: BufReader<File>, length: u64) -> Result<Self> {
        let mut header = [0; FILE_HEADER_BYTES as usize];
        file.read_exact(&mut header).map_err(read_error)?;
        let order = if header.ends_with(b"MI") { ByteOrder::Big } else { ByteOrder::Little };
        Ok(Self { file, length, order, offset: FILE_HEADER_BYTES, count: 0 })
    }

    /// Returns the next array; `None` at the end of the file.
    pub(super) fn next(&mut self) -> Result<Option<Element>> {
        while self.offset < self.length {
            self.count += 1;
            if self.count > MAX_ELEMENTS {
                return Err(malformed(format!("the file has more than {MAX_ELEMENTS} elements")));
            }
            let start = self.offset + TAG_BYTES;
            if start > self.length {
                return Err(malformed(format!(
                    "the element at byte {} is incomplete",
                    self.offset
                )));
            }
            self.file.seek(SeekFrom::Start(self.offset)).map_err(read_error)?;
            let mut tag = [0; TAG_BYTES as usize];
            self.file.read_exact(&mut tag).map_err(read_error)?;
            let (kind, bytes) = split(tag, self.order);
            let end = start + u64::from(bytes);
            if end > self.length {
                return Err(FormatError::Truncated {
                    format: Format::Mat,
                    promised: format!("an element at bytes {start} to {end}"),
                    present: format!("{} bytes in all", self.length),
                });
            }
            self.offset = end;
            if kind == MATRIX || kind == COMPRESSED {
                let compressed = kind == COMPRESSED;
                return Ok(Some(Element { start, bytes: bytes.into(), compressed }));
            }
        }
        Ok(None)
    }

    /// Byte order of the file.
    pub(super) fn order(&self) -> ByteOrder {
        self.order
    }

    /// Borrows the content of an element, to read its header.
    pub(super) fn content(&mut self, element: Element) -> Result<Content<'_>> {
        Content::open(&mut self.file, element, self.order)
    }

    /// Converts into the content of an element.
    pub(super) fn into_content(self, element: Element) -> Result<Content<'static>> {
        Content::open(self.file, element, self.order)
    }
}

/// The decompressed bytes of one array, at most as many as it declares.
pub(super) struct Content<'a> {
    source: Box<dyn Read + Send + 'a>,
    order: ByteOrder,
    /// Length of the element in the file, in bytes.
    stored: u64,
    /// Largest number of bytes per stored byte.
    expansion: u64,
    /// Number of bytes of the array that remain to be read.
    remaining: u64,
}

impl<'a> Content<'a> {
    /// Seeks to an element, and opens its content.
    pub(super) fn open(
        mut file: impl BufRead + Seek + Send + 'a,
        element: Element,
        order: ByteOrder,
    ) -> Result<Self> {
        file.seek(SeekFrom::Start(element.start)).map_err(read_error)?;
        let stored = element.bytes;
        let bytes = file.take(stored);
        if !element.compressed {
            let source = Box::new(bytes);
            return Ok(Self { source, order, stored, expansion: 1, remaining: stored });
        }
        let source = Box::new(ZlibDecoder::new(bytes));
        let (expansion, remaining) = (MAX_EXPANSION, TAG_BYTES);
        let mut content = Self { source, order, stored, expansion, remaining };
        let (kind, bytes) = content.tag()?;
        if kind != MATRIX {
            return Err(malformed(format!(
                "a compressed element has the type {kind}, which is not an array"
            )));
        }
        content.remaining = bytes.into();
        Ok(content)
    }

    /// Byte order of the file.
    pub(super) fn order(&self) -> ByteOrder {
        self.order
    }

    /// True if all bytes of the array have been read.
    pub(super) fn is_empty(&self) -> bool {
        self.remaining == 0
    }

    /// Checks that `bytes` more bytes can follow, before memory is allocated for them.
    pub(super) fn check_can_hold(&self, name: &str, bytes: u64) -> Result<()> {
        if bytes > self.remaining || bytes > self.stored.saturating_mul(self.expansion) {
            return Err(FormatError::Truncated {
                format: Format::Mat,
                promised: format!("'{name}' with {bytes} bytes of samples"),
                present: format!("{} bytes for it", self.stored.min(self.remaining)),
            });
        }
        Ok(())
    }

    /// Reads the type and the size of the next part of the array. A small part is packed into the tag, which shows as a
    /// type above 65535.
    pub(super) fn tag(&mut self) -> Result<(u32, u32)> {
        let mut tag = [0; TAG_BYTES as usize];
        self.fill(&mut tag)?;
        Ok(split(tag, self.order))
    }

    /// Fills `bytes`. Errors: the array declares fewer bytes, or the file contains fewer.
    pub(super) fn fill(&mut self, bytes: &mut [u8]) -> Result<()> {
        let needed = bytes.len() as u64;
        self.remaining = self.remaining.checked_sub(needed).ok_or_else(|| {
            malformed(format!("an array ends {} bytes too early", needed - self.remaining))
        })?;
        self.source.read_exact(bytes).map_err(read_error)
    }

    /// Checks that only padding follows, and verifies the checksum of compressed data.
    pub(super) fn finish(&mut self) -> Result<()> {
        let mut rest = Vec::new();
        // Reads one byte more than padding may have. Reading to the end verifies the checksum.
        self.source.by_ref().take(TAG_BYTES).read_to_end(&mut rest).map_err(read_error)?;
        if rest.len() as u64 >= TAG_BYTES {
            return Err(malformed("an array has more bytes than its size states"));
        }
        Ok(())
    }
}

/// Splits a tag into type and size.
fn split(tag: [u8; TAG_BYTES as usize], order: ByteOrder) -> (u32, u32) {
    let [a, b, c, d, e, f, g, h] = tag;
    match order {
        ByteOrder::Little => (u32::from_le_bytes([a, b, c, d]), u32::from_le_bytes([e, f, g, h])),
        ByteOrder::Big => (u32::from_be_bytes([a, b, c, d]), u32::from_be_bytes([e, f, g, h])),
    }
}

pub(super) fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::malformed(Format::Mat, problem)
}

fn read_error(source: std::io::Error) -> FormatError {
    samples::read_error(Format::Mat, source)
}
