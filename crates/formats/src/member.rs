//! Members of archives: their position, and their decompressed content.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read};
use std::os::unix::fs::FileExt;
use std::sync::Arc;

use flate2::Crc;
use flate2::bufread::DeflateDecoder;

use super::array::Restart;
use super::{Format, FormatError};
use crate::error::Result;

/// Largest expansion of Deflate in bytes per compressed byte.
const MAX_EXPANSION: u64 = 1032;

/// The compression of a member.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Packing {
    Stored,
    Deflated,
}

/// The description of a member. Its name is never used as a path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Member {
    pub(super) name: String,
    /// Offset of the content in the archive.
    pub(super) start: u64,
    /// Compressed length in bytes.
    pub(super) stored: u64,
    /// Decompressed length in bytes.
    pub(super) size: u64,
    pub(super) packing: Packing,
    /// CRC-32 of the decompressed content, if the archive has one.
    pub(super) crc: Option<u32>,
}

impl Member {
    /// Checks that the member is inside an archive of this length, and can have its claimed length.
    pub(super) fn checked(self, format: Format, length: u64) -> Result<Self> {
        let end = self.start.saturating_add(self.stored);
        if end > length {
            return Err(FormatError::Truncated {
                format,
                promised: format!("{} at bytes {} to {end}", quoted(&self.name), self.start),
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
                promised: format!("{} of {} bytes", quoted(&self.name), self.size),
                present: format!("{} bytes of it", self.stored),
            });
        }
        Ok(self)
    }
}

/// Refuses members of the same name: programs differ in which of them they read.
pub(super) fn distinct(members: Vec<Member>, format: Format) -> Result<Vec<Member>> {
    let mut names = HashSet::new();
    match members.iter().find(|member| !names.insert(member.name.as_str())) {
        None => Ok(members),
        Some(member) => {
            let name = quoted(&member.name);
            let problem = format!("two members have the name {name}: rename one of them");
            Err(FormatError::malformed(format, problem))
        }
    }
}

/// Reads the decompressed content of a member. The length must be as claimed, and the checksum is verified at the end.
pub(super) struct MemberReader {
    archive: Arc<File>,
    member: Member,
    source: Box<dyn Read + Send>,
    remaining: u64,
    crc: Crc,
}

/// A section of a file. Reads are positional, so readers can share the file.
struct Section {
    file: Arc<File>,
    position: u64,
    end: u64,
}

/// The decompressed content of a member.
fn content(file: &Arc<File>, member: &Member) -> Box<dyn Read + Send> {
    let (file, position) = (Arc::clone(file), member.start);
    let section = Section { file, position, end: position + member.stored };
    match member.packing {
        Packing::Stored => Box::new(section),
        Packing::Deflated => Box::new(DeflateDecoder::new(BufReader::new(section))),
    }
}

impl MemberReader {
    pub(super) fn new(archive: Arc<File>, member: Member) -> Self {
        let (source, remaining) = (content(&archive, &member), member.size);
        Self { archive, member, source, remaining, crc: Crc::new() }
    }

    fn check_end(&mut self) -> io::Result<()> {
        let name = quoted(&self.member.name);
        if self.source.read(&mut [0])? != 0 {
            return Err(invalid(format!("{name} has more bytes than its size states")));
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
        if self.remaining == 0 && !buffer.is_empty() {
            return self.check_end().map(|()| 0);
        }
        let limit = buffer.len().min(usize::try_from(self.remaining).unwrap_or(usize::MAX));
        let count = self.source.read(&mut buffer[..limit])?;
        if count == 0 && limit > 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        self.crc.update(&buffer[..count]);
        self.remaining -= count as u64;
        Ok(count)
    }
}

impl Restart for MemberReader {
    fn restart(&mut self) -> io::Result<()> {
        self.source = content(&self.archive, &self.member);
        self.remaining = self.member.size;
        self.crc = Crc::new();
        Ok(())
    }
}

impl Read for Section {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let remaining = usize::try_from(self.end - self.position).unwrap_or(usize::MAX);
        let limit = buffer.len().min(remaining);
        let count = self.file.read_at(&mut buffer[..limit], self.position)?;
        self.position += count as u64;
        Ok(count)
    }
}

/// Quotes a name for a message, up to a limit.
pub(super) fn quoted(name: &str) -> String {
    let short: String = name.chars().take(80).collect();
    format!("'{}'", short.escape_debug())
}

fn invalid(problem: String) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, problem)
}
