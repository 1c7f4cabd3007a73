//! Downloads a file, and resumes after an interruption. Existing files are not overwritten.

use std::fs::{self, File, OpenOptions};
use std::io::{BufReader, ErrorKind, Read, Seek, Sink, Write, copy, sink};
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::StreamExt;
use indicatif::ProgressBar;
use reqwest::{Method, StatusCode};
use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::{Client, Result, refusal, wait_to_retry};
use crate::cli::CliError;
use engine::job::{HashingWriter, Sha256};
use store::LockedFile;

/// Time between requests for a file that the service is still making.
const POLL: Duration = Duration::from_secs(1);

/// Result of a download.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::cli) enum Fetched {
    New,
    /// An identical file existed.
    Existing,
}

impl Client {
    /// Downloads `href` to the file `path`, and checks its hash if one is given. An existing file without a known hash is
    /// compared with a new download.
    /// Errors: another file has that name; the service can't be reached or refuses the request.
    pub(in crate::cli) async fn download(
        &self,
        href: &str,
        path: &Path,
        sha256: Option<Sha256>,
        bar: &ProgressBar,
    ) -> Result<Fetched> {
        let mut head = self.send(|| self.request(Method::HEAD, href)).await?;
        while head.status() == StatusCode::ACCEPTED {
            // A worker is encoding the movie.
            tokio::time::sleep(POLL).await;
            head = self.send(|| self.request(Method::HEAD, href)).await?;
        }
        let field = |name| head.headers().get(name).and_then(|value| value.to_str().ok());
        let size = field("content-length").and_then(|size| size.parse::<u64>().ok());
        let etag = field("etag").map(str::to_owned);
        let (Some(size), Some(etag)) = (size, etag) else {
            return Err(
                CliError::Failure(format!("the answer to {href} has no size or no ETag")).into()
            );
        };
        bar.set_length(size);
        let exists = path.symlink_metadata().is_ok();
        if exists {
            let is_same = has_size(path, size)? && sha256.is_none_or(|sha256| has(path, sha256));
            match (is_same, sha256) {
                (false, _) => return Err(name_in_use(path).into()),
                (true, Some(_)) => return Ok(Fetched::Existing),
                // Files of one size may differ. Only the bytes of the service decide.
                (true, None) => {}
            }
        }
        // Another process may have downloaded the beginning. The ETag in the name identifies the file's content.
        let part = self.bytes(href, &etag, part(path, &etag), size, bar).await?;
        if let Some(expected) = sha256.filter(|expected| *expected != part.hashed.sha256()) {
            let text = format!(
                "{}: the downloaded file has the hash {}, not {expected}",
                path.display(),
                part.hashed.sha256()
            );
            // A damaged download can't be resumed.
            part.remove();
            return Err(CliError::Failure(text).into());
        }
        if exists {
            let is_same = has(path, part.hashed.sha256());
            part.remove();
            return if is_same { Ok(Fetched::Existing) } else { Err(name_in_use(path).into()) };
        }
        part.publish(path)?;
        Ok(Fetched::New)
    }

    /// Downloads the bytes that the file at `path` lacks.
    async fn bytes(
        &self,
        href: &str,
        etag: &str,
        path: PathBuf,
        size: u64,
        bar: &ProgressBar,
    ) -> Result<PartialFile> {
        let mut part = PartialFile::open(path, size)?;
        let mut attempt = 0;
        loop {
            bar.set_position(part.length());
            if part.length() == size {
                return Ok(part);
            }
            let mut request = self.request(Method::GET, href);
            if part.length() > 0 {
                let range = format!("bytes={}-", part.length());
                request = request.header("Range", range).header("If-Range", etag);
            }
            let answer = match request.send().await {
                Ok(answer) if answer.status().is_success() => answer,
                Ok(answer) => {
                    wait_to_retry(refusal(answer).await, &mut attempt).await?;
                    continue;
                }
                Err(error) => {
                    wait_to_retry(self.interruption(&error), &mut attempt).await?;
                    continue;
                }
            };
            let current = answer.headers().get("etag").and_then(|etag| etag.to_str().ok());
            if current != Some(etag) {
                let text = format!("{href} changed during the download: fetch it again");
                return Err(CliError::Failure(text).into());
            }
            if answer.status() != StatusCode::PARTIAL_CONTENT {
                part.clear()?;
                bar.set_position(0);
            }
            let mut bytes = answer.bytes_stream();
            while let Some(piece) = bytes.next().await {
                match piece {
                    Ok(piece) => {
                        part.append(&piece)?;
                        bar.inc(piece.len() as u64);
                        attempt = 0;
                    }
                    Err(error) => {
                        part.record()?;
                        wait_to_retry(self.interruption(&error), &mut attempt).await?;
                        break;
                    }
                }
            }
        }
    }
}

/// Bytes between two records of an incomplete file.
const RECORD_BYTES: u64 = 1 << 20;

/// An incomplete file. A second file records the length and the hash of its beginning, because a power failure can leave
/// other bytes than were received.
struct PartialFile {
    file: LockedFile,
    path: PathBuf,
    /// Hash and number of the bytes in the file.
    hashed: HashingWriter<Sink>,
    /// Number of bytes in the record.
    recorded: u64,
}

