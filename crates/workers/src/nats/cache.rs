//! A worker's cache: files named by the hash of their bytes, in one folder, within a bound. What was
//! not used for longest goes first.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::connection::ClusterError;
use engine::job::Sha256;
use store::LockedFile;

/// A folder of files that can be had again.
#[derive(Debug)]
pub struct Cache {
    folder: PathBuf,
    /// The most bytes that it may hold.
    limit: u64,
    /// Of each file its size and its turn: the higher, the later it was used.
    files: HashMap<Sha256, (u64, u64)>,
    turn: u64,
    /// Locked as long as this lives.
    _lock: LockedFile,
}

impl Cache {
    /// Opens a folder, which is made if it is missing. Files in it that are not the cache's stay.
    ///
    /// # Errors
    /// If it can't be made or read, or if another worker has it: that one would remove what this one needs.
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
                "it is another worker's; give each worker a folder of its own (--cache)",
            )),
        })?;
        let mut found = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if let Some(draft) = name.strip_suffix(DRAFT)
                && draft.parse::<Sha256>().is_ok()
            {
                // A worker that was killed has left it.
                fs::remove_file(entry.path()).map_err(failed)?;
            } else if let Ok(sha256) = name.parse::<Sha256>() {
                let facts = entry.metadata().map_err(failed)?;
                let used = facts.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                found.push((used, sha256, facts.len()));
            }
        }
        found.sort_unstable_by_key(|(used, ..)| *used);
        let folder = folder.to_owned();
        let mut cache = Self { folder, limit, files: HashMap::new(), turn: 0, _lock: lock };
        for (_, sha256, size) in found {
            cache.note(sha256, size);
        }
        cache.make_room(0, &[]).map_err(failed)?;
        Ok(cache)
    }

    /// Where a file is, or would be.
    pub fn path(&self, sha256: Sha256) -> PathBuf {
        self.folder.join(sha256.to_string())
    }

    /// Whether a file is there, with the bytes that it should have; one that is damaged is removed.
    pub fn has(&mut self, sha256: Sha256) -> bool {
        let path = self.path(sha256);
        let hashed = fs::File::open(&path).and_then(|mut file| Sha256::of_reader(&mut file));
        match hashed {
            Ok((found, size)) if found == sha256 => {
                self.note(sha256, size);
                true
            }
            _ => {
                self.files.remove(&sha256);
                // It may not be there at all.
                let _ = fs::remove_file(path);
                false
            }
        }
    }

    /// Adds a file. Those in `needed` stay.
    ///
    /// # Errors
    /// If it is too large for the cache, or the disk fails.
    pub fn add(&mut self, sha256: Sha256, bytes: &[u8], needed: &[Sha256]) -> io::Result<()> {
        let size = bytes.len() as u64;
        self.make_room(size, needed)?;
        let path = self.path(sha256);
        let draft = self.folder.join(format!("{sha256}{DRAFT}"));
        fs::write(&draft, bytes)?;
        fs::rename(draft, path)?;
        self.note(sha256, size);
        Ok(())
    }

    fn note(&mut self, sha256: Sha256, size: u64) {
        self.turn += 1;
        self.files.insert(sha256, (size, self.turn));
    }

    fn make_room(&mut self, size: u64, needed: &[Sha256]) -> io::Result<()> {
        loop {
            let held: u64 = self.files.values().map(|(size, _)| size).sum();
            if held + size <= self.limit {
                return Ok(());
            }
            let free = self.files.iter().filter(|(sha256, _)| !needed.contains(sha256));
            let Some((&oldest, _)) = free.min_by_key(|(_, (_, turn))| *turn) else {
                return Err(io::Error::other(format!(
                    "one tile needs more than the {} bytes that the cache may hold: set a larger \
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

/// The end of the name of a file that is being written.
const DRAFT: &str = ".part";
/// The file whose lock says that a worker has the folder.
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
    fn the_bound_holds_and_what_was_used_last_stays() {
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

        let taken = Cache::open(folder.path(), 200).unwrap_err().to_string();
        assert!(taken.contains("another worker's"), "{taken}");
        drop(cache);
        let mut again = Cache::open(folder.path(), 200).unwrap();
        assert_eq!(sizes(folder.path()), 200, "the bound may have become smaller");
        std::fs::write(again.path(names[4]), "other bytes").unwrap();
        assert!(!again.has(names[4]), "damaged");
        assert!(!again.path(names[4]).exists());
    }
}
