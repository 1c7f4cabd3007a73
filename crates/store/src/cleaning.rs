//! Putting away what nobody needs: old jobs, and files that no row knows of.
//!
//! A crash between a file's move and the commit of its row leaves a file without a row. Nothing is
//! removed that a row refers to, and rows and files change together under the writer's lock.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::error::{Result, StoreError};
use super::rows::Expired;
use super::{DataDir, Store, dir, on_files, upgrade};
use crate::columns::{sql, sql_as};
use engine::job::{JobId, PartialId, Sha256, Timestamp};

/// An upload in pieces is a file first and a row a moment later.
const YOUNG: Duration = Duration::from_secs(60);

/// A crash leaves one or two things without a row. Above this number, and above this share of all files or
/// of their bytes, the database is not the folder's, or has lost records.
const FEW: usize = 3;
const SHARE: f64 = 0.2;

/// A stored thing that needs a row.
#[derive(Debug, PartialEq, Eq, Hash)]
enum Thing {
    Blob(Sha256),
    Results(JobId),
    Partial(PartialId),
}

impl Store {
    /// Moves blobs, results and partial uploads that no row knows of to `quarantine/TIME`. Says how many.
    /// Errors: [`StoreError::Refused`] if they are too many, unless `all` is set: nothing is moved
    /// then.
    pub async fn quarantine_orphans(&self, all: bool) -> Result<usize> {
        // 1. Without the lock: nearly all are known.
        let unknown = self.unlisted().await?;
        // 2. With it: files change together with their rows.
        let mut orphans = Vec::new();
        if !unknown.is_empty() {
            let mut transaction = self.write().await?;
            for (thing, path) in unknown {
                if path.exists() && !is_known(&mut transaction, &thing).await? {
                    orphans.push((thing, path));
                }
            }
        }
        if orphans.len() > FEW && !all {
            let (root, paths) = (self.dir().clone(), paths(&orphans));
            on_files(move || refuse_too_many(&root, &paths)).await?;
        }
        let place = self.dir().quarantine().join(folder_name(Timestamp::now()));
        let count = orphans.len();
        for (thing, path) in orphans {
            let mut transaction = self.write().await?;
            if is_known(&mut transaction, &thing).await? {
                continue;
            }
            tracing::warn!(file = %path.display(), "no record knows of it: moved to the quarantine");
            let (root, place) = (self.dir().root().to_owned(), place.clone());
            on_files(move || quarantine(&root, &path, &place)).await?;
        }
        Ok(count)
    }

    /// Removes what came into the quarantine before `before`.
    pub async fn empty_quarantine(&self, before: Timestamp) -> Result<()> {
        let (quarantine, before) = (self.dir().quarantine(), folder_name(before));
        on_files(move || {
            let old = dir::children(&quarantine)?.into_iter().filter(|path| name(path) < before);
            old.into_iter().try_for_each(|path| dir::remove(&path))
        })
        .await
    }

    /// Removes the files that are kept for a return to the version before, unless the last update was made after
    /// `before`.
    pub async fn release_kept(&self, before: Timestamp) -> Result<bool> {
        let (root, draft) = (self.dir().clone(), self.temporary_path());
        on_files(move || upgrade::release_kept(&root, before, &draft)).await
    }

    /// What lies in the folder and, at this moment, stands in no record.
    async fn unlisted(&self) -> Result<Vec<(Thing, PathBuf)>> {
        let (known, root) = (self.known_things().await?, self.dir().clone());
        on_files(move || {
            let mut things = things(&root)?;
            things.retain(|(thing, _)| !known.contains(thing));
            Ok(things)
        })
        .await
    }

    /// Number of blobs, results and partial uploads that no row knows of.
    pub(super) async fn unknown_things(&self) -> Result<usize> {
        let mut unknown = 0;
        for (thing, path) in self.unlisted().await? {
            let mut connection = self.readers.acquire().await?;
            unknown += usize::from(path.exists() && !is_known(&mut connection, &thing).await?);
        }
        Ok(unknown)
    }

    async fn known_things(&self) -> Result<HashSet<Thing>> {
        let blobs = sql_as!("SELECT sha256 FROM blobs").fetch_all(&self.readers).await?;
        let jobs = sql_as!("SELECT id FROM jobs").fetch_all(&self.readers).await?;
        let partials = "SELECT id FROM partials WHERE result IS NULL";
        let partials = sql_as!(partials).fetch_all(&self.readers).await?;
        let blobs = blobs.into_iter().map(Thing::Blob);
        let jobs = jobs.into_iter().map(Thing::Results);
        let partials = partials.into_iter().map(Thing::Partial);
        Ok(blobs.chain(jobs).chain(partials).collect())
    }

