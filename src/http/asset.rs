//! Documents that the program contains, sent compressed to clients that accept it.

use std::io::{Read, Write};

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use super::error::Result;
use super::{conditional, negotiation};
use engine::job::Sha256;

/// A document in two representations, each with its own strong ETag.
#[derive(Debug)]
pub(super) struct Asset {
    kind: &'static str,
    plain: Representation,
    packed: Representation,
}

#[derive(Debug)]
struct Representation {
    bytes: Bytes,
    etag: String,
}

impl Representation {
    fn new(bytes: Bytes) -> Self {
        Self { etag: conditional::etag(&Sha256::of(&bytes)), bytes }
    }
}

fn pack(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes)?;
    encoder.finish()
}

impl Asset {
    pub(super) fn new(kind: &'static str, bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        // Writing to memory does not fail. If it did, the document would be sent uncompressed.
        let packed = pack(&bytes).map_or_else(|_| bytes.clone(), Bytes::from);
        Self { kind, plain: Representation::new(bytes), packed: Representation::new(packed) }
    }

    /// A document that the program contains in gzip.
    pub(super) fn packed(kind: &'static str, packed: &'static [u8]) -> Self {
        let mut plain = Vec::new();
        // A test reads the same bytes. If it failed here, the document would be cut short.
        GzDecoder::new(packed).read_to_end(&mut plain).ok();
        let packed = Representation::new(Bytes::from_static(packed));
        Self { kind, plain: Representation::new(plain.into()), packed }
    }

    /// Bytes of the compressed representation.
    #[cfg(test)]
    pub(super) fn packed_len(&self) -> usize {
        self.packed.bytes.len()
    }

    /// The representation that the client takes, 304 or 412.
    pub(super) fn answer(&self, headers: &HeaderMap) -> Result<Response> {
        let gzip = negotiation::takes_gzip(headers);
        let file = if gzip { &self.packed } else { &self.plain };
        conditional::check_match(headers, &file.etag)?;
        let known = conditional::is_known(headers, &file.etag);
        let mut response = match known {
            true => StatusCode::NOT_MODIFIED.into_response(),
            false => file.bytes.clone().into_response(),
        };
        let fields = response.headers_mut();
        let mut set = |name: HeaderName, value: &'static str| {
            fields.insert(name, HeaderValue::from_static(value));
        };
        set(header::CONTENT_TYPE, self.kind);
        // The browser revalidates every file, so it never mixes old and new modules after an update.
        set(header::CACHE_CONTROL, "no-cache");
        set(header::VARY, "accept-encoding");
        if gzip && !known {
            set(header::CONTENT_ENCODING, "gzip");
        }
        if let Ok(etag) = HeaderValue::try_from(&file.etag) {
            fields.insert(header::ETAG, etag);
        }
        Ok(response)
    }

    /// As [`Self::answer`], for a page of this service or a file of one, with its content security policy.
    pub(super) fn page(&self, headers: &HeaderMap, policy: &'static str) -> Result<Response> {
        let mut response = self.answer(headers)?;
        let policy = HeaderValue::from_static(policy);
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
        Ok(response)
    }
}
