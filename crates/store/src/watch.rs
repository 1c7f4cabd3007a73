//! Detection of changes in the database without a query.

use std::io;
use std::time::{Duration, Instant};

use futures_util::{FutureExt, StreamExt};
use inotify::{EventStream, Inotify, WatchMask};

use super::Store;

/// A commit is written, synced, and only then visible to others, without an event of the kernel. So for `ECHO` after a
/// write, the watcher looks every `LOOK`.
const ECHO: Duration = Duration::from_millis(60);
const LOOK: Duration = Duration::from_millis(6);

/// Detects writes of any process to the database: each commit goes through the write-ahead log, whose changes the
/// kernel reports.
#[derive(Debug)]
pub struct Watcher {
    events: EventStream<Vec<u8>>,
    /// When the last write was seen.
    written: Option<Instant>,
}

impl Store {
    /// A watcher of this store.
    /// Errors: the kernel allows no further watcher.
    pub fn watcher(&self) -> io::Result<Watcher> {
        let inotify = Inotify::init()?;
        // The folder, since SQLite makes and removes its files. Blobs and results are in other folders.
        inotify.watches().add(self.dir.root(), WatchMask::MODIFY)?;
        Ok(Watcher { events: inotify.into_event_stream(vec![0; 4096])?, written: None })
    }
}

impl Watcher {
    /// Waits until there may be a change since the last call, at most for `time`.
    /// Errors: the kernel's queue can't be read.
    pub async fn changed(&mut self, time: Duration) -> io::Result<()> {
        let echo = self.written.is_some_and(|written| written.elapsed() < ECHO);
        let time = if echo { time.min(LOOK) } else { time };
        let mut event = tokio::time::timeout(time, self.events.next()).await.ok().flatten();
        while let Some(seen) = event {
            seen?;
            self.written = Some(Instant::now());
            // All events that are waiting count as one.
            event = self.events.next().now_or_never().flatten();
        }
        Ok(())
    }
}
