//! Sends a file or a range of it, with ETag and Range.

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt, SeekFrom, Take};
use tokio_util::io::ReaderStream;

use super::conditional::{self, RequestedRange};
use super::error::{ApiError, Code, Result};
use engine::job::Sha256;
use store::StoreError;

/// A file as the headers of an answer describe it.
#[derive(Debug)]
pub(super) struct Download {
    pub(super) sha256: Sha256,
    pub(super) size: u64,
    /// The media type.
    pub(super) kind: &'static str,
    /// `Content-Disposition`: `inline` or `attachment`, and the file name.
    pub(super) disposition: String,
    /// True if the service answers range requests.
    pub(super) accepts_ranges: bool,
}

impl Download {
    /// Answers with the file that `open` opens, the requested range of it, or 304 if the client has it.
    pub(super) async fn send(
        &self,
        open: impl Future<Output = Result<std::fs::File, StoreError>>,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let read = async |start, length| {
            stream_range(open.await?, start, length).await.map(Body::from_stream)
        };
        self.answer(read, request).await
    }

    /// Like [`Self::send`]. `read` makes the body, given the first byte and the length of the requested range.
    pub(super) async fn answer(
        &self,
        read: impl AsyncFnOnce(u64, u64) -> Result<Body>,
        (method, headers): (&Method, &HeaderMap),
    ) -> Result<Response> {
        let etag = conditional::etag(&self.sha256);
        let tag = [(header::ETAG, etag.clone())];
        if let Some(known) = conditional::not_modified(headers, &etag, tag)? {
            return Ok(known);
        }
        let (status, start, length) = self.portion(&etag, method, headers)?;
        let mut response = (status, read(start, length).await?).into_response();
        let fields = response.headers_mut();
        fields.insert(header::CONTENT_TYPE, HeaderValue::from_static(self.kind));
        fields.insert(header::CONTENT_LENGTH, length.into());
        let ranges = if self.accepts_ranges { "bytes" } else { "none" };
        fields.insert(header::ACCEPT_RANGES, HeaderValue::from_static(ranges));
        fields.insert(header::ETAG, value(etag));
        fields.insert(header::CONTENT_DISPOSITION, value(self.disposition.clone()));
        if status == StatusCode::PARTIAL_CONTENT {
            let range = format!("bytes {start}-{}/{}", start + length - 1, self.size);
            fields.insert(header::CONTENT_RANGE, value(range));
        }
        Ok(response)
    }

    /// Status of the answer, and first byte and length of the requested range.
    fn portion(
        &self,
        etag: &str,
        method: &Method,
        headers: &HeaderMap,
    ) -> Result<(StatusCode, u64, u64)> {
        let whole = (StatusCode::OK, 0, self.size);
        if !self.accepts_ranges {
            return Ok(whole);
        }
        match conditional::requested_range(method, headers, etag, self.size) {
            RequestedRange::Whole => Ok(whole),
            RequestedRange::Part { start, length } => {
                Ok((StatusCode::PARTIAL_CONTENT, start, length))
            }
            RequestedRange::Outside => Err(range_error(self.size)),
        }
    }
}

fn range_error(size: u64) -> ApiError {
    let detail = format!("the range begins after the end of the file, which has {size} bytes");
    ApiError::new(Code::RangeNotSatisfiable, detail)
        .with_header(header::CONTENT_RANGE, value(format!("bytes */{size}")))
}

/// Reads `length` bytes of a file from `start` on.
pub(super) async fn stream_range(
    file: std::fs::File,
    start: u64,
    length: u64,
) -> Result<ReaderStream<Take<File>>> {
    let mut file = File::from_std(file);
    if start > 0 {
        file.seek(SeekFrom::Start(start)).await.map_err(|error| ApiError::internal(&error))?;
    }
    Ok(ReaderStream::with_capacity(file.take(length), 64 * 1024))
}

fn value(text: String) -> HeaderValue {
    HeaderValue::try_from(text).unwrap_or_else(|_| HeaderValue::from_static(""))
}
