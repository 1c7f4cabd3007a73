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

/// Content security policy of this page. Redoc adds style elements with the nonce, draws icons from data, and searches in a
/// worker that it creates from a blob.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'nonce-NONCE'; img-src 'self' data:; \
     worker-src blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The page, and its policy. Both have a nonce that nobody can guess, the same until the service ends.
static PAGE: LazyLock<(Asset, HeaderValue)> = LazyLock::new(|| {
    let nonce = format!("{:032x}", rand::random::<u128>());
    let with_nonce = |text: &str| text.replace("NONCE", &nonce);
    let page = Asset::new("text/html; charset=utf-8", with_nonce(include_str!("index.html")));
    // Hexadecimal digits are valid in a header. If they were not, the browser would load nothing.
    let strictest = HeaderValue::from_static("default-src 'none'");
    (page, HeaderValue::try_from(with_nonce(POLICY)).unwrap_or(strictest))
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
    PAGE.0.page(&headers, PAGE.1.clone())
}

pub(super) async fn file(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    let file = FILES.iter().find(|(known, _)| *known == name).ok_or_else(|| {
        ApiError::new(
            Code::NotFound,
            "the reference has no file with this name; open /docs instead",
        )
    })?;
    file.1.page(&headers, PAGE.1.clone())
}
