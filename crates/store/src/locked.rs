//! Files that one process has for itself.

use std::fs::{File, TryLockError};
use std::io;
use std::ops::{Deref, DerefMut};

/// An open file with its lock, which is free as soon as this is dropped. Closing the file is not
/// enough: a process that is just being started has a copy of it until its program runs, and the copy
/// keeps the lock.
#[derive(Debug)]
pub struct LockedFile(File);

impl LockedFile {
    /// Waits for the lock.
    /// Errors: the file system knows no locks.
    pub fn wait(file: File) -> io::Result<Self> {
        file.lock()?;
        Ok(Self(file))
    }

    /// Takes the lock if nobody has it.
    /// Errors: [`TryLockError::WouldBlock`] if another has it.
    pub fn take(file: File) -> Result<Self, TryLockError> {
        file.try_lock()?;
        Ok(Self(file))
    }
}

impl Deref for LockedFile {
    type Target = File;

    fn deref(&self) -> &File {
        &self.0
    }
}

impl DerefMut for LockedFile {
    fn deref_mut(&mut self) -> &mut File {
        &mut self.0
    }
}

impl Drop for LockedFile {
    fn drop(&mut self) {
        // If that fails, closing it frees the lock, if later.
        let _ = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use std::fs::TryLockError;

    use super::LockedFile;

    #[test]
    fn a_copy_of_the_file_does_not_keep_the_lock() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let locked = LockedFile::take(file.reopen().unwrap()).unwrap();
        // As a process has it that is being started.
        let _copy = locked.try_clone().unwrap();
        let second = LockedFile::take(file.reopen().unwrap());
        assert!(matches!(second, Err(TryLockError::WouldBlock)));
        drop(locked);
        LockedFile::take(file.reopen().unwrap()).unwrap();
    }
}
