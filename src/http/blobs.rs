//! `/v1/blobs`: uploaded files, each addressed by its SHA-256.

use std::str::FromStr;

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use headers::{ContentLength, HeaderMapExt};

use super::access::Access;
use super::admission::Reservation;
use super::app::App;
use super::context::{RequestContext, changed};
use super::download::Download;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf, check_digest, check_encoding, content_digest};
use super::page::{Cursor, PageBody, PageQuery};
use super::shares;
use super::upload;
use engine::job::{Lab, Sha256, Timestamp};
use store::{Blob, BlobRow, StagedBlob};

/// `POST /v1/blobs`: stores a file, sent as the raw body or as the field `file` of a form.
pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    request: Request,
) -> Result<Response> {
    let (_slot, room) = match begin(&app, &access, &headers).await {
        Ok(reserved) => reserved,
        Err(error) => return Err(reject(error, &headers, request.into_body()).await),
    };
    let staged = if is_form(&headers) {
        // `Content-Digest` has the digest of the form and not of the file.
        receive_form(&app, room, request).await?
    } else {
        let staged = upload::receive(&app, room, request.into_body().into_data_stream()).await?;
        check_digest(content_digest(&headers)?, || staged.sha256())?;
        staged
    };
    store(&app, &access, staged).await
}

/// `GET /v1/blobs/{sha256}`: the size of the file, or 404 if the lab has not uploaded it.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
    request: RequestContext,
) -> Result<Response> {
    request.json(&body(&app, &access, sha256).await?)
}

async fn body(app: &App, access: &Access, sha256: Sha256) -> Result<Blob> {
    Ok(app.store.upload(&access.lab, sha256).await?)
}

/// Position in the list of uploads: time and hash of an upload.
#[derive(Debug)]
pub(super) struct Position(Timestamp, Sha256);

impl FromStr for Position {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (time, hash) = text.split_once('-').ok_or(())?;
        Ok(Self(Timestamp(time.parse().map_err(|_| ())?), hash.parse().map_err(|_| ())?))
    }
}

/// `GET /v1/blobs`: the lab's files, newest first.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<PageQuery<Position>>,
    request: RequestContext,
) -> Result<Response> {
    let after = query.cursor.map(|Cursor(Position(time, sha256))| (time, sha256));
    let page = app.store.uploads(&access.lab, after, query.limit.get()).await?;
    let cursor = |row: &BlobRow| format!("{}-{}", row.blob.created_at.0, row.blob.sha256);
    PageBody::new(page, cursor, |row| row).answer(&request)
}

/// `GET /v1/blobs/{sha256}/content`: the bytes of an upload, for the lab that uploaded it. The headers keep browsers from
/// displaying the file or running scripts in it.
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
        accepts_ranges: true,
    };
    let open = app.store.open_blob(sha256);
    let mut response = download.send(open, (&method, &headers)).await?;
    let fields = response.headers_mut();
    fields.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static("sandbox"));
    Ok(response)
}

/// `DELETE /v1/blobs/{sha256}`.
pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(sha256): Params<Sha256>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access, sha256)).await?;
    app.store.delete_upload(&access.lab, sha256).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Takes one of the places for uploads, and reserves disk space. Rejects an upload with a `Content-Length` above the limits
/// before its first byte is read.
async fn begin(
    app: &App,
    access: &Access,
    headers: &HeaderMap,
) -> Result<(shares::Place<Lab>, Reservation)> {
    check_encoding(headers)?;
    check_whole(headers)?;
    content_digest(headers)?;
    let slot = app.admission.place(&access.lab)?;
    let length = headers.typed_get::<ContentLength>().map_or(0, |length| length.0);
    app.admission.check_length(access, length).await?;
    Ok((slot, app.admission.reserve(&access.lab, length).await?))
}

/// Refuses a part of a file, which would be stored as a file (RFC 9110, 14.5).
fn check_whole(headers: &HeaderMap) -> Result<()> {
    if !headers.contains_key(header::CONTENT_RANGE) {
        return Ok(());
    }
    let detail = "Content-Range announces a part of a file, but this request stores its body as a whole file; send the \
                  whole file, or send it in pieces to /v1/uploads";
    Err(ApiError::new(Code::MalformedRequest, detail))
}

/// Reads the rest of a small body before the error is sent. Some clients read the answer only after they sent the body.
async fn reject(error: ApiError, headers: &HeaderMap, body: Body) -> ApiError {
    // With `Expect: 100-continue` the client has not sent the body yet.
    if !headers.contains_key(header::EXPECT) {
        upload::drain(&mut body.into_data_stream()).await;
    }
    error
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
    Err(malformed("the form has no field named file: send the file in that field".into()))
}

async fn store(app: &App, access: &Access, staged: StagedBlob) -> Result<Response> {
    let (blob, new) = app.store.store_upload(&access.lab, access.token, staged).await?;
    let status = if new { StatusCode::CREATED } else { StatusCode::OK };
    let location = [(header::LOCATION, format!("/v1/blobs/{}", blob.sha256))];
    Ok((location, changed(status, &blob)?).into_response())
}
