//! Who may come in: bearer tokens, each with a lab and a role.
//!
//! A service for which no token was ever made is open; all data are the lab `local`'s then.

use std::net::IpAddr;
use std::sync::Arc;

use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use headers::authorization::{Authorization, Bearer};
use headers::{Cookie, HeaderMapExt};
use rustix::system::uname;

use super::error::{ApiError, Code, Result};
use crate::job::{Lab, Role, Secret, TokenId};
use crate::store::{Store, Token};

/// A page that can't set headers of its requests (for pictures and events, say) keeps the token in
/// this cookie. It opens only what changes nothing, so that no foreign page can use it to do harm.
const COOKIE: &str = "sci_recon_token";

/// Who may use a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rule {
    /// Everyone.
    Public,
    /// Those who may read, for what changes nothing; those who may submit, for the rest.
    ByMethod,
    /// Those who look after the service.
    Admin,
}

impl Rule {
    fn role(self, method: &Method) -> Option<Role> {
        match self {
            Self::Public => None,
            Self::Admin => Some(Role::Admin),
            Self::ByMethod if method.is_safe() => Some(Role::Read),
            Self::ByMethod => Some(Role::Submit),
        }
    }
}

/// What the guard found out: for whom a request is.
#[derive(Debug, Clone)]
pub(super) struct Access {
    /// Whose data are seen.
    pub(super) lab: Lab,
    pub(super) role: Role,
    pub(super) token: Option<TokenId>,
    /// Bytes of uploads, and of what is prepared of them, that the token may keep here.
    pub(super) max_bytes: Option<u64>,
}

impl<S: Send + Sync> FromRequestParts<S> for Access {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self> {
        // Without the guard nobody is let in: a public route has no data of a lab.
        parts.extensions.get().cloned().ok_or_else(missing)
    }
}

/// Lets a request pass if its token may do what it wants.
pub(super) async fn guard(
    State((store, hosts, rule)): State<(Store, Arc<[String]>, Rule)>,
    mut request: Request,
    next: Next,
) -> Response {
    let Some(role) = rule.role(request.method()) else { return next.run(request).await };
    let secret = secret(request.method(), request.headers());
    match admit((&store, &hosts), secret, role, (request.method(), request.headers())).await {
        Ok(access) => {
            tracing::Span::current().record("lab", access.lab.as_str());
            request.extensions_mut().insert(access);
            next.run(request).await
        }
        Err(refusal) => refusal.into_response(),
    }
}

async fn admit(
    (store, hosts): (&Store, &[String]),
    secret: Option<Secret>,
    role: Role,
    (method, headers): (&Method, &HeaderMap),
) -> Result<Access> {
    let token = match &secret {
        Some(secret) => store.token(secret).await?,
        None => None,
    };
    let Some(token) = token else {
        if store.is_open().await? {
            check_site(method, headers, hosts)?;
            let (lab, role) = (Lab::local(), Role::Admin);
            return Ok(Access { lab, role, token: None, max_bytes: None });
        }
        return Err(missing());
    };
    if token.role < role {
        let detail = format!("this needs the role {role}; the token has {}", token.role);
        return Err(ApiError::new(Code::Forbidden, detail));
    }
    let Token { id, lab, role, max_bytes, .. } = token;
    Ok(Access { lab, role, token: Some(id), max_bytes })
}

/// Refuses what a page of another site may have had a browser send: without tokens nothing else tells
/// it from what the user wants. A name that was made to point here is known by the `Host` (DNS
/// rebinding), a form or a script by the `Origin` or by `Sec-Fetch-Site`.
fn check_site(method: &Method, headers: &HeaderMap, names: &[String]) -> Result<()> {
    let foreign = |detail: String| Err(ApiError::new(Code::ForeignSite, detail));
    let text = |name: &str| headers.get(name).map(|value| value.to_str().unwrap_or("?"));
    let host = text("host").unwrap_or("localhost");
    if !is_own_name(host, names) {
        return foreign(format!(
            "there are no tokens, so this service answers only to its own names, and {host} is none \
             of them; ask at its address, make a token, or start it with --host NAME"
        ));
    }
    if method.is_safe() {
        return Ok(());
    }
    let origin = text("origin").filter(|origin| {
        origin.split_once("://").is_none_or(|(_, place)| !place.eq_ignore_ascii_case(host))
    });
    let site = text("sec-fetch-site").filter(|site| !["same-origin", "none"].contains(site));
    match origin.or(site) {
        Some(from) => foreign(format!("a page of {from} may not change anything here")),
        None => Ok(()),
    }
}

