//! The parts of a request that shape its answer: conditions, preferences, and the address to which references are
//! relative.

use std::time::Duration;

use axum::extract::{FromRequestParts, OriginalUri};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::response::Response;
use serde::Serialize;

use super::conditional;
use super::error::{ApiError, Result};

const PREFER: HeaderName = HeaderName::from_static("prefer");
const APPLIED: HeaderName = HeaderName::from_static("preference-applied");
/// The longest wait of a request, in seconds.
const LONGEST_WAIT: f64 = 20.0;

/// Address and headers of a request.
#[derive(Debug)]
pub(super) struct RequestContext {
    uri: Uri,
    pub(super) headers: HeaderMap,
}

impl<S: Send + Sync> FromRequestParts<S> for RequestContext {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self> {
        let original = parts.extensions.get::<OriginalUri>();
        let uri = original.map_or_else(|| parts.uri.clone(), |OriginalUri(uri)| uri.clone());
        Ok(Self { uri, headers: parts.headers.clone() })
    }
}

impl RequestContext {
    /// The reference that leads from the address of this request to a path of the service. It holds below any prefix
    /// that a proxy adds.
    pub(super) fn reference(&self, target: &str) -> String {
        relative(self.uri.path(), target)
    }

    /// Answers a GET: JSON with its ETag, 304 or 412.
    pub(super) fn json<T: Serialize>(&self, body: &T) -> Result<Response> {
        conditional::json(body, &self.headers)
    }

    /// [`Self::json`] for a page of a list, with the link to the next one.
    pub(super) fn page<T: Serialize>(&self, body: &T, next: Option<&str>) -> Result<Response> {
        let mut response = self.json(body)?;
        if let Some(Ok(link)) = next.map(|cursor| HeaderValue::try_from(self.next(cursor))) {
            response.headers_mut().append(header::LINK, link);
        }
        Ok(response)
    }

    /// The link to the page after a cursor: the same query with another cursor.
    fn next(&self, cursor: &str) -> String {
        let pairs = self.uri.query().unwrap_or_default().split('&');
        let kept = pairs.filter(|pair| !pair.is_empty() && !pair.starts_with("cursor="));
        let cursor = format!("cursor={cursor}");
        let query: Vec<&str> = kept.chain([cursor.as_str()]).collect();
        format!("<?{}>; rel=\"next\"", query.join("&"))
    }

    /// The wait that the request prefers (RFC 7240).
    pub(super) fn wait(&self) -> Wait {
        Wait::of(&self.headers)
    }
}

/// Answers a request that has created or changed something: JSON with its ETag.
pub(super) fn changed<T: Serialize>(status: StatusCode, body: &T) -> Result<Response> {
    let mut response = conditional::json(body, &HeaderMap::new())?;
    *response.status_mut() = status;
    Ok(response)
}

/// The wait that `Prefer` states: `wait=SECONDS` or `respond-async`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Wait {
    Unstated,
    /// The longest wait in seconds.
    Seconds(f64),
    /// The answer comes at once.
    Async,
}

impl Wait {
    fn of(headers: &HeaderMap) -> Self {
        let values = headers.get_all(PREFER).iter().filter_map(|value| value.to_str().ok());
        let mut found = Self::Unstated;
        for preference in values.flat_map(|value| value.split([',', ';'])) {
            let (name, value) = preference.split_once('=').unwrap_or((preference, ""));
            let seconds = || value.trim().trim_matches('"').parse::<f64>().ok();
            match (name.trim().to_ascii_lowercase().as_str(), found) {
                ("respond-async", Self::Unstated) => found = Self::Async,
                // Malformed preferences are ignored, as the RFC requires.
                ("wait", _) => {
                    if let Some(seconds) = seconds().filter(|seconds| *seconds >= 0.0) {
                        found = Self::Seconds(seconds.min(LONGEST_WAIT));
                    }
                }
                _ => {}
            }
        }
        found
    }

