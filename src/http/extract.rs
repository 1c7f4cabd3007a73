//! Extractors that reject requests with problem details, and parsers of request headers.

use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts, Path, Query, RawPathParams, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Code, Result};
use super::strict::Strict;
use engine::job::{InvalidField, Sha256};
use store::{Inserted, RequestKey};

/// The service, and the access that the request has.
pub(super) struct Caller(pub(super) App, pub(super) Access);

impl FromRequestParts<App> for Caller {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self> {
        Ok(Self(app.clone(), Access::from_request_parts(parts, app).await?))
    }
}

/// The parameters of the path. A malformed identifier is answered with 404, like an unknown one. So is a number with a sign
/// or leading zeros.
#[derive(Debug)]
pub(super) struct Params<T>(pub(super) T);

impl<T, S> FromRequestParts<S> for Params<T>
where
    T: DeserializeOwned + Send,
    S: Send + Sync,
{
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self> {
        let raw = RawPathParams::from_request_parts(parts, state).await;
        let raw = raw.map_err(|error| ApiError::new(Code::NotFound, error.body_text()))?;
        // Names of labs may look like numbers. Hashes are too long for one.
        let is_odd = |&(name, value): &(&str, &str)| {
            name != "lab" && value.parse::<u32>().is_ok() && canonical_number(value).is_none()
        };
        if let Some((name, value)) = raw.iter().find(is_odd) {
            let detail =
                format!("{name} is {value}: write the number without a sign and leading zeros");
            return Err(ApiError::new(Code::NotFound, detail));
        }
        match Path::<T>::from_request_parts(parts, state).await {
            Ok(Path(params)) => Ok(Self(params)),
            Err(PathRejection::FailedToDeserializePathParams(error)) => {
                Err(ApiError::new(Code::NotFound, error.body_text()))
            }
            Err(error) => Err(ApiError::internal(&error)),
        }
    }
}

/// The query parameters. Unknown parameters are rejected if `T` denies unknown fields.
#[derive(Debug)]
pub(super) struct QueryOf<T>(pub(super) T);

impl<T, S> FromRequestParts<S> for QueryOf<T>
where
    T: DeserializeOwned,
    S: Send + Sync,
{
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self> {
        match Query::<T>::from_request_parts(parts, state).await {
            Ok(Query(query)) => Ok(Self(query)),
            Err(QueryRejection::FailedToDeserializeQueryString(error)) => {
                let text = error.body_text();
                // The standard library's errors of numbers name neither a form nor a range.
                let number = [
                    "invalid digit found in string",
                    "number too large to fit in target type",
                    "cannot parse integer from empty string",
                ];
                let cause = number.iter().find_map(|cause| text.strip_suffix(cause));
                let text = cause
                    .map(|place| format!("{place}a whole number from 0 on is expected"))
                    .unwrap_or(text);
                Err(ApiError::new(Code::InvalidQuery, text))
            }
            Err(error) => Err(ApiError::internal(&error)),
        }
    }
}

/// A JSON body.
#[derive(Debug)]
pub(super) struct Body<T>(pub(super) T);

impl<T, S> FromRequest<S> for Body<T>
where
    T: DeserializeOwned,
    S: Send + Sync,
{
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self> {
        if !is_json(request.headers()) {
            let detail = "the body must be sent as Content-Type: application/json";
            return Err(ApiError::new(Code::UnsupportedMediaType, detail));
        }
        check_encoding(request.headers())?;
        let expected = content_digest(request.headers())?;
        let bytes = Bytes::from_request(request, state).await.map_err(unreadable)?;
        check_digest(expected, || Sha256::of(&bytes))?;
        if bytes.is_empty() {
            return Err(ApiError::new(Code::EmptyBody, "the body is empty; send a JSON object"));
        }
        parse(&bytes).map(Self)
    }
}

/// Rejects a compressed body. The service would store and hash the compressed bytes.
pub(super) fn check_encoding(headers: &HeaderMap) -> Result<()> {
    let encoding = headers.get_all(header::CONTENT_ENCODING).iter().find(|coding| {
        !coding.to_str().is_ok_and(|coding| coding.trim().eq_ignore_ascii_case("identity"))
    });
    let Some(encoding) = encoding else { return Ok(()) };
    let detail = format!(
        "Content-Encoding {encoding:?} is not supported: send the body without compression"
    );
    let identity = HeaderValue::from_static("identity");
    Err(ApiError::new(Code::UnsupportedMediaType, detail)
        .with_header(header::ACCEPT_ENCODING, identity))
}

/// The SHA-256 in `Content-Digest` (RFC 9530); `None` without this header. Further algorithms are ignored. A header without
/// SHA-256 is refused, because nothing would be checked.
pub(super) fn content_digest(headers: &HeaderMap) -> Result<Option<Sha256>> {
    let malformed = || {
        let detail = "Content-Digest must have a member sha-256=:DIGEST:, with 32 bytes in base64 between the colons";
        ApiError::new(Code::MalformedRequest, detail)
    };
    if !headers.contains_key("content-digest") {
        return Ok(None);
    }
    for value in headers.get_all("content-digest") {
        for member in value.to_str().map_err(|_| malformed())?.split(',') {
            let (name, digest) = member.trim().split_once('=').ok_or_else(malformed)?;
            if name != "sha-256" {
                continue;
            }
            let digest = digest.strip_prefix(':').and_then(|text| text.strip_suffix(':'));
            let bytes = digest.and_then(|text| STANDARD.decode(text).ok()).ok_or_else(malformed)?;
            return Ok(Some(Sha256::new(bytes.try_into().map_err(|_| malformed())?)));
        }
    }
    Err(malformed())
}

