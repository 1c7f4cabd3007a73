//! A file of lines of one size, of which each becomes another one as it is read.

use std::fmt;
use std::io;
use std::sync::Arc;

use axum::body::Bytes;
use futures_util::stream::{self, Stream};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt, SeekFrom};

/// About as many bytes are made at once: of large pictures a few lines.
const BAND: u64 = 256 * 1024;

/// Puts a line behind others, made of the bytes that all lines share, its number and the stored line.
pub(super) type Make = Arc<dyn Fn(&[u8], usize, &[u8], &mut Vec<u8>) + Send + Sync>;

#[derive(Clone)]
pub(super) struct Lines {
    /// Where the first one begins.
    pub(super) start: u64,
    pub(super) count: u64,
    /// Bytes of each as it is stored.
    pub(super) stored: u64,
    /// Bytes of each as it is made.
    pub(super) made: u64,
    pub(super) make: Make,
}

impl fmt::Debug for Lines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} lines of {} bytes", self.count, self.made)
    }
}

#[allow(clippy::cast_possible_truncation)] // within a band, or lines of a file
impl Lines {
    pub(super) fn length(&self) -> u64 {
        self.count * self.made
    }

    /// The bytes from `skip` on, `take` of them.
    pub(super) async fn read(
        self,
        file: std::fs::File,
        shared: Bytes,
        (skip, take): (u64, u64),
    ) -> io::Result<impl Stream<Item = io::Result<Bytes>>> {
        let (first, end) = (skip / self.made, skip + take);
        let mut file = File::from_std(file);
        file.seek(SeekFrom::Start(self.start + first * self.stored)).await?;
        Ok(stream::try_unfold((file, first), move |(mut file, line)| {
            let (lines, shared) = (self.clone(), shared.clone());
            async move {
                let at = line * lines.made;
                if at >= end {
                    return Ok(None);
                }
                let count = (BAND / lines.made).max(1).min((end - at).div_ceil(lines.made));
                let made = lines.band(&mut file, &shared, (line, count)).await?;
                let inside = skip.max(at) - at..end.min(at + made.len() as u64) - at;
                let made = made.slice(inside.start as usize..inside.end as usize);
                Ok(Some((made, (file, line + count))))
            }
        }))
    }

    /// The next lines of the file.
    async fn band(
        &self,
        file: &mut File,
        shared: &[u8],
        (line, count): (u64, u64),
    ) -> io::Result<Bytes> {
        let mut stored = vec![0; (count * self.stored) as usize];
        file.read_exact(&mut stored).await?;
        let mut made = Vec::with_capacity((count * self.made) as usize);
        for (index, stored) in stored.chunks_exact(self.stored as usize).enumerate() {
            (self.make)(shared, line as usize + index, stored, &mut made);
        }
        Ok(made.into())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use axum::body::Bytes;
    use futures_util::TryStreamExt;

    use super::{BAND, Lines};

    /// Lines of three bytes, of which each gets its number and what all share.
    #[tokio::test]
    async fn a_range_is_that_part_of_the_whole() {
        let count = BAND / 5 + 100;
        let stored: Vec<u8> = (0..2 + count * 3).map(|at| (at % 251) as u8).collect();
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&stored).unwrap();
        let make = |shared: &[u8], line: usize, stored: &[u8], made: &mut Vec<u8>| {
            made.extend(stored);
            made.extend([(line % 7) as u8, shared[0]]);
        };
        let lines = Lines { start: 2, count, stored: 3, made: 5, make: Arc::new(make) };
        let read = async |skip: u64, take: u64| {
            let file = file.try_clone().unwrap();
            let bands = lines.clone().read(file, Bytes::from("!"), (skip, take)).await.unwrap();
            bands.try_collect::<Vec<_>>().await.unwrap()
        };
        let whole = read(0, lines.length()).await;
        assert_eq!(whole.len(), 2, "bands");
        let whole = whole.concat();
        assert_eq!(whole.len() as u64, lines.length());
        assert_eq!(whole[10..15], [8, 9, 10, 2, b'!']);
        for (skip, take) in [(0, 1), (4, 1), (3, 4), (7, BAND), (lines.length() - 3, 3), (9, 0)] {
            let part = &whole[skip as usize..(skip + take) as usize];
            assert_eq!(read(skip, take).await.concat(), part, "{skip} {take}");
        }
    }
}
