//! Whether anything in the database has changed, without asking it.

use std::io;
use std::time::Duration;

use futures_util::{FutureExt, StreamExt};
use inotify::{EventStream, Inotify, WatchMask};

use super::Store;

/// Sees when any process writes to the database: each commit goes through a file beside it, of which the
/// kernel tells.
#[derive(Debug)]
pub struct Watcher(EventStream<Vec<u8>>);

impl Store {
    /// A watcher of this store.
    ///
    /// # Errors
    /// If the kernel gives no more of them.
    pub fn watcher(&self) -> io::Result<Watcher> {
        let inotify = Inotify::init()?;
        // The folder, since SQLite makes and removes its files. Blobs and results are in folders of their own.
        inotify.watches().add(self.dir.root(), WatchMask::MODIFY)?;
        Ok(Watcher(inotify.into_event_stream(vec![0; 4096])?))
    }
}

impl Watcher {
    /// Waits for a change since the last call, at most for `time`.
    ///
    /// # Errors
    /// If the kernel's queue can't be read.
    pub async fn changed(&mut self, time: Duration) -> io::Result<()> {
        let mut event = tokio::time::timeout(time, self.0.next()).await.ok().flatten();
        while let Some(seen) = event {
            seen?;
            // All that have come meanwhile are one.
            event = self.0.next().now_or_never().flatten();
        }
        Ok(())
    }
}
