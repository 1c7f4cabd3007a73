//! What happens to every request around its handler, apart from what layers of `tower-http` do.

use std::any::Any;
use std::future::{Ready, ready};

use axum::BoxError;
use axum::body::Body;
use axum::error_handling::HandleErrorLayer;
use axum::extract::{OriginalUri, Request, State};
use axum::http::{Extensions, HeaderMap, HeaderValue, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tower::ServiceBuilder;
use tower::layer::util::{Identity, Stack};
use tower::limit::GlobalConcurrencyLimitLayer;
use tower::load_shed::LoadShedLayer;
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{And, Predicate, SizeAbove};
use tower_http::set_header::SetResponseHeaderLayer;

use super::context::relative;
use super::error::{ApiError, Code};
use super::negotiation::weighted;
use store::Store;

/// Bytes from which on compression saves more than its header costs.
const COMPRESSED_FROM: u64 = 1024;
/// Ending of the ETag of a compressed answer.
const PACKED: &str = "-gzip\"";

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
        // Of thousands one ends within a second, unless each takes an hour.
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

type IsText = fn(StatusCode, Version, &HeaderMap, &Extensions) -> bool;

/// Compresses texts, except files that accept ranges.
pub(super) fn compression() -> CompressionLayer<And<SizeAbove, IsText>> {
    let is_text: IsText = |_, _, fields, _| {
        let kind = fields.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
        let kind = kind.and_then(|kind| kind.split(';').next()).unwrap_or_default();
        let is_text = match kind.split_once('/') {
            Some(("text", form)) => form != "event-stream",
            Some(("application", form)) => matches!(form, "json" | "problem+json" | "yaml"),
            _ => kind == "image/svg+xml",
        };
        is_text && !fields.contains_key(header::ACCEPT_RANGES)
    };
    CompressionLayer::new().compress_when(SizeAbove::new(COMPRESSED_FROM).and(is_text))
}

/// Removes refusals of plain content from `Accept-Encoding`. A server may ignore them (RFC 9110, 12.5.3). The layer of
/// compression would answer 406 after the request has had its effect.
fn admit_plain_content(headers: &mut HeaderMap) {
    let admitted: Vec<String> = weighted(headers, header::ACCEPT_ENCODING)
        .filter(|(name, weight)| *weight > 0.0 || !matches!(name.as_str(), "identity" | "*"))
        .map(|(name, weight)| format!("{name};q={weight}"))
        .collect();
    match HeaderValue::try_from(admitted.join(", ")) {
        Ok(value) if !admitted.is_empty() => drop(headers.insert(header::ACCEPT_ENCODING, value)),
        _ => drop(headers.remove(header::ACCEPT_ENCODING)),
    }
}

/// Distinguishes the ETags of compressed answers, because strong ETags differ between encodings (RFC 9110, 8.8.3.3).
/// Handlers know the ETags of the plain content alone.
pub(super) async fn encoded_tags(mut request: Request, next: Next) -> Response {
    admit_plain_content(request.headers_mut());
    let mut knows_packed = false;
    for (name, value) in request.headers_mut() {
        let is_condition = name == header::IF_MATCH || name == header::IF_NONE_MATCH;
        let tags = value.to_str().ok().filter(|tags| is_condition && tags.contains(PACKED));
        if let Some(Ok(plain)) = tags.map(|tags| tags.replace(PACKED, "\"").try_into()) {
            *value = plain;
            knows_packed = true;
        }
    }
    let mut response = next.run(request).await;
    let is_unmodified = response.status() == StatusCode::NOT_MODIFIED;
    let is_known = is_unmodified && knows_packed;
    let fields = response.headers_mut();
    if is_unmodified {
        // A 304 has the `Vary` of the content (RFC 9110, 15.4.5).
        fields.append(header::VARY, HeaderValue::from_static("accept-encoding"));
    }
    if (is_known || fields.contains_key(header::CONTENT_ENCODING))
        && let Some(tag) = fields.get(header::ETAG).and_then(|tag| tag.to_str().ok())
        && let Ok(tag) = format!("{}{PACKED}", tag.trim_end_matches('"')).try_into()
    {
        fields.insert(header::ETAG, tag);
    }
    response
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

/// Refuses the query of a request whose handler reads none. `queries` has the methods of those that do.
pub(super) async fn closed_query(
    State(queries): State<Vec<&'static str>>,
    request: Request,
    next: Next,
) -> Response {
    let method = if request.method() == Method::HEAD { &Method::GET } else { request.method() };
    let is_read = queries.iter().any(|known| method.as_str().eq_ignore_ascii_case(known));
    let query = request.uri().query().filter(|query| !query.is_empty() && !is_read);
    if let Some(name) = query.and_then(|query| query.split(['=', '&']).next()) {
        let detail = format!("unknown parameter `{}`: this request takes none", shortened(name));
        return ApiError::new(Code::InvalidQuery, detail).into_response();
    }
    next.run(request).await
}

/// The answer to a request that takes too long.
pub(super) fn timed_out(seconds: u64) -> ApiError {
    tracing::warn!(seconds, "an answer took too long");
    let detail = format!("there was no answer within {seconds} seconds");
    // The cause has lasted for so long, and is expected to last as long again.
    ApiError::new(Code::TimedOut, detail).retry_after(seconds)
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
    use axum::http::{StatusCode, header};
    use axum::routing::get;
    use tokio::sync::Notify;
    use tower::ServiceExt;

    use super::shedding;

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
