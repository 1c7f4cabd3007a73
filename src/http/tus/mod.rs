//! `/v1/uploads`: resumable uploads by tus 1.0 (core, creation, deferred length, checksum, expiration, termination).
//!
//! The crate `tus-protocol` 0.1 leaves storage, state, locks and hooks to its caller, and these are most of the code
//! below. The protocol alone is four handlers, so the crate is not used.

mod append;
pub mod headers;

use axum::body::Body;
use axum::extract::{OriginalUri, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::access::Access;
use super::app::App;
use super::conditional;
use super::context::RequestContext;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf, check_encoding, content_digest, request_key};
use super::listen::Cut;
use super::page::{Cursor, PageBody, PageQuery};
use engine::job::{Lab, PartialId, Sha256, Timestamp};
use store::{FIRST_RESERVE, FoundPartial, NewPartial, Partial, PartialFile, ResourceKind};

const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
const LENGTH: HeaderName = HeaderName::from_static("upload-length");
const DEFER_LENGTH: HeaderName = HeaderName::from_static("upload-defer-length");
const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
const METADATA: HeaderName = HeaderName::from_static("upload-metadata");
const CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");
const EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
/// Supported extensions of the protocol.
const EXTENSIONS: &str = "creation,creation-defer-length,checksum,expiration,termination";
const VERSION: HeaderValue = HeaderValue::from_static("1.0.0");

/// Rewrites a request by the rules of tus. `X-HTTP-Method-Override` replaces the method, whatever that is. The trailing
/// slash of `/v1/uploads/` is removed.
pub(super) fn rewrite(mut request: Request) -> Request {
    let path = request.uri().path();
    if path != "/v1/uploads" && !path.starts_with("/v1/uploads/") {
        return request;
    }
    if path == "/v1/uploads/" {
        let query = request.uri().query().map_or(String::new(), |query| format!("?{query}"));
        if let Ok(uri) = format!("/v1/uploads{query}").parse() {
            let original = std::mem::replace(request.uri_mut(), uri);
            request.extensions_mut().insert(OriginalUri(original));
        }
    }
    let name = request.headers().get("x-http-method-override");
    if let Some(Ok(method)) = name.map(|name| Method::from_bytes(name.as_bytes())) {
        *request.method_mut() = method;
    }
    request
}

/// Rejects requests of other versions than 1.0.0, and adds the version to every answer.
pub(super) async fn version(request: Request, next: Next) -> Response {
    let requested = request.headers().get(&RESUMABLE);
    // GET lists uploads and is no part of tus; OPTIONS is how a client learns the version.
    let is_exempt = matches!(*request.method(), Method::OPTIONS | Method::GET);
    let mut response = if requested == Some(&VERSION) || is_exempt {
        next.run(request).await
    } else {
        let detail = "the header Tus-Resumable must be 1.0.0";
        ApiError::new(Code::TusVersion, detail)
            .with_header(HeaderName::from_static("tus-version"), VERSION)
            .into_response()
    };
    response.headers_mut().insert(RESUMABLE, VERSION);
    response
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Upload")]
pub(super) struct UploadBody {
    id: PartialId,
    /// Bytes of the whole file; null until the client states them.
    length: Option<u64>,
    /// Bytes received so far.
    received: u64,
    /// `Upload-Metadata` as the client sent it.
    metadata: String,
    /// The blob that the upload has become; null until it is complete.
    sha256: Option<Sha256>,
    expires_at: Timestamp,
}

impl From<Partial> for UploadBody {
    fn from(upload: Partial) -> Self {
        Self {
            id: upload.id,
            length: upload.facts.length,
            received: upload.received,
            metadata: upload.facts.metadata,
            sha256: upload.result,
            expires_at: upload.expires_at,
        }
    }
}

async fn current(app: &App, lab: &Lab, id: PartialId) -> Result<UploadBody> {
    Ok(app.store.partial(lab, id).await?.into())
}

/// `GET /v1/uploads`: the lab's uploads, newest first.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<PageQuery<PartialId>>,
    request: RequestContext,
) -> Result<Response> {
    let after = query.cursor.map(|Cursor(id)| id);
    let page = app.store.partials(&access.lab, after, query.limit.get()).await?;
    PageBody::new(page, |upload: &Partial| upload.id.to_string(), UploadBody::from).answer(&request)
}

/// `OPTIONS /v1/uploads`: the supported version, extensions, checksums and size.
pub(super) async fn options(State(app): State<App>) -> Response {
    let fields = [
        ("tus-version", "1.0.0".to_owned()),
        ("tus-extension", EXTENSIONS.to_owned()),
        ("tus-checksum-algorithm", headers::ALGORITHMS.to_owned()),
        ("tus-max-size", app.settings.max_upload_bytes.to_string()),
    ];
    (StatusCode::NO_CONTENT, fields).into_response()
}

