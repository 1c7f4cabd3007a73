//! Conditional and partial requests (RFC 9110): `If-Match`, `If-None-Match`, `If-Range` and `Range`.

use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use headers::{ETag, HeaderMapExt, IfMatch, IfNoneMatch};
use serde::Serialize;

use super::error::{ApiError, Code, Result};
use engine::job::Sha256;

/// A strong ETag: the hash of the content.
pub(super) fn etag(sha256: &Sha256) -> String {
    format!("\"{sha256}\"")
}

/// True if the client has the content with this ETag (`If-None-Match`, compared weakly).
fn is_known(headers: &HeaderMap, etag: &str) -> bool {
    match (headers.typed_get::<IfNoneMatch>(), etag.parse::<ETag>()) {
        (Some(known), Ok(etag)) => !known.precondition_passes(&etag),
        _ => false,
    }
}

/// Rejects a request if `If-Match` does not contain this ETag, compared strongly.
pub(super) fn check_match(headers: &HeaderMap, etag: &str) -> Result<()> {
    match (headers.typed_get::<IfMatch>(), etag.parse::<ETag>()) {
        (Some(expected), Ok(current)) if !expected.precondition_passes(&current) => {
            let detail = format!(
                "the ETag is {etag}, which If-Match does not contain: the resource has changed"
            );
            Err(ApiError::new(Code::PreconditionFailed, detail))
        }
        _ => Ok(()),
    }
}

/// The ETag that [`json`] sends with this body.
pub(super) fn etag_of<T: Serialize>(body: &T) -> Result<String> {
    let text = serde_json::to_vec(body).map_err(|error| ApiError::internal(&error))?;
    Ok(etag(&Sha256::of(&text)))
}

/// The answer 304 with `fields`, if the client has the content with this ETag.
///
/// Errors: 412 if `If-Match` does not contain the ETag.
pub(super) fn not_modified<const N: usize>(
    headers: &HeaderMap,
    etag: &str,
    fields: [(HeaderName, String); N],
) -> Result<Option<Response>> {
    check_match(headers, etag)?;
    let known = is_known(headers, etag);
    Ok(known.then(|| (StatusCode::NOT_MODIFIED, fields).into_response()))
}

/// Answers with content and its ETag, or with 304 if the client has it.
pub(super) fn content(headers: &HeaderMap, kind: &'static str, bytes: Vec<u8>) -> Response {
    let etag = etag(&Sha256::of(&bytes));
    let tags = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, "private, no-cache".into())];
    match not_modified(headers, &etag, tags.clone()) {
        Ok(Some(known)) => known,
        Ok(None) => (tags, [(header::CONTENT_TYPE, kind)], bytes).into_response(),
        Err(error) => error.into_response(),
    }
}

/// Answers with a page that loads the style sheet and pictures of the service, and no scripts.
pub(super) fn page(headers: &HeaderMap, text: String) -> Response {
    const POLICY: HeaderValue = HeaderValue::from_static(
        "default-src 'none'; style-src 'self'; img-src 'self'; base-uri 'none'; form-action 'none'; \
         frame-ancestors 'none'",
    );
    let mut response = content(headers, "text/html; charset=utf-8", text.into_bytes());
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, POLICY);
    response
}

/// Answers with a JSON body and its ETag, or with 304 if the client has it.
pub(super) fn json<T: Serialize>(body: &T, headers: &HeaderMap) -> Result<Response> {
    let text = serde_json::to_vec(body).map_err(|error| ApiError::internal(&error))?;
    Ok(content(headers, "application/json", text))
}

/// The part of a file that a request asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RequestedRange {
    Whole,
    Part {
        start: u64,
        length: u64,
    },
    /// A range after the end of the file.
    Outside,
}

