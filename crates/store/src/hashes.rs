//! Hashes of stored files, remembered for as long as a file looks the same.

use std::fs::{File, Metadata};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use flate2::Crc;
use quick_cache::sync::Cache;
use sha2::Digest;

use super::error::{Result, StoreError};
use engine::job::Sha256;

/// Files of which the hash is remembered.
const REMEMBERED: usize = 65_536;
/// Bytes that are read at a time.
const PIECE: usize = 256 * 1024;

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

/// What follows from the bytes of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Digests {
    pub(super) sha256: Sha256,
    /// CRC-32, by which ZIP archives check their members.
    pub(super) crc32: u32,
}

/// Digests in the making.
#[derive(Debug, Default)]
pub(super) struct Digester {
    sha256: sha2::Sha256,
    crc32: Crc,
}

impl Digester {
    pub(super) fn update(&mut self, bytes: &[u8]) {
        self.sha256.update(bytes);
        self.crc32.update(bytes);
    }

    pub(super) fn finish(self) -> Digests {
        Digests { sha256: Sha256::new(self.sha256.finalize().into()), crc32: self.crc32.sum() }
    }
}

/// Digests of files that were read.
#[derive(Debug)]
pub(super) struct Hashes(pub(super) Cache<Identity, Digests>);

impl Default for Hashes {
    fn default() -> Self {
        Self(Cache::new(REMEMBERED))
    }
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

/// The digests of the bytes that are left to read.
pub(super) fn digest(mut file: File) -> Result<Digests> {
    let failed = StoreError::io("read", Path::new("a stored file"));
    let read = |file: &mut File, digester: &mut Digester| -> std::io::Result<()> {
        let mut buffer = vec![0; PIECE];
        loop {
            match file.read(&mut buffer)? {
                0 => return Ok(()),
                count => digester.update(&buffer[..count]),
            }
        }
    };
    let mut digester = Digester::default();
    read(&mut file, &mut digester).map_err(failed)?;
    Ok(digester.finish())
}
