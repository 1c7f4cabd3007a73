//! Documents that the program contains.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::conditional;
use super::error::Result;
use engine::job::Sha256;

/// A document with its strong ETag.
#[derive(Debug)]
pub(super) struct Asset {
    kind: &'static str,
    bytes: Bytes,
    etag: String,
}

impl Asset {
    pub(super) fn new(kind: &'static str, bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        Self { kind, etag: conditional::etag(&Sha256::of(&bytes)), bytes }
    }

    /// The document, 304 or 412.
    pub(super) fn answer(&self, headers: &HeaderMap) -> Result<Response> {
        let fields = [
            (header::ETAG, self.etag.clone()),
            (header::CONTENT_TYPE, self.kind.into()),
            // The browser revalidates every file, so it never mixes old and new modules after an update.
            (header::CACHE_CONTROL, "no-cache".into()),
        ];
        let known = conditional::not_modified(headers, &self.etag, fields.clone())?;
        Ok(known.unwrap_or_else(|| (fields, self.bytes.clone()).into_response()))
    }

    /// As [`Self::answer`], for a page of this service or a file of one, with its content security policy.
    pub(super) fn page(&self, headers: &HeaderMap, policy: HeaderValue) -> Result<Response> {
        let mut response = self.answer(headers)?;
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
        Ok(response)
    }
}
