//! Lists the stored and deflated members of a ZIP archive.
//!
//! This module parses the directory, because the crate `zip` allocates memory for as many members as an archive claims,
//! and reads directories of any length. The tests use that crate as a reference.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::member::{Member, Packing, distinct, quoted};
use super::{Format, FormatError, limits};
use crate::error::Result;

/// Signatures and lengths of the records of a ZIP archive.
const END: &[u8] = b"PK\x05\x06";
const END_BYTES: u64 = 22;
const LOCATOR: &[u8] = b"PK\x06\x07";
const LOCATOR_BYTES: u64 = 20;
const END64: &[u8] = b"PK\x06\x06";
const END64_BYTES: u64 = 56;
const ENTRY: &[u8] = b"PK\x01\x02";
const ENTRY_BYTES: usize = 46;
const LOCAL: &[u8] = b"PK\x03\x04";
const LOCAL_BYTES: usize = 30;
/// Number of the extra field for sizes and offsets above 32 bits.
const ZIP64: u64 = 1;
/// Longest comment, which follows the directory.
const MAX_COMMENT_BYTES: u64 = 65_535;
/// Longest accepted directory. It is enough for the largest number of frames with long names.
const MAX_DIRECTORY_BYTES: u64 = 4 << 20;

/// Position of the directory.
struct Directory {
    start: u64,
    bytes: u64,
}

/// Returns all members except folders. Errors: a damaged or too long directory; encrypted members, or ones compressed
/// by another method than Deflate; members outside the file, longer than Deflate can expand, or of one name.
pub(super) fn members(file: &File, length: u64) -> Result<Vec<Member>> {
    let directory = directory(file, length)?;
    let what = "the length of the directory in bytes";
    limits::check(Format::Zip, what, directory.bytes, MAX_DIRECTORY_BYTES)?;
    let bytes = read(file, length, directory.start, directory.bytes)?;
    let mut rest = &*bytes;
    let mut members = Vec::new();
    while !rest.is_empty() {
        let (head, tail) = rest.split_at_checked(ENTRY_BYTES).ok_or_else(truncated)?;
        if !head.starts_with(ENTRY) {
            return Err(malformed("the directory contains something other than members"));
        }
        let [name, extra, comment] = [28, 30, 32].map(|at| number(&head[at..at + 2]) as usize);
        let (text, tail) = tail.split_at_checked(name).ok_or_else(truncated)?;
        let (extra, tail) = tail.split_at_checked(extra).ok_or_else(truncated)?;
        rest = tail.get(comment..).ok_or_else(truncated)?;
        let name = String::from_utf8_lossy(text).into_owned();
        if !name.ends_with('/') {
            members.push(member(file, length, name, (head, extra))?);
        }
    }
    distinct(members, Format::Zip)
}

/// Finds the directory by its end record, from the end of the file.
fn directory(file: &File, length: u64) -> Result<Directory> {
    let tail = length.min(END_BYTES + MAX_COMMENT_BYTES);
    let tail_start = length - tail;
    let bytes = read(file, length, tail_start, tail)?;
    let is_end = |start: &usize| {
        let end = &bytes[*start..];
        end.starts_with(END) && number(&end[20..22]) + END_BYTES == end.len() as u64
    };
    let last = bytes.len().checked_sub(END_BYTES as usize);
    let position = last.and_then(|last| (0..=last).rev().find(is_end)).ok_or_else(|| {
        malformed(
            "there is no directory at the end: the file is cut short, or has other data after it",
        )
    })?;
    let end = &bytes[position..];
    let (size, start) = (number(&end[12..16]), number(&end[16..20]));
    if number(&end[10..12]) != 0xffff && size != 0xffff_ffff && start != 0xffff_ffff {
        return Ok(Directory { start, bytes: size });
    }
    let locator = (tail_start + position as u64).checked_sub(LOCATOR_BYTES);
    let locator = locator.ok_or_else(truncated)?;
    let locator = read(file, length, locator, LOCATOR_BYTES)?;
    if !locator.starts_with(LOCATOR) {
        return Ok(Directory { start, bytes: size });
    }
    let end = read(file, length, number(&locator[8..16]), END64_BYTES)?;
    if !end.starts_with(END64) {
        return Err(malformed("the end record of the directory is not at its stated position"));
    }
    Ok(Directory { start: number(&end[48..56]), bytes: number(&end[40..48]) })
}

fn member(file: &File, length: u64, name: String, (head, extra): (&[u8], &[u8])) -> Result<Member> {
    let unsupported = |found: String| FormatError::Unsupported {
        format: Format::Zip,
        found: format!("{} {found}", quoted(&name)),
        accepted: "members that are stored or deflated, and not encrypted (to store them: python -c \"import zipfile; \
                   z = zipfile.ZipFile('in.zip'); o = zipfile.ZipFile('out.zip', 'w'); \
                   [o.writestr(n, z.read(n)) for n in z.namelist()]\")",
    };
    if number(&head[8..10]) & 1 != 0 {
        return Err(unsupported("encrypted".to_owned()));
    }
    let packing = match number(&head[10..12]) {
        0 => Packing::Stored,
        8 => Packing::Deflated,
        method => return Err(unsupported(format!("compressed by method {method}"))),
    };
    // Values above 32 bits are in an extra field, in this order.
    let mut wide = field(extra, ZIP64).unwrap_or_default();
    let [size, stored, offset] = [(24, 28), (20, 24), (42, 46)].map(|(from, to)| {
        let value = number(&head[from..to]);
        match wide.split_at_checked(8) {
            Some((bytes, tail)) if value == 0xffff_ffff => {
                wide = tail;
                number(bytes)
            }
            _ => value,
        }
    });
    let local = read(file, length, offset, LOCAL_BYTES as u64)?;
    if !local.starts_with(LOCAL) {
        return Err(malformed(format!("{} is not at its stated position", quoted(&name))));
    }
    let names = number(&local[26..28]) + number(&local[28..30]);
    let start = offset + LOCAL_BYTES as u64 + names;
    let crc = Some(number(&head[16..20]) as u32);
    Member { name, start, stored, size, packing, crc }.checked(Format::Zip, length)
}

/// The content of the extra field with this number.
fn field(mut extra: &[u8], requested: u64) -> Option<&[u8]> {
    while let Some((head, rest)) = extra.split_at_checked(4) {
        let (content, tail) = rest.split_at_checked(number(&head[2..4]) as usize)?;
        if number(&head[..2]) == requested {
            return Some(content);
        }
        extra = tail;
    }
    None
}

fn read(file: &File, length: u64, start: u64, bytes: u64) -> Result<Vec<u8>> {
    if start.saturating_add(bytes) > length {
        return Err(FormatError::Truncated {
            format: Format::Zip,
            promised: format!("{bytes} bytes of its directory at {start}"),
            present: format!("{length} bytes in all"),
        });
    }
    let mut buffer = vec![0; bytes as usize];
    file.read_exact_at(&mut buffer, start).map_err(FormatError::io("read the archive"))?;
    Ok(buffer)
}

/// Decodes a little-endian number of at most 8 bytes.
fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

fn truncated() -> FormatError {
    malformed("the directory ends inside a member")
}

fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::malformed(Format::Zip, problem)
}
