//! The headers of an EXR file, split into attributes.
//!
//! The EXR crate writes attributes in the order of a hash map, which differs between processes. They are sorted here, so
//! that equal frames give equal files. Readers ignore the order.

use std::io::{self, BufRead, Read};

use ::exr::error::Error as ExrError;
use ::exr::meta::header::Header;
use ::exr::meta::{MetaData, magic_number};

/// Length of magic number and version, in bytes.
const PROLOGUE_BYTES: usize = 8;
/// Version flag of files with several parts. Their headers end with an empty one.
const MULTI_PART: u8 = 0x10;
/// Start of the attribute with the name of a part.
const NAME: &[u8] = b"name\0";

/// The part of a file before the chunk tables.
#[derive(Debug, Clone)]
pub(super) struct Head {
    prologue: [u8; PROLOGUE_BYTES],
    /// The attributes of each part. An attribute starts with its name and a zero byte, its type and a zero byte, and
    /// its size in four bytes.
    pub(super) parts: Vec<Vec<Vec<u8>>>,
}

impl Head {
    /// Errors: [`ExrError`] for headers that a strict reader refuses.
    pub(super) fn new(headers: &[Header]) -> Result<Self, ExrError> {
        let strict = true;
        let requirements = MetaData::validate(headers, strict)?;
        let mut bytes = Vec::new();
        magic_number::write(&mut bytes)?;
        requirements.write(&mut bytes)?;
        Header::write_all(headers, &mut bytes, requirements.is_multilayer())?;
        let mut head = Self::read(&mut &*bytes)?;
        // Each attribute starts with its name and a zero byte, so sorting the bytes sorts the names.
        head.parts.iter_mut().for_each(|attributes| attributes.sort());
        Ok(head)
    }

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

    /// The head of a file that has only this part, without a name.
    pub(super) fn single_part(&self, part: usize) -> Self {
        let mut prologue = self.prologue;
        prologue[5] &= !MULTI_PART;
        let attributes = self.parts.get(part).into_iter().flatten();
        let attributes = attributes.filter(|attribute| !attribute.starts_with(NAME)).cloned();
        Self { prologue, parts: vec![attributes.collect()] }
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
