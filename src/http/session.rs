//! `/view/session`: exchanges a token for a cookie that scripts cannot read.

use std::time::{Duration, Instant};

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};

use super::access::{HOST_SESSION, SECURE_SESSION, SESSION, missing};
use super::client::Client;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, QueryOf};
use engine::job::{Secret, Timestamp, TokenId};

/// Longest life of a session.
const LIFE: Duration = Duration::from_secs(7 * 86_400);

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Session")]
pub(super) struct SessionBody {
    token: TokenId,
    expires_at: Timestamp,
}

/// The query of both requests. The browser sends the cookie below `path`, the path of the page, which may lie below a
/// prefix of a proxy.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SessionQuery {
    #[serde(default)]
    path: CookiePath,
}

#[derive(Debug, Deserialize)]
#[serde(try_from = "String")]
struct CookiePath(String);

impl Default for CookiePath {
    fn default() -> Self {
        Self("/".into())
    }
}

impl TryFrom<String> for CookiePath {
    type Error = &'static str;

    fn try_from(path: String) -> Result<Self, &'static str> {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"/-_.~%".contains(&byte);
        if path.starts_with('/') && path.len() <= 200 && path.bytes().all(plain) {
            return Ok(Self(path));
        }
        Err("path must be the path of the page, such as /sci/")
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<SessionQuery>,
    client: Option<Extension<Client>>,
    headers: HeaderMap,
) -> Result<Response> {
    let Some(token) = access.token else {
        let detail = "there are no tokens, so that nobody needs a session";
        return Err(ApiError::new(Code::IllegalState, detail));
    };
    // A session that made others would outlive every one of them.
    if access.session.is_some() {
        return Err(missing());
    }
    if let Some(rate) = app.session_rates.take(token, Instant::now()) {
        rate.check(|quota| format!("the token may begin {quota} sessions"))?;
    }
    let secret = Secret::random().map_err(|error| ApiError::internal(&error))?;
    let now = Timestamp::now();
    let end = now.after(LIFE);
    let expires_at = access.expires_at.map_or(end, |expires| expires.min(end));
    app.store.add_session(token, &secret, expires_at).await?;
    let seconds = (expires_at.0 - now.0).max(0) / 1000;
    let is_https = is_https(client, &headers);
    let cookie = cookie(is_https, &query.path, secret.reveal(), seconds);
    let body = Json(SessionBody { token, expires_at });
    Ok((StatusCode::CREATED, [(header::SET_COOKIE, cookie)], body).into_response())
}

/// Ends the session, if one was shown.
pub(super) async fn delete(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<SessionQuery>,
    client: Option<Extension<Client>>,
    headers: HeaderMap,
) -> Result<Response> {
    if let Some(secret) = &access.session {
        app.store.end_session(secret).await?;
    }
    let cookie = cookie(is_https(client, &headers), &query.path, "", 0);
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response())
}

/// True if the browser uses HTTPS, which ends at a proxy. The proxy says so if it is trusted, else the browser in
/// `Origin`.
fn is_https(client: Option<Extension<Client>>, headers: &HeaderMap) -> bool {
    let origin = headers.get(header::ORIGIN).and_then(|origin| origin.to_str().ok());
    client.is_some_and(|Extension(client)| client.is_https)
        || origin.is_some_and(|origin| origin.starts_with("https://"))
}

fn cookie(is_https: bool, CookiePath(path): &CookiePath, value: &str, seconds: i64) -> String {
    let (name, secure) = match (is_https, path.as_str()) {
        (true, "/") => (HOST_SESSION, "; Secure"),
        (true, _) => (SECURE_SESSION, "; Secure"),
        (false, _) => (SESSION, ""),
    };
    format!("{name}={value}; Path={path}; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}")
}
