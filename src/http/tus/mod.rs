//! `/v1/uploads`: uploads in pieces, by tus 1.0 (core, creation, checksum, expiration, termination).
//!
//! `tus-protocol` 0.1 leaves storage, state, locks and hooks to the caller. Here the offset, the quotas and the
//! disk reservation share one database, so all four would be this code again; the protocol is four handlers.

mod append;
pub mod headers;

use axum::body::Body;
use axum::extract::{OriginalUri, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::access::Access;
use super::app::App;
use super::conditional;
use super::context::RequestContext;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params, QueryOf, check_encoding, content_digest, request_key};
use super::listen::Cut;
use super::page::{Cursor, Limit, PageBody};
use engine::job::{Lab, PartialId, Sha256, Timestamp};
use store::{FIRST_RESERVE, FoundPartial, Inserted, Made, NewPartial, Partial, PartialFile};

const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
const LENGTH: HeaderName = HeaderName::from_static("upload-length");
const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
const METADATA: HeaderName = HeaderName::from_static("upload-metadata");
const CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");
const EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
const VERSION: HeaderValue = HeaderValue::from_static("1.0.0");

/// Rewrites a request by the rules of tus. `X-HTTP-Method-Override` replaces the method, for clients that can send only
/// POST. A trailing slash of the address of all uploads is ignored.
pub(super) fn rewrite(mut request: Request) -> Request {
    let path = request.uri().path();
    if path == "/v1/uploads/" {
        let query = request.uri().query().map_or(String::new(), |query| format!("?{query}"));
        if let Ok(uri) = format!("/v1/uploads{query}").parse() {
            let original = std::mem::replace(request.uri_mut(), uri);
            request.extensions_mut().insert(OriginalUri(original));
        }
    } else if path.starts_with("/v1/uploads/") && *request.method() == Method::POST {
        let meant = request.headers().get("x-http-method-override");
        let meant = meant.and_then(|name| Method::from_bytes(name.as_bytes()).ok());
        *request.method_mut() = meant.unwrap_or(Method::POST);
    }
    request
}