impl PartialFile {
    /// Opens the file, and keeps of an earlier one the beginning that agrees with its record.
    fn open(path: PathBuf, size: u64) -> Result<Self, CliError> {
        let unwritable = |error: std::io::Error| CliError::file("write", &path, &error);
        let folder = path.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(folder).map_err(unwritable)?;
        // A link that somebody has put there could name any file of the user.
        if path.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink()) {
            let text = format!("{} is a symbolic link: delete it", path.display());
            return Err(CliError::Input(text));
        }
        let mut options = OpenOptions::new();
        let file = options.create(true).truncate(false).read(true).write(true).open(&path);
        // Two processes would append to the same file.
        let file = LockedFile::take(file.map_err(unwritable)?)
            .map_err(|error| CliError::file("lock", &path, &error))?;
        let mut part = Self { file, path, hashed: HashingWriter::new(sink()), recorded: 0 };
        match part.resume(size) {
            Ok(true) => Ok(part),
            Ok(false) => part.clear().map(|()| part),
            Err(error) => Err(part.unwritable(&error)),
        }
    }

    /// Continues an earlier file. False if its beginning does not agree with its record.
    fn resume(&mut self, size: u64) -> std::io::Result<bool> {
        let Ok(text) = fs::read_to_string(self.record_path()) else { return Ok(false) };
        let Some((length, sha256)) = text.trim_end().split_once(' ') else { return Ok(false) };
        let (Ok(length), Ok(sha256)) = (length.parse::<u64>(), sha256.parse::<Sha256>()) else {
            return Ok(false);
        };
        if length > size || length > self.file.metadata()?.len() {
            return Ok(false);
        }
        let beginning = (&mut *self.file).take(length);
        copy(&mut BufReader::with_capacity(256 * 1024, beginning), &mut self.hashed)?;
        if (self.hashed.sha256(), self.hashed.size()) != (sha256, length) {
            return Ok(false);
        }
        self.recorded = length;
        self.file.set_len(length)?;
        Ok(true)
    }

    fn clear(&mut self) -> Result<(), CliError> {
        (self.hashed, self.recorded) = (HashingWriter::new(sink()), 0);
        let cleared = self.file.set_len(0).and_then(|()| self.file.rewind());
        cleared.map_err(|error| self.unwritable(&error))
    }

    fn append(&mut self, piece: &[u8]) -> Result<(), CliError> {
        let written = self.file.write_all(piece).and_then(|()| self.hashed.write_all(piece));
        written.map_err(|error| self.unwritable(&error))?;
        if self.length() >= self.recorded + RECORD_BYTES { self.record() } else { Ok(()) }
    }

    /// Number of bytes in the file.
    fn length(&self) -> u64 {
        self.hashed.size()
    }

    /// Writes the record. A torn record agrees with no file, so the download starts again.
    fn record(&mut self) -> Result<(), CliError> {
        self.recorded = self.length();
        let path = self.record_path();
        let written = fs::write(&path, format!("{} {}\n", self.recorded, self.hashed.sha256()));
        written.map_err(|error| CliError::file("write", &path, &error))
    }

    fn record_path(&self) -> PathBuf {
        self.path.with_added_extension("sha256")
    }

    /// Gives a complete file the final name.
    fn publish(self, path: &Path) -> Result<(), CliError> {
        self.file.sync_all().map_err(|error| self.unwritable(&error))?;
        rename_new(&self.path, path)?;
        let _ = fs::remove_file(self.record_path());
        Ok(())
    }

    fn remove(self) {
        let _ = fs::remove_file(self.record_path());
        let _ = fs::remove_file(&self.path);
    }

    fn unwritable(&self, error: &std::io::Error) -> CliError {
        CliError::file("write", &self.path, error)
    }
}

/// Path of an incomplete file.
fn part(path: &Path, etag: &str) -> PathBuf {
    let tag: String = etag.chars().filter(char::is_ascii_hexdigit).take(16).collect();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{tag}.part"))
}

/// True for a regular file of this size.
fn has_size(path: &Path, size: u64) -> Result<bool, CliError> {
    let meta = path.symlink_metadata().map_err(|error| CliError::file("read", path, &error))?;
    Ok(meta.is_file() && meta.len() == size)
}

/// True if the file can be read and has this hash.
fn has(path: &Path, sha256: Sha256) -> bool {
    let hash = || Ok::<_, std::io::Error>(Sha256::of_reader(&mut File::open(path)?)?.0);
    hash().is_ok_and(|actual| actual == sha256)
}

fn name_in_use(path: &Path) -> CliError {
    CliError::Input(format!(
        "{} exists and is a different file; it is not overwritten: choose another folder with --out",
        path.display()
    ))
}

/// Renames a file unless the new name is in use.
pub(in crate::cli) fn rename_new(from: &Path, path: &Path) -> Result<(), CliError> {
    let renamed = match renameat_with(CWD, from, CWD, path, RenameFlags::NOREPLACE) {
        // Some network file systems can't do that in one step.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) if !path.exists() => {
            fs::rename(from, path)
        }
        renamed => renamed.map_err(Into::into),
    };
    renamed.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => name_in_use(path),
        _ => CliError::file("write", path, &error),
    })
}
