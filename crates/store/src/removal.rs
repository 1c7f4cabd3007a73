//! Removal of files in the background: large files take long, and others wait for the lock of the database.

use std::path::PathBuf;
use std::sync::Arc;

use tokio::sync::watch;

use super::{dir, on_files};

/// Removals that go on. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Removals(Arc<watch::Sender<usize>>);

impl Default for Removals {
    fn default() -> Self {
        Self(Arc::new(watch::Sender::new(0)))
    }
}

impl Removals {
    /// Begins to remove a file or a folder. It must lie among the temporary files, so that the sweep at the next
    /// start finds what a crash or an error leaves.
    pub fn begin(&self, path: PathBuf) {
        let removals = self.0.clone();
        removals.send_modify(|count| *count += 1);
        tokio::spawn(async move {
            if let Err(error) = on_files(move || dir::remove(&path)).await {
                tracing::warn!(%error, "a deleted file still takes room until the next start");
            }
            removals.send_modify(|count| *count -= 1);
        });
    }

    /// Waits until all files are removed.
    pub async fn finished(&self) {
        // The sender lives as long as this.
        let _ = self.0.subscribe().wait_for(|count| *count == 0).await;
    }
}

#[cfg(test)]
mod tests {
    use super::Removals;

    #[tokio::test]
    async fn removals_are_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let removals = Removals::default();
        for name in ["a", "b"] {
            let path = folder.path().join(name);
            std::fs::create_dir(&path).unwrap();
            std::fs::write(path.join("file"), name).unwrap();
            removals.begin(path);
        }
        removals.finished().await;
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
