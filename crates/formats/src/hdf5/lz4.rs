//! LZ4 as an HDF5 filter (32004): blocks after their common size, all numbers in big-endian order.
//!
//! The filter of `hdf5-reader` expects the size before each block, so it reads chunks of one block only.

use hdf5_reader::error::{Error, Result};

/// Number of the filter.
pub(super) const FILTER: u16 = 32004;
/// Largest expansion of LZ4 in bytes per compressed byte.
const MAX_EXPANSION: usize = 255;

/// Decompresses a chunk.
///
/// Errors: data that are cut short or damaged; a chunk of more than `max_bytes`.
pub(super) fn decompress(bytes: &[u8], max_bytes: usize) -> Result<Vec<u8>> {
    let invalid = |problem: &str| Error::DecompressionError(format!("LZ4: {problem}"));
    let cut = || invalid("the data are cut short");
    let (size, rest) = bytes.split_first_chunk().ok_or_else(cut)?;
    let (block_size, mut rest) = rest.split_first_chunk().ok_or_else(cut)?;
    let size = usize::try_from(u64::from_be_bytes(*size)).unwrap_or(usize::MAX);
    let block_size = u32::from_be_bytes(*block_size) as usize;
    if size > max_bytes {
        return Err(invalid("a chunk is too large"));
    }
    if block_size == 0 && size > 0 {
        return Err(invalid("the blocks are empty"));
    }
    let mut chunk = Vec::new();
    while chunk.len() < size {
        let (stored, tail) = rest.split_first_chunk().ok_or_else(cut)?;
        let stored = u32::from_be_bytes(*stored) as usize;
        let (block, tail) = tail.split_at_checked(stored).ok_or_else(cut)?;
        rest = tail;
        let length = block_size.min(size - chunk.len());
        if stored == length {
            chunk.extend_from_slice(block);
            continue;
        }
        if length > stored.saturating_mul(MAX_EXPANSION) {
            return Err(invalid("a block is larger than its data allow"));
        }
        let block = lz4_flex::block::decompress(block, length);
        let block = block.map_err(|error| invalid(&error.to_string()))?;
        if block.len() != length {
            return Err(invalid("a block has another size than stated"));
        }
        chunk.extend(block);
    }
    Ok(chunk)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{any, prop, proptest};

    use super::decompress;

    /// A chunk in blocks of this size.
    fn compress(chunk: &[u8], block: usize) -> Vec<u8> {
        let mut bytes = (chunk.len() as u64).to_be_bytes().to_vec();
        bytes.extend((block as u32).to_be_bytes());
        for block in chunk.chunks(block) {
            let packed = lz4_flex::block::compress(block);
            let packed = if packed.len() < block.len() { &packed } else { block };
            bytes.extend((packed.len() as u32).to_be_bytes());
            bytes.extend(packed);
        }
        bytes
    }

    #[test]
    fn chunks_of_several_blocks_are_decompressed() {
        let chunk: Vec<u8> = (0..1000).map(|k| (k / 50 * 7) as u8).collect();
        for block in [16, 100, 1000, 4096] {
            let bytes = compress(&chunk, block);
            assert_eq!(decompress(&bytes, 1000).unwrap(), chunk, "{block}");
            assert!(decompress(&bytes, 999).is_err());
            for length in [0, 7, 11, 13, bytes.len() - 1] {
                assert!(decompress(&bytes[..length], 1000).is_err(), "{block} {length}");
            }
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_decompressed_within_the_limit_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            let start = [0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 64];
            if let Ok(chunk) = decompress(&[&start[..], &bytes].concat(), 1000) {
                assert_eq!(chunk.len(), 512);
            }
        }
    }
}