/// Rejects a body with another hash than `Content-Digest` states.
pub(super) fn check_digest(expected: Option<Sha256>, hash: impl FnOnce() -> Sha256) -> Result<()> {
    let Some(expected) = expected else { return Ok(()) };
    let actual = hash();
    if actual == expected {
        return Ok(());
    }
    let detail = format!(
        "Content-Digest states the SHA-256 {expected}, but the received bytes have {actual}"
    );
    Err(ApiError::new(Code::HashMismatch, detail))
}

fn is_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let essence = kind.and_then(|kind| kind.split(';').next()).map(str::trim);
    essence.is_some_and(|essence| essence.eq_ignore_ascii_case("application/json"))
}

fn unreadable(error: BytesRejection) -> ApiError {
    if error.status() == StatusCode::PAYLOAD_TOO_LARGE {
        return ApiError::new(Code::TooLarge, "a JSON body must be smaller than 256 KiB");
    }
    ApiError::new(Code::MalformedRequest, error.body_text())
}

fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T> {
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(Strict(&mut deserializer)).map_err(|error| {
        let pointer = pointer(error.path());
        let inner = error.into_inner();
        if inner.is_data() {
            ApiError::fields(
                Code::InvalidRequest,
                vec![InvalidField::new(pointer, without_position(&inner))],
            )
        } else {
            ApiError::new(Code::MalformedJson, inner.to_string())
        }
    })?;
    deserializer.end().map_err(|error| ApiError::new(Code::MalformedJson, error.to_string()))?;
    Ok(value)
}

/// The message of an error in a field. The pointer names the place, so the line and the column are left out.
fn without_position(error: &serde_json::Error) -> String {
    let text = error.to_string();
    let position = format!(" at line {} column {}", error.line(), error.column());
    text.strip_suffix(&position).map(str::to_owned).unwrap_or(text)
}

fn pointer(path: &serde_path_to_error::Path) -> String {
    use serde_path_to_error::Segment;
    let mut pointer = String::new();
    for segment in path {
        let text = match segment {
            Segment::Seq { index } => index.to_string(),
            Segment::Map { key } => key.replace('~', "~0").replace('/', "~1"),
            Segment::Enum { .. } | Segment::Unknown => continue,
        };
        pointer.push('/');
        pointer.push_str(&text);
    }
    pointer
}

/// The `Idempotency-Key` of a request, with a hash of the parsed request. White space and the order of fields do not
/// change the hash.
pub(super) fn request_key<T: Serialize>(
    headers: &HeaderMap,
    request: &T,
) -> Result<Option<RequestKey>> {
    hashed_key(idempotency_key(headers)?, request)
}

/// An idempotency key with the hash of its request.
pub(super) fn hashed_key<T: Serialize>(
    key: Option<String>,
    request: &T,
) -> Result<Option<RequestKey>> {
    let Some(key) = key else { return Ok(None) };
    let text = serde_json::to_vec(request).map_err(|error| ApiError::internal(&error))?;
    Ok(Some(RequestKey { key, request: Sha256::of(&text) }))
}

/// Parses a decimal number without sign and leading zeros, so that each file and picture has a single address.
pub(super) fn canonical_number(text: &str) -> Option<usize> {
    text.parse().ok().filter(|number: &usize| number.to_string() == text)
}

/// The status and the identifier in the answer to a request that creates something.
pub(super) fn created<Id>(inserted: Inserted<Id>) -> (StatusCode, Id) {
    match inserted {
        Inserted::New(id) => (StatusCode::CREATED, id),
        Inserted::Before(id) => (StatusCode::OK, id),
    }
}

pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    match value.to_str() {
        Ok(key) if (1..=255).contains(&key.len()) => Ok(Some(key.to_owned())),
        _ => {
            let detail = "Idempotency-Key must have 1 to 255 printable ASCII characters";
            Err(ApiError::new(Code::MalformedRequest, detail))
        }
    }
}

#[cfg(test)]
mod tests {
    use engine::job::CalibrationRequest;

    use super::{Code, parse};

    #[test]
    fn arrays_of_a_wrong_length_are_invalid_fields() {
        let masks = "0".repeat(64);
        for frames in ["[0,1,2]", "[0]", "[]", "[0,1,[2]]", "[0,-1]", "7"] {
            let body = format!(r#"{{"masks":"{masks}","frames":{frames}}}"#);
            let error = parse::<CalibrationRequest>(body.as_bytes()).unwrap_err();
            assert_eq!(error.code(), Code::InvalidRequest, "{frames}");
            let problem = serde_json::to_value(error.problem()).unwrap();
            let pointer = problem["pointer"].as_str().unwrap();
            assert!(pointer.starts_with("/frames"), "{frames}: {pointer}");
        }
        let cut = parse::<CalibrationRequest>(br#"{"frames":[0,1"#).unwrap_err();
        assert_eq!(cut.code(), Code::MalformedJson);
    }
}
