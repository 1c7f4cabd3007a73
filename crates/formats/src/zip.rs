//! The members of a ZIP archive, stored or deflated.
//!
//! The directory is read here: the crate `zip` makes room for as many members as an archive claims, and reads a
//! directory of any length. It serves the tests as a second opinion.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::member::{Member, Packing, shown};
use super::{Format, FormatError};
use crate::error::Result;

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
/// The field of sizes and places that 32 bits don't hold.
const ZIP64: u64 = 1;
/// A comment stands behind the directory, and is not longer.
const MAX_COMMENT_BYTES: u64 = 65_535;
/// What a directory of as many frames as are read, with long names, needs.
const MAX_DIRECTORY_BYTES: u64 = 4 << 20;

/// Where the directory lies.
struct Directory {
    start: u64,
    bytes: u64,
}

/// All members that are no folders. Errors: a damaged directory, or one larger than an archive of frames has; what
/// is encrypted or packed by another method than Deflate; members that lie outside the file or claim more than
/// Deflate can hold.
pub(super) fn members(file: &File, length: u64) -> Result<Vec<Member>> {
    let directory = directory(file, length)?;
    if directory.bytes > MAX_DIRECTORY_BYTES {
        return Err(FormatError::OverLimit {
            format: Format::Zip,
            what: "the length of the directory in bytes",
            value: directory.bytes,
            limit: MAX_DIRECTORY_BYTES,
        });
    }
    let bytes = read(file, length, directory.start, directory.bytes)?;
    let mut rest = &*bytes;
    let mut members = Vec::new();
    while !rest.is_empty() {
        let (head, behind) = rest.split_at_checked(ENTRY_BYTES).ok_or_else(cut)?;
        if !head.starts_with(ENTRY) {
            return Err(malformed("the directory has something else than members"));
        }
        let [name, extra, comment] = [28, 30, 32].map(|at| number(&head[at..at + 2]) as usize);
        let (text, behind) = behind.split_at_checked(name).ok_or_else(cut)?;
        let (extra, behind) = behind.split_at_checked(extra).ok_or_else(cut)?;
        rest = behind.get(comment..).ok_or_else(cut)?;
        let name = String::from_utf8_lossy(text).into_owned();
        if !name.ends_with('/') {
            members.push(member(file, length, name, (head, extra))?);
        }
    }
    Ok(members)
}

/// Finds the end of the directory, from the back of the file.
fn directory(file: &File, length: u64) -> Result<Directory> {
    let tail = length.min(END_BYTES + MAX_COMMENT_BYTES);
    let tail_start = length - tail;
    let bytes = read(file, length, tail_start, tail)?;
    let ends = |at: &usize| {
        let end = &bytes[*at..];
        end.starts_with(END) && number(&end[20..22]) + END_BYTES == end.len() as u64
    };
    let last = bytes.len().checked_sub(END_BYTES as usize);
    let at = last.and_then(|last| (0..=last).rev().find(ends)).ok_or_else(|| {
        malformed(
            "the directory at its end is missing: the file is cut short, or goes on behind it",
        )
    })?;
    let end = &bytes[at..];
    let (size, start) = (number(&end[12..16]), number(&end[16..20]));
    if number(&end[10..12]) != 0xffff && size != 0xffff_ffff && start != 0xffff_ffff {
        return Ok(Directory { start, bytes: size });
    }
    let locator = (tail_start + at as u64).checked_sub(LOCATOR_BYTES).ok_or_else(cut)?;
    let locator = read(file, length, locator, LOCATOR_BYTES)?;
    if !locator.starts_with(LOCATOR) {
        return Ok(Directory { start, bytes: size });
    }
    let end = read(file, length, number(&locator[8..16]), END64_BYTES)?;
    if !end.starts_with(END64) {
        return Err(malformed("the end of the directory is not where the archive says"));
    }
    Ok(Directory { start: number(&end[48..56]), bytes: number(&end[40..48]) })
}

fn member(file: &File, length: u64, name: String, (head, extra): (&[u8], &[u8])) -> Result<Member> {
    let unsupported = |found: String| FormatError::Unsupported {
        format: Format::Zip,
        found: format!("{} {found}", shown(&name)),
        accepted: "members that are stored or deflated, and not encrypted (python -c \"import zipfile; \
                   z = zipfile.ZipFile('in.zip'); o = zipfile.ZipFile('out.zip', 'w'); \
                   [o.writestr(n, z.read(n)) for n in z.namelist()]\" stores them)",
    };
    if number(&head[8..10]) & 1 != 0 {
        return Err(unsupported("encrypted".to_owned()));
    }
    let packing = match number(&head[10..12]) {
        0 => Packing::Stored,
        8 => Packing::Deflated,
        method => return Err(unsupported(format!("packed by method {method}"))),
    };
    // What 32 bits don't hold stands in a field of its own, in this order.
    let mut wide = field(extra, ZIP64).unwrap_or_default();
    let [size, stored, place] = [(24, 28), (20, 24), (42, 46)].map(|(from, to)| {
        let value = number(&head[from..to]);
        match wide.split_at_checked(8) {
            Some((bytes, behind)) if value == 0xffff_ffff => {
                wide = behind;
                number(bytes)
            }
            _ => value,
        }
    });
    let local = read(file, length, place, LOCAL_BYTES as u64)?;
    if !local.starts_with(LOCAL) {
        return Err(malformed(format!("{} is not where the directory says", shown(&name))));
    }
    let names = number(&local[26..28]) + number(&local[28..30]);
    let start = place + LOCAL_BYTES as u64 + names;
    let crc = Some(number(&head[16..20]) as u32);
    Member { name, start, stored, size, packing, crc }.checked(Format::Zip, length)
}

/// The content of an extra field with this number.
fn field(mut extra: &[u8], wanted: u64) -> Option<&[u8]> {
    while let Some((head, rest)) = extra.split_at_checked(4) {
        let (content, behind) = rest.split_at_checked(number(&head[2..4]) as usize)?;
        if number(&head[..2]) == wanted {
            return Some(content);
        }
        extra = behind;
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

/// A little-endian number of at most 8 bytes.
fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

fn cut() -> FormatError {
    malformed("its directory ends inside a member")
}

fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::malformed(Format::Zip, problem)
}
