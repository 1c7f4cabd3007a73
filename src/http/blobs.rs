//! `/v1/blobs`: files by the SHA-256 of their bytes.

use std::str::FromStr;

use axum::Json;
use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use headers::{ContentLength, HeaderMapExt};
use serde::Deserialize;
use serde_with::DeserializeFromStr;

use super::access::Access;
use super::admission::Reservation;
use super::app::App;
use super::download::Download;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf, check_digest, check_encoding, content_digest};
use super::page::{Limit, PageBody};
use super::shares::Place;
use super::upload;
use engine::job::{Sha256, Timestamp};
use store::{Blob, BlobRow, StagedBlob};

/// `POST /v1/blobs`: the file as the raw body, or as the field `file` of a form.
pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    request: Request,
) -> Result<Response> {
    let (_slot, room) = match begin(&app, &access, &headers).await {
        Ok(begun) => begun,
        Err(refusal) => return Err(refuse(refusal, &headers, request.into_body()).await),
    };
    let staged = if is_form(&headers) {
        // The digest is that of the form, not of the file.
        receive_form(&app, room, request).await?
    } else {
        let staged = upload::receive(&app, room, request.into_body().into_data_stream()).await?;
        check_digest(content_digest(&headers)?, || staged.sha256())?;
        staged
    };
    store(&app, &access, staged).await
}

/// `PUT /v1/blobs/{sha256}`: the raw body, which must have this hash.
pub(super) async fn put(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response> {
    let (_slot, room) = match begin(&app, &access, &headers).await {
        Ok(begun) => begun,
        Err(refusal) => return Err(refuse(refusal, &headers, body).await),
    };
    let staged = upload::receive(&app, room, body.into_data_stream()).await?;
    check_digest(content_digest(&headers)?, || staged.sha256())?;
    if staged.sha256() != sha256 {
        let detail = format!("the address says {sha256}, the bytes have {}", staged.sha256());
        return Err(ApiError::new(Code::HashMismatch, detail));
    }
    store(&app, &access, staged).await
}

/// `GET /v1/blobs/{sha256}`: whether the file is there, and its size.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
) -> Result<Json<Blob>> {
    Ok(Json(app.store.upload(&access.lab, sha256).await?))
}

/// Where a list goes on: behind an upload of this time and hash. Opaque for clients.
#[derive(Debug, DeserializeFromStr)]
pub(super) struct BlobCursor(Timestamp, Sha256);

impl FromStr for BlobCursor {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let parts = text.split_once('-');
        let parts = parts.and_then(|(time, hash)| Some((time.parse().ok()?, hash.parse().ok()?)));
        let (time, hash) = parts.ok_or("the cursor is none of this list")?;
        Ok(Self(Timestamp(time), hash))
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<BlobCursor>,
}

/// `GET /v1/blobs`: the lab's files, newest first.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
) -> Result<Json<PageBody<BlobRow>>> {
    let after = query.cursor.map(|BlobCursor(time, sha256)| (time, sha256));
    let page = app.store.uploads(&access.lab, after, query.limit.get()).await?;
    let cursor = |row: &BlobRow| format!("{}-{}", row.blob.created_at.0, row.blob.sha256);
    Ok(Json(PageBody::new(page, cursor, |row| row)))
}

/// `GET /v1/blobs/{sha256}/content`: the bytes as they were sent, for the lab that sent them. No browser
/// shows them, whatever they are.
pub(super) async fn content(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let blob = app.store.upload(&access.lab, sha256).await?;
    let download = Download {
        sha256,
        size: blob.size,
        kind: "application/octet-stream",
        disposition: format!("attachment; filename=\"{sha256}.bin\""),
        in_parts: true,
    };
    let open = app.store.open_blob(sha256);
    let mut response = download.send(open, (&method, &headers)).await?;
    let fields = response.headers_mut();
    fields.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    fields.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static("sandbox"));
    Ok(response)
}

/// `DELETE /v1/blobs/{sha256}`.
pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
) -> Result<StatusCode> {
    app.store.delete_upload(&access.lab, sha256).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Takes one of the places for uploads and reserves room on the disk; refuses an upload that says by
/// its length that it can't be taken, before its first byte.
async fn begin(app: &App, access: &Access, headers: &HeaderMap) -> Result<(Place, Reservation)> {
    check_encoding(headers)?;
    content_digest(headers)?;
    let slot = app.admission.place(&access.lab)?;
    let length = headers.typed_get::<ContentLength>().map_or(0, |length| length.0);
    app.admission.check_length(access, length).await?;
    Ok((slot, app.admission.reserve(&access.lab, length).await?))
}

/// Lets the client come to the end of a small body, so that it gets to see the refusal.
async fn refuse(refusal: ApiError, headers: &HeaderMap, body: Body) -> ApiError {
    // A client that waits for leave to send has none.
    if !headers.contains_key(header::EXPECT) {
        upload::drain(&mut body.into_data_stream()).await;
    }
    refusal
}

fn is_form(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    kind.is_some_and(|kind| kind.trim_start().to_ascii_lowercase().starts_with("multipart/"))
}

async fn receive_form(app: &App, room: Reservation, request: Request) -> Result<StagedBlob> {
    let malformed = |text: String| ApiError::new(Code::MalformedRequest, text);
    let mut form = Multipart::from_request(request, app)
        .await
        .map_err(|error| malformed(error.body_text()))?;
    while let Some(field) = form.next_field().await.map_err(|error| malformed(error.body_text()))? {
        if field.name() == Some("file") {
            return upload::receive(app, room, field).await;
        }
    }
    Err(malformed("the form has no field named file".into()))
}

async fn store(app: &App, access: &Access, staged: StagedBlob) -> Result<Response> {
    let (blob, new) = app.store.store_upload(&access.lab, access.token, staged).await?;
    let status = if new { StatusCode::CREATED } else { StatusCode::OK };
    let location = [(header::LOCATION, format!("/v1/blobs/{}", blob.sha256))];
    Ok((status, location, Json(blob)).into_response())
}
