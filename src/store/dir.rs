//! The data folder: where each thing lies, and the file operations that survive a power cut.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use super::error::StoreError;
use crate::job::{JobId, PartialId, Sha256};

/// The folder with all that the service keeps.
///
/// ```text
/// sci-recon.db          records
/// blobs/ab/cdef...      files by the SHA-256 of their bytes
/// results/JOB/          manifest.json and one folder for each snapshot
/// partial/ID            uploads that come in pieces
/// tmp/                  files that are being written, locked by their writers
/// ```
#[derive(Debug, Clone)]
pub struct DataDir {
    root: Arc<Path>,
}

impl DataDir {
    /// Makes the folder and those in it, where they are missing.
    pub(crate) fn create(root: &Path) -> Result<Self, StoreError> {
        fs::create_dir_all(root).map_err(StoreError::io("make the folder", root))?;
        let root = root.canonicalize().map_err(StoreError::io("find", root))?;
        for name in ["blobs", "results", "partial", "tmp"] {
            let path = root.join(name);
            fs::create_dir_all(&path).map_err(StoreError::io("make the folder", &path))?;
        }
        sync_dir(&root)?;
        Ok(Self { root: root.into() })
    }

    /// The folder itself.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn database(&self) -> PathBuf {
        self.root.join("sci-recon.db")
    }

    /// Where the file with this hash lies, if it is in the store.
    #[must_use]
    pub fn blob(&self, sha256: &Sha256) -> PathBuf {
        let hex = sha256.to_string();
        self.blobs().join(&hex[..2]).join(&hex[2..])
    }

    pub(crate) fn blobs(&self) -> PathBuf {
        self.root.join("blobs")
    }

    pub(crate) fn all_results(&self) -> PathBuf {
        self.root.join("results")
    }

    /// The folder with the results of a job.
    #[must_use]
    pub fn results(&self, job: JobId) -> PathBuf {
        self.all_results().join(job.to_string())
    }

    /// The folder with the results of one snapshot of a job.
    #[must_use]
    pub fn snapshot_results(&self, job: JobId, snapshot: u32) -> PathBuf {
        self.results(job).join(format!("snapshot_{snapshot:04}"))
    }

    pub(crate) fn partials(&self) -> PathBuf {
        self.root.join("partial")
    }

    pub(crate) fn partial(&self, id: PartialId) -> PathBuf {
        self.partials().join(id.to_string())
    }

    pub(crate) fn tmp(&self) -> PathBuf {
        self.root.join("tmp")
    }

    /// Waits for the lock file `name` and holds it until the file is dropped.
    pub(crate) async fn lock_blocking(&self, name: &str) -> Result<File, StoreError> {
        let path = self.root.join(name);
        super::on_files(move || {
            let file = File::create(&path).map_err(StoreError::io("make", &path))?;
            file.lock().map_err(StoreError::io("lock", &path))?;
            Ok(file)
        })
        .await
    }

    /// Takes the lock of the server, of which there is one for each folder; none if it is taken.
    ///
    /// # Errors
    /// If the lock file can't be made.
    pub fn try_lock_server(&self) -> Result<Option<File>, StoreError> {
        let path = self.root.join("server.lock");
        let file = File::create(&path).map_err(StoreError::io("make", &path))?;
        match file.try_lock() {
            Ok(()) => Ok(Some(file)),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(StoreError::io("lock", &path)(error)),
        }
    }

    /// Removes what dead processes left in `tmp`: whatever nobody holds the lock of. Says how much.
    ///
    /// # Errors
    /// If the folder can't be read.
    pub fn sweep_tmp(&self) -> Result<usize, StoreError> {
        let tmp = self.tmp();
        let mut removed = 0;
        for entry in fs::read_dir(&tmp).map_err(StoreError::io("read the folder", &tmp))? {
            let path = entry.map_err(StoreError::io("read the folder", &tmp))?.path();
            let Ok(file) = File::open(&path) else { continue };
            // A moment passes between a file's making and its lock.
            if is_young(&file, Duration::from_secs(10)) || file.try_lock().is_err() {
                continue;
            }
            if remove(&path).is_ok() {
                removed += 1;
            }
        }
        Ok(removed)
    }

    /// Bytes that are free on the disk of this folder, and its size.
    ///
    /// # Errors
    /// If the file system does not say.
    pub fn disk(&self) -> Result<(u64, u64), StoreError> {
        let stat = rustix::fs::statvfs(&*self.root).map_err(|error| {
            StoreError::io("ask for the free space of", &self.root)(error.into())
        })?;
        Ok((stat.f_bavail * stat.f_frsize, stat.f_blocks * stat.f_frsize))
    }
}

fn is_young(file: &File, age: Duration) -> bool {
    let modified = file.metadata().and_then(|meta| meta.modified());
    modified.is_ok_and(|at| SystemTime::now().duration_since(at).is_ok_and(|past| past < age))
}

/// Writes a folder's entries to the disk: without it a rename may be forgotten in a power cut.
pub(crate) fn sync_dir(path: &Path) -> Result<(), StoreError> {
    File::open(path)
        .and_then(|dir| dir.sync_all())
        .map_err(StoreError::io("write to the disk the folder", path))
}

/// Renames a file or folder that is on the disk already, for good.
pub(crate) fn rename_durably(from: &Path, to: &Path) -> Result<(), StoreError> {
    fs::rename(from, to).map_err(StoreError::io("move a file to", to))?;
    to.parent().map_or(Ok(()), sync_dir)
}

/// Makes one folder, for good. It may be there already.
pub(crate) fn make_dir_durably(path: &Path) -> Result<(), StoreError> {
    match fs::create_dir(path) {
        Ok(()) => path.parent().map_or(Ok(()), sync_dir),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(StoreError::io("make the folder", path)(error)),
    }
}

/// Removes a file or a folder with all in it. It may be gone already.
pub(crate) fn remove(path: &Path) -> Result<(), StoreError> {
    let result = match fs::symlink_metadata(path) {
        Ok(meta) if meta.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match result {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(StoreError::io("remove", path)(error))
        }
        _ => Ok(()),
    }
}