/// Whether this host, perhaps with a port, is an address, this machine, or one of the names.
fn is_own_name(host: &str, names: &[String]) -> bool {
    let name = host.parse::<Authority>().map(|place| place.host().to_ascii_lowercase());
    let Ok(name) = name else { return false };
    let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    let here = uname();
    let here = here.nodename().to_str().unwrap_or("localhost");
    address.is_ok()
        || name == "localhost"
        || name.eq_ignore_ascii_case(here)
        || names.iter().any(|own| name.eq_ignore_ascii_case(own))
}

fn secret(method: &Method, headers: &HeaderMap) -> Option<Secret> {
    match headers.typed_try_get::<Authorization<Bearer>>() {
        Ok(Some(bearer)) => Secret::parse(bearer.token().trim()),
        Ok(None) if method.is_safe() => Secret::parse(headers.typed_get::<Cookie>()?.get(COOKIE)?),
        _ => None,
    }
}

/// The same for a token that is missing, unknown, misspelled or revoked.
fn missing() -> ApiError {
    let detail = "a valid token is needed, as the header Authorization: Bearer sci_...";
    ApiError::new(Code::Unauthorized, detail).with_header(
        header::WWW_AUTHENTICATE,
        HeaderValue::from_static("Bearer realm=\"sci-recon\""),
    )
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderMap, HeaderValue, Method};

    use super::{Secret, check_site, secret};

    fn headers(name: &'static str, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name.parse().unwrap(), HeaderValue::from_str(value).unwrap())])
    }

    #[test]
    fn pages_of_other_sites_are_told_by_what_browsers_say() {
        let check = |method: Method, lines: &[(&'static str, &str)]| {
            let lines = lines.iter().map(|(name, value)| headers(name, value));
            let all: HeaderMap =
                lines.flatten().map(|(name, value)| (name.unwrap(), value)).collect();
            check_site(&method, &all, &["bench.example".into()]).is_ok()
        };
        for host in ["127.0.0.1:8080", "[::1]:8080", "LOCALHOST", "bench.example:80", "10.1.2.3"] {
            assert!(check(Method::POST, &[("host", host)]), "{host}");
        }
        for host in ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example:8080", "a b"]
        {
            assert!(!check(Method::GET, &[("host", host)]), "{host}");
        }
        let own = ("host", "127.0.0.1:8080");
        for line in [
            ("origin", "http://evil.example"),
            ("origin", "http://127.0.0.1:9090"),
            ("origin", "null"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-site", "same-site"),
        ] {
            assert!(!check(Method::POST, &[own, line]), "{line:?}");
            assert!(check(Method::GET, &[own, line]), "{line:?}: the page does not see the answer");
        }
        let page = [own, ("origin", "http://127.0.0.1:8080"), ("sec-fetch-site", "same-origin")];
        assert!(check(Method::DELETE, &page));
    }

    #[test]
    fn a_token_comes_as_a_header_or_for_looking_as_a_cookie() {
        let wanted = Secret::from_bytes([1; 32]);
        let text = wanted.reveal().to_owned();
        let bearer = headers("authorization", &format!("bearer {text}"));
        assert_eq!(secret(&Method::DELETE, &bearer), Some(wanted.clone()));
        let cookie = headers("cookie", &format!("a=b; sci_recon_token={text}; c=d"));
        assert_eq!(secret(&Method::GET, &cookie), Some(wanted));
        assert_eq!(secret(&Method::POST, &cookie), None);
        for bad in [format!("Basic {text}"), text.to_owned(), "Bearer".into(), "Bearer x".into()] {
            assert_eq!(secret(&Method::GET, &headers("authorization", &bad)), None, "{bad}");
        }
    }
}
