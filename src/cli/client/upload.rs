//! Uploads a file in pieces (tus 1.0). An interrupted upload is resumed, even by another process.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use indicatif::ProgressBar;
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use uuid::Uuid;

use super::{Client, ClientError, Result, refusal, wait_to_retry};
use crate::cli::CliError;
use crate::cli::error::open_input;
use engine::job::Sha256;

/// Bytes of a piece.
const PIECE: u64 = 4 << 20;
/// Attempts at one file. A new attempt is needed if the service has lost the received bytes.
const MAX_UPLOADS: u32 = 3;

impl Client {
    /// Uploads a file unless the service already has it, and returns its hash. Memory holds one piece.
    pub(in crate::cli) async fn upload(&self, path: &Path, bar: &ProgressBar) -> Result<Sha256> {
        let unreadable = |error: std::io::Error| CliError::file("read", path, &error);
        let mut file = open_input(path)?;
        let (sha256, size) = Sha256::of_reader(&mut file).map_err(unreadable)?;
        if size == 0 {
            return Err(CliError::Input(format!("{} is empty", path.display())).into());
        }
        bar.set_length(size);
        // The key is derived from the content, so that a later process resumes the same upload.
        let mut key = format!("upload-{sha256}");
        for _ in 0..MAX_UPLOADS {
            if self.has(sha256).await? {
                bar.set_position(size);
                return Ok(sha256);
            }
            let url = self.begin(sha256, size, &key).await?;
            match self.pieces(&url, &mut file, size, bar).await {
                Err(ClientError::Refused { status, .. })
                    if [StatusCode::NOT_FOUND, StatusCode::GONE].contains(&status) => {}
                sent => sent?,
            }
            // The upload with that key may have expired, or its file may have been deleted.
            key = format!("upload-{sha256}-{}", Uuid::now_v7());
        }
        if self.has(sha256).await? {
            return Ok(sha256);
        }
        let text =
            format!("{}: the service has lost the upload {MAX_UPLOADS} times", path.display());
        Err(CliError::Failure(text).into())
    }

    /// True if the lab has uploaded a file with this hash.
    pub(in crate::cli) async fn has(&self, sha256: Sha256) -> Result<bool> {
        Ok(self.find(&format!("/v1/blobs/{sha256}")).await?.is_some())
    }

    fn tus(&self, method: Method, path: &str) -> RequestBuilder {
        self.request(method, path).header("Tus-Resumable", "1.0.0")
    }

    /// Creates an upload, and returns the path of its URL.
    async fn begin(&self, sha256: Sha256, size: u64, key: &str) -> Result<String> {
        let metadata = format!("sha256 {}", STANDARD.encode(sha256.to_string()));
        let created = self.send(|| {
            let request = self.tus(Method::POST, "/v1/uploads").header("Idempotency-Key", key);
            request.header("Upload-Length", size).header("Upload-Metadata", &metadata)
        });
        let created = created.await?;
        let url = created.headers().get("location").and_then(|url| url.to_str().ok());
        // Relative, or below a prefix of a proxy: the identifier is at the end.
        let id = url.and_then(|url| url.rsplit('/').next()).filter(|id| !id.is_empty());
        let id =
            id.ok_or_else(|| CliError::Failure("the service's answer names no upload".into()))?;
        Ok(format!("/v1/uploads/{id}"))
    }

    /// Sends the bytes that the service lacks.
    async fn pieces(&self, url: &str, file: &mut File, size: u64, bar: &ProgressBar) -> Result<()> {
        let unreadable = |error| CliError::Failure(format!("the file can't be read: {error}"));
        let mut attempt = 0;
        let mut offset = self.offset(url).await?;
        while offset < size {
            bar.set_position(offset);
            let mut piece = Vec::new();
            file.seek(SeekFrom::Start(offset)).map_err(unreadable)?;
            file.take(PIECE).read_to_end(&mut piece).map_err(unreadable)?;
            if piece.is_empty() {
                return Err(
                    CliError::Failure("the file became shorter during the upload".into()).into()
                );
            }
            let request = self
                .tus(Method::PATCH, url)
                .header("Upload-Offset", offset)
                .header("Content-Type", "application/offset+octet-stream")
                .body(piece);
            let error = match request.send().await {
                Ok(answer) if answer.status().is_success() => {
                    (offset, attempt) = (parse_offset(&answer)?, 0);
                    continue;
                }
                // The service has the piece; its answer was lost.
                Ok(answer) if answer.status() == StatusCode::CONFLICT => ClientError::Temporary(
                    "the offset does not match the bytes received so far".into(),
                ),
                Ok(answer) => refusal(answer).await,
                Err(error) => self.interruption(&error),
            };
            wait_to_retry(error, &mut attempt).await?;
            let before = offset;
            offset = self.offset(url).await?;
            // The received part of an interrupted piece counts.
            attempt = if offset > before { 0 } else { attempt };
        }
        bar.set_position(size);
        Ok(())
    }

    async fn offset(&self, url: &str) -> Result<u64> {
        parse_offset(&self.send(|| self.tus(Method::HEAD, url)).await?)
    }
}

fn parse_offset(answer: &Response) -> Result<u64> {
    let offset = answer.headers().get("upload-offset").and_then(|offset| offset.to_str().ok());
    let offset = offset.and_then(|offset| offset.parse().ok());
    offset.ok_or_else(|| CliError::Failure("the service's answer has no offset".into()).into())
}
