//! A copy of everything, consistent in itself, made while the service runs.
//!
//! No lock of the database is held, so that nobody waits for a copy, not even for one that is suspended.
//! Every file first gets a second name, which keeps its bytes, whatever becomes of the first one. Then the
//! database is written out; what it knows and has no second name yet gets one. If something of that was
//! deleted in between, the database is written out again. The bytes are copied and checked at the end.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};

use super::error::{Result, StoreError};
use super::locked::LockedFile;
use super::records::{self, Record};
use super::{DataDir, Store, dir, identity, on_files};
use crate::columns::sql;
use engine::job::{HashingWriter, PartialId, Sha256};

/// So often the database is written out, at most: what is made and deleted within the moment that one
/// writing takes makes another one necessary.
const ROUNDS: u32 = 50;

#[derive(Debug, Default, serde::Serialize)]
pub struct Backup {
    /// Files that were copied, the database among them.
    pub files: u64,
    pub bytes: u64,
    /// Files that were copied although their bytes differ from the recorded hash.
    pub damaged: Vec<String>,
    /// Recorded files that are missing.
    pub missing: Vec<String>,
}

impl Store {
    /// Copies everything into the new folder `to`, which appears when all is in it. A damaged file is copied and named.
    /// The rest of an earlier copy to this folder that was killed is removed.
    pub async fn backup(&self, to: &Path) -> Result<Backup> {
        let place = to.to_owned();
        let draft = on_files(move || Draft::new(&place)).await?;
        let staged = self.staged_dir()?;
        let frozen = DataDir::find(staged.path())?;
        // 1. Second names for all files.
        let (live, names) = (self.dir().clone(), frozen.clone());
        on_files(move || {
            for (from, to) in [
                (live.blobs(), names.blobs()),
                (live.all_results(), names.all_results()),
                (live.partials(), names.partials()),
            ] {
                link_all(&from, &to)?;
            }
            Ok(())
        })
        .await?;
        // 2. A database that knows of nothing else.
        let (mut database, missing) = self.settle(&frozen).await?;
        let marker = identity::marker(&mut database, self.schema).await?;
        // 3. The bytes.
        let mut backup = Backup { missing, ..Backup::default() };
        self.copy_known(&mut database, &frozen, &draft.folder, &mut backup).await?;
        database.close().await?;
        // 4. The database and the marker last, and then the name.
        let to = to.to_owned();
        on_files(move || {
            let (_, bytes) = copy_file(&frozen.database(), &draft.folder.database())?;
            backup.files += 1;
            backup.bytes += bytes;
            draft.finish(&to, &marker)?;
            Ok(backup)
        })
        .await
    }

    /// Writes the database out until every file that it knows of has a second name, or is missing here as
    /// well. Says which are missing.
    async fn settle(&self, frozen: &DataDir) -> Result<(SqliteConnection, Vec<String>)> {
        let path = frozen.database();
        for _ in 0..ROUNDS {
            dir::remove(&path)?;
            sql!("VACUUM INTO ?", [path.to_string_lossy().into_owned()])
                .execute(&self.readers)
                .await?;
            let options = SqliteConnectOptions::new().filename(&path).immutable(true);
            let mut database = options.read_only(true).connect().await?;
            if let Some(missing) = self.complete_names(&mut database, frozen).await? {
                return Ok((database, missing));
            }
            database.close().await?;
        }
        Err(StoreError::Restless(ROUNDS))
    }

