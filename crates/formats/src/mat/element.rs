//! The outer structure of a level 5 file: a header, then elements, plain or compressed.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Take};

use flate2::bufread::ZlibDecoder;

use crate::error::Result;
use crate::samples::{self, ByteOrder};
use crate::{Format, FormatError};

const FILE_HEADER_BYTES: u64 = 128;
const TAG_BYTES: u64 = 8;
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;

/// A scene has three arrays; a file with thousands of tiny ones would only cost time.
const MAX_ELEMENTS: usize = 1000;

/// Deflate expands a byte to at most 1032.
const MAX_EXPANSION: u64 = 1032;

/// Walks over the elements of a file.
pub(super) struct Elements {
    file: BufReader<File>,
    length: u64,
    order: ByteOrder,
    at: u64,
    seen: usize,
}

/// Where an array lies in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Element {
    start: u64,
    bytes: u64,
    compressed: bool,
}

impl Elements {
    /// `file` stands at its start and is `length` bytes long.
    pub(super) fn new(mut file: BufReader<File>, length: u64) -> Result<Self> {
        let mut header = [0; FILE_HEADER_BYTES as usize];
        file.read_exact(&mut header).map_err(read_error)?;
        let order = if header.ends_with(b"MI") { ByteOrder::Big } else { ByteOrder::Little };
        Ok(Self { file, length, order, at: FILE_HEADER_BYTES, seen: 0 })
    }

    /// The next element that is an array, `None` at the end of the file.
    pub(super) fn next(&mut self) -> Result<Option<Element>> {
        while self.at < self.length {
            self.seen += 1;
            if self.seen > MAX_ELEMENTS {
                return Err(malformed(format!("more than {MAX_ELEMENTS} elements")));
            }
            let start = self.at + TAG_BYTES;
            if start > self.length {
                return Err(malformed(format!("no element begins at byte {}", self.at)));
            }
            self.file.seek(SeekFrom::Start(self.at)).map_err(read_error)?;
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
            self.at = end;
            if kind == MATRIX || kind == COMPRESSED {
                let compressed = kind == COMPRESSED;
                return Ok(Some(Element { start, bytes: bytes.into(), compressed }));
            }
        }
        Ok(None)
    }

    /// The order of the bytes in a number.
    pub(super) fn order(&self) -> ByteOrder {
        self.order
    }

    /// The content of an element, for a look at its header.
    pub(super) fn look_into(&mut self, element: Element) -> Result<Content<&mut BufReader<File>>> {
        Content::open(&mut self.file, element, self.order)
    }

    /// The content of an element, to keep.
    pub(super) fn into_content(self, element: Element) -> Result<Content<BufReader<File>>> {
        Content::open(self.file, element, self.order)
    }
}

/// The bytes of one array, inflated where they are compressed; never more than it declares.
pub(super) struct Content<R> {
    source: Source<R>,
    order: ByteOrder,
    /// Bytes of the element in the file.
    stored: u64,
    /// Bytes of the array that are still to be read.
    left: u64,
}

enum Source<R> {
    Plain(Take<R>),
    Zlib(ZlibDecoder<Take<R>>),
}

impl<R: BufRead + Seek> Content<R> {
    /// The content of an element of this file, wherever that stands.
    pub(super) fn open(mut file: R, element: Element, order: ByteOrder) -> Result<Self> {
        file.seek(SeekFrom::Start(element.start)).map_err(read_error)?;
        let stored = element.bytes;
        let bytes = file.take(stored);
        if !element.compressed {
            return Ok(Self { source: Source::Plain(bytes), order, stored, left: stored });
        }
        let source = Source::Zlib(ZlibDecoder::new(bytes));
        let mut content = Self { source, order, stored, left: TAG_BYTES };
        let (kind, bytes) = content.tag()?;
        if kind != MATRIX {
            return Err(malformed(format!("a compressed element of type {kind}, not an array")));
        }
        content.left = bytes.into();
        Ok(content)
    }
}

impl<R: BufRead> Content<R> {
    /// The order of the bytes in a number.
    pub(super) fn order(&self) -> ByteOrder {
        self.order
    }

    /// True when the array has no bytes left.
    pub(super) fn is_empty(&self) -> bool {
        self.left == 0
    }

    /// Checks that `bytes` more bytes can come, before memory is taken for them.
    pub(super) fn check_can_hold(&self, name: &str, bytes: u64) -> Result<()> {
        let expansion = match self.source {
            Source::Plain(_) => 1,
            Source::Zlib(_) => MAX_EXPANSION,
        };
        if bytes > self.left || bytes > self.stored.saturating_mul(expansion) {
            return Err(FormatError::Truncated {
                format: Format::Mat,
                promised: format!("'{name}' with {bytes} bytes of numbers"),
                present: format!("{} bytes for it", self.stored.min(self.left)),
            });
        }
        Ok(())
    }

    /// The type and size of the next part of the array. What a small part packs into the tag's own
    /// size field shows as a type above 65535.
    pub(super) fn tag(&mut self) -> Result<(u32, u32)> {
        let mut tag = [0; TAG_BYTES as usize];
        self.fill(&mut tag)?;
        Ok(split(tag, self.order))
    }

    /// Fills `bytes`. Errors: the array declares fewer bytes, or the file delivers fewer.
    pub(super) fn fill(&mut self, bytes: &mut [u8]) -> Result<()> {
        let wanted = bytes.len() as u64;
        self.left = self.left.checked_sub(wanted).ok_or_else(|| {
            malformed(format!("an array ends {} bytes too early", wanted - self.left))
        })?;
        self.source.read_exact(bytes).map_err(read_error)
    }

    /// Checks that nothing but padding follows, and the checksum of compressed data.
    pub(super) fn finish(&mut self) -> Result<()> {
        let mut rest = Vec::new();
        // One byte more than may be there: reading to the end checks the checksum.
        self.source.by_ref().take(TAG_BYTES).read_to_end(&mut rest).map_err(read_error)?;
        if rest.len() as u64 >= TAG_BYTES {
            return Err(malformed("an array has more bytes than its size tells"));
        }
        Ok(())
    }
}

impl<R: BufRead> Read for Source<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Self::Plain(source) => source.read(buffer),
            Self::Zlib(source) => source.read(buffer),
        }
    }
}

/// Type and size from a tag.
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
