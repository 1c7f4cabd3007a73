//! Conditional and partial requests (RFC 9110): `If-Match`, `If-None-Match`, `If-Range` and `Range`.

use axum::http::{HeaderMap, HeaderName, Method, StatusCode, header};
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
pub(super) fn is_known(headers: &HeaderMap, etag: &str) -> bool {
    match (headers.typed_get::<IfNoneMatch>(), etag.parse::<ETag>()) {
        (Some(known), Ok(etag)) => !known.precondition_passes(&etag),
        _ => false,
    }
}

/// Refuses a request about another state of a thing than the one with this ETag (`If-Match`, compared
/// strongly).
pub(super) fn check_match(headers: &HeaderMap, etag: &str) -> Result<()> {
    let wanted = headers.typed_get::<IfMatch>();
    match (wanted, etag.parse::<ETag>()) {
        (Some(wanted), Ok(found)) if !wanted.precondition_passes(&found) => {
            let detail = format!("If-Match names another state than this one, which is {etag}");
            Err(ApiError::new(Code::PreconditionFailed, detail))
        }
        _ => Ok(()),
    }
}

/// The ETag under which [`json`] answers with this.
pub(super) fn etag_of<T: Serialize>(body: &T) -> Result<String> {
    let text = serde_json::to_vec(body).map_err(|error| ApiError::internal(&error))?;
    Ok(etag(&Sha256::of(&text)))
}

/// Content with its ETag, or word that the client has it.
pub(super) fn content(headers: &HeaderMap, kind: &'static str, bytes: Vec<u8>) -> Response {
    let etag = etag(&Sha256::of(&bytes));
    if let Err(refusal) = check_match(headers, &etag) {
        return refusal.into_response();
    }
    let tags = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, "no-cache".into())];
    if is_known(headers, &etag) {
        return (StatusCode::NOT_MODIFIED, tags).into_response();
    }
    (tags, [(header::CONTENT_TYPE, kind)], bytes).into_response()
}

pub(super) fn json<T: Serialize>(body: &T, headers: &HeaderMap) -> Result<Response> {
    let text = serde_json::to_vec(body).map_err(|error| ApiError::internal(&error))?;
    Ok(content(headers, "application/json", text))
}

/// What part of a file is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wanted {
    Whole,
    Part {
        start: u64,
        length: u64,
    },
    /// Bytes that are not there.
    Outside,
}

/// Reads `Range` and `If-Range` for a file of `size` bytes. Ranges are defined for GET alone. Several ranges
/// at once, other units and what can't be read are ignored, as the RFC allows: the whole file is the answer
/// then.
pub(super) fn wanted(method: &Method, headers: &HeaderMap, etag: &str, size: u64) -> Wanted {
    if method != Method::GET {
        return Wanted::Whole;
    }
    let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let Some(range) = text(header::RANGE) else { return Wanted::Whole };
    if headers.contains_key(header::IF_RANGE) && text(header::IF_RANGE) != Some(etag) {
        return Wanted::Whole;
    }
    let Some((first, last)) = range
        .strip_prefix("bytes=")
        .filter(|set| !set.contains(','))
        .and_then(|set| set.trim().split_once('-'))
    else {
        return Wanted::Whole;
    };
    match (number(first), number(last)) {
        (Some(start), _) if last.is_empty() && start >= size => Wanted::Outside,
        (Some(start), _) if last.is_empty() => Wanted::Part { start, length: size - start },
        (Some(start), Some(end)) if start > end => Wanted::Whole,
        (Some(start), Some(_)) if start >= size => Wanted::Outside,
        (Some(start), Some(end)) => Wanted::Part { start, length: end.min(size - 1) - start + 1 },
        (None, Some(0)) if first.is_empty() => Wanted::Outside,
        (None, Some(suffix)) if first.is_empty() => {
            let length = suffix.min(size);
            Wanted::Part { start: size - length, length }
        }
        _ => Wanted::Whole,
    }
}

fn number(text: &str) -> Option<u64> {
    if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    // Digits that don't fit name a byte past every file.
    Some(text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::{Wanted, check_match, is_known};
    use axum::http::{HeaderMap, Method};

    fn wanted(headers: &HeaderMap, etag: &str, size: u64) -> Wanted {
        super::wanted(&Method::GET, headers, etag, size)
    }

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs.iter().map(|(name, value)| (name.parse().unwrap(), value.parse().unwrap())).collect()
    }

    #[test]
    fn ranges_of_ten_bytes() {
        let part = |start, length| Wanted::Part { start, length };
        for (range, expected) in [
            ("bytes=0-0", part(0, 1)),
            ("bytes=2-5", part(2, 4)),
            ("bytes=2-", part(2, 8)),
            ("bytes=2-99999999999999999999999", part(2, 8)),
            ("bytes=-3", part(7, 3)),
            ("bytes=-30", part(0, 10)),
            ("bytes=10-", Wanted::Outside),
            ("bytes=10-12", Wanted::Outside),
            ("bytes=99999999999999999999999-", Wanted::Outside),
            ("bytes=-0", Wanted::Outside),
            ("bytes=5-2", Wanted::Whole),
            ("bytes=0-1,4-5", Wanted::Whole),
            ("bytes=+1-2", Wanted::Whole),
            ("bytes=a-b", Wanted::Whole),
            ("bytes=-", Wanted::Whole),
            ("lines=1-2", Wanted::Whole),
        ] {
            assert_eq!(wanted(&headers(&[("range", range)]), "\"t\"", 10), expected, "{range}");
        }
    }

    #[test]
    fn a_range_of_an_older_content_is_not_taken() {
        let with =
            |tag| wanted(&headers(&[("range", "bytes=0-1"), ("if-range", tag)]), "\"t\"", 10);
        assert_eq!(with("\"t\""), Wanted::Part { start: 0, length: 2 });
        assert_eq!(with("\"old\""), Wanted::Whole);
        assert_eq!(with("W/\"t\""), Wanted::Whole, "weak tags do not serve for ranges");
    }

    #[test]
    fn a_head_has_no_ranges() {
        let part = headers(&[("range", "bytes=0-1")]);
        assert_eq!(super::wanted(&Method::HEAD, &part, "\"t\"", 10), Wanted::Whole);
    }

    #[test]
    fn another_state_than_the_one_that_is_meant_is_refused() {
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
