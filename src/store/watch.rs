//! Whether anything in the database has changed, without a query.

use std::time::{Duration, Instant};

use sqlx::{ConnectOptions, SqliteConnection};

use super::Store;
use super::error::Result;
use super::rows::sql_scalar;

/// Time between two looks; a look takes microseconds.
const LOOK: Duration = Duration::from_millis(20);

/// Sees changes that any process has committed.
#[derive(Debug)]
pub struct Watcher {
    connection: SqliteConnection,
    /// What SQLite's `data_version` was when a change was last seen.
    version: i64,
}

impl Store {
    /// A watcher with a connection of its own: SQLite tells a connection of the changes by others.
    pub async fn watcher(&self) -> Result<Watcher> {
        let options = self.readers.connect_options().as_ref().clone();
        let mut watcher = Watcher { connection: options.connect().await?, version: 0 };
        watcher.version = watcher.look().await?;
        Ok(watcher)
    }
}

impl Watcher {
    async fn look(&mut self) -> Result<i64> {
        Ok(sql_scalar!("PRAGMA data_version", []).fetch_one(&mut self.connection).await?)
    }

    /// Waits for a change since the last call, at most for `time`, and tells whether there was one.
    pub async fn changed(&mut self, time: Duration) -> Result<bool> {
        let start = Instant::now();
        loop {
            let version = self.look().await?;
            if version != std::mem::replace(&mut self.version, version) {
                return Ok(true);
            }
            let left = time.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Ok(false);
            }
            tokio::time::sleep(left.min(LOOK)).await;
        }
    }
}
