//! Hashes of stored files, remembered for as long as a file looks the same.

use std::fs::{File, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use quick_cache::sync::Cache;

use super::error::{Result, StoreError};
use crate::job::Sha256;

/// Files of which the hash is remembered.
const REMEMBERED: usize = 65_536;

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

/// Hashes of files that were read.
#[derive(Debug)]
pub(super) struct Hashes(pub(super) Cache<Identity, Sha256>);

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

/// The hash of the bytes that are left to read.
pub(super) fn hash(mut file: File) -> Result<Sha256> {
    let hashed = Sha256::of_reader(&mut file);
    Ok(hashed.map_err(StoreError::io("read", Path::new("a stored file")))?.0)
}
