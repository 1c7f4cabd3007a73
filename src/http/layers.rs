//! What happens to every request around its handler, apart from what layers of `tower-http` do.

use std::any::Any;
use std::convert::Infallible;
use std::future::{Ready, ready};
use std::time::Instant;

use axum::BoxError;
use axum::body::Body;
use axum::error_handling::HandleErrorLayer;
use axum::extract::{MatchedPath, OriginalUri, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tower::layer::util::{Identity, Stack};
use tower::limit::GlobalConcurrencyLimitLayer;
use tower::load_shed::LoadShedLayer;
use tower::{Layer, Service, ServiceBuilder, ServiceExt, service_fn};
use tower_http::cors::CorsLayer;
use tower_http::request_id::{MakeRequestId, RequestId};
use tower_http::set_header::SetResponseHeaderLayer;
use tracing::Span;
use tracing::field::Empty;
use uuid::Uuid;

use super::access::Admitted;
use super::context::relative;
use super::error::{ApiError, Code, REQUEST_ID};
use super::metrics;
use store::Store;

const HEADER: HeaderName = HeaderName::from_static("x-request-id");
const TRACE_PARENT: HeaderName = HeaderName::from_static("traceparent");

/// Makes identifiers of requests.
#[derive(Debug, Clone, Copy)]
pub(super) struct NewId;

impl MakeRequestId for NewId {
    fn make_request_id<B>(&mut self, _: &axum::http::Request<B>) -> Option<RequestId> {
        HeaderValue::try_from(Uuid::now_v7().to_string()).ok().map(RequestId::new)
    }
}

/// Removes an identifier with characters that a log can't show.
pub(super) fn without_odd_id(mut request: Request) -> Request {
    if request.headers().get(&HEADER).is_some_and(|id| !is_plain(id)) {
        request.headers_mut().remove(&HEADER);
    }
    request
}

/// The span of a request, which its log lines show: its identifier, and the trace of a caller that sends `traceparent`.
pub(super) fn span(request: &Request) -> Span {
    let (method, path) = (request.method(), request.uri().path());
    let id = identifier(request);
    let span = tracing::info_span!(
        "request", id, %method, path, lab = Empty, trace_id = Empty, parent_id = Empty
    );
    if let Some((trace, parent)) = trace_parent(request.headers()) {
        span.record("trace_id", trace).record("parent_id", parent);
    }
    span
}

fn identifier(request: &Request) -> &str {
    let id = request.headers().get(&HEADER).and_then(|id| id.to_str().ok());
    id.unwrap_or("unknown")
}

/// The identifiers of the trace and of the caller's span, in hexadecimal digits (W3C Trace Context). A malformed or repeated
/// header is ignored, as the standard requires.
fn trace_parent(headers: &HeaderMap) -> Option<(&str, &str)> {
    let mut values = headers.get_all(&TRACE_PARENT).iter();
    let value = values.next().filter(|_| values.next().is_none())?.to_str().ok()?;
    let is_hex = |text: &str, digits: usize| {
        text.len() == digits && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
    };
    let is_identifier =
        |text: &str, digits: usize| is_hex(text, digits) && text.bytes().any(|byte| byte != b'0');
    let mut parts = value.split('-');
    let (version, trace, parent, flags) =
        (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
    // Later versions may have more parts.
    let is_known = is_hex(version, 2) && version != "ff";
    let is_complete = version != "00" || parts.next().is_none();
    (is_known
        && is_complete
        && is_hex(flags, 2)
        && is_identifier(trace, 32)
        && is_identifier(parent, 16))
    .then_some((trace, parent))
}

/// Refuses requests beyond a number in progress, so that a flood does not exhaust the memory.
pub(super) type Shedding = ServiceBuilder<
    Stack<
        GlobalConcurrencyLimitLayer,
        Stack<
            LoadShedLayer,
            Stack<HandleErrorLayer<fn(BoxError) -> Ready<ApiError>, ()>, Identity>,
        >,
    >,
>;

/// Routes with clones of this layer share the number.
pub(super) fn shedding(most: usize) -> Shedding {
    let overloaded: fn(BoxError) -> Ready<ApiError> = |_| {
        let detail = "too many requests are in progress; nothing was changed; try again";
        ready(ApiError::new(Code::Unavailable, detail).retry_after(1))
    };
    ServiceBuilder::new()
        .layer(HandleErrorLayer::new(overloaded))
        .layer(LoadShedLayer::new())
        .layer(GlobalConcurrencyLimitLayer::new(most))
}

/// Headers that restrict browsers, for answers that do not set their own.
pub(super) fn restrictions() -> [SetResponseHeaderLayer<HeaderValue>; 3] {
    [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CONTENT_SECURITY_POLICY, "frame-ancestors 'none'"),
    ]
    .map(|(name, value)| {
        SetResponseHeaderLayer::if_not_present(name, HeaderValue::from_static(value))
    })
}

/// Logs and counts the request when it is answered.
pub(super) async fn observe(mut request: Request, next: Next) -> Response {
    let id = identifier(&request).to_owned();
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let route = request.extensions().get::<MatchedPath>().map(|route| route.as_str().to_owned());
    let admitted = Admitted::default();
    request.extensions_mut().insert(admitted.clone());
    let start = Instant::now();
    let response = REQUEST_ID.scope(id, next.run(request)).await;
    let (status, took) = (response.status().as_u16(), start.elapsed());
    // A status that everyone polls for is not worth a line each. Strangers must not fill the log.
    let is_stranger = admitted.get().is_none() && !response.status().is_server_error();
    if is_stranger || is_quiet(&method, &path) {
        tracing::debug!(status, ms = took.as_millis(), "answered");
    } else {
        tracing::info!(status, ms = took.as_millis(), "answered");
    }
    metrics::observe(known(&method), route.as_deref().unwrap_or("none"), status, took);
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

/// Repeats a deletion that a full disk prevented, once the reserve is given up.
pub(super) async fn delete_with_reserve(
    State(store): State<Store>,
    request: Request,
    next: Next,
) -> Response {
    if request.method() != Method::DELETE {
        return next.run(request).await;
    }
    let (parts, body) = request.into_parts();
    let again = Request::from_parts(parts.clone(), Body::empty());
    let response = next.clone().run(Request::from_parts(parts, body)).await;
    if response.status() != StatusCode::INSUFFICIENT_STORAGE {
        return response;
    }
    match store.give_up_reserve().await {
        Ok(true) => next.run(again).await,
        Ok(false) => response,
        Err(error) => ApiError::from(error).into_response(),
    }
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use axum::Router;
    use axum::body::Body;
    use axum::extract::Request;
    use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
    use axum::routing::get;
    use tokio::sync::Notify;
    use tower::ServiceExt;

    use super::{TRACE_PARENT, shedding, trace_parent};

    #[test]
    fn a_trace_is_taken_from_a_valid_header_alone() {
        let (trace, parent) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
        let of = |values: &[&str]| {
            let values = values.iter().map(|value| (TRACE_PARENT, value.parse().unwrap()));
            let headers: HeaderMap<HeaderValue> =
                values.fold(HeaderMap::new(), |mut all, (name, value)| {
                    all.append(name, value);
                    all
                });
            trace_parent(&headers).map(|(trace, parent)| (trace.to_owned(), parent.to_owned()))
        };
        let valid = format!("00-{trace}-{parent}-01");
        for good in [valid.clone(), format!("cc-{trace}-{parent}-00-later")] {
            assert_eq!(of(&[&good]), Some((trace.to_owned(), parent.to_owned())), "{good}");
        }
        assert_eq!(of(&[&valid, &valid]), None);
        for bad in [
            String::new(),
            "00".to_owned(),
            format!("00-{trace}-{parent}"),
            format!("00-{trace}-{parent}-01-more"),
            format!("ff-{trace}-{parent}-01"),
            format!("00-{}-{parent}-01", trace.to_uppercase()),
            format!("00-{}-{parent}-01", "0".repeat(32)),
            format!("00-{trace}-{}-01", "0".repeat(16)),
            format!("00-{trace}0-{parent}-01"),
        ] {
            assert_eq!(of(&[&bad]), None, "{bad}");
        }
    }

    #[tokio::test]
    async fn requests_beyond_the_limit_are_refused() {
        let (limit, gate) = (shedding(2), Arc::new(Notify::new()));
        let wait = || {
            let gate = gate.clone();
            get(move || async move { gate.notified().await }).layer(limit.clone())
        };
        let router = Router::new().route("/a", wait()).route("/b", wait());
        let send = |path: &str| {
            let request = Request::builder().uri(path).body(Body::empty()).unwrap();
            router.clone().oneshot(request)
        };
        let held = [tokio::spawn(send("/a")), tokio::spawn(send("/b"))];
        tokio::task::yield_now().await;
        for path in ["/a", "/b"] {
            let refused = send(path).await.unwrap();
            assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
            assert_eq!(refused.headers()[header::RETRY_AFTER], "1");
        }
        gate.notify_waiters();
        for answer in held {
            assert_eq!(answer.await.unwrap().unwrap().status(), StatusCode::OK);
        }
        gate.notify_one();
        assert_eq!(send("/b").await.unwrap().status(), StatusCode::OK);
    }
}
