//! The inner structure of an array: flags, dimensions, name, samples.

use super::element::{Content, malformed};
use crate::error::Result;
use crate::hdf5::python_name;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, SampleType};

const INT8: u32 = 1;
const INT32: u32 = 5;
const UINT32: u32 = 6;

/// Longest accepted name. MATLAB's limit is 63.
const MAX_NAME_BYTES: u32 = 255;
/// Largest accepted number of axes.
const MAX_AXES: u32 = 16;
/// The largest class with flags, dimensions and a name (uint64).
const LAST_ORDINARY_CLASS: u8 = 15;

const COMPLEX: u32 = 0x0800;
const LOGICAL: u32 = 0x0200;

/// The header of an array, before its samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ArrayHeader {
    pub(super) name: String,
    /// Lengths of the axes, the fastest one first.
    pub(super) dimensions: Vec<u64>,
    class: u8,
    flags: u32,
}

impl ArrayHeader {
    /// Reads the header. Empty arrays and those of opaque classes have no header, and so no name.
    pub(super) fn read(content: &mut Content<'_>) -> Result<Self> {
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
            .map(|axis| {
                u64::try_from(axis as i32)
                    .map_err(|_| malformed("an array has a negative dimension"))
            })
            .collect::<Result<_, _>>()?;
        let name = Part::read(content, "name", MAX_NAME_BYTES)?.expect_type(INT8)?;
        header.name = String::from_utf8_lossy(&name.bytes).into_owned();
        Ok(header)
    }

    /// The data type of the array. Errors: [`FormatError::Unsupported`] for other classes.
    pub(super) fn sample_type(&self) -> Result<SampleType> {
        let name = python_name(&self.name);
        let refused = match self.class {
            // A sparse matrix may also be complex, so it is checked first.
            5 => format!(
                "a sparse matrix (to convert it: python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                 scipy.io.loadmat('in.mat')['{name}'].toarray())\")"
            ),
            _ if self.flags & COMPLEX != 0 => format!(
                "complex numbers (to convert to absolute values: python -c \"import numpy, scipy.io; a = \
                 abs(scipy.io.loadmat('in.mat')['{name}']); numpy.save('out.npy', numpy.moveaxis(a, -1, 0) if a.ndim > 2 \
                 else a)\")"
            ),
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
            1 => format!(
                "a cell array (to convert cells with one frame each: python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                 numpy.stack(list(scipy.io.loadmat('in.mat')['{name}'].ravel())))\")"
            ),
            2 => format!(
                "a struct (to convert its first array: python -c \"import numpy, scipy.io; s = scipy.io.loadmat('in.mat', \
                 simplify_cells=True)['{name}']; a = next(v for v in s.values() if numpy.ndim(v) > 1); \
                 numpy.save('out.npy', numpy.moveaxis(a, -1, 0) if a.ndim > 2 else a)\")"
            ),
            3 => "an object".to_owned(),
            4 => "text".to_owned(),
            _ => "an array of an unknown class".to_owned(),
        };
        Err(FormatError::Unsupported {
            format: Format::Mat,
            found: format!("{refused} in '{}'", self.name),
            accepted: "double, single, logical and integers",
        })
    }
}

/// Reads the tag of the samples: their storage type and number of bytes, which must match the dimensions.
pub(super) fn read_data_tag(
    content: &mut Content<'_>,
    header: &ArrayHeader,
) -> Result<(SampleType, u64)> {
    let (kind, bytes) = content.tag()?;
    let name = &header.name;
    if kind > 0xffff {
        return Err(FormatError::Unsupported {
            format: Format::Mat,
            found: format!("'{name}' with at most four bytes of samples"),
            accepted: "larger arrays",
        });
    }
    let storage = storage(kind)
        .ok_or_else(|| malformed(format!("'{name}' has the unknown storage type {kind}")))?;
    let count = header.dimensions.iter().fold(1u64, |product, axis| product.saturating_mul(*axis));
    let promised = count.saturating_mul(storage.bytes() as u64);
    if promised != u64::from(bytes) {
        return Err(malformed(format!(
            "'{name}' of {:?} needs {promised} bytes of samples, but has {bytes}",
            header.dimensions
        )));
    }
    Ok((storage, promised))
}

/// A part of the header of an array.
struct Part {
    name: &'static str,
    kind: u32,
    bytes: Vec<u8>,
}

impl Part {
    /// Reads a part of at most `limit` bytes, and its padding.
    fn read(content: &mut Content<'_>, name: &'static str, limit: u32) -> Result<Self> {
        let (kind, size) = content.tag()?;
        if kind > 0xffff {
            // At most four bytes are packed into the tag, in the place of the size.
            let length = (kind >> 16) as usize;
            let packed = match content.order() {
                ByteOrder::Little => size.to_le_bytes(),
                ByteOrder::Big => size.to_be_bytes(),
            };
            let bytes = packed.get(..length).ok_or_else(|| {
                malformed(format!("the {name} of an array has {length} bytes in the tag"))
            })?;
            return Ok(Self { name, kind: kind & 0xffff, bytes: bytes.to_vec() });
        }
        if size > limit {
            return Err(malformed(format!(
                "the {name} of an array has {size} bytes, but at most {limit} are expected"
            )));
        }
        let mut bytes = vec![0; size.next_multiple_of(8) as usize];
        content.fill(&mut bytes)?;
        bytes.truncate(size as usize);
        Ok(Self { name, kind, bytes })
    }

    fn expect_type(self, kind: u32) -> Result<Self> {
        if self.kind == kind {
            return Ok(self);
        }
        Err(malformed(format!(
            "the {} of an array has the type {}, not {kind}",
            self.name, self.kind
        )))
    }

    fn words(&self, order: ByteOrder) -> impl Iterator<Item = u32> + '_ {
        let (words, _) = self.bytes.as_chunks::<4>();
        words.iter().map(move |word| match order {
            ByteOrder::Little => u32::from_le_bytes(*word),
            ByteOrder::Big => u32::from_be_bytes(*word),
        })
    }
}

/// The storage type with this code. MATLAB stores doubles that are small integers as integers.
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
