//! The data folder: where each thing lies, and the file operations that survive a power cut.

use std::fs::{self, File, TryLockError};
use std::io;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use rustix::fs::FallocateFlags;

use super::database_file::DatabaseFiles;
use super::error::{Result, StoreError};
use super::locked::LockedFile;
use engine::job::{JobId, PartialId, Sha256};

/// Reserved bytes as one lab sees them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reserved {
    pub own: u64,
    pub others: u64,
    /// True if there are other labs, which need room, too.
    pub is_shared: bool,
}

/// Bytes of the reserve file: the write-ahead log of thousands of deletions.
const RESERVE_BYTES: u64 = 32 << 20;

/// The folder with all that the service keeps.
///
/// ```text
/// sci-recon.db          records
/// sci-recon.json        the marker: which folder this is, for the database to be compared with
/// blobs/ab/cdef...      files by the SHA-256 of their bytes
/// results/JOB/          manifest.json and one folder for each snapshot
/// partial/ID            uploads that come in pieces
/// quarantine/TIME/      what no record knows of, for some days
/// before-updates/       copies of the database from before updates of the program
/// before-updates/kept/  files that were deleted in the days after an update, for a return to such a copy
/// tmp/                  files that are being written, locked by their writers
/// reserve               empty room for a start and for deletions on a full disk
/// ```
#[derive(Debug, Clone)]
pub struct DataDir {
    root: Arc<Path>,
}

impl DataDir {
    /// Makes the folder where it is missing.
    pub(crate) fn create(root: &Path) -> Result<Self> {
        fs::create_dir_all(root).map_err(StoreError::io("make the folder", root))?;
        Self::find(root)
    }

    /// The folder, which must be there.
    pub(crate) fn find(root: &Path) -> Result<Self> {
        match root.canonicalize() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(StoreError::NoFolder(root.to_owned()))
            }
            path => Ok(Self { root: path.map_err(StoreError::io("find", root))?.into() }),
        }
    }

    /// Makes the folders in it, where they are missing.
    pub(crate) fn fill(&self) -> Result<()> {
        for path in [self.blobs(), self.all_results(), self.partials(), self.tmp()] {
            fs::create_dir_all(&path).map_err(StoreError::io("make the folder", &path))?;
        }
        sync_dir(&self.root)
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn database(&self) -> PathBuf {
        self.root.join("sci-recon.db")
    }

    /// Path of the file with this hash, if it is in the store.
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

    pub fn results(&self, job: JobId) -> PathBuf {
        self.all_results().join(job.to_string())
    }

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

    /// Copies of the database from before updates of the program.
    pub(crate) fn before_updates(&self) -> PathBuf {
        self.root.join("before-updates")
    }

    /// Files that the last copy in [`Self::before_updates`] knows of and that were deleted since.
    pub(crate) fn kept(&self) -> PathBuf {
        self.before_updates().join("kept")
    }

    /// Folder that keeps files without a row for some days.
    pub(crate) fn quarantine(&self) -> PathBuf {
        self.root.join("quarantine")
    }

    /// Takes the lock of the server. Each folder has one.
    pub(crate) fn lock_server(&self) -> Result<LockedFile> {
        let path = self.server_lock();
        // The file of a running server keeps what that server has recorded.
        let mut options = File::options();
        let file = options.create(true).truncate(false).write(true).open(&path);
        match LockedFile::take(file.map_err(StoreError::io("make", &path))?) {
            Ok(file) => Ok(file),
            Err(TryLockError::WouldBlock) => Err(StoreError::Taken(self.root.to_path_buf())),
            Err(TryLockError::Error(error)) => Err(StoreError::io("lock", &path)(error)),
        }
    }

    fn server_lock(&self) -> PathBuf {
        self.root.join("server.lock")
    }

    /// Records the files of the open database, for [`Self::check_files_of_server`].
    pub(crate) fn record_files(&self, mut lock: &File, files: &DatabaseFiles) -> Result<()> {
        let text = serde_json::to_vec(files).map_err(io::Error::from);
        let recorded = text.and_then(|text| {
            lock.set_len(0)?;
            lock.write_all(&text)
        });
        recorded.map_err(StoreError::io("write", &self.server_lock()))
    }

    /// Errors: [`StoreError::DatabaseGone`] if a server runs on this folder and uses other files than the present ones.
    pub(crate) fn check_files_of_server(&self) -> Result<()> {
        let path = self.server_lock();
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(StoreError::io("open", &path)(error)),
        };
        if !matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)) {
            return Ok(());
        }
        // A server that is just starting has not recorded its files.
        let Ok(files) = serde_json::from_reader::<_, DatabaseFiles>(file) else { return Ok(()) };
        files.check(&self.database())
    }

    /// Removes what dead processes left in `tmp`: whatever nobody holds the lock of. Says how much.
    pub fn sweep_tmp(&self) -> Result<usize> {
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

    fn reserve(&self) -> PathBuf {
        self.root.join("reserve")
    }

    /// True if a start needs the reserve.
    pub(crate) fn is_full(&self) -> Result<bool> {
        Ok(self.disk()?.0 < RESERVE_BYTES / 4)
    }

    /// Removes the reserve file, so that a service with a full disk can start and delete. True if there was one.
    pub(crate) fn give_up_reserve(&self) -> Result<bool> {
        let exists = self.reserve().exists();
        remove(&self.reserve())?;
        if exists {
            tracing::warn!(
                "the disk is full: its reserve is given up, so that jobs and files can be deleted"
            );
        }
        Ok(exists)
    }

    /// Makes the reserve file, if it is missing and the disk has room for it and for `min_free` more bytes.
    pub fn keep_reserve(&self, min_free: u64) -> Result<()> {
        let path = self.reserve();
        if path.exists() || self.disk()?.0 < min_free.saturating_add(2 * RESERVE_BYTES) {
            return Ok(());
        }
        let draft = self.tmp().join("reserve");
        let file = File::create(&draft).map_err(StoreError::io("make", &draft))?;
        let allocated = rustix::fs::fallocate(&file, FallocateFlags::empty(), 0, RESERVE_BYTES);
        if let Err(error) = allocated {
            remove(&draft)?;
            return Err(StoreError::io("reserve room for", &path)(error.into()));
        }
        rename_durably(&draft, &path)
    }

    /// Bytes that are free on the disk of this folder, and its size.
    pub fn disk(&self) -> Result<(u64, u64)> {
        let stat = rustix::fs::statvfs(&*self.root).map_err(|error| {
            StoreError::io("ask for the free space of", &self.root)(error.into())
        })?;
        Ok((stat.f_bavail * stat.f_frsize, stat.f_blocks * stat.f_frsize))
    }

    /// Refuses `what` if the disk has no room for its `needed` bytes beside those that are reserved and the `min_free`
    /// ones that stay free. If there are other labs, a lab may reserve half of the bytes that these leave, so that room
    /// remains for each of them.
    /// Errors: [`StoreError::NoRoom`]; [`StoreError::NoShare`].
    pub fn check_room(
        &self,
        what: &'static str,
        needed: u64,
        reserved: Reserved,
        min_free: u64,
    ) -> Result<()> {
        let free = self.disk()?.0;
        let Reserved { own, others, is_shared } = reserved;
        let promised = own.saturating_add(others);
        if free < promised.saturating_add(needed).saturating_add(min_free) {
            return Err(StoreError::NoRoom { what, needed, free, promised, reserve: min_free });
        }
        let share = free.saturating_sub(min_free).saturating_sub(others) / 2;
        if is_shared && own.saturating_add(needed) > share {
            return Err(StoreError::NoShare { what, needed, own, share });
        }
        Ok(())
    }
}

