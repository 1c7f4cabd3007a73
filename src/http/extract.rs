//! Extractors whose refusals are problems.

use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts, Path, Query, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode, header};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Code, Result};
use crate::job::{InvalidField, Sha256};
use crate::store::{Inserted, RequestKey};

/// The service, and for whom a request to it is.
pub(super) struct Caller(pub(super) App, pub(super) Access);

impl FromRequestParts<App> for Caller {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self> {
        Ok(Self(app.clone(), Access::from_request_parts(parts, app).await?))
    }
}

/// The parameters in the path. What has not the form of an identifier names nothing: 404.
#[derive(Debug)]
pub(super) struct Params<T>(pub(super) T);

impl<T, S> FromRequestParts<S> for Params<T>
where
    T: DeserializeOwned + Send,
    S: Send + Sync,
{
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self> {
        match Path::<T>::from_request_parts(parts, state).await {
            Ok(Path(params)) => Ok(Self(params)),
            Err(PathRejection::FailedToDeserializePathParams(error)) => {
                Err(ApiError::new(Code::NotFound, error.body_text()))
            }
            Err(error) => Err(ApiError::internal(&error)),
        }
    }
}

/// The query parameters. Unknown ones are refused if `T` says so.
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
                Err(ApiError::new(Code::InvalidQuery, error.body_text()))
            }
            Err(error) => Err(ApiError::internal(&error)),
        }
    }
}

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
        let bytes = Bytes::from_request(request, state).await.map_err(unreadable)?;
        if bytes.is_empty() {
            return Err(ApiError::new(Code::EmptyBody, "a JSON object is needed as the body"));
        }
        parse(&bytes).map(Self)
    }
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
    let value = serde_path_to_error::deserialize(&mut deserializer).map_err(|error| {
        let pointer = pointer(error.path());
        let inner = error.into_inner();
        if inner.is_data() {
            ApiError::fields(
                Code::InvalidRequest,
                vec![InvalidField::new(pointer, inner.to_string())],
            )
        } else {
            ApiError::new(Code::MalformedJson, inner.to_string())
        }
    })?;
    deserializer.end().map_err(|error| ApiError::new(Code::MalformedJson, error.to_string()))?;
    Ok(value)
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

/// The key against making a thing twice that came with this request. The request is hashed as it was
/// understood, so that white space and the order of fields do not matter.
pub(super) fn request_key<T: Serialize>(
    headers: &HeaderMap,
    request: &T,
) -> Result<Option<RequestKey>> {
    let Some(key) = idempotency_key(headers)? else { return Ok(None) };
    let text = serde_json::to_vec(request).map_err(|error| ApiError::internal(&error))?;
    Ok(Some(RequestKey { key, request: Sha256::of(&text) }))
}

/// The status of an answer to a request that makes a thing, and the thing.
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
