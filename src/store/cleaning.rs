//! Removing what nobody needs: old jobs, and files that no row knows of.
//!
//! A crash between a file's move and the commit of its row leaves a file without a row. Nothing is
//! removed that a row refers to, and rows and files change together under the writer's lock.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::error::StoreError;
use super::rows::parsed;
use super::{Store, dir, on_files};
use crate::job::{JobId, PartialId, Sha256, Timestamp};

/// An upload in pieces is a file first and a row a moment later.
const YOUNG: Duration = Duration::from_secs(60);

/// A file or folder and the row that should know of it.
enum Candidate {
    Blob(Sha256, PathBuf),
    Results(JobId, PathBuf),
    Partial(PartialId, PathBuf),
}

impl Store {
    /// Removes temporary files of dead processes, and blobs, results and partial uploads that no row
    /// knows of. Says how many.
    pub async fn remove_orphans(&self) -> Result<usize, StoreError> {
        let root = self.dir().clone();
        let (mut removed, candidates) = on_files(move || {
            let swept = root.sweep_tmp()?;
            let mut found = Vec::new();
            for folder in children(&root.blobs())? {
                for path in children(&folder)? {
                    let hex = format!("{}{}", name(&folder), name(&path));
                    found.extend(hex.parse().ok().map(|sha256| Candidate::Blob(sha256, path)));
                }
            }
            for path in children(&root.all_results())? {
                found.extend(name(&path).parse().ok().map(|job| Candidate::Results(job, path)));
            }
            for path in children(&root.partials())?.into_iter().filter(|path| is_settled(path)) {
                found.extend(name(&path).parse().ok().map(|id| Candidate::Partial(id, path)));
            }
            Ok((swept, found))
        })
        .await?;
        for candidate in candidates {
            // Without the lock first: nearly all are known.
            if !self.is_known(&candidate).await? && self.remove_orphan(candidate).await? {
                removed += 1;
            }
        }
        Ok(removed)
    }

    async fn is_known(&self, candidate: &Candidate) -> Result<bool, StoreError> {
        let mut connection = self.readers.acquire().await?;
        known(&mut connection, candidate).await
    }

    async fn remove_orphan(&self, candidate: Candidate) -> Result<bool, StoreError> {
        let mut transaction = self.write().await?;
        if known(&mut transaction, &candidate).await? {
            return Ok(false);
        }
        let (Candidate::Blob(_, path) | Candidate::Results(_, path) | Candidate::Partial(_, path)) =
            candidate;
        on_files(move || dir::remove(&path)).await?;
        Ok(true)
    }

    /// Deletes jobs that ended before `before`, oldest first, until so many bytes of the disk are
    /// free. Says how many.
    pub async fn remove_jobs(
        &self,
        before: Timestamp,
        until_free: u64,
    ) -> Result<usize, StoreError> {
        let rows = sqlx::query(
            // A job that has not ended has no time at which it did.
            "SELECT id FROM jobs WHERE finished_at < ? ORDER BY finished_at, id",
        )
        .bind(before.0)
        .fetch_all(&self.readers)
        .await?;
        let mut removed = 0;
        for row in &rows {
            if self.dir().disk()?.0 >= until_free {
                break;
            }
            match self.remove_job(parsed(row, "id")?).await {
                Ok(()) => removed += 1,
                // Taken up again or deleted meanwhile.
                Err(StoreError::NotFinal(_) | StoreError::NotFound { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(removed)
    }
}

async fn known(
    connection: &mut sqlx::SqliteConnection,
    candidate: &Candidate,
) -> Result<bool, StoreError> {
    let query = match candidate {
        Candidate::Blob(sha256, _) => {
            sqlx::query("SELECT 1 FROM blobs WHERE sha256 = ?").bind(sha256.to_string())
        }
        Candidate::Results(job, _) => {
            sqlx::query("SELECT 1 FROM jobs WHERE id = ?").bind(job.to_string())
        }
        Candidate::Partial(id, _) => {
            let query = "SELECT 1 FROM partials WHERE id = ? AND result IS NULL";
            sqlx::query(query).bind(id.to_string())
        }
    };
    Ok(query.fetch_optional(connection).await?.is_some())
}

fn children(folder: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let entries = match fs::read_dir(folder) {
        // Not a folder, or gone meanwhile.
        Err(_) if !folder.is_dir() => return Ok(Vec::new()),
        entries => entries.map_err(StoreError::io("read the folder", folder))?,
    };
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    paths.collect::<Result<_, _>>().map_err(StoreError::io("read the folder", folder))
}

fn name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

fn is_settled(path: &Path) -> bool {
    let modified = fs::metadata(path).and_then(|meta| meta.modified());
    modified.is_ok_and(|at| SystemTime::now().duration_since(at).is_ok_and(|age| age > YOUNG))
}
