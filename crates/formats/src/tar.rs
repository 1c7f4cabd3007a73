//! The members of a tar archive that is not compressed.
//!
//! The headers are read here: they are blocks of 512 bytes with few fields, and the crate `tar` reads names of any
//! length into memory.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::member::{Member, Packing, shown};
use super::{Format, FormatError};
use crate::error::Result;

const BLOCK: u64 = 512;
/// Where the signature stands in a header, and that of headers which split a name.
const MAGIC: (usize, &[u8]) = (257, b"ustar\0");
/// Members that are looked at; those that are no frames among them.
const MAX_MEMBERS: usize = 16_384;
/// Of a name that has a member of its own.
const MAX_NAME_BYTES: u64 = 1 << 16;

/// All members that are regular files. Errors: a damaged header; members that lie outside the file; sparse files.
pub(super) fn members(file: &File, length: u64) -> Result<Vec<Member>> {
    let (mut at, mut members, mut seen) = (0, Vec::new(), 0);
    let mut long_name = None;
    while at + BLOCK <= length {
        let head = read(file, at, BLOCK)?;
        if head.iter().all(|byte| *byte == 0) {
            break;
        }
        seen += 1;
        if seen > MAX_MEMBERS {
            return Err(malformed(format!("more than {MAX_MEMBERS} members")));
        }
        check_sum(&head, at)?;
        let (start, size) = (at + BLOCK, number(&head[124..136])?);
        let name = long_name.take().unwrap_or_else(|| name(&head));
        let (stored, packing) = (size, Packing::Stored);
        let member = Member { name, start, stored, size, packing, crc: None };
        let member = member.checked(Format::Tar, length)?;
        at = start + size.next_multiple_of(BLOCK);
        match head[156] {
            0 | b'0' | b'7' => members.push(member),
            b'L' => long_name = Some(text(&attached(file, &member)?)),
            b'x' => long_name = extended(&attached(file, &member)?)?,
            // Folders and links, and what holds for the archive as a whole.
            b'1'..=b'6' | b'g' | b'K' => {}
            other => {
                return Err(FormatError::Unsupported {
                    format: Format::Tar,
                    found: format!(
                        "{} of the kind '{}'",
                        shown(&member.name),
                        other.escape_ascii()
                    ),
                    accepted: "regular files",
                });
            }
        }
    }
    Ok(members)
}

/// The name in a header, with the folders before it.
fn name(head: &[u8]) -> String {
    let (name, prefix) = (text(&head[..100]), text(&head[345..500]));
    if prefix.is_empty() || !head[MAGIC.0..].starts_with(MAGIC.1) {
        return name;
    }
    format!("{prefix}/{name}")
}

/// The bytes of a member that tells of the next one.
fn attached(file: &File, member: &Member) -> Result<Vec<u8>> {
    if member.size > MAX_NAME_BYTES {
        return Err(malformed(format!("a name of {} bytes", member.size)));
    }
    read(file, member.start, member.size)
}

/// The name that an extended header (`LENGTH KEY=VALUE` in lines) gives the next member. Errors: another size.
fn extended(bytes: &[u8]) -> Result<Option<String>> {
    let mut name = None;
    for line in bytes.split(|byte| *byte == b'\n') {
        let line = String::from_utf8_lossy(line);
        match line.split_once(' ').and_then(|(_, pair)| pair.split_once('=')) {
            Some(("path", path)) => name = Some(path.to_owned()),
            Some((key, _)) if key == "size" || key.starts_with("GNU.sparse") => {
                return Err(malformed(format!("a member whose {key} is told apart")));
            }
            _ => {}
        }
    }
    Ok(name)
}

/// The sum of all bytes of a header, its own field taken as spaces.
fn check_sum(head: &[u8], at: u64) -> Result<()> {
    let sum: u64 = head.iter().map(|byte| u64::from(*byte)).sum();
    let field: u64 = head[148..156].iter().map(|byte| u64::from(*byte)).sum();
    if number(&head[148..156]).ok() == Some(sum - field + 8 * u64::from(b' ')) {
        return Ok(());
    }
    Err(malformed(format!("the header at byte {at} is damaged")))
}

/// An octal number, padded with spaces or zero bytes.
fn number(field: &[u8]) -> Result<u64> {
    let digits = text(field);
    u64::from_str_radix(digits.trim(), 8)
        .map_err(|_| malformed(format!("'{}' is no octal number", digits.escape_default())))
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
