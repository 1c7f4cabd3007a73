//! Files on their way into the store: written under a temporary name, hashed, brought to the disk.
//!
//! A writer holds a lock on its file, so that the sweep can distinguish it from the files of dead processes. A file
//! that is dropped before it is stored is removed.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use uuid::Uuid;

use super::Store;
use super::error::{Result, StoreError};
use super::hashes::{Identity, digest};
use super::locked::LockedFile;
use super::{DataDir, dir, on_files, upgrade};
use engine::job::{HashingWriter, Sha256, Timestamp, WrittenFile};

/// A temporary file or folder; its lock and its removal.
#[derive(Debug)]
struct Temporary {
    path: PathBuf,
    /// Open for the lock alone.
    _lock: LockedFile,
    /// Set when the content has found its place.
    moved: bool,
}

impl Temporary {
    fn new(path: PathBuf, lock: File) -> Result<Self> {
        let lock = LockedFile::wait(lock).map_err(StoreError::io("lock", &path))?;
        Ok(Self { path, _lock: lock, moved: false })
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.moved {
            // Nothing depends on it: what stays is swept at the next start.
            let _ = dir::remove(&self.path);
        }
    }
}

impl Store {
    pub(super) fn temporary_path(&self) -> PathBuf {
        self.dir().tmp().join(Uuid::now_v7().to_string())
    }

    /// A new file that is hashed while it is written. Blocks on the disk.
    pub fn blob_writer(&self) -> Result<BlobWriter> {
        let staged = self.staged_path()?;
        let path = &staged.0.path;
        let file = File::options().write(true).open(path);
        let file = file.map_err(StoreError::io("open", path))?;
        let file = HashingWriter::new(BufWriter::with_capacity(256 * 1024, file));
        Ok(BlobWriter { file, temporary: staged.0 })
    }

    /// A new empty file for a writer that wants a path. Blocks on the disk.
    pub fn staged_path(&self) -> Result<StagedPath> {
        let path = self.temporary_path();
        let lock = File::create_new(&path).map_err(StoreError::io("make", &path))?;
        Ok(StagedPath(Temporary::new(path, lock)?))
    }

    /// A second name for an existing file, on its way into the store; `lock` holds the file's lock already. Blocks on
    /// the disk.
    pub(super) fn staged_link(&self, original: &Path, lock: File) -> Result<StagedPath> {
        let path = self.temporary_path();
        fs::hard_link(original, &path).map_err(StoreError::io("link", &path))?;
        Ok(StagedPath(Temporary::new(path, lock)?))
    }

    /// Takes a file or a folder out of its place, at once and as a whole; its bytes go in the background, as large
    /// files take long and others wait for the lock of the database. It may be gone already. Files that the version
    /// before an update knows are kept for some days: those that existed at `since`, or have not changed since they
    /// were made.
    pub(super) async fn discard(&self, place: PathBuf, since: Option<Timestamp>) -> Result<()> {
        let rest = self.temporary_path();
        let (moved, root) = (rest.clone(), self.dir().clone());
        let found = on_files(move || {
            if keep(&root, &place, since)? {
                return Ok(false);
            }
            match fs::rename(&place, &moved) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
                Err(error) => Err(StoreError::io("remove", &place)(error)),
                Ok(()) => place.parent().map_or(Ok(()), dir::sync_dir).map(|()| true),
            }
        })
        .await?;
        if found {
            self.removals.begin(rest);
        }
        Ok(())
    }

    /// A new empty folder for the results of a task. Blocks on the disk.
    pub fn staged_dir(&self) -> Result<StagedDir> {
        let path = self.temporary_path();
        fs::create_dir(&path).map_err(StoreError::io("make the folder", &path))?;
        let lock = File::open(&path).map_err(StoreError::io("open", &path))?;
        Ok(StagedDir(Temporary::new(path, lock)?))
    }
}

/// Moves a file or folder to those that are kept after an update, if it is one of them.
fn keep(root: &DataDir, place: &Path, since: Option<Timestamp>) -> Result<bool> {
    let Some(kept) = upgrade::keep_as(root, place, since)? else { return Ok(false) };
    if let Some(folder) = kept.parent() {
        fs::create_dir_all(folder).map_err(StoreError::io("make the folder", folder))?;
    }
    // The first one of this name is the one that the copy of the database knows.
    if kept.exists() {
        return Ok(false);
    }
    dir::rename_durably(place, &kept)?;
    place.parent().map_or(Ok(()), dir::sync_dir).map(|()| true)
}

