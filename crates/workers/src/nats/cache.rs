//! A worker's cache: one folder of limited size, with files named by the hash of their bytes. The least recently used
//! file is removed first.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::connection::ClusterError;
use engine::job::Sha256;
use store::LockedFile;

/// A folder of files that can be fetched again.
#[derive(Debug)]
pub struct Cache {
    folder: PathBuf,
    /// Limit of the total size in bytes.
    limit: u64,
    files: HashMap<Sha256, CachedFile>,
    /// Number of uses so far.
    uses: u64,
    /// Reserves the folder for this cache until it is dropped.
    _lock: LockedFile,
}

#[derive(Debug, Clone, Copy)]
struct CachedFile {
    bytes: u64,
    /// Value of [`Cache::uses`] at the last use.
    last_use: u64,
}

impl Cache {
    /// Opens a folder, and creates it if it is missing. Files of other origin remain untouched.
    /// Errors: it can't be created or read, or another worker uses it: each would remove files that the other needs.
    pub fn open(folder: &Path, limit: u64) -> Result<Self, ClusterError> {
        let failed = |error: io::Error| ClusterError::Cache {
            path: folder.display().to_string(),
            reason: error.to_string(),
        };
        fs::create_dir_all(folder).map_err(failed)?;
        let lock = fs::File::create(folder.join(LOCK)).map_err(failed)?;
        let lock = LockedFile::take(lock).map_err(|error| match error {
            fs::TryLockError::Error(error) => failed(error),
            fs::TryLockError::WouldBlock => failed(io::Error::other(
                "another worker uses it; give each worker a separate folder (--cache)",
            )),
        })?;
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if let Some(draft) = name.strip_suffix(DRAFT)
                && draft.parse::<Sha256>().is_ok()
            {
                // A killed worker has left an unfinished file.
                fs::remove_file(entry.path()).map_err(failed)?;
            } else if let Ok(sha256) = name.parse::<Sha256>() {
                let metadata = entry.metadata().map_err(failed)?;
                let used = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                files.push((used, sha256, metadata.len()));
            }
        }
        files.sort_unstable_by_key(|(used, ..)| *used);
        let folder = folder.to_owned();
        let mut cache = Self { folder, limit, files: HashMap::new(), uses: 0, _lock: lock };
        for (_, sha256, bytes) in files {
            cache.record_use(sha256, bytes);
        }
        cache.make_room(0, &[]).map_err(failed)?;
        Ok(cache)
    }

    /// The path of a file, which may not be in the cache.
    pub fn path(&self, sha256: Sha256) -> PathBuf {
        self.folder.join(sha256.to_string())
    }

    /// True if the cache has the file and its bytes are intact. A damaged file is removed.
    pub fn has(&mut self, sha256: Sha256) -> bool {
        let path = self.path(sha256);
        let hashed = fs::File::open(&path).and_then(|mut file| Sha256::of_reader(&mut file));
        match hashed {
            Ok((actual, bytes)) if actual == sha256 => {
                self.record_use(sha256, bytes);
                true
            }
            _ => {
                self.files.remove(&sha256);
                // The file may not exist.
                let _ = fs::remove_file(path);
                false
            }
        }
    }

    /// Adds a file. Files in `needed` are not removed to make room.
    /// Errors: it is too large for the cache, or the disk fails.
    pub fn add(&mut self, sha256: Sha256, bytes: &[u8], needed: &[Sha256]) -> io::Result<()> {
        let size = bytes.len() as u64;
        self.make_room(size, needed)?;
        let path = self.path(sha256);
        let draft = self.folder.join(format!("{sha256}{DRAFT}"));
        fs::write(&draft, bytes)?;
        fs::rename(draft, path)?;
        self.record_use(sha256, size);
        Ok(())
    }

    fn record_use(&mut self, sha256: Sha256, bytes: u64) {
        self.uses += 1;
        self.files.insert(sha256, CachedFile { bytes, last_use: self.uses });
    }

    fn make_room(&mut self, size: u64, needed: &[Sha256]) -> io::Result<()> {
        loop {
            let total: u64 = self.files.values().map(|file| file.bytes).sum();
            if total + size <= self.limit {
                return Ok(());
            }
            let removable = self.files.iter().filter(|(sha256, _)| !needed.contains(sha256));
            let Some((&oldest, _)) = removable.min_by_key(|(_, file)| file.last_use) else {
                return Err(io::Error::other(format!(
                    "one tile needs more than the {} bytes that the cache may use: set a larger \
            --cache-bytes",
                    self.limit
                )));
            };
            self.files.remove(&oldest);
            match fs::remove_file(self.path(oldest)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
    }
}

/// Suffix of a file that is being written.
const DRAFT: &str = ".part";
/// A worker that uses the folder holds a lock on this file.
const LOCK: &str = "lock";

#[cfg(test)]
mod tests {
    use super::Cache;
    use engine::job::Sha256;

    fn sizes(folder: &std::path::Path) -> u64 {
        let entries = std::fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
    }

    #[test]
    fn the_limit_holds_and_the_least_recently_used_file_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let files: Vec<Vec<u8>> = (0..5).map(|n| vec![n; 100]).collect();
        let names: Vec<Sha256> = files.iter().map(|bytes| Sha256::of(bytes)).collect();
        let mut cache = Cache::open(folder.path(), 300).unwrap();
        for n in 0..3 {
            cache.add(names[n], &files[n], &[]).unwrap();
        }
        assert!(cache.has(names[0]), "used again");
        cache.add(names[3], &files[3], &[]).unwrap();
        assert!(cache.has(names[0]) && !cache.has(names[1]) && cache.has(names[3]));
        cache.add(names[4], &files[4], &[names[2]]).unwrap();
        assert!(cache.has(names[2]), "it is needed");
        assert_eq!(sizes(folder.path()), 300);
        let refused = cache.add(names[1], &files[1], &names).unwrap_err().to_string();
        assert!(refused.contains("--cache-bytes"), "{refused}");

        let refused = Cache::open(folder.path(), 200).unwrap_err().to_string();
        assert!(refused.contains("another worker uses it"), "{refused}");
        drop(cache);
        let mut again = Cache::open(folder.path(), 200).unwrap();
        assert_eq!(sizes(folder.path()), 200, "a smaller limit applies to files that exist");
        std::fs::write(again.path(names[4]), "other bytes").unwrap();
        assert!(!again.has(names[4]), "damaged");
        assert!(!again.path(names[4]).exists());
    }
}
