//! Detects that the files of the database were removed, replaced or truncated while it is open.
//!
//! SQLite keeps using removed files, so all changes would be lost at the next start. The server records its files in its
//! lock file. Other processes compare them before they open the database.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::{Result, StoreError};

/// Endings of the names of the database, its write-ahead log, and the index of the log that all processes share.
const ENDINGS: [&str; 3] = ["", "-wal", "-shm"];

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct FileId {
    device: u64,
    inode: u64,
}

/// The files of an open database, in the order of [`ENDINGS`]; `None` for one that was not made yet.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct DatabaseFiles {
    files: [Option<FileId>; 3],
    /// Size in bytes of the database when it was opened. It never shrinks.
    size: u64,
}

impl DatabaseFiles {
    /// The files of the database at `path`, which must be open: only then do the others stay.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let meta = look_at(path)?.ok_or_else(|| StoreError::DatabaseGone(path.to_owned()))?;
        let mut files = [Some(id(&meta)), None, None];
        for (file, ending) in files.iter_mut().zip(ENDINGS).skip(1) {
            *file = look_at(&sibling(path, ending))?.as_ref().map(id);
        }
        Ok(Self { files, size: meta.len() })
    }

    /// Errors: [`StoreError::DatabaseGone`] if one of the files is not at its place, or the database is shorter.
    pub(crate) fn check(&self, path: &Path) -> Result<()> {
        for (file, ending) in self.files.iter().zip(ENDINGS).filter(|(file, _)| file.is_some()) {
            let path = sibling(path, ending);
            let found = look_at(&path)?;
            let is_short =
                ending.is_empty() && found.as_ref().is_some_and(|meta| meta.len() < self.size);
            if found.as_ref().map(id) != *file || is_short {
                return Err(StoreError::DatabaseGone(path));
            }
        }
        Ok(())
    }
}

fn sibling(database: &Path, ending: &str) -> PathBuf {
    let mut name = database.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

fn id(meta: &fs::Metadata) -> FileId {
    FileId { device: meta.dev(), inode: meta.ino() }
}

/// `None` if there is no file.
fn look_at(path: &Path) -> Result<Option<fs::Metadata>> {
    match fs::metadata(path) {
        Ok(meta) => Ok(Some(meta)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(StoreError::io("look at", path)(error)),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::DatabaseFiles;

    #[test]
    fn removed_replaced_and_truncated_files_are_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let names = ["db", "db-wal", "db-shm", "aside"];
        let [database, log, index, aside] = names.map(|name| folder.path().join(name));
        assert!(DatabaseFiles::open(&database).is_err());
        fs::write(&database, "pages").unwrap();
        let alone = DatabaseFiles::open(&database).unwrap();
        for path in [&log, &index] {
            fs::write(path, "").unwrap();
        }
        let files = DatabaseFiles::open(&database).unwrap();
        for path in [&database, &log, &index] {
            fs::rename(path, &aside).unwrap();
            assert!(files.check(&database).is_err(), "{} is removed", path.display());
            assert_eq!(alone.check(&database).is_ok(), path != &database);
            fs::copy(&aside, path).unwrap();
            assert!(files.check(&database).is_err(), "{} is a copy", path.display());
            fs::rename(&aside, path).unwrap();
            files.check(&database).unwrap();
        }
        fs::write(&database, "page").unwrap();
        assert!(files.check(&database).is_err(), "the database is shorter");
    }
}
