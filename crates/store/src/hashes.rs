//! Hashes of stored files, remembered for as long as a file looks the same.

use std::fs::{File, Metadata};
use std::io::{Read, Sink, Write, sink};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;

use quick_cache::sync::Cache;
use tokio::sync::Semaphore;

use super::error::{Result, StoreError};
use super::on_files;
use engine::job::{HashingWriter, Sha256};

/// Number of files whose hash is remembered.
const REMEMBERED: usize = 65_536;
/// Bytes that are read at a time.
const SLICE: usize = 1 << 20;
/// Slices that are read at the same time. Files take turns, so that a small file does not wait for large ones.
const SLICES_AT_ONCE: usize = 4;

/// A file as it was when it was hashed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Identity {
    device: u64,
    inode: u64,
    size: u64,
    changed: (i64, i64),
}

impl Identity {
    pub(super) fn of(meta: &Metadata) -> Self {
        let (device, inode, size) = (meta.dev(), meta.ino(), meta.len());
        Self { device, inode, size, changed: (meta.mtime(), meta.mtime_nsec()) }
    }
}

/// Hashes of files that were written or read.
#[derive(Debug)]
pub(super) struct Hashes {
    known: Cache<Identity, Sha256>,
    turns: Semaphore,
}

impl Default for Hashes {
    fn default() -> Self {
        Self { known: Cache::new(REMEMBERED), turns: Semaphore::new(SLICES_AT_ONCE) }
    }
}

impl Hashes {
    /// Remembers the hash of a file.
    pub(super) fn remember(&self, file: Identity, sha256: Sha256) {
        self.known.insert(file, sha256);
    }

    /// The hash of an open file. It is read once for all who ask, and to its end even if none of them waits any
    /// longer.
    pub(super) async fn of(self: &Arc<Self>, file: &File, meta: &Metadata) -> Result<Sha256> {
        let identity = Identity::of(meta);
        if let Some(known) = self.known.get(&identity) {
            return Ok(known);
        }
        let again = file.try_clone().map_err(unreadable())?;
        let hashes = self.clone();
        let reading = tokio::spawn(async move {
            let read = hashes.read(Hashing::new(again));
            hashes.known.get_or_insert_async(&identity, read).await
        });
        reading.await.map_err(|_| StoreError::Interrupted)?
    }

    async fn read(&self, mut file: Hashing) -> Result<Sha256> {
        loop {
            let _turn = self.turns.acquire().await.map_err(|_| StoreError::Interrupted)?;
            let (read, count) = file.advance().await?;
            if count == 0 {
                return Ok(read.finish());
            }
            file = read;
        }
    }
}

/// A file that is hashed slice by slice, so that it can be broken off between two of them.
#[derive(Debug)]
pub(super) struct Hashing {
    pub(super) file: File,
    hashed: HashingWriter<Sink>,
    slice: Vec<u8>,
}

impl Hashing {
    pub(super) fn new(file: File) -> Self {
        Self { file, hashed: HashingWriter::new(sink()), slice: Vec::new() }
    }

    /// Reads the next slice. Gives its bytes, 0 at the end of the file.
    pub(super) async fn advance(mut self) -> Result<(Self, usize)> {
        on_files(move || {
            self.slice.resize(SLICE, 0);
            let count = self.file.read(&mut self.slice).map_err(unreadable())?;
            self.hashed.write_all(&self.slice[..count]).map_err(unreadable())?;
            Ok((self, count))
        })
        .await
    }

    /// The hash of all slices that were read.
    pub(super) fn finish(self) -> Sha256 {
        self.hashed.sha256()
    }
}

fn unreadable() -> impl FnOnce(std::io::Error) -> StoreError {
    StoreError::io("read", Path::new("a stored file"))
}

/// Opens a file; none if there is none.
pub(super) fn open(path: &Path) -> Result<Option<(File, Metadata)>> {
    let file = match File::open(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        file => file.map_err(StoreError::io("open", path))?,
    };
    let meta = file.metadata().map_err(StoreError::io("read", path))?;
    Ok(Some((file, meta)))
}

/// The hash of the bytes that are left to read.
pub(super) fn digest(mut file: File) -> Result<Sha256> {
    Ok(Sha256::of_reader(&mut file).map_err(unreadable())?.0)
}
