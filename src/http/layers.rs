//! What happens to every request around its handler.

use std::any::Any;
use std::convert::Infallible;
use std::time::Instant;

use axum::extract::{MatchedPath, OriginalUri, Request};
use axum::http::{HeaderName, HeaderValue, Method, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tower::{Layer, Service, ServiceExt, service_fn};
use tower_http::cors::CorsLayer;
use tracing::Instrument;
use tracing::field::Empty;
use uuid::Uuid;

use super::access::Admitted;
use super::context::relative;
use super::error::{ApiError, Code, REQUEST_ID};
use super::metrics;

const HEADER: HeaderName = HeaderName::from_static("x-request-id");

/// Gives the request an identifier, or keeps the client's; logs and counts it when it is answered.
pub(super) async fn observe(mut request: Request, next: Next) -> Response {
    let id = request.headers().get(&HEADER).filter(|id| is_plain(id)).cloned();
    let id = id.unwrap_or_else(new_id);
    request.headers_mut().insert(HEADER, id.clone());
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let route = request.extensions().get::<MatchedPath>().map(|route| route.as_str().to_owned());
    let span = tracing::info_span!("request", id = id.to_str().unwrap_or(""), %method, path = %path, lab = Empty);
    let admitted = Admitted::default();
    request.extensions_mut().insert(admitted.clone());
    let start = Instant::now();
    let answer = next.run(request).instrument(span.clone());
    let mut response = REQUEST_ID.scope(id.to_str().unwrap_or("").to_owned(), answer).await;
    let (status, took) = (response.status().as_u16(), start.elapsed());
    // A status that everyone polls for is not worth a line each. Strangers must not fill the log.
    let _entered = span.enter();
    let is_stranger = admitted.get().is_none() && !response.status().is_server_error();
    if is_stranger || is_quiet(&method, &path) {
        tracing::debug!(status, ms = took.as_millis(), "answered");
    } else {
        tracing::info!(status, ms = took.as_millis(), "answered");
    }
    metrics::observe(known(&method), route.as_deref().unwrap_or("none"), status, took);
    response.headers_mut().insert(HEADER, id);
    response
}

fn is_quiet(method: &Method, path: &str) -> bool {
    method == Method::GET && (!path.starts_with("/v1/") || path.starts_with("/v1/jobs"))
}

/// Methods are a label of the metrics, and clients can make up new ones without end.
fn known(method: &Method) -> &'static str {
    match *method {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::PUT => "PUT",
        Method::DELETE => "DELETE",
        Method::PATCH => "PATCH",
        Method::OPTIONS => "OPTIONS",
        _ => "other",
    }
}

/// True for an identifier that can stand in a log as it is.
fn is_plain(id: &HeaderValue) -> bool {
    let bytes = id.as_bytes();
    (1..=100).contains(&bytes.len())
        && bytes.iter().all(|byte| byte.is_ascii_alphanumeric() || b"-_.:/+=".contains(byte))
}

fn new_id() -> HeaderValue {
    let text = Uuid::now_v7().to_string();
    HeaderValue::try_from(text).unwrap_or_else(|_| HeaderValue::from_static("unknown"))
}

/// Makes references in headers relative to the address of the request, so that they hold below any prefix that a proxy
/// adds. Handlers name paths of the service.
pub(super) async fn relative_references(mut request: Request, next: Next) -> Response {
    let known = request.extensions().get::<OriginalUri>().map(|OriginalUri(uri)| uri.clone());
    let uri = known.unwrap_or_else(|| request.uri().clone());
    request.extensions_mut().insert(OriginalUri(uri.clone()));
    let mut response = next.run(request).await;
    let fields = response.headers_mut();
    for name in [header::LOCATION, header::CONTENT_LOCATION] {
        let Some(target) = fields.get(&name).and_then(|value| value.to_str().ok()) else {
            continue;
        };
        if let Ok(value) = HeaderValue::try_from(relative(uri.path(), target)) {
            fields.insert(name, value);
        }
    }
    let link = fields.get(header::LINK).and_then(|link| link.to_str().ok());
    if let Some((target, rest)) = link.and_then(|link| link.strip_prefix("</")?.split_once('>')) {
        let target = relative(uri.path(), &format!("/{target}"));
        if let Ok(value) = HeaderValue::try_from(format!("<{target}>{rest}")) {
            fields.insert(header::LINK, value);
        }
    }
    response
}

