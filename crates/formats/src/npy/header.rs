//! Parses the header of an npy file, a flat dictionary of three keys.
//!
//! The parser of the crate `ndarray-npy` allocates whatever length a file claims, and parses any Python literal
//! recursively. A small file of nested brackets could overflow the stack.

use crate::error::Result;
use crate::samples::ByteOrder;
use crate::{Format, FormatError, SampleType};

/// Longest accepted header. NumPy has the same limit for untrusted files.
pub(super) const MAX_HEADER_BYTES: u64 = 10_000;

const ACCEPTED_TYPES: &str = "integers and floats of 8 to 64 bits and bool, in 2 or 3 dimensions";

/// The content of an npy header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) sample: SampleType,
    pub(super) order: ByteOrder,
    pub(super) fortran_order: bool,
    pub(super) shape: Vec<u64>,
}

impl Header {
    /// Parses the dictionary, for example
    /// `{'descr': '<f4', 'fortran_order': False, 'shape': (8, 256, 256), }`.
    pub(super) fn parse(text: &[u8]) -> Result<Self> {
        let mut cursor = Cursor { text, position: 0 };
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        cursor.expect(b'{')?;
        while !cursor.accept(b'}') {
            let key = cursor.string()?;
            cursor.expect(b':')?;
            match key {
                b"descr" => descr = Some(cursor.type_descriptor()?),
                b"fortran_order" => fortran_order = Some(cursor.boolean()?),
                b"shape" => shape = Some(cursor.shape()?),
                _ => return Err(cursor.error("one of the keys descr, fortran_order, shape")),
            }
            if !cursor.accept(b',') {
                cursor.expect(b'}')?;
                break;
            }
        }
        let (Some((sample, order)), Some(fortran_order), Some(shape)) =
            (descr, fortran_order, shape)
        else {
            return Err(malformed("the header lacks one of the keys descr, fortran_order, shape"));
        };
        Ok(Self { sample, order, fortran_order, shape })
    }
}

/// A position in the text of a header. Whitespace between tokens is skipped.
struct Cursor<'a> {
    text: &'a [u8],
    position: usize,
}

impl<'a> Cursor<'a> {
    fn peek(&mut self) -> Option<u8> {
        while self.text.get(self.position).is_some_and(u8::is_ascii_whitespace) {
            self.position += 1;
        }
        self.text.get(self.position).copied()
    }

    fn accept(&mut self, token: u8) -> bool {
        let matches = self.peek() == Some(token);
        self.position += usize::from(matches);
        matches
    }

    fn expect(&mut self, token: u8) -> Result<()> {
        if self.accept(token) {
            return Ok(());
        }
        Err(self.error(&format!("'{}'", char::from(token))))
    }

    fn string(&mut self) -> Result<&'a [u8]> {
        let quote = match self.peek() {
            Some(quote @ (b'\'' | b'"')) => quote,
            _ => return Err(self.error("a quoted string")),
        };
        let start = self.position + 1;
        let rest = self.text.get(start..).unwrap_or_default();
        let Some(length) = rest.iter().position(|&b| b == quote) else {
            return Err(self.error("a quoted string that ends"));
        };
        self.position = start + length + 1;
        Ok(&rest[..length])
    }

    /// Reads the letters and digits at the cursor.
    fn word(&mut self) -> &'a [u8] {
        self.peek();
        let rest = self.text.get(self.position..).unwrap_or_default();
        let length = rest.iter().position(|b| !b.is_ascii_alphanumeric()).unwrap_or(rest.len());
        self.position += length;
        &rest[..length]
    }

    fn boolean(&mut self) -> Result<bool> {
        match self.word() {
            b"True" => Ok(true),
            b"False" => Ok(false),
            _ => Err(self.error("True or False")),
        }
    }

    fn shape(&mut self) -> Result<Vec<u64>> {
        let mut shape = Vec::new();
        self.expect(b'(')?;
        while !self.accept(b')') {
            // Python 2 writes long integers with a trailing L.
            let word = self.word();
            let digits = word.strip_suffix(b"L").unwrap_or(word);
            let axis = str::from_utf8(digits).ok().and_then(|d| d.parse().ok());
            match axis {
                // NumPy allows at most 64 axes.
                Some(axis) if shape.len() < 64 => shape.push(axis),
                _ => return Err(self.error("a tuple of non-negative integers")),
            }
            if !self.accept(b',') {
                self.expect(b')')?;
                break;
            }
        }
        Ok(shape)
    }

    fn type_descriptor(&mut self) -> Result<(SampleType, ByteOrder)> {
        if self.peek() == Some(b'[') {
            return Err(unsupported("a structured dtype".to_owned()));
        }
        let descr = self.string()?;
        let (order, code) = match descr {
            [b'<' | b'|' | b'=', code @ ..] => (ByteOrder::Little, code),
            [b'>', code @ ..] => (ByteOrder::Big, code),
            code => (ByteOrder::Little, code),
        };
        let sample = match code {
            b"b1" => SampleType::Bool,
            b"u1" => SampleType::U8,
            b"u2" => SampleType::U16,
            b"u4" => SampleType::U32,
            b"u8" => SampleType::U64,
            b"i1" => SampleType::I8,
            b"i2" => SampleType::I16,
            b"i4" => SampleType::I32,
            b"i8" => SampleType::I64,
            b"f2" => SampleType::F16,
            b"f4" => SampleType::F32,
            b"f8" => SampleType::F64,
            _ => {
                return Err(unsupported(format!("dtype {}", dtype_name(code, descr))));
            }
        };
        Ok((sample, order))
    }

    fn error(&self, expected: &str) -> FormatError {
        malformed(&format!("expected {expected} at byte {} of the header", self.position))
    }
}

/// The common name of an unsupported data type, with a conversion if there is one.
fn dtype_name(code: &[u8], descr: &[u8]) -> String {
    let name = match code {
        b"O" => {
            "object, a pickle (to convert arrays of one size: python -c \"import numpy; numpy.save('out.npy', \
             numpy.stack(numpy.load('in.npy', allow_pickle=True)))\")"
        }
        b"c8" | b"c16" => {
            "complex64 or complex128 (to convert to absolute values: python -c \"import numpy; numpy.save('out.npy', \
             numpy.abs(numpy.load('in.npy')))\")"
        }
        b"f16" => "float128",
        _ => {
            let shown: String = String::from_utf8_lossy(descr).chars().take(24).collect();
            return format!("'{}'", shown.escape_default());
        }
    };
    name.to_owned()
}

pub(super) fn unsupported(found: String) -> FormatError {
    FormatError::Unsupported { format: Format::Npy, found, accepted: ACCEPTED_TYPES }
}

fn malformed(problem: &str) -> FormatError {
    FormatError::malformed(Format::Npy, problem)
}