/// `POST /v1/uploads`: creates an upload.
pub(super) async fn create(Caller(app, access): Caller, headers: HeaderMap) -> Result<Response> {
    if headers.contains_key("upload-concat") {
        let detail = "uploads are not concatenated: send the file as one upload (parallelUploads: 1 in tus-js-client)";
        return Err(malformed(detail.into()));
    }
    let length = announced_length(&headers)?;
    let metadata = text(&headers, &METADATA)?.unwrap_or_default();
    let expected = expected_sha256(metadata).map_err(malformed)?;
    let key = request_key(&headers, &(length, metadata))?;
    if let Some(id) =
        app.store.created_with(&access.lab, ResourceKind::Upload, key.as_ref()).await?
    {
        return created(&app, &access.lab, id).await;
    }
    app.admission.check_length(&access, length.unwrap_or(1)).await?;
    let Access { lab, token, .. } = access;
    let facts =
        NewPartial { lab: lab.clone(), token, length, metadata: metadata.to_owned(), expected };
    // The reservation is extended while the upload grows.
    let first = length.unwrap_or(FIRST_RESERVE).min(FIRST_RESERVE);
    let insert = app.store.begin_partial(facts, app.settings.upload_age(), key.as_ref());
    let inserted = app.admission.with_room(&lab, "the upload", first, insert).await?;
    created(&app, &lab, inserted.id()).await
}

/// The length that a new upload states; `None` if a later piece states it.
fn announced_length(headers: &HeaderMap) -> Result<Option<u64>> {
    match text(headers, &DEFER_LENGTH)? {
        None => stated_length(headers).map(Some),
        Some("1") if !headers.contains_key(&LENGTH) => Ok(None),
        Some(_) => {
            let detail = "Upload-Defer-Length must be 1, and stands in place of Upload-Length";
            Err(malformed(detail.into()))
        }
    }
}

/// `Upload-Length`, which is at least 1.
fn stated_length(headers: &HeaderMap) -> Result<u64> {
    match number(headers, &LENGTH)? {
        0 => Err(ApiError::new(Code::EmptyBody, "the upload has no bytes")),
        length => Ok(length),
    }
}

/// The answer to a request that created an upload, with the address for its pieces. A repeated request with the same
/// key also gets 201, because clients of tus accept no other status.
async fn created(app: &App, lab: &Lab, id: PartialId) -> Result<Response> {
    let upload = app.store.partial(lab, id).await?;
    let location = [(header::LOCATION, format!("/v1/uploads/{}", upload.id))];
    Ok((StatusCode::CREATED, location, state_headers(&upload)).into_response())
}

/// The hash of the whole file, if the metadata have the key `sha256`.
fn expected_sha256(metadata: &str) -> Result<Option<Sha256>, String> {
    let pairs = headers::metadata(metadata)?;
    let Some((_, value)) = pairs.into_iter().find(|(name, _)| *name == "sha256") else {
        return Ok(None);
    };
    let text = String::from_utf8(value).map_err(|_| "sha256 in Upload-Metadata is not text")?;
    text.parse().map(Some).map_err(|error: engine::job::InvalidText| error.to_string())
}

/// `HEAD /v1/uploads/{upload}`: the number of bytes received.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
) -> Result<Response> {
    let mut upload = app.store.partial(&access.lab, id).await?;
    // If the connection broke after the last byte, the upload is finished here. If the file is shorter than the offset,
    // opening it fails with an error for the client.
    if upload.result.is_none()
        && (upload.is_complete() || app.store.partial_bytes(id).await? < upload.received)
    {
        upload = run_detached(async move {
            match app.store.open_partial(&access.lab, id).await? {
                FoundPartial::Open(file) => finish(&app, file).await,
                FoundPartial::Stored(stored) => Ok(stored),
                FoundPartial::Busy => Ok(upload),
            }
        })
        .await?;
    }
    let length = match upload.facts.length {
        Some(length) => (LENGTH, length.to_string()),
        None => (DEFER_LENGTH, "1".to_owned()),
    };
    let facts = [length, (METADATA, upload.facts.metadata.clone())];
    let facts = facts.into_iter().filter(|(_, value)| !value.is_empty());
    let cache = [(header::CACHE_CONTROL, "no-store")];
    let etag = [(header::ETAG, conditional::etag_of(&UploadBody::from(upload.clone()))?)];
    Ok((
        cache,
        etag,
        state_headers(&upload),
        axum::response::AppendHeaders(facts.collect::<Vec<_>>()),
    )
        .into_response())
}

/// `PATCH /v1/uploads/{upload}`: appends a piece.
pub(super) async fn patch(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
    headers: HeaderMap,
    request: RequestContext,
    body: Body,
) -> Result<Response> {
    drop(app.precondition(&request, &access.lab, current(&app, &access.lab, id)).await?);
    let permit = app.admission.place(&access.lab)?;
    let upload = run_detached(async move {
        let _permit = permit;
        receive_piece(&app, &access, id, &headers, body).await
    });
    match upload.await {
        Ok(upload) => Ok((StatusCode::NO_CONTENT, state_headers(&upload)).into_response()),
        // Clients of tus resume after a closed connection, but give up after status 408.
        Err(error) if error.code() == Code::UploadStalled => {
            let mut response = error.into_response();
            response.extensions_mut().insert(Cut);
            Ok(response)
        }
        Err(error) => Err(error),
    }
}

