//! Lines of equal size that are converted while they are read from a stored file. A line is a row of pixels.

use std::fmt;
use std::io;
use std::sync::Arc;

use axum::body::Bytes;
use futures_util::stream::{self, Stream};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt, SeekFrom};

/// Bytes that are composed at a time, rounded to whole lines.
const BAND_BYTES: u64 = 256 * 1024;

/// Appends a composed line to a buffer. Arguments: the bytes that all lines share, the line's number, the stored line, and
/// the buffer.
pub(super) type Compose = Arc<dyn Fn(&[u8], usize, &[u8], &mut Vec<u8>) + Send + Sync>;

#[derive(Clone)]
pub(super) struct Lines {
    /// Offset of the first line in the stored file.
    pub(super) start: u64,
    pub(super) count: u64,
    /// Bytes of a stored line.
    pub(super) stored_bytes: u64,
    /// Bytes of a composed line.
    pub(super) composed_bytes: u64,
    pub(super) compose: Compose,
}

impl fmt::Debug for Lines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} lines of {} bytes", self.count, self.composed_bytes)
    }
}

#[allow(clippy::cast_possible_truncation)] // within a band, or lines of a file
impl Lines {
    pub(super) fn length(&self) -> u64 {
        self.count * self.composed_bytes
    }

    /// Composes `take` bytes after the first `skip` bytes, in bands of lines.
    pub(super) async fn read(
        self,
        file: std::fs::File,
        shared: Bytes,
        skip: u64,
        take: u64,
    ) -> io::Result<impl Stream<Item = io::Result<Bytes>>> {
        let (first, end) = (skip / self.composed_bytes, skip + take);
        let mut file = File::from_std(file);
        file.seek(SeekFrom::Start(self.start + first * self.stored_bytes)).await?;
        Ok(stream::try_unfold((file, first), move |(mut file, line)| {
            let (lines, shared) = (self.clone(), shared.clone());
            async move {
                let start = line * lines.composed_bytes;
                if start >= end {
                    return Ok(None);
                }
                let needed = (end - start).div_ceil(lines.composed_bytes);
                let count = (BAND_BYTES / lines.composed_bytes).max(1).min(needed);
                let band = lines.read_band(&mut file, &shared, line, count).await?;
                let range = skip.max(start) - start..end.min(start + band.len() as u64) - start;
                let bytes = band.slice(range.start as usize..range.end as usize);
                Ok(Some((bytes, (file, line + count))))
            }
        }))
    }

    /// Reads and composes the next `count` lines, from number `first` on.
    async fn read_band(
        &self,
        file: &mut File,
        shared: &[u8],
        first: u64,
        count: u64,
    ) -> io::Result<Bytes> {
        let mut stored = vec![0; (count * self.stored_bytes) as usize];
        file.read_exact(&mut stored).await?;
        let mut composed = Vec::with_capacity((count * self.composed_bytes) as usize);
        for (index, line) in stored.chunks_exact(self.stored_bytes as usize).enumerate() {
            (self.compose)(shared, first as usize + index, line, &mut composed);
        }
        Ok(composed.into())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use axum::body::Bytes;
    use futures_util::TryStreamExt;

    use super::{BAND_BYTES, Lines};

    /// Each line of three bytes is extended by its number and by a byte that all lines share.
    #[tokio::test]
    async fn a_range_has_the_same_bytes_as_the_whole() {
        let count = BAND_BYTES / 5 + 100;
        let stored: Vec<u8> = (0..2 + count * 3).map(|at| (at % 251) as u8).collect();
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&stored).unwrap();
        let compose = |shared: &[u8], number: usize, stored: &[u8], composed: &mut Vec<u8>| {
            composed.extend(stored);
            composed.extend([(number % 7) as u8, shared[0]]);
        };
        let compose = Arc::new(compose);
        let lines = Lines { start: 2, count, stored_bytes: 3, composed_bytes: 5, compose };
        let read = async |skip: u64, take: u64| {
            let file = file.try_clone().unwrap();
            let bands = lines.clone().read(file, Bytes::from("!"), skip, take).await.unwrap();
            bands.try_collect::<Vec<_>>().await.unwrap()
        };
        let whole = read(0, lines.length()).await;
        assert_eq!(whole.len(), 2, "bands");
        let whole = whole.concat();
        assert_eq!(whole.len() as u64, lines.length());
        assert_eq!(whole[10..15], [8, 9, 10, 2, b'!']);
        for (skip, take) in
            [(0, 1), (4, 1), (3, 4), (7, BAND_BYTES), (lines.length() - 3, 3), (9, 0)]
        {
            let part = &whole[skip as usize..(skip + take) as usize];
            assert_eq!(read(skip, take).await.concat(), part, "{skip} {take}");
        }
    }
}
