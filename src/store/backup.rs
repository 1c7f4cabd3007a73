//! A copy of everything, consistent in itself, made while the service runs.
//!
//! Files are put in place and removed under the writer's lock of the database. So it is held for as
//! long as it takes to give every file a second name and to write the database out; the bytes are
//! copied and checked afterwards, from those second names, when the service has long gone on.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use sha2::Digest;

use super::error::{Result, StoreError};
use super::rows::sql;
use super::{Store, dir, identity, on_files};
use crate::job::Sha256;

#[derive(Debug, Default)]
pub struct Backup {
    /// Files that were copied, the database among them.
    pub files: u64,
    pub bytes: u64,
    /// Blobs and results whose bytes are not those on record.
    pub damaged: Vec<String>,
}

impl Store {
    /// Copies everything into the new folder `to`. A damaged file is copied and named.
    pub async fn backup(&self, to: &Path) -> Result<Backup> {
        let to = to.to_owned();
        fs::create_dir(&to).map_err(StoreError::io("make the folder", &to))?;
        let staged = self.staged_dir()?;
        let frozen = staged.path().to_owned();
        // 1. Under the lock: second names for all files, and the database as it is now.
        let lock = self.write().await?;
        let (root, names) = (self.dir().root().to_owned(), frozen.clone());
        on_files(move || {
            let folders = ["blobs", "results", "partial"];
            folders.iter().try_for_each(|name| link_all(&root.join(name), &names.join(name)))
        })
        .await?;
        let database = frozen.join("sci-recon.db");
        sql!("VACUUM INTO ?", [database.to_string_lossy().into_owned()])
            .execute(&self.readers)
            .await?;
        let expected = self.expected_hashes().await?;
        let marker = identity::marker(&mut *self.readers.acquire().await?, super::schema()).await?;
        lock.rollback().await?;
        // 2. The bytes.
        let backup = on_files(move || {
            let mut backup = Backup::default();
            copy_all(&frozen, Path::new(""), &to, &expected, &mut backup)?;
            // Last: a copy that was broken off is no data folder.
            identity::write(&to, &to.join("sci-recon.json.new"), &marker)?;
            Ok(backup)
        })
        .await?;
        drop(staged);
        Ok(backup)
    }

    /// The hashes on record of result files, by their place in the data folder.
    async fn expected_hashes(&self) -> Result<HashMap<PathBuf, Sha256>> {
        let rows: Vec<(String, i64, String, Sha256)> =
            sqlx::query_as("SELECT job, snapshot, name, sha256 FROM result_files")
                .fetch_all(&self.readers)
                .await?;
        let place = |job: String, snapshot: i64| match snapshot {
            -1 => PathBuf::from("results").join(job),
            snapshot => PathBuf::from("results").join(job).join(format!("snapshot_{snapshot:04}")),
        };
        let read =
            |(job, snapshot, name, sha256)| (place(job, snapshot).join::<String>(name), sha256);
        Ok(rows.into_iter().map(read).collect())
    }
}

/// Gives every file below a folder a second name below another one.
fn link_all(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir(to).map_err(StoreError::io("make the folder", to))?;
    for entry in fs::read_dir(from).map_err(StoreError::io("read the folder", from))? {
        let entry = entry.map_err(StoreError::io("read the folder", from))?;
        let (path, name) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            link_all(&path, &name)?;
        } else {
            fs::hard_link(&path, &name).map_err(StoreError::io("link", &path))?;
        }
    }
    Ok(())
}

/// Copies a folder, brings it to the disk, and checks what has a hash on record.
fn copy_all(
    from: &Path,
    place: &Path,
    to: &Path,
    expected: &HashMap<PathBuf, Sha256>,
    backup: &mut Backup,
) -> Result<()> {
    let folder = from.join(place);
    for entry in fs::read_dir(&folder).map_err(StoreError::io("read the folder", &folder))? {
        let entry = entry.map_err(StoreError::io("read the folder", &folder))?;
        let place = place.join(entry.file_name());
        let copy = to.join(&place);
        if entry.path().is_dir() {
            fs::create_dir(&copy).map_err(StoreError::io("make the folder", &copy))?;
            copy_all(from, &place, to, expected, backup)?;
            continue;
        }
        let (found, bytes) = copy_file(&entry.path(), &copy)?;
        backup.files += 1;
        backup.bytes += bytes;
        if hash_on_record(&place, expected).is_some_and(|hash| hash != found) {
            backup.damaged.push(place.display().to_string());
        }
    }
    dir::sync_dir(&to.join(place))
}

fn copy_file(from: &Path, to: &Path) -> Result<(Sha256, u64)> {
    let mut source = File::open(from).map_err(StoreError::io("open", from))?;
    let mut copy = File::create_new(to).map_err(StoreError::io("make", to))?;
    let (mut hasher, mut bytes, mut buffer) = (sha2::Sha256::new(), 0, vec![0; 256 * 1024]);
    loop {
        let count = source.read(&mut buffer).map_err(StoreError::io("read", from))?;
        if count == 0 {
            break;
        }
        hasher.update(&buffer[..count]);
        copy.write_all(&buffer[..count]).map_err(StoreError::io("write", to))?;
        bytes += count as u64;
    }
    copy.sync_all().map_err(StoreError::io("write to the disk", to))?;
    Ok((Sha256::new(hasher.finalize().into()), bytes))
}

/// A blob's name is its hash; that of a result stands in the database.
fn hash_on_record(place: &Path, expected: &HashMap<PathBuf, Sha256>) -> Option<Sha256> {
    let text = place.to_str()?;
    if let Some(hex) = text.strip_prefix("blobs/") {
        return hex.replace('/', "").parse().ok();
    }
    expected.get(place).copied()
}
