//! Whether anything in the database has changed, without asking it.

use std::io;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::time::Duration;

use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use tokio::io::unix::AsyncFd;

use super::Store;

/// Sees when any process writes to the database: each commit goes through a file beside it, of which the
/// kernel tells (inotify).
#[derive(Debug)]
pub struct Watcher(AsyncFd<OwnedFd>);

impl Store {
    /// A watcher of this store.
    ///
    /// # Errors
    /// If the kernel gives no more of them.
    pub fn watcher(&self) -> io::Result<Watcher> {
        let queue = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC)?;
        // The folder, since SQLite makes and removes its files. Blobs and results are in folders of their own.
        inotify::add_watch(&queue, self.dir.root(), WatchFlags::MODIFY)?;
        Ok(Watcher(AsyncFd::register(queue)?))
    }
}

impl Watcher {
    /// Waits for a change since the last call, at most for `time`.
    ///
    /// # Errors
    /// If the kernel's queue can't be read.
    pub async fn changed(&mut self, time: Duration) -> io::Result<()> {
        let Ok(ready) = tokio::time::timeout(time, self.0.readable()).await else { return Ok(()) };
        let mut ready = ready?;
        let mut buffer = [MaybeUninit::uninit(); 4096];
        loop {
            match inotify::Reader::new(ready.get_inner(), &mut buffer).next() {
                Ok(_) => {}
                Err(Errno::AGAIN) => break,
                Err(error) => return Err(error.into()),
            }
        }
        ready.clear_ready();
        Ok(())
    }
}
