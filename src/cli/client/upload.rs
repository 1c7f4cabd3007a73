//! A file to the service in pieces (tus 1.0), which goes on after a cut where it was, also in another process.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use indicatif::ProgressBar;
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use uuid::Uuid;

use super::{Client, ClientError, Result, again, refusal};
use crate::cli::CliError;
use engine::job::Sha256;

/// Bytes of a piece.
const PIECE: u64 = 4 << 20;
/// Uploads of one file that are begun anew because what had come is gone.
const BEGINNINGS: u32 = 3;

impl Client {
    /// Sends a file, unless it is there already; gives its hash. Memory holds a piece.
    pub(in crate::cli) async fn upload(&self, path: &Path, bar: &ProgressBar) -> Result<Sha256> {
        let unreadable = |error: std::io::Error| CliError::file("read", path, &error);
        let mut file = File::open(path).map_err(unreadable)?;
        let (sha256, size) = Sha256::of_reader(&mut file).map_err(unreadable)?;
        if size == 0 {
            return Err(CliError::Input(format!("{} is empty", path.display())).into());
        }
        bar.set_length(size);
        // The same file is the same upload, whoever sends it: it goes on where another process was.
        let mut key = format!("upload-{sha256}");
        for _ in 0..BEGINNINGS {
            if self.has(sha256).await? {
                bar.set_position(size);
                return Ok(sha256);
            }
            let place = self.begin(sha256, size, &key).await?;
            match self.pieces(&place, &mut file, size, bar).await {
                Err(ClientError::Refused { status, .. })
                    if [StatusCode::NOT_FOUND, StatusCode::GONE].contains(&status) => {}
                sent => sent?,
            }
            // What that key stands for may be gone: an upload that has ended, or a file that was deleted since.
            key = format!("upload-{sha256}-{}", Uuid::now_v7());
        }
        if self.has(sha256).await? {
            return Ok(sha256);
        }
        let text = format!("{}: the service loses the upload again and again", path.display());
        Err(CliError::Failure(text).into())
    }

    async fn has(&self, sha256: Sha256) -> Result<bool> {
        match self.get(&format!("/v1/blobs/{sha256}")).await {
            Ok(_) => Ok(true),
            Err(ClientError::Refused { status: StatusCode::NOT_FOUND, .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn tus(&self, method: Method, path: &str) -> RequestBuilder {
        self.request(method, path).header("Tus-Resumable", "1.0.0")
    }

    /// Announces a file; gives the address of its pieces.
    async fn begin(&self, sha256: Sha256, size: u64, key: &str) -> Result<String> {
        let metadata = format!("sha256 {}", STANDARD.encode(sha256.to_string()));
        let begun = self.send(|| {
            let request = self.tus(Method::POST, "/v1/uploads").header("Idempotency-Key", key);
            request.header("Upload-Length", size).header("Upload-Metadata", &metadata)
        });
        let begun = begun.await?;
        let place = begun.headers().get("location").and_then(|place| place.to_str().ok());
        // Relative, or below a prefix of a proxy: the identifier is at the end.
        let id = place.and_then(|place| place.rsplit('/').next()).filter(|id| !id.is_empty());
        let id = id.ok_or_else(|| CliError::Failure("the service names no upload".into()))?;
        Ok(format!("/v1/uploads/{id}"))
    }

    /// Sends what the service does not have yet.
    async fn pieces(
        &self,
        place: &str,
        file: &mut File,
        size: u64,
        bar: &ProgressBar,
    ) -> Result<()> {
        let unreadable = |error| CliError::Failure(format!("the file can't be read: {error}"));
        let mut attempt = 0;
        let mut offset = self.offset(place).await?;
        while offset < size {
            bar.set_position(offset);
            let mut piece = Vec::new();
            file.seek(SeekFrom::Start(offset)).map_err(unreadable)?;
            file.take(PIECE).read_to_end(&mut piece).map_err(unreadable)?;
            if piece.is_empty() {
                return Err(CliError::Failure("the file became shorter".into()).into());
            }
            let request = self
                .tus(Method::PATCH, place)
                .header("Upload-Offset", offset)
                .header("Content-Type", "application/offset+octet-stream")
                .body(piece);
            let error = match request.send().await {
                Ok(answer) if answer.status().is_success() => {
                    (offset, attempt) = (told_offset(&answer)?, 0);
                    continue;
                }
                // An answer was lost, not its piece.
                Ok(answer) if answer.status() == StatusCode::CONFLICT => {
                    ClientError::Passing("the piece does not follow".into())
                }
                Ok(answer) => refusal(answer).await,
                Err(error) => self.cut(&error),
            };
            again(error, &mut attempt).await?;
            let before = offset;
            offset = self.offset(place).await?;
            // A piece that was cut counts as far as it came.
            attempt = if offset > before { 0 } else { attempt };
        }
        bar.set_position(size);
        Ok(())
    }

    async fn offset(&self, place: &str) -> Result<u64> {
        told_offset(&self.send(|| self.tus(Method::HEAD, place)).await?)
    }
}

fn told_offset(answer: &Response) -> Result<u64> {
    let offset = answer.headers().get("upload-offset").and_then(|offset| offset.to_str().ok());
    let offset = offset.and_then(|offset| offset.parse().ok());
    offset.ok_or_else(|| CliError::Failure("the service tells no offset".into()).into())
}
