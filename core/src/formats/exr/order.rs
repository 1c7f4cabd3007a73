//! Attributes in the order of their names, so that the same frame gives the same bytes.
//!
//! The EXR crate keeps attributes in a hash map and writes them in another order in every process.
//! Their order means nothing to readers and their sizes stay, so they are put in order in place.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Magic number and version.
const PROLOGUE_BYTES: u64 = 8;
/// The flag in the version for files of several parts, which end their headers with an empty one.
const MULTI_PART: u8 = 0x10;

/// Sorts the attributes of each header of a file that was just written.
pub(super) fn sort_attributes(path: &Path) -> io::Result<()> {
    let mut file = File::options().read(true).write(true).open(path)?;
    let mut prologue = [0; PROLOGUE_BYTES as usize];
    file.read_exact(&mut prologue)?;
    let several = prologue[5] & MULTI_PART != 0;
    let mut reader = BufReader::new(&mut file);
    let mut sorted = Vec::new();
    loop {
        let mut attributes = read_header(&mut reader)?;
        if several && attributes.is_empty() {
            break;
        }
        // Each begins with its name and a zero, so this is the order of the names.
        attributes.sort();
        sorted.extend(attributes.concat());
        sorted.push(0);
        if !several {
            break;
        }
    }
    file.seek(SeekFrom::Start(PROLOGUE_BYTES))?;
    file.write_all(&sorted)
}

/// The attributes of a header as they stand, without the zero at its end.
fn read_header(reader: &mut impl BufRead) -> io::Result<Vec<Vec<u8>>> {
    let mut attributes = Vec::new();
    loop {
        let mut attribute = Vec::new();
        reader.read_until(0, &mut attribute)?;
        if attribute.len() <= 1 {
            return Ok(attributes);
        }
        reader.read_until(0, &mut attribute)?;
        let mut size = [0; 4];
        reader.read_exact(&mut size)?;
        attribute.extend(size);
        reader.take(u32::from_le_bytes(size).into()).read_to_end(&mut attribute)?;
        attributes.push(attribute);
    }
}
