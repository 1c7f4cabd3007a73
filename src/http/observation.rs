//! Logs, counts and traces requests.

use std::time::Instant;

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::Response;
use tracing::Span;
use tracing::field::Empty;

use super::access::Admitted;
use super::error::REQUEST_ID;
use super::metrics;

/// The identifier of a request.
pub(super) const HEADER: HeaderName = HeaderName::from_static("x-request-id");
const TRACE_PARENT: HeaderName = HeaderName::from_static("traceparent");

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
    if let Some(TraceParent { trace, parent, is_sampled: _is_sampled }) =
        trace_parent(request.headers())
    {
        span.record("trace_id", trace).record("parent_id", parent);
        #[cfg(feature = "otel")]
        crate::traces::go_on(&span, trace, parent, _is_sampled);
    }
    span
}

fn identifier(request: &Request) -> &str {
    let id = request.headers().get(&HEADER).and_then(|id| id.to_str().ok());
    id.unwrap_or("unknown")
}

/// The trace of a caller (W3C Trace Context).
#[derive(Debug, PartialEq)]
struct TraceParent<'a> {
    /// The identifiers of the trace and of the caller's span, in hexadecimal digits.
    trace: &'a str,
    parent: &'a str,
    /// True if the caller records the trace.
    is_sampled: bool,
}

/// The trace of the caller. A malformed or repeated header is ignored, as the standard requires.
fn trace_parent(headers: &HeaderMap) -> Option<TraceParent<'_>> {
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
    .then(|| {
        let is_sampled = u8::from_str_radix(flags, 16).is_ok_and(|flags| flags & 1 == 1);
        TraceParent { trace, parent, is_sampled }
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
        Method::DELETE => "DELETE",
        Method::PATCH => "PATCH",
        Method::OPTIONS => "OPTIONS",
        _ => "other",
    }
}

/// True for an identifier that a log can show unchanged.
fn is_plain(id: &HeaderValue) -> bool {
    let bytes = id.as_bytes();
    (1..=100).contains(&bytes.len())
        && bytes.iter().all(|byte| byte.is_ascii_alphanumeric() || b"-_.:/+=".contains(byte))
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderMap, HeaderValue};

    use super::{TRACE_PARENT, trace_parent};

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
            trace_parent(&headers)
                .map(|of| (of.trace.to_owned(), of.parent.to_owned(), of.is_sampled))
        };
        let valid = format!("00-{trace}-{parent}-01");
        for (good, is_sampled) in
            [(valid.clone(), true), (format!("cc-{trace}-{parent}-00-later"), false)]
        {
            let expected = Some((trace.to_owned(), parent.to_owned(), is_sampled));
            assert_eq!(of(&[&good]), expected, "{good}");
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
}