/// A file that is hashed while it is written.
#[derive(Debug)]
pub struct BlobWriter {
    temporary: Temporary,
    file: HashingWriter<BufWriter<File>>,
}

impl BlobWriter {
    pub fn size(&self) -> u64 {
        self.file.size()
    }

    /// Brings the file to the disk.
    pub fn finish(mut self) -> Result<StagedBlob> {
        let synced = self.file.flush().and_then(|()| self.file.writer.get_ref().sync_all());
        synced.map_err(StoreError::io("write to the disk", &self.temporary.path))?;
        let (sha256, size) = (self.file.sha256(), self.file.size());
        Ok(StagedBlob { temporary: self.temporary, sha256, size })
    }
}

impl Write for BlobWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// A temporary file that some other code writes.
#[derive(Debug)]
pub struct StagedPath(Temporary);

impl StagedPath {
    /// The path to write to. The file exists and is empty; it must not be replaced by another one.
    pub fn path(&self) -> &Path {
        &self.0.path
    }

    /// Reads the file back to hash it, and brings it to the disk.
    pub fn finish(self) -> Result<StagedBlob> {
        let path = &self.0.path;
        let file = File::open(path).map_err(StoreError::io("open", path))?;
        let size = file.metadata().map_err(StoreError::io("read", path))?.len();
        file.sync_all().map_err(StoreError::io("write to the disk", path))?;
        Ok(StagedBlob { temporary: self.0, sha256: digest(file)?, size })
    }
}

/// A file that is on the disk, but not yet in the store.
#[derive(Debug)]
pub struct StagedBlob {
    temporary: Temporary,
    sha256: Sha256,
    size: u64,
}

impl StagedBlob {
    pub fn sha256(&self) -> Sha256 {
        self.sha256
    }

    pub fn size(&self) -> u64 {
        self.size
    }

    /// The path of the file until it is stored.
    pub fn path(&self) -> &Path {
        &self.temporary.path
    }

    /// Moves the file to its place. Gives its identity there, and the file that it replaced, which the caller removes.
    /// The writer's lock of the database must be held.
    pub(super) fn put(mut self, place: &Path) -> Result<(Identity, Option<PathBuf>)> {
        if let Some(folder) = place.parent() {
            dir::make_dir_durably(folder)?;
        }
        // An existing file has the same bytes, or is damaged. It is removed in the background: the time that this takes
        // would reveal that another lab had sent the same bytes.
        let old = self.temporary.path.with_extension("old");
        let replaced = fs::hard_link(place, &old).is_ok();
        dir::rename_durably(&self.temporary.path, place)?;
        // Two names of one file stay two: it was stored before, by an attempt that a crash ended.
        dir::remove(&self.temporary.path)?;
        self.temporary.moved = true;
        let identity = Identity::of(&fs::metadata(place).map_err(StoreError::io("read", place))?);
        Ok((identity, replaced.then_some(old)))
    }
}

/// A temporary folder in which a task writes its result files. The writer syncs them.
#[derive(Debug)]
pub struct StagedDir(Temporary);

impl StagedDir {
    pub fn path(&self) -> &Path {
        &self.0.path
    }

    /// Moves the folder to `place`. Gives the folder that it replaced, which the caller removes. The writer's lock must
    /// be held.
    pub(super) fn put(mut self, place: &Path) -> Result<Option<PathBuf>> {
        if place.exists() {
            let old = self.0.path.with_extension("old");
            dir::rename_durably(place, &old)?;
            dir::rename_durably(&self.0.path, place)?;
            self.0.moved = true;
            return Ok(Some(old));
        }
        dir::rename_durably(&self.0.path, place)?;
        self.0.moved = true;
        Ok(None)
    }

    /// Moves the files, not the folder, into the folder `place`. The writer's lock must be held.
    pub(super) fn put_files(self, place: &Path, files: &[WrittenFile]) -> Result<()> {
        for WrittenFile { file, .. } in files {
            dir::rename_durably(&self.0.path.join(&file.name), &place.join(&file.name))?;
        }
        Ok(())
    }
}