/// Speaks version 1.0.0 alone, and says so in every answer.
pub(super) async fn version(request: Request, next: Next) -> Response {
    let spoken = request.headers().get(&RESUMABLE);
    // The list of uploads is none of tus.
    let is_free = matches!(*request.method(), Method::OPTIONS | Method::GET);
    let mut response = if spoken == Some(&VERSION) || is_free {
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

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<Cursor<PartialId>>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Upload")]
pub(super) struct UploadBody {
    id: PartialId,
    /// Bytes of the whole file.
    length: u64,
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

/// `GET /v1/uploads`: those that have begun, newest first.
pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    request: RequestContext,
) -> Result<Response> {
    let after = query.cursor.map(|Cursor(id)| id);
    let page = app.store.partials(&access.lab, after, query.limit.get()).await?;
    PageBody::new(page, |upload: &Partial| upload.id.to_string(), UploadBody::from).answer(&request)
}

/// `OPTIONS /v1/uploads`: what this service can do.
pub(super) async fn options(State(app): State<App>) -> Response {
    let fields = [
        ("tus-version", "1.0.0".to_owned()),
        ("tus-extension", "creation,checksum,expiration,termination".to_owned()),
        ("tus-checksum-algorithm", headers::ALGORITHMS.to_owned()),
        ("tus-max-size", app.settings.max_upload_bytes.to_string()),
    ];
    (StatusCode::NO_CONTENT, fields).into_response()
}

/// `POST /v1/uploads`: begins an upload.
pub(super) async fn create(Caller(app, access): Caller, headers: HeaderMap) -> Result<Response> {
    if headers.contains_key("upload-concat") {
        let detail = "uploads are not concatenated: send the file as one upload (parallelUploads: 1 in tus-js-client)";
        return Err(malformed(detail.into()));
    }
    if headers.contains_key("upload-defer-length") {
        let detail = "an upload states its length when it is created: send Upload-Length in place of \
                      Upload-Defer-Length";
        return Err(malformed(detail.into()));
    }
    let length = number(&headers, &LENGTH)?;
    if length == 0 {
        return Err(ApiError::new(Code::EmptyBody, "the upload has no bytes"));
    }
    let metadata = text(&headers, &METADATA)?.unwrap_or_default();
    let expected = expected(metadata).map_err(malformed)?;
    let key = request_key(&headers, &(length, metadata))?;
    if let Some(id) = app.store.made_with(&access.lab, Made::Upload, key.as_ref()).await? {
        return begun(&app, &access.lab, Inserted::Before(id)).await;
    }
    app.admission.check_length(&access, length).await?;
    let Access { lab, token, .. } = access;
    let facts =
        NewPartial { lab: lab.clone(), token, length, metadata: metadata.to_owned(), expected };
    // More is reserved as it grows.
    let first = length.min(FIRST_RESERVE);
    let begin = app.store.begin_partial(facts, app.settings.upload_age(), key.as_ref());
    let inserted = app.admission.with_room(&lab, ("the upload", first), begin).await?;
    begun(&app, &lab, inserted).await
}

/// The answer to a request that has begun an upload, or had begun it before: where its pieces go. It is
/// 201 in any case, which is what clients of tus expect.
async fn begun(app: &App, lab: &Lab, inserted: Inserted<PartialId>) -> Result<Response> {
    let upload = app.store.partial(lab, inserted.id()).await?;
    let location = [(header::LOCATION, format!("/v1/uploads/{}", upload.id))];
    Ok((StatusCode::CREATED, location, state(&upload)).into_response())
}

/// The hash of the whole file, if the metadata name it.
fn expected(metadata: &str) -> Result<Option<Sha256>, String> {
    let pairs = headers::metadata(metadata)?;
    let Some((_, value)) = pairs.into_iter().find(|(name, _)| *name == "sha256") else {
        return Ok(None);
    };
    let text = String::from_utf8(value).map_err(|_| "the metadata's sha256 is no text")?;
    text.parse().map(Some).map_err(|error: engine::job::InvalidText| error.to_string())
}

/// `HEAD /v1/uploads/{upload}`: how far it is.
pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
) -> Result<Response> {
    let mut upload = app.store.partial(&access.lab, id).await?;
    // All has come, but not the end of its request; or bytes on record are lost, which is told here.
    if upload.result.is_none()
        && (upload.received == upload.facts.length
            || app.store.partial_bytes(id).await? < upload.received)
    {
        upload = to_the_end(async move {
            match app.store.open_partial(&access.lab, id).await? {
                FoundPartial::Open(file) => finish(&app, file).await,
                FoundPartial::Stored(upload) => Ok(upload),
                FoundPartial::Busy => Ok(upload),
            }
        })
        .await?;
    }
    let length = upload.facts.length.to_string();
    let about = [(LENGTH, length), (METADATA, upload.facts.metadata.clone())];
    let about = about.into_iter().filter(|(_, value)| !value.is_empty());
    let cache = [(header::CACHE_CONTROL, "no-store")];
    let etag = [(header::ETAG, conditional::etag_of(&UploadBody::from(upload.clone()))?)];
    Ok((cache, etag, state(&upload), axum::response::AppendHeaders(about.collect::<Vec<_>>()))
        .into_response())
}

/// `PATCH /v1/uploads/{upload}`: the next piece.
pub(super) async fn patch(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
    headers: HeaderMap,
    request: RequestContext,
    body: Body,
) -> Result<Response> {
    drop(request.precondition(&app.changes, current(&app, &access.lab, id)).await?);
    let permit = app.admission.place(&access.lab)?;
    let upload = to_the_end(async move {
        let _permit = permit;
        piece(&app, &access, id, &headers, body).await
    });
    match upload.await {
        Ok(upload) => Ok((StatusCode::NO_CONTENT, state(&upload)).into_response()),
        // Clients of tus go on after a cut, and give up after 408.
        Err(error) if error.code() == Code::UploadStalled => {
            let mut response = error.into_response();
            response.extensions_mut().insert(Cut);
            Ok(response)
        }
        Err(error) => Err(error),
    }
}

/// A task of its own: what has come is recorded also when the connection, and with it the request, is
/// gone.
async fn to_the_end<T: Send + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<T> {
    tokio::spawn(work).await.map_err(|error| ApiError::internal(&error))?
}

async fn piece(
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
        let detail = format!("{} bytes are here; the piece begins at {offset}", upload.received);
        return Err(ApiError::new(Code::OffsetMismatch, detail));
    }
    let Some(file) = file else { return Ok(upload) };
    // Of a piece that does not say its length, room is reserved as it comes.
    let length = text(headers, &header::CONTENT_LENGTH)?.and_then(|text| text.parse().ok());
    let length: u64 = length.unwrap_or_default();
    let length = length.min(upload.facts.length - upload.received);
    let room = app.admission.reserve(&access.lab, length).await?;
    let file = append::append(app, file, room, checksum, body).await?;
    finish(app, file).await
}

/// Stores the file if all of it is there.
async fn finish(app: &App, file: PartialFile) -> Result<Partial> {
    if file.is_complete() {
        return Ok(app.store.finish_partial(file).await?);
    }
    Ok(file.upload().clone())
}

/// `DELETE /v1/uploads/{upload}`: ends it; what has come goes.
pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<PartialId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard = request.precondition(&app.changes, current(&app, &access.lab, id)).await?;
    app.store.partial(&access.lab, id).await?;
    let store = app.store.clone();
    let deleted = to_the_end(async move { Ok(store.delete_partial(id).await?) });
    if deleted.await? { Ok(StatusCode::NO_CONTENT) } else { Err(busy()) }
}

/// How far the upload is, until when it is kept, and, once it is stored, as what.
fn state(upload: &Partial) -> HeaderMap {
    let mut fields = HeaderMap::new();
    fields.insert(OFFSET, upload.received.into());
    if let Ok(expires) = HeaderValue::try_from(upload.expires_at.http_date()) {
        fields.insert(EXPIRES, expires);
    }
    if let Some(Ok(place)) =
        upload.result.map(|sha256| HeaderValue::try_from(format!("/v1/blobs/{sha256}")))
    {
        fields.insert(header::CONTENT_LOCATION, place);
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
    // SQLite keeps signed numbers.
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
