//! Splits the headers of an EXR file into attributes.

use std::io::{self, BufRead, Read};

/// Length of magic number and version, in bytes.
const PROLOGUE_BYTES: usize = 8;
/// Version flag of files with several parts. Their headers end with an empty one.
const MULTI_PART: u8 = 0x10;

/// The part of a file before the chunk tables.
pub(super) struct Head {
    prologue: [u8; PROLOGUE_BYTES],
    /// The attributes of each part. An attribute starts with its name and a zero byte, its type and a zero byte, and
    /// its size in four bytes.
    pub(super) parts: Vec<Vec<Vec<u8>>>,
}

impl Head {
    pub(super) fn read(reader: &mut impl BufRead) -> io::Result<Self> {
        let mut head = Self { prologue: [0; PROLOGUE_BYTES], parts: Vec::new() };
        reader.read_exact(&mut head.prologue)?;
        loop {
            let attributes = read_attributes(reader)?;
            if head.has_several_parts() && attributes.is_empty() {
                return Ok(head);
            }
            head.parts.push(attributes);
            if !head.has_several_parts() {
                return Ok(head);
            }
        }
    }

    /// True for a file with several parts, in which chunks contain the number of their part.
    pub(super) fn has_several_parts(&self) -> bool {
        self.prologue[5] & MULTI_PART != 0
    }

    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut bytes = self.prologue.to_vec();
        for attributes in &self.parts {
            attributes.iter().for_each(|attribute| bytes.extend(attribute));
            bytes.push(0);
        }
        if self.has_several_parts() {
            bytes.push(0);
        }
        bytes
    }
}

/// Reads the attributes of a part, without the final zero byte.
fn read_attributes(reader: &mut impl BufRead) -> io::Result<Vec<Vec<u8>>> {
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
