//! `/docs`: the contract as a page, rendered by Redoc.
//!
//! Redoc 2 has half the size of Redoc 3, and a quarter of that of Scalar. `scripts/vendor-redoc.sh` fetches it.

use std::io::Read;
use std::sync::LazyLock;

use axum::http::{HeaderMap, HeaderValue};
use axum::response::Response;
use flate2::read::GzDecoder;

use super::asset::Asset;
use super::error::{ApiError, Code, Result};
use super::extract::Params;

/// Content security policy of this page. Redoc draws icons from data, and searches in a worker that it creates from a blob.
/// The hashes are those of style elements: the one of the page, one of Redoc's scroll bars, and empty ones, which scripts of
/// Redoc fill.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src \
     'sha256-u6hUI69DnmCZZ4VJjD9xPQgvC6bEgdk9yXA8e2n6CsI=' \
     'sha256-QMIg+bpjm3JdElJ388KYke01izlUW0UoNOeKjpMxdgc=' \
     'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='; \
     img-src 'self' data:; worker-src blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

static PAGE: LazyLock<Asset> = LazyLock::new(|| {
    Asset::new("text/html; charset=utf-8", include_bytes!("index.html").as_slice())
});

static FILES: LazyLock<[(&str, Asset); 3]> = LazyLock::new(|| {
    let script = "text/javascript; charset=utf-8";
    let licence = include_bytes!("LICENSE.txt").as_slice();
    [
        ("start.js", Asset::new(script, include_bytes!("start.js").as_slice())),
        ("redoc.js", Asset::new(script, unpacked(include_bytes!("redoc.js.gz")))),
        ("LICENSE.txt", Asset::new("text/plain; charset=utf-8", licence)),
    ]
});

fn unpacked(packed: &[u8]) -> Vec<u8> {
    let mut plain = Vec::new();
    // A test reads the same bytes. If it failed here, the script would be cut short.
    GzDecoder::new(packed).read_to_end(&mut plain).ok();
    plain
}

pub(super) async fn page(headers: HeaderMap) -> Result<Response> {
    PAGE.page(&headers, HeaderValue::from_static(POLICY))
}

pub(super) async fn file(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    let file = FILES.iter().find(|(known, _)| *known == name).ok_or_else(|| {
        ApiError::new(
            Code::NotFound,
            "the reference has no file with this name; open /docs instead",
        )
    })?;
    file.1.page(&headers, HeaderValue::from_static(POLICY))
}
