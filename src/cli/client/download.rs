//! A file from the service, which goes on after a cut where it was. Nothing that is there is overwritten.

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::StreamExt;
use indicatif::ProgressBar;
use reqwest::{Method, StatusCode};
use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::{Client, Result, again, refusal};
use crate::cli::CliError;
use engine::job::Sha256;
use store::LockedFile;

/// Time between looks whether a file has been made.
const MADE: Duration = Duration::from_secs(1);

/// What became of a download.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::cli) enum Fetched {
    New,
    /// The same file was there.
    Before,
}

impl Client {
    /// Fetches what is at `href` as the file `path`, and checks its hash if one is given.
    /// Errors: if there is another file of that name.
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
            tokio::time::sleep(MADE).await;
            head = self.send(|| self.request(Method::HEAD, href)).await?;
        }
        let field = |name| head.headers().get(name).and_then(|value| value.to_str().ok());
        let size = field("content-length").and_then(|size| size.parse::<u64>().ok());
        let etag = field("etag").map(str::to_owned);
        let (Some(size), Some(etag)) = (size, etag) else {
            return Err(CliError::Failure(format!("{href} tells no size and ETag")).into());
        };
        bar.set_length(size);
        if path.symlink_metadata().is_ok() {
            return is_same(path, size, sha256).map_err(Into::into);
        }
        // Whose beginning it is, the ETag in its name tells: the cut may have been in another process.
        let part = part(path, &etag);
        self.bytes(href, &etag, (&part, size), bar).await?;
        settle(&part, path, sha256).map_err(Into::into)
    }

    /// Fetches what is not in `part` yet.
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
        // Two processes would write one behind the other.
        let mut file =
            LockedFile::take(file).map_err(|error| CliError::file("lock", part, &error))?;
        let mut attempt = 0;
        loop {
            let have = file.metadata().map_err(unwritable)?.len();
            bar.set_position(have);
            if have == size {
                file.sync_all().map_err(unwritable)?;
                return Ok(());
            }
            let mut request = self.request(Method::GET, href);
            if have > 0 {
                let range = format!("bytes={have}-");
                request = request.header("Range", range).header("If-Range", etag);
            }
            let answer = match request.send().await {
                Ok(answer) if answer.status().is_success() => answer,
                Ok(answer) => {
                    again(refusal(answer).await, &mut attempt).await?;
                    continue;
                }
                Err(error) => {
                    again(self.cut(&error), &mut attempt).await?;
                    continue;
                }
            };
            let found = answer.headers().get("etag").and_then(|etag| etag.to_str().ok());
            if found != Some(etag) {
                let text = format!("{href} has changed while it was fetched: fetch it again");
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
                        again(self.cut(&error), &mut attempt).await?;
                        break;
                    }
                }
            }
        }
    }
}

/// Where a file lies until all of it is there.
fn part(path: &Path, etag: &str) -> PathBuf {
    let tag: String = etag.chars().filter(char::is_ascii_hexdigit).take(16).collect();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{tag}.part"))
}

/// Whether the file that is there is the one that would be fetched.
fn is_same(path: &Path, size: u64, sha256: Option<Sha256>) -> Result<Fetched, CliError> {
    let meta = path.symlink_metadata().map_err(|error| CliError::file("read", path, &error))?;
    let same = meta.is_file()
        && meta.len() == size
        && sha256.is_none_or(|sha256| hash(path).is_ok_and(|found| found == sha256));
    if same { Ok(Fetched::Before) } else { Err(taken(path)) }
}

fn taken(path: &Path) -> CliError {
    CliError::Input(format!(
        "{} is there, and is another file: nothing is overwritten",
        path.display()
    ))
}

fn hash(path: &Path) -> std::io::Result<Sha256> {
    Ok(Sha256::of_reader(&mut File::open(path)?)?.0)
}

/// Checks a file that is complete, and gives it its name.
fn settle(part: &Path, path: &Path, sha256: Option<Sha256>) -> Result<Fetched, CliError> {
    if let Some(expected) = sha256 {
        let found = hash(part).map_err(|error| CliError::file("read", part, &error))?;
        if found != expected {
            // There is nothing in it to go on from.
            let _ = fs::remove_file(part);
            let text =
                format!("{}: what has come has the hash {found}, not {expected}", path.display());
            return Err(CliError::Failure(text));
        }
    }
    place(part, path)?;
    Ok(Fetched::New)
}

/// Gives a file its name, unless another one has it.
pub(in crate::cli) fn place(made: &Path, path: &Path) -> Result<(), CliError> {
    let renamed = match renameat_with(CWD, made, CWD, path, RenameFlags::NOREPLACE) {
        // Some network file systems can't do that in one step.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) if !path.exists() => {
            fs::rename(made, path)
        }
        renamed => renamed.map_err(Into::into),
    };
    renamed.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => taken(path),
        _ => CliError::file("write", path, &error),
    })
}