    /// Deletes jobs that ended before `before`, oldest first, until `until_free` bytes of the disk are free. Calls `removed`
    /// for each.
    pub async fn remove_jobs(
        &self,
        before: Timestamp,
        until_free: u64,
        mut removed: impl FnMut(Expired<JobId>),
    ) -> Result<()> {
        let ended: Vec<Expired<JobId>> = sql_as!(
            // A job that has not ended has no time at which it did.
            "SELECT lab, id FROM jobs WHERE finished_at < ? ORDER BY finished_at, id",
            [before]
        )
        .fetch_all(&self.readers)
        .await?;
        for job in ended {
            if self.dir().disk()?.0 >= until_free {
                break;
            }
            match self.remove_job(job.id).await {
                Ok(()) => {
                    removed(job);
                    // Before the disk is asked again.
                    self.removals.finished().await;
                }
                // The job was retried or deleted in between, or its masks are being saved.
                Err(
                    StoreError::NotFinal(_) | StoreError::NotFound { .. } | StoreError::JobInUse(_),
                ) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

async fn is_known(connection: &mut sqlx::SqliteConnection, thing: &Thing) -> Result<bool> {
    let query = match thing {
        Thing::Blob(sha256) => {
            let query = "SELECT 1 FROM blobs WHERE sha256 = ?1
                         UNION ALL SELECT 1 FROM removals WHERE kind = 'blob' AND id = ?1";
            sql!(query, [sha256])
        }
        Thing::Results(job) => {
            let query = "SELECT 1 FROM jobs WHERE id = ?1
                         UNION ALL SELECT 1 FROM removals WHERE kind = 'results' AND id = ?1";
            sql!(query, [job])
        }
        Thing::Partial(id) => {
            let query = "SELECT 1 FROM partials WHERE id = ? AND result IS NULL";
            sql!(query, [id])
        }
    };
    Ok(query.fetch_optional(connection).await?.is_some())
}

/// All that lies in the folder.
fn things(root: &DataDir) -> Result<Vec<(Thing, PathBuf)>> {
    let mut found = Vec::new();
    for folder in dir::children(&root.blobs())? {
        for path in dir::children(&folder)? {
            let hex = format!("{}{}", name(&folder), name(&path));
            found.extend(hex.parse().ok().map(|sha256| (Thing::Blob(sha256), path)));
        }
    }
    for path in dir::children(&root.all_results())? {
        found.extend(name(&path).parse().ok().map(|job| (Thing::Results(job), path)));
    }
    for path in dir::children(&root.partials())?.into_iter().filter(|path| is_settled(path)) {
        found.extend(name(&path).parse().ok().map(|id| (Thing::Partial(id), path)));
    }
    Ok(found)
}

fn paths(things: &[(Thing, PathBuf)]) -> Vec<PathBuf> {
    things.iter().map(|(_, path)| path.clone()).collect()
}

fn refuse_too_many(root: &DataDir, orphans: &[PathBuf]) -> Result<()> {
    let (files, bytes) = measure(orphans)?;
    let (all, all_bytes) = measure(&[root.blobs(), root.all_results(), root.partials()])?;
    #[allow(clippy::cast_precision_loss)] // a share
    let share = |part: u64, all: u64| part as f64 / all.max(1) as f64;
    if share(files, all).max(share(bytes, all_bytes)) <= SHARE {
        return Ok(());
    }
    let found = "the database does not know of";
    Err(StoreError::Refused {
        folder: root.root().to_owned(),
        found: format!("{found} {files} of the {all} files ({bytes} of {all_bytes} bytes)"),
        remedy: super::identity::ACCEPT,
    })
}

/// Number and bytes of the files at and below these paths.
fn measure(paths: &[PathBuf]) -> Result<(u64, u64)> {
    let (mut files, mut bytes) = (0, 0);
    for path in paths {
        let (more, more_bytes) = if path.is_dir() {
            measure(&dir::children(path)?)?
        } else {
            // It may have been removed in between.
            (1, fs::metadata(path).map_or(0, |meta| meta.len()))
        };
        files += more;
        bytes += more_bytes;
    }
    Ok((files, bytes))
}

fn quarantine(root: &Path, path: &Path, place: &Path) -> Result<()> {
    let to = place.join(path.strip_prefix(root).unwrap_or(path));
    if let Some(folder) = to.parent() {
        fs::create_dir_all(folder).map_err(StoreError::io("make the folder", folder))?;
    }
    dir::rename_durably(path, &to)
}

/// A name that sorts by time.
fn folder_name(time: Timestamp) -> String {
    time.to_string().replace(':', "-")
}

fn name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

fn is_settled(path: &Path) -> bool {
    let modified = fs::metadata(path).and_then(|meta| meta.modified());
    modified.is_ok_and(|at| SystemTime::now().duration_since(at).is_ok_and(|age| age > YOUNG))
}