    /// Gives second names to what this database knows of and has none yet; says what is missing. Returns `None` if
    /// something was deleted since the database was written.
    async fn complete_names(
        &self,
        database: &mut SqliteConnection,
        frozen: &DataDir,
    ) -> Result<Option<Vec<String>>> {
        let (mut missing, mut after) = (Vec::new(), None);
        while let Some(page) = records::next_page(database, &mut after).await? {
            let (live, names) = (self.dir().clone(), frozen.clone());
            let absent = on_files(move || {
                let mut absent = Vec::new();
                for record in page {
                    if !name_again(&record.path(&live), &record.path(&names))? {
                        absent.push(record);
                    }
                }
                Ok(absent)
            })
            .await?;
            for record in absent {
                if !records::stands(&mut *self.readers.acquire().await?, &record).await? {
                    return Ok(None);
                }
                missing.push(record.name(self.dir()));
            }
        }
        for (id, _) in records::partials(database).await? {
            if !name_again(&self.dir().partial(id), &frozen.partial(id))? {
                let now = records::partials(&mut *self.readers.acquire().await?).await?;
                if !now.iter().any(|(other, _)| *other == id) {
                    return Ok(None);
                }
                missing.push(format!("partial/{id}"));
            }
        }
        Ok(Some(missing))
    }

    /// Copies the files that this database knows of, and checks them.
    async fn copy_known(
        &self,
        database: &mut SqliteConnection,
        frozen: &DataDir,
        to: &DataDir,
        backup: &mut Backup,
    ) -> Result<()> {
        let partials = records::partials(database).await?;
        let mut after = None;
        while let Some(page) = records::next_page(database, &mut after).await? {
            let (live, frozen, to) = (self.dir().clone(), frozen.clone(), to.clone());
            let mut so_far = std::mem::take(backup);
            *backup = on_files(move || {
                for record in page {
                    copy_record(&record, &live, &frozen, &to, &mut so_far)?;
                }
                Ok(so_far)
            })
            .await?;
        }
        let (frozen, to) = (frozen.clone(), to.clone());
        let mut so_far = std::mem::take(backup);
        *backup = on_files(move || {
            for (id, received) in partials {
                copy_partial(id, received, &frozen, &to, &mut so_far)?;
            }
            Ok(so_far)
        })
        .await?;
        Ok(())
    }
}

/// The folder of a copy that is not finished, next to where it will be.
struct Draft {
    folder: DataDir,
    lock: LockedFile,
}

impl Draft {
    fn new(to: &Path) -> Result<Self> {
        let mut name = to.file_name().unwrap_or_default().to_owned();
        name.push(identity::UNFINISHED_NAME);
        let path = to.with_file_name(name);
        let marker = path.join("sci-recon.json");
        if let Ok(lock) = File::open(&path) {
            let refuse = |found: &str, remedy| {
                Err(StoreError::Refused { folder: path.clone(), found: found.into(), remedy })
            };
            if !is_draft(&path, &marker)? {
                return refuse("it is there already", "name another folder");
            }
            if lock.try_lock().is_err() {
                return refuse("another copy is being made here", "wait for it");
            }
            remove_draft(&path, &marker)?;
        }
        fs::create_dir(&path).map_err(StoreError::io("make the folder", &path))?;
        let lock = File::open(&path).map_err(StoreError::io("open", &path))?;
        let lock = LockedFile::wait(lock).map_err(StoreError::io("lock", &path))?;
        fs::write(&marker, identity::UNFINISHED).map_err(StoreError::io("write", &marker))?;
        dir::restrict(&path)?;
        let folder = DataDir::find(&path)?;
        folder.fill()?;
        Ok(Self { folder, lock })
    }

    /// Brings all to the disk and gives the folder its name.
    fn finish(self, to: &Path, marker: &identity::Marker) -> Result<()> {
        let root = self.folder.root();
        identity::write(root, &root.join("sci-recon.json.new"), marker)?;
        // One call for all: a sync of each of many small files would take hours.
        rustix::fs::syncfs(&*self.lock)
            .map_err(|error| StoreError::io("write to the disk", root)(error.into()))?;
        if to.exists() {
            return Err(StoreError::Refused {
                folder: to.to_owned(),
                found: "it is there already".into(),
                remedy: "name another folder",
            });
        }
        dir::rename_durably(root, to)
    }
}

