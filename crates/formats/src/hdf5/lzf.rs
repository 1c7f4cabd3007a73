//! LZF, the fast compression of h5py (filter 32000).
//!
//! The only crate for this format is deprecated. The format is a sequence of literal runs and of references to bytes
//! that were already decompressed.

use hdf5_reader::error::{Error, Result};

/// Number of the filter.
pub(super) const FILTER: u16 = 32000;
/// A control byte below this value is the length of a literal run, less 1.
const LITERALS: u8 = 32;
/// A length of a reference with this value is continued in the next byte.
const LONG: usize = 7;

/// Decompresses a chunk. `parameters` are those of the filter; the third one is the size of a chunk in bytes.
///
/// Errors: data that are cut short, refer to bytes before the start, or exceed the size or `max_bytes`.
pub(super) fn decompress(bytes: &[u8], parameters: &[u32], max_bytes: usize) -> Result<Vec<u8>> {
    let stated = parameters.get(2).map(|size| *size as usize).filter(|size| *size > 0);
    let limit = stated.unwrap_or(max_bytes).min(max_bytes);
    let invalid = |problem: &str| Error::DecompressionError(format!("LZF: {problem}"));
    let cut = || invalid("the data are cut short");
    let mut chunk: Vec<u8> = Vec::new();
    let mut rest = bytes.iter();
    while let Some(&control) = rest.next() {
        if control < LITERALS {
            let length = usize::from(control) + 1;
            let literals = rest.as_slice().get(..length).ok_or_else(cut)?;
            chunk.extend_from_slice(literals);
            rest.nth(length - 1);
        } else {
            let mut length = usize::from(control >> 5);
            if length == LONG {
                length += usize::from(*rest.next().ok_or_else(cut)?);
            }
            let low = *rest.next().ok_or_else(cut)?;
            let distance = (usize::from(control & 31) << 8 | usize::from(low)) + 1;
            let start = chunk.len().checked_sub(distance);
            let start = start.ok_or_else(|| invalid("a reference points before the start"))?;
            // The copy may overlap its source, which repeats the last bytes.
            for place in start..start + length + 2 {
                chunk.push(chunk[place]);
            }
        }
        if chunk.len() > limit {
            return Err(invalid("a chunk is larger than stated"));
        }
    }
    Ok(chunk)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{any, prop, proptest};

    use super::decompress;

    #[test]
    fn literals_and_references_are_decompressed() {
        // Three literals, a reference that overlaps itself, and a long reference.
        let bytes = [2, 1, 2, 3, 1 << 5, 0, 7 << 5, 1, 2];
        let chunk = decompress(&bytes, &[4, 0x105, 16], 1 << 20).unwrap();
        assert_eq!(chunk, [1, 2, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3]);
        assert!(decompress(&bytes, &[4, 0x105, 15], 1 << 20).is_err());
        assert!(decompress(&bytes, &[], 15).is_err());
        for length in [1, 5, 7, 8] {
            assert!(decompress(&bytes[..length], &[], 1 << 20).is_err(), "{length}");
        }
        assert!(decompress(&[0, 1, 1 << 5, 1], &[], 1 << 20).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_decompressed_within_the_limit_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(chunk) = decompress(&bytes, &[], 1000) {
                assert!(chunk.len() <= 1000);
            }
        }
    }
}