/// Runs the work as a separate task, which completes even if the client disconnects.
async fn run_detached<T: Send + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<T> {
    tokio::spawn(work).await.map_err(|error| ApiError::internal(&error))?
}

async fn receive_piece(
    app: &App,
    access: &Access,
    id: PartialId,
    headers: &HeaderMap,
    body: Body,
) -> Result<Partial> {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
    if kind != Some("application/offset+octet-stream") {
        let detail = "a piece must be sent as Content-Type: application/offset+octet-stream";
        return Err(ApiError::new(Code::UnsupportedMediaType, detail));
    }
    check_encoding(headers)?;
    let offset = number(headers, &OFFSET)?;
    let stated = headers.contains_key(&LENGTH).then(|| stated_length(headers)).transpose()?;
    let checksum = text(headers, &CHECKSUM)?.map(headers::Checksum::parse).transpose();
    let mut checksum = checksum.map_err(malformed)?;
    if checksum.is_none() {
        checksum = content_digest(headers)?.map(headers::Checksum::sha256);
    }
    let (upload, file) = match app.store.open_partial(&access.lab, id).await? {
        FoundPartial::Open(file) => (file.upload().clone(), Some(file)),
        FoundPartial::Stored(upload) => (upload, None),
        FoundPartial::Busy => return Err(busy()),
    };
    if offset != upload.received {
        let detail = format!(
            "Upload-Offset is {offset}, but {0} bytes were received: continue at offset {0}",
            upload.received
        );
        return Err(ApiError::new(Code::OffsetMismatch, detail));
    }
    if let Some(stated) = stated {
        check_length(&upload, stated)?;
    }
    let Some(mut file) = file else {
        append::expect_no_bytes(app, upload.received, body).await?;
        return Ok(upload);
    };
    if let (Some(stated), None) = (stated, upload.facts.length) {
        app.admission.check_size(stated)?;
        app.store.set_partial_length(&mut file, stated).await?;
    }
    // Without Content-Length, space is reserved while the bytes arrive.
    let length = text(headers, &header::CONTENT_LENGTH)?.and_then(|text| text.parse().ok());
    let length: u64 = length.unwrap_or_default();
    let most = file.upload().facts.length.unwrap_or(app.settings.max_upload_bytes);
    let length = length.min(most.saturating_sub(upload.received));
    let room = app.admission.reserve(&access.lab, length).await?;
    let file = append::append(app, file, room, checksum, body).await?;
    finish(app, file).await
}

/// Checks the length that a piece states: a known one can't change, and no received byte can be taken back.
fn check_length(upload: &Partial, stated: u64) -> Result<()> {
    let received = upload.received;
    match upload.facts.length {
        Some(length) if length != stated => Err(malformed(format!(
            "Upload-Length is {stated}, but the upload has {length} bytes, which can't change"
        ))),
        None if stated < received => {
            Err(malformed(format!("Upload-Length is {stated}, but {received} bytes were received")))
        }
        _ => Ok(()),
    }
}

/// Stores the file if it is complete.
async fn finish(app: &App, file: PartialFile) -> Result<Partial> {
    if file.is_complete() {
        return Ok(app.store.finish_partial(file).await?);
    }
    Ok(file.upload().clone())
}

/// `DELETE /v1/uploads/{upload}`: ends the upload and deletes the received bytes.
pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard = app.precondition(&request, &access.lab, current(&app, &access.lab, id)).await?;
    app.store.partial(&access.lab, id).await?;
    let store = app.store.clone();
    let deleted = run_detached(async move { Ok(store.delete_partial(id).await?) });
    if deleted.await? { Ok(StatusCode::NO_CONTENT) } else { Err(busy()) }
}

/// Headers with the offset, the time of expiry, and the blob of a finished upload.
fn state_headers(upload: &Partial) -> HeaderMap {
    let mut fields = HeaderMap::new();
    fields.insert(OFFSET, upload.received.into());
    if let Ok(expires) = HeaderValue::try_from(upload.expires_at.http_date()) {
        fields.insert(EXPIRES, expires);
    }
    if let Some(Ok(address)) =
        upload.result.map(|sha256| HeaderValue::try_from(format!("/v1/blobs/{sha256}")))
    {
        fields.insert(header::CONTENT_LOCATION, address);
    }
    fields
}

fn text<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Result<Option<&'a str>> {
    let value = headers.get(name).map(HeaderValue::to_str).transpose();
    value.map_err(|_| malformed(format!("{name} is not printable ASCII")))
}

fn number(headers: &HeaderMap, name: &HeaderName) -> Result<u64> {
    let digits = |text: &&str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let number = text(headers, name)?.filter(digits).and_then(|text| text.parse().ok());
    // SQLite stores signed numbers.
    number
        .filter(|number| i64::try_from(*number).is_ok())
        .ok_or_else(|| malformed(format!("the header {name} must be a number of bytes")))
}

fn malformed(detail: String) -> ApiError {
    ApiError::new(Code::MalformedRequest, detail)
}

fn busy() -> ApiError {
    ApiError::new(Code::UploadBusy, "another request is writing to this upload")
}
