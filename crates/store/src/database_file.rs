//! Detects that the files of the database were removed or replaced while it is open.
//!
//! SQLite keeps using removed files, so all changes would be lost at the next start.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::{Result, StoreError};

/// The device and the number of a file.
type FileId = (u64, u64);

/// The files of an open database.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DatabaseFiles {
    database: FileId,
    /// The write-ahead log; `None` if it was not made yet.
    log: Option<FileId>,
}

impl DatabaseFiles {
    /// The files of the database at `path`, which must be open: only then does its write-ahead log stay.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let database = id(path)?.ok_or_else(|| StoreError::DatabaseGone(path.to_owned()))?;
        Ok(Self { database, log: id(&log_of(path))? })
    }

    /// Errors: [`StoreError::DatabaseGone`] if one of the files is not at its place.
    pub(crate) fn check(&self, path: &Path) -> Result<()> {
        let log = log_of(path);
        let expected = [(path, Some(self.database)), (&log, self.log)];
        for (path, file) in expected {
            if file.is_some() && id(path)? != file {
                return Err(StoreError::DatabaseGone(path.to_owned()));
            }
        }
        Ok(())
    }
}

fn log_of(database: &Path) -> PathBuf {
    let mut name = database.as_os_str().to_owned();
    name.push("-wal");
    name.into()
}

/// `None` if there is no file.
fn id(path: &Path) -> Result<Option<FileId>> {
    match fs::metadata(path) {
        Ok(meta) => Ok(Some((meta.dev(), meta.ino()))),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(StoreError::io("look at", path)(error)),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::DatabaseFiles;

    #[test]
    fn removed_and_replaced_files_are_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let [database, log, aside] = ["db", "db-wal", "aside"].map(|name| folder.path().join(name));
        assert!(DatabaseFiles::open(&database).is_err());
        fs::write(&database, "").unwrap();
        let without_log = DatabaseFiles::open(&database).unwrap();
        fs::write(&log, "").unwrap();
        let files = DatabaseFiles::open(&database).unwrap();
        for path in [&database, &log] {
            fs::rename(path, &aside).unwrap();
            assert!(files.check(&database).is_err(), "{} is removed", path.display());
            assert_eq!(without_log.check(&database).is_ok(), path == &log);
            fs::copy(&aside, path).unwrap();
            assert!(files.check(&database).is_err(), "{} is a copy", path.display());
            fs::rename(&aside, path).unwrap();
            files.check(&database).unwrap();
        }
    }
}
