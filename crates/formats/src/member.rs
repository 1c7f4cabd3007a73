//! A member of an archive: where it lies, and its bytes.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read};
use std::os::unix::fs::FileExt;
use std::sync::Arc;

use flate2::Crc;
use flate2::bufread::DeflateDecoder;

use super::array::Restart;
use super::{Format, FormatError};
use crate::error::Result;

/// Deflate expands a byte to at most 1032.
const MAX_EXPANSION: u64 = 1032;

/// How the bytes of a member lie in the archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Packing {
    Stored,
    Deflated,
}

/// Where a member lies, and what the archive says of it. Its name is shown and compared, and never used as a path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Member {
    pub(super) name: String,
    /// Its first byte in the archive.
    pub(super) start: u64,
    /// Bytes in the archive.
    pub(super) stored: u64,
    /// Bytes of the member itself.
    pub(super) size: u64,
    pub(super) packing: Packing,
    /// The checksum of these, where the archive has it.
    pub(super) crc: Option<u32>,
}

impl Member {
    /// Checks that it lies in an archive of this length and can be as long as it claims.
    pub(super) fn checked(self, format: Format, length: u64) -> Result<Self> {
        let end = self.start.saturating_add(self.stored);
        if end > length {
            return Err(FormatError::Truncated {
                format,
                promised: format!("{} at bytes {} to {end}", shown(&self.name), self.start),
                present: format!("{length} bytes in all"),
            });
        }
        let possible = match self.packing {
            Packing::Stored => self.size == self.stored,
            Packing::Deflated => self.size <= self.stored.saturating_mul(MAX_EXPANSION),
        };
        if !possible {
            return Err(FormatError::Truncated {
                format,
                promised: format!("{} of {} bytes", shown(&self.name), self.size),
                present: format!("{} bytes of it", self.stored),
            });
        }
        Ok(self)
    }
}

/// The bytes of a member, never more or fewer than it claims; at their end the checksum is looked at.
pub(super) struct MemberReader {
    archive: Arc<File>,
    member: Member,
    source: Source,
    left: u64,
    crc: Crc,
}

enum Source {
    Stored(Section),
    Deflated(DeflateDecoder<BufReader<Section>>),
}

/// A part of a file, read at its places, so that others may read the file too.
struct Section {
    file: Arc<File>,
    at: u64,
    end: u64,
}

impl Source {
    fn of(file: &Arc<File>, member: &Member) -> Self {
        let (file, at) = (Arc::clone(file), member.start);
        let section = Section { file, at, end: at + member.stored };
        match member.packing {
            Packing::Stored => Self::Stored(section),
            Packing::Deflated => Self::Deflated(DeflateDecoder::new(BufReader::new(section))),
        }
    }
}

impl MemberReader {
    pub(super) fn new(archive: Arc<File>, member: Member) -> Self {
        let (source, left) = (Source::of(&archive, &member), member.size);
        Self { archive, member, source, left, crc: Crc::new() }
    }

    fn check_end(&mut self) -> io::Result<()> {
        let name = shown(&self.member.name);
        if self.source.read(&mut [0])? != 0 {
            return Err(invalid(format!("{name} has more bytes than its size tells")));
        }
        match self.member.crc {
            Some(crc) if crc != self.crc.sum() => {
                Err(invalid(format!("the checksum of {name} is wrong")))
            }
            _ => Ok(()),
        }
    }
}

impl Read for MemberReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.left == 0 && !buffer.is_empty() {
            return self.check_end().map(|()| 0);
        }
        let most = buffer.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        let count = self.source.read(&mut buffer[..most])?;
        if count == 0 && most > 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        self.crc.update(&buffer[..count]);
        self.left -= count as u64;
        Ok(count)
    }
}

impl Restart for MemberReader {
    fn restart(&mut self) -> io::Result<()> {
        self.source = Source::of(&self.archive, &self.member);
        self.left = self.member.size;
        self.crc = Crc::new();
        Ok(())
    }
}

impl Read for Source {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Stored(section) => section.read(buffer),
            Self::Deflated(decoder) => decoder.read(buffer),
        }
    }
}

impl Read for Section {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = usize::try_from(self.end - self.at).unwrap_or(usize::MAX);
        let most = buffer.len().min(left);
        let count = self.file.read_at(&mut buffer[..most], self.at)?;
        self.at += count as u64;
        Ok(count)
    }
}

/// A name for a message, bounded in length.
pub(super) fn shown(name: &str) -> String {
    let short: String = name.chars().take(80).collect();
    format!("'{}'", short.escape_debug())
}

fn invalid(problem: String) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, problem)
}
