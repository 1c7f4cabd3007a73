//! The inner structure of an array: flags, dimensions, name, numbers.

use std::io::BufRead;

use super::element::{Content, malformed};
use crate::error::Result;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, SampleType};

const INT8: u32 = 1;
const INT32: u32 = 5;
const UINT32: u32 = 6;

/// MATLAB's own limit is 63.
const MAX_NAME_BYTES: u32 = 255;
/// More axes than any sensible array has.
const MAX_AXES: u32 = 16;
/// The largest class that begins with flags, dimensions and a name (15, uint64).
const LAST_ORDINARY_CLASS: u8 = 15;

const COMPLEX: u32 = 0x0800;
const LOGICAL: u32 = 0x0200;

/// What an array says before its numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ArrayHeader {
    pub(super) name: String,
    /// Sizes of the axes, the one that varies fastest first.
    pub(super) dimensions: Vec<u64>,
    class: u8,
    flags: u32,
}

impl ArrayHeader {
    /// Reads the header. Arrays without one (empty, or of MATLAB's opaque classes) have no name.
    pub(super) fn read<R: BufRead>(content: &mut Content<R>) -> Result<Self> {
        let mut header = Self { name: String::new(), dimensions: Vec::new(), class: 0, flags: 0 };
        if content.is_empty() {
            return Ok(header);
        }
        let flags = Part::read(content, "flags", 8)?.expect_type(UINT32)?;
        let flags = flags.words(content.order()).next().unwrap_or_default();
        header.flags = flags;
        header.class = (flags & 0xff) as u8;
        if header.class > LAST_ORDINARY_CLASS {
            return Ok(header);
        }
        let dimensions = Part::read(content, "dimensions", 4 * MAX_AXES)?.expect_type(INT32)?;
        header.dimensions = dimensions
            .words(content.order())
            .map(|axis| u64::try_from(axis as i32).map_err(|_| malformed("a negative dimension")))
            .collect::<Result<_, _>>()?;
        let name = Part::read(content, "name", MAX_NAME_BYTES)?.expect_type(INT8)?;
        header.name = String::from_utf8_lossy(&name.bytes).into_owned();
        Ok(header)
    }

    /// How the array's numbers are meant. Errors: a class that is not accepted.
    pub(super) fn sample_type(&self) -> Result<SampleType> {
        let refused = match self.class {
            // A sparse matrix may be complex, too: its line comes first.
            5 => {
                "a sparse matrix (python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                 scipy.io.loadmat('in.mat')['mask'].toarray())\")"
            }
            _ if self.flags & COMPLEX != 0 => {
                "complex numbers (absolute values: python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                 numpy.moveaxis(abs(scipy.io.loadmat('in.mat')['mask']), -1, 0))\")"
            }
            6 => return Ok(SampleType::F64),
            7 => return Ok(SampleType::F32),
            9 if self.flags & LOGICAL != 0 => return Ok(SampleType::Bool),
            9 => return Ok(SampleType::U8),
            11 => return Ok(SampleType::U16),
            8 => return Ok(SampleType::I8),
            10 => return Ok(SampleType::I16),
            12 => return Ok(SampleType::I32),
            13 => return Ok(SampleType::U32),
            14 => return Ok(SampleType::I64),
            15 => return Ok(SampleType::U64),
            1 => {
                "a cell array (of a frame each: python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                 numpy.stack(list(scipy.io.loadmat('in.mat')['mask'].ravel())))\")"
            }
            2 => {
                "a struct (its first field: python -c \"import numpy, scipy.io; s = scipy.io.loadmat('in.mat', \
                 simplify_cells=True)['mask']; numpy.save('out.npy', numpy.moveaxis(list(s.values())[0], -1, 0))\")"
            }
            3 => "an object",
            4 => "text",
            _ => "an array of an unknown class",
        };
        Err(FormatError::Unsupported {
            format: Format::Mat,
            found: format!("{refused} in '{}'", self.name),
            accepted: "double, single, logical and integers",
        })
    }
}

/// Reads the tag of the numbers: how they are stored, and how many bytes follow, checked against
/// the dimensions.
pub(super) fn read_data_tag<R: BufRead>(
    content: &mut Content<R>,
    header: &ArrayHeader,
) -> Result<(SampleType, u64)> {
    let (kind, bytes) = content.tag()?;
    let name = &header.name;
    if kind > 0xffff {
        return Err(FormatError::Unsupported {
            format: Format::Mat,
            found: format!("'{name}' with at most four bytes of numbers"),
            accepted: "frames of some size",
        });
    }
    let storage = storage(kind)
        .ok_or_else(|| malformed(format!("'{name}' stores numbers as type {kind}")))?;
    let count = header.dimensions.iter().fold(1u64, |product, axis| product.saturating_mul(*axis));
    let promised = count.saturating_mul(storage.bytes() as u64);
    if promised != u64::from(bytes) {
        return Err(malformed(format!(
            "'{name}' of {:?} needs {promised} bytes of numbers, but has {bytes}",
            header.dimensions
        )));
    }
    Ok((storage, promised))
}

/// A part of an array's header with its bytes.
struct Part {
    what: &'static str,
    kind: u32,
    bytes: Vec<u8>,
}

impl Part {
    /// Reads a part of at most `limit` bytes, and its padding.
    fn read<R: BufRead>(content: &mut Content<R>, what: &'static str, limit: u32) -> Result<Self> {
        let (kind, size) = content.tag()?;
        if kind > 0xffff {
            // At most four bytes: they stand in the tag, where the size would be.
            let length = (kind >> 16) as usize;
            let packed = match content.order() {
                ByteOrder::Little => size.to_le_bytes(),
                ByteOrder::Big => size.to_be_bytes(),
            };
            let bytes = packed.get(..length).ok_or_else(|| {
                malformed(format!("the {what} of an array: {length} bytes in the tag"))
            })?;
            return Ok(Self { what, kind: kind & 0xffff, bytes: bytes.to_vec() });
        }
        if size > limit {
            return Err(malformed(format!(
                "the {what} of an array: {size} bytes, at most {limit} are expected"
            )));
        }
        let mut bytes = vec![0; size.next_multiple_of(8) as usize];
        content.fill(&mut bytes)?;
        bytes.truncate(size as usize);
        Ok(Self { what, kind, bytes })
    }

    fn expect_type(self, kind: u32) -> Result<Self> {
        if self.kind == kind {
            return Ok(self);
        }
        Err(malformed(format!("the {} of an array: type {}, not {kind}", self.what, self.kind)))
    }

    fn words(&self, order: ByteOrder) -> impl Iterator<Item = u32> + '_ {
        let (words, _) = self.bytes.as_chunks::<4>();
        words.iter().map(move |word| match order {
            ByteOrder::Little => u32::from_le_bytes(*word),
            ByteOrder::Big => u32::from_be_bytes(*word),
        })
    }
}

/// How numbers are stored, by the code of their type; MATLAB stores small whole doubles as integers.
fn storage(kind: u32) -> Option<SampleType> {
    Some(match kind {
        INT8 => SampleType::I8,
        2 => SampleType::U8,
        3 => SampleType::I16,
        4 => SampleType::U16,
        INT32 => SampleType::I32,
        UINT32 => SampleType::U32,
        7 => SampleType::F32,
        9 => SampleType::F64,
        12 => SampleType::I64,
        13 => SampleType::U64,
        _ => return None,
    })
}
