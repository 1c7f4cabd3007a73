//! Sorts the attributes of an EXR file by name, so that equal frames give equal files.
//!
//! The EXR crate writes attributes in the order of a hash map, which differs between processes. Readers ignore the
//! order, and sorting does not change any size, so the headers are sorted in place.

use std::fs::File;
use std::io::{self, BufReader, Seek, Write};
use std::path::Path;

use super::head::Head;

/// Sorts the attributes of each header of a file.
pub(super) fn sort_attributes(path: &Path) -> io::Result<()> {
    let mut file = File::options().read(true).write(true).open(path)?;
    let mut head = Head::read(&mut BufReader::new(&mut file))?;
    // Each attribute starts with its name and a zero byte, so sorting the bytes sorts the names.
    head.parts.iter_mut().for_each(|attributes| attributes.sort());
    file.rewind()?;
    file.write_all(&head.bytes())
}
