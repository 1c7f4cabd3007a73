//! Attributes in the order of their names, so that the same frame gives the same bytes.
//!
//! The EXR crate keeps attributes in a hash map and writes them in another order in every process.
//! Their order means nothing to readers and their sizes stay, so they are put in order in place.

use std::fs::File;
use std::io::{self, BufReader, Seek, Write};
use std::path::Path;

use super::head::Head;

/// Sorts the attributes of each header of a file that was just written.
pub(super) fn sort_attributes(path: &Path) -> io::Result<()> {
    let mut file = File::options().read(true).write(true).open(path)?;
    let mut head = Head::read(&mut BufReader::new(&mut file))?;
    // Each begins with its name and a zero, so this is the order of the names.
    head.parts.iter_mut().for_each(|attributes| attributes.sort());
    file.rewind()?;
    file.write_all(&head.bytes())
}
