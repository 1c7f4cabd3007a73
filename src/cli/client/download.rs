//! Downloads a file, and resumes after an interruption. Existing files are not overwritten.

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::StreamExt;
use indicatif::ProgressBar;
use reqwest::{Method, StatusCode};
use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::{Client, Result, refusal, wait_to_retry};
use crate::cli::CliError;
use engine::job::Sha256;
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
    /// Downloads `href` to the file `path`, and checks its hash if one is given.
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
        if path.symlink_metadata().is_ok() {
            return is_same(path, size, sha256).map_err(Into::into);
        }
        // Another process may have downloaded the beginning. The ETag in the name identifies the file's content.
        let part = part(path, &etag);
        self.bytes(href, &etag, (&part, size), bar).await?;
        settle(&part, path, sha256).map_err(Into::into)
    }

    /// Downloads the bytes that `part` lacks.
    async fn bytes(
        &self,
        href: &str,
        etag: &str,
        (part, size): (&Path, u64),
        bar: &ProgressBar,
    ) -> Result<()> {
        let unwritable = |error: std::io::Error| CliError::file("write", part, &error);
        let folder = part.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(folder).map_err(unwritable)?;
        let file = OpenOptions::new().create(true).append(true).open(part).map_err(unwritable)?;
        // Two processes would append to the same file.
        let mut file =
            LockedFile::take(file).map_err(|error| CliError::file("lock", part, &error))?;
        let mut attempt = 0;
        loop {
            let received = file.metadata().map_err(unwritable)?.len();
            bar.set_position(received);
            if received == size {
                file.sync_all().map_err(unwritable)?;
                return Ok(());
            }
            let mut request = self.request(Method::GET, href);
            if received > 0 {
                let range = format!("bytes={received}-");
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
                file.set_len(0).map_err(unwritable)?;
                bar.set_position(0);
            }
            let mut bytes = answer.bytes_stream();
            while let Some(piece) = bytes.next().await {
                match piece {
                    Ok(piece) => {
                        file.write_all(&piece).map_err(unwritable)?;
                        bar.inc(piece.len() as u64);
                        attempt = 0;
                    }
                    Err(error) => {
                        wait_to_retry(self.interruption(&error), &mut attempt).await?;
                        break;
                    }
                }
            }
        }
    }
}

/// Path of an incomplete file.
fn part(path: &Path, etag: &str) -> PathBuf {
    let tag: String = etag.chars().filter(char::is_ascii_hexdigit).take(16).collect();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{tag}.part"))
}

/// Compares an existing file with the one that would be downloaded.
/// Errors: it is a different file.
fn is_same(path: &Path, size: u64, sha256: Option<Sha256>) -> Result<Fetched, CliError> {
    let meta = path.symlink_metadata().map_err(|error| CliError::file("read", path, &error))?;
    let is_same = meta.is_file()
        && meta.len() == size
        && sha256.is_none_or(|sha256| hash(path).is_ok_and(|actual| actual == sha256));
    if is_same { Ok(Fetched::Existing) } else { Err(name_in_use(path)) }
}

fn name_in_use(path: &Path) -> CliError {
    CliError::Input(format!(
        "{} exists and is a different file; it is not overwritten: choose another folder with --out",
        path.display()
    ))
}

fn hash(path: &Path) -> std::io::Result<Sha256> {
    Ok(Sha256::of_reader(&mut File::open(path)?)?.0)
}

/// Checks a complete file, and gives it the final name.
fn settle(part: &Path, path: &Path, sha256: Option<Sha256>) -> Result<Fetched, CliError> {
    if let Some(expected) = sha256 {
        let actual = hash(part).map_err(|error| CliError::file("read", part, &error))?;
        if actual != expected {
            // A damaged download can't be resumed.
            let _ = fs::remove_file(part);
            let text = format!(
                "{}: the downloaded file has the hash {actual}, not {expected}",
                path.display()
            );
            return Err(CliError::Failure(text));
        }
    }
    rename_new(part, path)?;
    Ok(Fetched::New)
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