/// Headers of answers that pages of other origins may read.
pub(super) fn exposed() -> Vec<HeaderName> {
    let tus = [
        "tus-resumable",
        "tus-version",
        "tus-extension",
        "tus-max-size",
        "tus-checksum-algorithm",
        "upload-offset",
        "upload-length",
        "upload-defer-length",
        "upload-metadata",
        "upload-expires",
    ];
    let others = ["preference-applied", "ratelimit", "ratelimit-policy"];
    let own = tus.into_iter().chain(others).map(HeaderName::from_static);
    let known = [
        header::LOCATION,
        header::CONTENT_LOCATION,
        header::ETAG,
        header::CONTENT_RANGE,
        header::ACCEPT_RANGES,
        header::CONTENT_DISPOSITION,
        header::LINK,
        header::RETRY_AFTER,
        HEADER,
    ];
    own.chain(known).collect()
}

/// Adds the headers of CORS. An OPTIONS that is no preflight, as those of tus, goes to its handler.
pub(super) fn cors<S>(
    cors: CorsLayer,
    service: S,
) -> impl Service<Request, Response = Response, Error = Infallible, Future: Send>
+ Clone
+ Send
+ Sync
+ 'static
where
    S: Service<Request, Response = Response, Error = Infallible, Future: Send>
        + Clone
        + Send
        + Sync
        + 'static,
{
    let open = cors.layer(service.clone());
    service_fn(move |request: Request| {
        let is_plain = request.method() == Method::OPTIONS
            && !request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
        let (open, plain) = (open.clone(), service.clone());
        async move { if is_plain { plain.oneshot(request).await } else { open.oneshot(request).await } }
    })
}

/// Refuses a request that names two hosts, or none: a proxy before us and we may take it for different ones
/// (RFC 9112, 3.2).
pub(super) async fn one_host(request: Request, next: Next) -> Response {
    let hosts = request.headers().get_all(header::HOST).iter().count();
    if hosts > 1 || (hosts == 0 && request.version() == Version::HTTP_11) {
        let detail = format!("{hosts} Host headers; a request has one");
        return ApiError::new(Code::MalformedRequest, detail).into_response();
    }
    next.run(request).await
}

/// The answer to a request that takes too long.
pub(super) fn timed_out(seconds: u64) -> ApiError {
    tracing::warn!(seconds, "an answer took too long");
    ApiError::new(Code::TimedOut, format!("there was no answer within {seconds} seconds"))
}

/// After an upload that was refused on the way the connection still holds the rest of its body; a
/// client that sent its next request into it would lose that request.
pub(super) async fn close_after_refusal(mut response: Response) -> Response {
    if response.status().is_client_error() || response.status().is_server_error() {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

/// The answer to a request whose handler panicked.
pub(super) fn panicked(cause: Box<dyn Any + Send>) -> Response {
    let text = cause
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| cause.downcast_ref::<&str>().copied())
        .unwrap_or("no message");
    tracing::error!(panic = text, "a handler panicked");
    ApiError::new(Code::Internal, "an error of the service; its log says more").into_response()
}

/// The answer to a path that leads nowhere.
pub(super) async fn not_found(request: Request) -> ApiError {
    let detail = format!("no route leads to {:?}", shortened(request.uri().path()));
    ApiError::new(Code::NotFound, detail)
}

/// The answer to a method that the path does not have; the router adds the header `Allow`.
pub(super) async fn method_not_allowed(request: Request) -> ApiError {
    let path = shortened(request.uri().path());
    let method = shortened(request.method().as_str());
    let detail = format!("{path:?} does not take {method}; the header Allow says what it takes");
    ApiError::new(Code::MethodNotAllowed, detail)
}

fn shortened(text: &str) -> String {
    text.chars().take(120).collect()
}
