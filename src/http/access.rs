//! Who may come in: bearer tokens, each with a lab and a role.
//!
//! A service for which no token was ever made is open; all data are the lab `local`'s then.

use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use headers::authorization::{Authorization, Bearer};
use headers::{Cookie, HeaderMapExt};

use super::error::{ApiError, Code, Result};
use crate::job::{Lab, Role, Secret, TokenId};
use crate::store::Store;

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
    pub(super) token: Option<TokenId>,
    /// Bytes of uploads that the token may keep here.
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
    State((store, rule)): State<(Store, Rule)>,
    mut request: Request,
    next: Next,
) -> Response {
    let Some(role) = rule.role(request.method()) else { return next.run(request).await };
    let secret = secret(request.method(), request.headers());
    match admit(&store, secret, role).await {
        Ok(access) => {
            tracing::Span::current().record("lab", access.lab.as_str());
            request.extensions_mut().insert(access);
            next.run(request).await
        }
        Err(refusal) => refusal.into_response(),
    }
}

async fn admit(store: &Store, secret: Option<Secret>, role: Role) -> Result<Access> {
    let token = match &secret {
        Some(secret) => store.token(secret).await?,
        None => None,
    };
    let Some(token) = token else {
        if store.is_open().await? {
            return Ok(Access { lab: Lab::local(), token: None, max_bytes: None });
        }
        return Err(missing());
    };
    if token.role < role {
        let detail = format!("this needs the role {role}; the token has {}", token.role);
        return Err(ApiError::new(Code::Forbidden, detail));
    }
    Ok(Access { lab: token.lab, token: Some(token.id), max_bytes: token.max_bytes })
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

    use super::{Secret, secret};

    fn headers(name: &'static str, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name.parse().unwrap(), HeaderValue::from_str(value).unwrap())])
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