/// True if a folder with this suffix is an interrupted copy: before its mark was written, or just before its rename.
fn is_draft(folder: &Path, marker: &Path) -> Result<bool> {
    let mark = fs::read(marker).unwrap_or_default();
    if mark == identity::UNFINISHED.as_bytes() || identity::is_marker(&mark) {
        return Ok(true);
    }
    let alone = dir::children(folder)?.iter().all(|path| path == marker);
    Ok(alone && identity::UNFINISHED.as_bytes().starts_with(&mark))
}

/// Removes a copy that was broken off, its mark last: if this is broken off, too, the rest is still known as such.
fn remove_draft(folder: &Path, marker: &Path) -> Result<()> {
    for path in dir::children(folder)?.iter().filter(|path| *path != marker) {
        dir::remove(path)?;
    }
    dir::remove(marker)?;
    dir::remove(folder)
}

/// Gives every file below a folder a second name below another one. Files that disappear during this are skipped.
fn link_all(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir(to).map_err(StoreError::io("make the folder", to))?;
    for path in dir::children(from)? {
        let Some(name) = path.file_name() else { continue };
        if path.is_dir() {
            link_all(&path, &to.join(name))?;
        } else {
            link(&path, &to.join(name))?;
        }
    }
    Ok(())
}

/// Gives a file a second name; false if it does not exist.
fn link(from: &Path, to: &Path) -> Result<bool> {
    match fs::hard_link(from, to) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound && !from.exists() => Ok(false),
        Err(error) => Err(StoreError::io("link", from)(error)),
    }
}

/// Gives a file a second name, if it has none; false if neither name exists.
fn name_again(from: &Path, to: &Path) -> Result<bool> {
    if to.exists() {
        return Ok(true);
    }
    make_parent(to)?;
    link(from, to)
}

fn make_parent(path: &Path) -> Result<()> {
    let Some(folder) = path.parent() else { return Ok(()) };
    fs::create_dir_all(folder).map_err(StoreError::io("make the folder", folder))
}

fn copy_record(
    record: &Record,
    live: &DataDir,
    frozen: &DataDir,
    to: &DataDir,
    backup: &mut Backup,
) -> Result<()> {
    let copy = record.path(to);
    let frozen_path = record.path(frozen);
    if !frozen_path.exists() {
        // Missing: named already.
        return Ok(());
    }
    make_parent(&copy)?;
    let (mut found, mut bytes) = copy_file(&frozen_path, &copy)?;
    // A result that was made again between its second name and the database has other bytes.
    if found != record.sha256 && record.is_at(live)? {
        dir::remove(&copy)?;
        (found, bytes) = copy_file(&record.path(live), &copy)?;
    }
    backup.files += 1;
    backup.bytes += bytes;
    if found != record.sha256 {
        backup.damaged.push(record.name(live));
    }
    Ok(())
}

fn copy_partial(
    id: PartialId,
    received: u64,
    frozen: &DataDir,
    to: &DataDir,
    backup: &mut Backup,
) -> Result<()> {
    if !frozen.partial(id).exists() {
        return Ok(());
    }
    let (_, bytes) = copy_file(&frozen.partial(id), &to.partial(id))?;
    backup.files += 1;
    backup.bytes += bytes;
    if bytes < received {
        backup.damaged.push(format!("partial/{id}"));
    }
    Ok(())
}

fn copy_file(from: &Path, to: &Path) -> Result<(Sha256, u64)> {
    let mut source = File::open(from).map_err(StoreError::io("open", from))?;
    let copy = File::create_new(to).map_err(StoreError::io("make", to))?;
    let (mut copy, mut buffer) = (HashingWriter::new(copy), vec![0; 256 * 1024]);
    loop {
        let count = source.read(&mut buffer).map_err(StoreError::io("read", from))?;
        if count == 0 {
            return Ok((copy.sha256(), copy.size()));
        }
        copy.write_all(&buffer[..count]).map_err(StoreError::io("write", to))?;
    }
}
