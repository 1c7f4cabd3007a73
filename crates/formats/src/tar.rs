//! Lists the members of an uncompressed tar archive.
//!
//! This module parses the headers, because the crate `tar` reads names of any length into memory. A header is a block
//! of 512 bytes with few fields.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::member::{Member, Packing, distinct, quoted};
use super::{Format, FormatError};
use crate::error::Result;

/// Size of headers, and alignment of members, in bytes.
const BLOCK: u64 = 512;
/// Offset of the signature in a header, and the signature of headers that split a name in two fields.
const MAGIC: (usize, &[u8]) = (257, b"ustar\0");
/// Largest number of members, including those that are not frames.
const MAX_MEMBERS: usize = 16_384;
/// Longest name that is stored in a separate member.
const MAX_NAME_BYTES: u64 = 1 << 16;

/// Returns all members that are regular files. Errors: a damaged header; members outside the file, or of one
/// name; links, devices and sparse files; an archive without its end.
pub(super) fn members(file: &File, length: u64) -> Result<Vec<Member>> {
    let (mut offset, mut members, mut count) = (0, Vec::new(), 0);
    let mut long_name = None;
    loop {
        if offset + BLOCK > length {
            // Members may be missing, and a frame would be lost in silence.
            let problem = "the archive is cut short: it has no block of zeros at its end; copy or pack it again";
            return Err(malformed(problem));
        }
        let head = read(file, offset, BLOCK)?;
        if head.iter().all(|byte| *byte == 0) {
            break;
        }
        count += 1;
        if count > MAX_MEMBERS {
            return Err(malformed(format!("the archive has more than {MAX_MEMBERS} members")));
        }
        verify_checksum(&head, offset)?;
        let (start, size) = (offset + BLOCK, number(&head[124..136])?);
        let name = long_name.take().unwrap_or_else(|| name(&head));
        let (stored, packing) = (size, Packing::Stored);
        let member = Member { name, start, stored, size, packing, crc: None };
        let member = member.checked(Format::Tar, length)?;
        offset = start + size.next_multiple_of(BLOCK);
        match head[156] {
            0 | b'0' | b'7' => members.push(member),
            b'L' => long_name = Some(text(&read_metadata(file, &member)?)),
            b'x' => long_name = extended_name(&read_metadata(file, &member)?)?,
            // Folders, and metadata of other members.
            b'5' | b'g' | b'K' => {}
            kind => return Err(no_file(&member.name, kind)),
        }
    }
    distinct(members, Format::Tar)
}

/// The error for a member that has no content. Left out in silence, it could be a frame that is missing.
fn no_file(name: &str, kind: u8) -> FormatError {
    let kind = match kind {
        b'1' | b'2' => {
            "a link, which has no content; pack it with tar --hard-dereference --dereference"
                .to_owned()
        }
        b'3' | b'4' | b'6' => "a device or a pipe".to_owned(),
        _ => format!("of the kind '{}'", kind.escape_ascii()),
    };
    FormatError::Unsupported {
        format: Format::Tar,
        found: format!("{}, {kind}", quoted(name)),
        accepted: "regular files",
    }
}

/// The name in a header, including folders.
fn name(head: &[u8]) -> String {
    let (name, prefix) = (text(&head[..100]), text(&head[345..500]));
    if prefix.is_empty() || !head[MAGIC.0..].starts_with(MAGIC.1) {
        return name;
    }
    format!("{prefix}/{name}")
}

/// Reads a member with metadata of the next one.
fn read_metadata(file: &File, member: &Member) -> Result<Vec<u8>> {
    if member.size > MAX_NAME_BYTES {
        return Err(malformed(format!("a member has a name of {} bytes", member.size)));
    }
    read(file, member.start, member.size)
}

/// The name of the next member in an extended header, which has lines of `LENGTH KEY=VALUE`. Errors: a header that
/// changes the size.
fn extended_name(bytes: &[u8]) -> Result<Option<String>> {
    let mut name = None;
    for line in bytes.split(|byte| *byte == b'\n') {
        let line = String::from_utf8_lossy(line);
        match line.split_once(' ').and_then(|(_, pair)| pair.split_once('=')) {
            Some(("path", path)) => name = Some(path.to_owned()),
            Some((key, _)) if key == "size" || key.starts_with("GNU.sparse") => {
                return Err(malformed(format!(
                    "an extended header sets {key}, which is not supported"
                )));
            }
            _ => {}
        }
    }
    Ok(name)
}

/// Verifies the checksum of a header: the sum of all bytes, with spaces in the place of the checksum.
fn verify_checksum(head: &[u8], offset: u64) -> Result<()> {
    let sum: u64 = head.iter().map(|byte| u64::from(*byte)).sum();
    let field: u64 = head[148..156].iter().map(|byte| u64::from(*byte)).sum();
    if number(&head[148..156]).ok() == Some(sum - field + 8 * u64::from(b' ')) {
        return Ok(());
    }
    Err(malformed(format!("the header at byte {offset} is damaged")))
}

/// Parses an octal number that is padded with spaces or zero bytes.
fn number(field: &[u8]) -> Result<u64> {
    let digits = text(field);
    u64::from_str_radix(digits.trim(), 8)
        .map_err(|_| malformed(format!("'{}' is not an octal number", digits.escape_default())))
}

/// The text before the first zero byte.
fn text(field: &[u8]) -> String {
    let end = field.iter().position(|byte| *byte == 0).unwrap_or(field.len());
    String::from_utf8_lossy(&field[..end]).into_owned()
}

fn read(file: &File, start: u64, bytes: u64) -> Result<Vec<u8>> {
    let mut buffer = vec![0; bytes as usize];
    file.read_exact_at(&mut buffer, start).map_err(FormatError::io("read the archive"))?;
    Ok(buffer)
}

fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::malformed(Format::Tar, problem)
}