    /// The time to wait; `default` if none is stated.
    pub(super) fn time(self, default: Duration) -> Duration {
        match self {
            Self::Unstated => default,
            Self::Seconds(seconds) => Duration::from_secs_f64(seconds),
            Self::Async => Duration::ZERO,
        }
    }

    /// States in an answer which preference was applied.
    pub(super) fn applied(self, mut response: Response) -> Response {
        let text = match self {
            Self::Unstated => return response,
            Self::Seconds(seconds) => format!("wait={seconds}"),
            Self::Async => "respond-async".to_owned(),
        };
        if let Ok(value) = HeaderValue::try_from(text) {
            response.headers_mut().insert(APPLIED, value);
        }
        response.headers_mut().append(header::VARY, HeaderValue::from_static("prefer"));
        response
    }
}

/// The relative reference from one path to another (RFC 3986, 4.2).
pub(super) fn relative(from: &str, to: &str) -> String {
    let folder = from.rfind('/').map_or("", |end| &from[..=end]);
    let shared = folder.bytes().zip(to.bytes()).take_while(|(one, other)| one == other).count();
    let shared = folder[..shared].rfind('/').map_or(0, |end| end + 1);
    let up = "../".repeat(folder[shared..].matches('/').count());
    match (up.as_str(), &to[shared..]) {
        ("", "") => "./".to_owned(),
        (up, rest) => format!("{up}{rest}"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use axum::http::{HeaderMap, HeaderValue};

    use super::{RequestContext, Wait, relative};

    #[test]
    fn references_lead_from_any_address_to_any_other() {
        for (from, to, expected) in [
            ("/v1/jobs", "/v1/jobs/a", "jobs/a"),
            ("/v1/uploads/", "/v1/uploads/a", "a"),
            ("/v1/uploads/a", "/v1/blobs/b", "../blobs/b"),
            ("/v1/jobs/a/exports", "/v1/jobs/a/snapshots/0/exports/mp4", "snapshots/0/exports/mp4"),
            ("/v1/jobs/a/snapshots/0", "/v1/jobs/a/snapshots/0/exports/exr", "0/exports/exr"),
            ("/v1/jobs", "/problems/not_found", "../problems/not_found"),
            ("/readyz", "/problems/not_found", "problems/not_found"),
            ("/v1/jobs/a", "/v1/jobsters", "../jobsters"),
            ("/", "/", "./"),
        ] {
            assert_eq!(relative(from, to), expected, "{from} {to}");
        }
    }

    #[test]
    fn the_next_page_has_the_same_query() {
        let link = |uri: &str| {
            RequestContext { uri: uri.parse().unwrap(), headers: HeaderMap::new() }.next("abc")
        };
        assert_eq!(link("/v1/jobs"), "<?cursor=abc>; rel=\"next\"");
        let all = link("/v1/jobs?lab=a&cursor=old&limit=2");
        assert_eq!(all, "<?lab=a&limit=2&cursor=abc>; rel=\"next\"");
    }

    #[test]
    fn clients_state_how_long_they_wait() {
        let wait = |values: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append("prefer", HeaderValue::from_static(value));
            }
            Wait::of(&headers)
        };
        assert_eq!(wait(&[]), Wait::Unstated);
        assert_eq!(wait(&["respond-async"]), Wait::Async);
        assert_eq!(wait(&["respond-async, wait=3"]), Wait::Seconds(3.0));
        assert_eq!(wait(&["wait=3, respond-async"]), Wait::Seconds(3.0));
        assert_eq!(wait(&["Respond-Async", "wait=\"2.5\"; x=1"]), Wait::Seconds(2.5));
        assert_eq!(wait(&["wait=100"]), Wait::Seconds(20.0));
        assert_eq!(wait(&["wait=-1, handling=lenient"]), Wait::Unstated);
        assert_eq!(wait(&["wait=NaN"]), Wait::Unstated);
        assert_eq!(wait(&[]).time(Duration::from_secs(7)), Duration::from_secs(7));
        assert_eq!(wait(&["respond-async"]).time(Duration::from_secs(7)), Duration::ZERO);
    }
}
