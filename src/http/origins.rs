//! Cross-origin requests (CORS): pages of allowed origins use the API with a token.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::Request;
use axum::http::{HeaderName, HeaderValue, Method, header};
use axum::response::Response;
use tower::{Layer, Service, ServiceExt, service_fn};
use tower_http::cors::{AllowHeaders, CorsLayer};

use super::observation;

/// Time for which a browser remembers what another origin may do.
const PREFLIGHT_AGE: Duration = Duration::from_secs(3600);

/// Lets pages of these origins use the API with a token; none without origins.
pub(super) fn cors(origins: &[HeaderValue]) -> Option<CorsLayer> {
    let cors = CorsLayer::new()
        .allow_origin(origins.to_vec())
        .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::PATCH, Method::DELETE])
        .allow_headers(AllowHeaders::mirror_request())
        .expose_headers(exposed())
        .max_age(PREFLIGHT_AGE);
    (!origins.is_empty()).then_some(cors)
}

/// Headers of answers that pages of other origins may read.
fn exposed() -> Vec<HeaderName> {
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
        observation::HEADER,
    ];
    own.chain(known).collect()
}

/// Adds the headers of CORS. An OPTIONS that is no preflight, as those of tus, goes to its handler.
pub(super) fn with_cors<S>(
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