/// True if a file was modified less than `age` ago, or ahead of the clock: a clock that was set back tells no age.
fn is_young(file: &File, age: Duration) -> bool {
    let modified = file.metadata().and_then(|meta| meta.modified());
    modified.is_ok_and(|at| SystemTime::now().duration_since(at).map_or(true, |past| past < age))
}

/// Runs work on files, which blocks, where it may block.
pub(crate) async fn on_files<T, F>(work: F) -> Result<T>
where
    T: Send + 'static,
    F: FnOnce() -> Result<T> + Send + 'static,
{
    tokio::task::spawn_blocking(work).await.map_err(|_| StoreError::Interrupted)?
}

/// The paths in a folder; none if it is no folder, or gone.
pub(crate) fn children(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(folder) {
        Err(_) if !folder.is_dir() => return Ok(Vec::new()),
        entries => entries.map_err(StoreError::io("read the folder", folder))?,
    };
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    paths.collect::<Result<_, _>>().map_err(StoreError::io("read the folder", folder))
}

/// Writes a folder's entries to the disk: without it a rename may be forgotten in a power cut.
pub(crate) fn sync_dir(path: &Path) -> Result<()> {
    // The parent of a bare name.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    File::open(path)
        .and_then(|dir| dir.sync_all())
        .map_err(StoreError::io("write to the disk the folder", path))
}

/// Lets nobody but the owner look into a folder, or into a file.
pub(crate) fn restrict(path: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    let is_dir = fs::metadata(path).is_ok_and(|meta| meta.is_dir());
    let mode = fs::Permissions::from_mode(if is_dir { 0o700 } else { 0o600 });
    fs::set_permissions(path, mode).map_err(StoreError::io("keep for its owner", path))
}

/// Renames a synced file or folder durably.
pub(crate) fn rename_durably(from: &Path, to: &Path) -> Result<()> {
    fs::rename(from, to).map_err(StoreError::io("move a file to", to))?;
    to.parent().map_or(Ok(()), sync_dir)
}

/// Makes one folder durably. It may exist already.
pub(crate) fn make_dir_durably(path: &Path) -> Result<()> {
    match fs::create_dir(path) {
        Ok(()) => path.parent().map_or(Ok(()), sync_dir),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(StoreError::io("make the folder", path)(error)),
    }
}

/// Removes a file or a folder with its contents. It is no error if it does not exist.
pub(crate) fn remove(path: &Path) -> Result<()> {
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