/// Parses `Range` and `If-Range` for a file of `size` bytes. Ranges are only defined for GET. Several ranges, other units
/// and malformed ranges are ignored, as the RFC allows; the answer is then the whole file.
pub(super) fn requested_range(
    method: &Method,
    headers: &HeaderMap,
    etag: &str,
    size: u64,
) -> RequestedRange {
    if method != Method::GET {
        return RequestedRange::Whole;
    }
    let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let Some(range) = text(header::RANGE) else { return RequestedRange::Whole };
    if headers.contains_key(header::IF_RANGE) && text(header::IF_RANGE) != Some(etag) {
        return RequestedRange::Whole;
    }
    let Some((first, last)) = range
        .strip_prefix("bytes=")
        .filter(|set| !set.contains(','))
        .and_then(|set| set.trim().split_once('-'))
    else {
        return RequestedRange::Whole;
    };
    match (number(first), number(last)) {
        (Some(start), _) if last.is_empty() && start >= size => RequestedRange::Outside,
        (Some(start), _) if last.is_empty() => RequestedRange::Part { start, length: size - start },
        (Some(start), Some(end)) if start > end => RequestedRange::Whole,
        (Some(start), Some(_)) if start >= size => RequestedRange::Outside,
        (Some(start), Some(end)) => {
            RequestedRange::Part { start, length: end.min(size - 1) - start + 1 }
        }
        (None, Some(0)) if first.is_empty() => RequestedRange::Outside,
        (None, Some(suffix)) if first.is_empty() => {
            let length = suffix.min(size);
            RequestedRange::Part { start: size - length, length }
        }
        _ => RequestedRange::Whole,
    }
}

fn number(text: &str) -> Option<u64> {
    if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    // A number that exceeds 64 bits is after the end of any file.
    Some(text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::{RequestedRange, check_match, is_known};
    use axum::http::{HeaderMap, Method};

    fn requested_range(headers: &HeaderMap, etag: &str, size: u64) -> RequestedRange {
        super::requested_range(&Method::GET, headers, etag, size)
    }

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs.iter().map(|(name, value)| (name.parse().unwrap(), value.parse().unwrap())).collect()
    }

    #[test]
    fn ranges_of_a_file_of_ten_bytes_are_parsed() {
        let part = |start, length| RequestedRange::Part { start, length };
        for (range, expected) in [
            ("bytes=0-0", part(0, 1)),
            ("bytes=2-5", part(2, 4)),
            ("bytes=2-", part(2, 8)),
            ("bytes=2-99999999999999999999999", part(2, 8)),
            ("bytes=-3", part(7, 3)),
            ("bytes=-30", part(0, 10)),
            ("bytes=10-", RequestedRange::Outside),
            ("bytes=10-12", RequestedRange::Outside),
            ("bytes=99999999999999999999999-", RequestedRange::Outside),
            ("bytes=-0", RequestedRange::Outside),
            ("bytes=5-2", RequestedRange::Whole),
            ("bytes=0-1,4-5", RequestedRange::Whole),
            ("bytes=+1-2", RequestedRange::Whole),
            ("bytes=a-b", RequestedRange::Whole),
            ("bytes=-", RequestedRange::Whole),
            ("lines=1-2", RequestedRange::Whole),
        ] {
            assert_eq!(
                requested_range(&headers(&[("range", range)]), "\"t\"", 10),
                expected,
                "{range}"
            );
        }
    }

    #[test]
    fn a_range_of_older_content_gets_the_whole_file() {
        let with = |tag| {
            requested_range(&headers(&[("range", "bytes=0-1"), ("if-range", tag)]), "\"t\"", 10)
        };
        assert_eq!(with("\"t\""), RequestedRange::Part { start: 0, length: 2 });
        assert_eq!(with("\"old\""), RequestedRange::Whole);
        assert_eq!(with("W/\"t\""), RequestedRange::Whole, "If-Range compares tags strongly");
    }

    #[test]
    fn a_head_request_ignores_ranges() {
        let part = headers(&[("range", "bytes=0-1")]);
        assert_eq!(
            super::requested_range(&Method::HEAD, &part, "\"t\"", 10),
            RequestedRange::Whole
        );
    }

    #[test]
    fn a_request_for_another_state_is_rejected() {
        for list in ["\"t\"", "\"a\", \"t\"", "*"] {
            assert!(check_match(&headers(&[("if-match", list)]), "\"t\"").is_ok(), "{list}");
        }
        for list in ["\"x\"", "W/\"t\""] {
            assert!(check_match(&headers(&[("if-match", list)]), "\"t\"").is_err(), "{list}");
        }
        assert!(check_match(&headers(&[]), "\"t\"").is_ok());
    }

    #[test]
    fn known_content_is_not_sent_again() {
        for list in ["\"t\"", "\"a\", \"t\"", "W/\"t\"", "*"] {
            assert!(is_known(&headers(&[("if-none-match", list)]), "\"t\""), "{list}");
        }
        assert!(!is_known(&headers(&[("if-none-match", "\"x\"")]), "\"t\""));
        assert!(!is_known(&headers(&[]), "\"t\""));
    }
}
