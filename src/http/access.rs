//! Who may come in: bearer tokens, each with a lab and a role, and the sessions of browsers that stand for them.
//!
//! A service for which no token was ever made is open; all data are the lab `local`'s then.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use axum::body::{Body, HttpBody};
use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::uri::{Authority, Uri};
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use headers::authorization::{Authorization, Bearer};
use headers::{Cookie, HeaderMapExt};
use rustix::system::uname;

use super::client::Client;
use super::error::{ApiError, Code, Result};
use super::rate::Rates;
use super::revocation::{Grant, Revocations};
use super::sign_ins::SignIns;
use crate::audit::AuditLog;
use crate::config::ServeArguments;
use engine::job::{Lab, Label, Role, Secret, Timestamp, TokenId};
use store::{Store, Token};

/// The cookie of a session, which `POST /view/session` sets on HTTP.
pub(super) const SESSION: &str = "sci_recon_session";
/// The cookie on HTTPS: the browser accepts it from this host alone, not from another one of the same domain.
pub(super) const HOST_SESSION: &str = "__Host-sci_recon_session";
/// The cookie on HTTPS below a path prefix, where browsers allow no `__Host-`: it comes from a page on HTTPS.
pub(super) const SECURE_SESSION: &str = "__Secure-sci_recon_session";
/// What changes something by a session has this header: a page of another site can't set it.
const CHANGES: &str = "x-requested-with";

/// Who may use a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rule {
    /// Everyone.
    Public,
    /// Everyone with a token, for themselves.
    Own,
    /// Those who may read, for what changes nothing; those who may submit, for the rest.
    ByMethod,
    /// As by method, for one lab or for all of them.
    AcrossLabs,
    /// Those who look after the service.
    Admin,
    /// Those who look after all labs: with the role admin, for what changes something.
    AllLabs,
}

impl Rule {
    fn role(self, method: &Method) -> Option<Role> {
        match self {
            Self::Public => None,
            Self::Own => Some(Role::Read),
            Self::Admin => Some(Role::Admin),
            Self::AllLabs if !method.is_safe() => Some(Role::Admin),
            _ if method.is_safe() => Some(Role::Read),
            _ => Some(Role::Submit),
        }
    }
}

/// What the guard found out: for whom a request is.
#[derive(Debug, Clone)]
pub(super) struct Access {
    /// Whose data are seen.
    pub(super) lab: Lab,
    pub(super) role: Role,
    /// True if the data of every lab may be asked for.
    pub(super) all_labs: bool,
    /// True if they were, on a route that shows them together.
    pub(super) across: bool,
    pub(super) token: Option<TokenId>,
    /// The note of the token.
    pub(super) note: Option<Label>,
    /// Bytes of uploads, and of what is prepared of them, that the token may keep here.
    pub(super) max_bytes: Option<u64>,
    /// From when on the token is worth nothing.
    pub(super) expires_at: Option<Timestamp>,
    /// The session that stood for the token.
    pub(super) session: Option<Secret>,
}

impl Access {
    /// On a service without tokens.
    fn open() -> Self {
        Self {
            lab: Lab::local(),
            role: Role::Admin,
            all_labs: true,
            across: false,
            token: None,
            note: None,
            max_bytes: None,
            expires_at: None,
            session: None,
        }
    }
    fn of(token: Token, session: Option<Secret>) -> Self {
        let Token { id, lab, role, all_labs, note, max_bytes, expires_at, .. } = token;
        let token = Some(id);
        Self { lab, role, all_labs, across: false, token, note, max_bytes, expires_at, session }
    }

    fn grant(&self) -> Grant {
        match (&self.session, self.token) {
            (Some(session), _) => Grant::Session(session.clone()),
            (None, Some(token)) => Grant::Token(token),
            (None, None) => Grant::Open,
        }
    }

    /// The lab whose data are to be shown; none for those of all labs.
    pub(super) fn shown(&self) -> Option<&Lab> {
        (!self.across).then_some(&self.lab)
    }
}

/// The access that the guard grants to a request, for the layers around the guard.
#[derive(Debug, Clone, Default)]
pub(super) struct Admitted(Arc<Mutex<Option<Access>>>);

impl Admitted {
    pub(super) fn set(&self, access: &Access) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(access.clone());
    }

    pub(super) fn get(&self) -> Option<Access> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The slot of a request.
    pub(super) fn of(request: &Request) -> Self {
        request.extensions().get().cloned().unwrap_or_default()
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Access {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self> {
        // Without the guard nobody is let in: a public route has no data of a lab.
        parts.extensions.get().cloned().ok_or_else(missing)
    }
}

/// The limits of the guard: names and origins that distinguish own pages from those of other sites, and the rates of
/// requests and of failed sign-ins.
#[derive(Debug)]
pub(super) struct Sites {
    hosts: Vec<String>,
    origins: Vec<HeaderValue>,
    rates: Rates<TokenId>,
    sign_ins: SignIns,
}

impl Sites {
    pub(super) fn new(settings: &ServeArguments, audit: AuditLog) -> Self {
        Self {
            hosts: settings.hosts.clone(),
            origins: settings.cors_origins.clone(),
            rates: Rates::new(settings.requests_per_minute),
            sign_ins: SignIns::new(audit),
        }
    }
}

/// Lets a request pass if its token may do what it wants. What is answered bit by bit ends when the token
/// does.
pub(super) async fn guard(
    State((store, sites, revocations, rule)): State<(Store, Arc<Sites>, Revocations, Rule)>,
    mut request: Request,
    next: Next,
) -> Response {
    let Some(role) = rule.role(request.method()) else { return next.run(request).await };
    match admit(&store, &sites, rule, role, &mut request).await {
        Ok(access) => {
            Admitted::of(&request).set(&access);
            tracing::Span::current().record("lab", access.lab.as_str());
            let rate = access.token.and_then(|token| sites.rates.take(token, Instant::now()));
            let may = |quota| format!("the token may send {quota} requests");
            let refusal = rate.and_then(|rate| rate.check(may).err());
            request.extensions_mut().insert(access.clone());
            let mut response = match refusal {
                Some(refusal) => refusal.into_response(),
                None => next.run(request).await,
            };
            if let Some(rate) = rate {
                rate.state(response.headers_mut());
            }
            // A browser must not show data after the end of a session.
            let cached = response.headers_mut().entry(header::CACHE_CONTROL);
            cached.or_insert(HeaderValue::from_static("private, no-cache"));
            if response.body().size_hint().exact().is_some() {
                return response;
            }
            response.map(|body| {
                let parts = body.into_data_stream();
                Body::from_stream(parts.take_until(revocations.end_of(access.grant())))
            })
        }
        Err(refusal) => refusal.into_response(),
    }
}

async fn admit(
    store: &Store,
    sites: &Sites,
    rule: Rule,
    role: Role,
    request: &mut Request,
) -> Result<Access> {
    let (method, headers) = (request.method(), request.headers());
    let is_https = request.extensions().get::<Client>().is_some_and(|client| client.is_https);
    let shown = credential(headers, is_https);
    let found = match &shown {
        Some(Credential::Token(secret)) => store.token(secret).await?.map(|token| (token, None)),
        Some(Credential::Session(secret)) => {
            let token = store.token_of_session(secret).await?;
            token.map(|token| (token, Some(secret.clone())))
        }
        None => None,
    };
    let Some((token, session)) = found else {
        if store.is_open().await? {
            check_name(headers, &sites.hosts)?;
            check_site(method, headers, &sites.origins)?;
            let access = Access::open();
            return choose_lab(store, rule, access, request).await;
        }
        if shown.is_some() || headers.contains_key(header::AUTHORIZATION) {
            let client = request.extensions().get::<Client>().copied();
            sites.sign_ins.failed(client, method, request.uri().path(), headers)?;
        }
        return Err(missing());
    };
    // A refusal is recorded with the token.
    Admitted::of(request).set(&Access::of(token.clone(), session.clone()));
    if session.is_some() && !method.is_safe() {
        check_site(method, headers, &[])?;
        if !headers.contains_key(CHANGES) {
            let detail = "what changes something by a session has the header X-Requested-With";
            return Err(ApiError::new(Code::ForeignSite, detail));
        }
    }
    if token.role < role {
        let detail = format!("this needs the role {role}; the token has {}", token.role);
        return Err(ApiError::new(Code::Forbidden, detail));
    }
    if rule == Rule::AllLabs && !token.all_labs {
        let detail = "this needs a token for all labs (sci-recon token create --all-labs)";
        return Err(ApiError::new(Code::Forbidden, detail));
    }
    note_use(store, &token);
    choose_lab(store, rule, Access::of(token, session), request).await
}

/// Notes the use of a token, for which no request waits.
fn note_use(store: &Store, token: &Token) {
    if !token.is_use_due() {
        return;
    }
    let (store, token) = (store.clone(), token.id);
    tokio::spawn(async move {
        if let Err(error) = store.note_use(token).await {
            tracing::warn!(%error, "the use of a token was not noted");
        }
    });
}

/// Takes the parameter `lab` from the query: whose data are asked for, if not those of the token's lab. `*`
/// stands for all labs.
async fn choose_lab(
    store: &Store,
    rule: Rule,
    mut access: Access,
    request: &mut Request,
) -> Result<Access> {
    let (mut labs, rest) = without_lab(request.uri());
    let Some(wanted) = labs.pop() else { return Ok(access) };
    if !labs.is_empty() {
        let detail = "the parameter lab occurs more than once; name one lab, or * for all";
        return Err(ApiError::new(Code::InvalidQuery, detail));
    }
    *request.uri_mut() = rest;
    if wanted == access.lab.as_str() {
        return Ok(access);
    }
    if !access.all_labs {
        let detail = format!("the token is for the lab {} alone", access.lab);
        return Err(ApiError::new(Code::Forbidden, detail));
    }
    if wanted == "*" && rule == Rule::AcrossLabs && request.method().is_safe() {
        access.across = true;
        return Ok(access);
    }
    let lab = wanted.parse::<Lab>().ok();
    match lab {
        Some(lab) if store.knows_lab(&lab).await? => Ok(Access { lab, ..access }),
        _ => {
            let wanted: String = wanted.chars().take(80).collect();
            Err(ApiError::new(Code::NotFound, format!("there is no lab {wanted:?}")))
        }
    }
}

/// The values of the parameter `lab`, and the address without it.
fn without_lab(uri: &Uri) -> (Vec<String>, Uri) {
    let pairs = || uri.query().unwrap_or_default().split('&');
    let labs = pairs().filter_map(|pair| pair.strip_prefix("lab="));
    let labs: Vec<_> = labs.map(|lab| lab.replace("%2A", "*").replace("%2a", "*")).collect();
    if labs.is_empty() {
        return (labs, uri.clone());
    }
    let rest: Vec<_> = pairs().filter(|pair| !pair.starts_with("lab=")).collect();
    let rest = format!("{}?{}", uri.path(), rest.join("&"));
    (labs, rest.parse().unwrap_or_else(|_| uri.clone()))
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name).map(|value| value.to_str().unwrap_or("?"))
}

/// Refuses a name that may have been made to point here (DNS rebinding): without tokens nothing else tells a
/// page of another site from the user.
fn check_name(headers: &HeaderMap, names: &[String]) -> Result<()> {
    let host = text(headers, "host").unwrap_or("localhost");
    if is_own_name(host, names) {
        return Ok(());
    }
    let detail = format!(
        "there are no tokens, so this service answers only to its own names, and {host} is none \
         of them; ask at its address, make a token, or start it with --host NAME"
    );
    Err(ApiError::new(Code::ForeignSite, detail))
}

/// Refuses a change that a page of another site may have had a browser send, as `Sec-Fetch-Site` or `Origin` show. Pages
/// of the `allowed` origins may.
fn check_site(method: &Method, headers: &HeaderMap, allowed: &[HeaderValue]) -> Result<()> {
    let origin = headers.get(header::ORIGIN);
    if method.is_safe() || origin.is_some_and(|origin| allowed.contains(origin)) {
        return Ok(());
    }
    let text = |name| text(headers, name);
    let host = text("host").unwrap_or("localhost");
    let origin = text("origin").filter(|origin| {
        origin.split_once("://").is_none_or(|(_, place)| !place.eq_ignore_ascii_case(host))
    });
    let site = text("sec-fetch-site").filter(|site| !["same-origin", "none"].contains(site));
    match origin.or(site) {
        Some(from) => {
            let detail = format!("a page of {from} may not change anything here");
            Err(ApiError::new(Code::ForeignSite, detail))
        }
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

/// What a request shows to be let in.
#[derive(Debug, PartialEq, Eq)]
enum Credential {
    Token(Secret),
    Session(Secret),
}

/// The credential of a request. A cookie without a prefix may have been set by another host of the domain, so one is not
/// accepted on HTTPS.
fn credential(headers: &HeaderMap, is_https: bool) -> Option<Credential> {
    if let Some(bearer) = headers.typed_try_get::<Authorization<Bearer>>().transpose() {
        return Secret::parse(bearer.ok()?.token().trim()).map(Credential::Token);
    }
    let cookies = headers.typed_get::<Cookie>()?;
    let plain = || cookies.get(SESSION).filter(|_| !is_https);
    let session =
        cookies.get(HOST_SESSION).or_else(|| cookies.get(SECURE_SESSION)).or_else(plain)?;
    Secret::parse(session).map(Credential::Session)
}

/// The same for a token that is missing, unknown, misspelled or revoked.
pub(super) fn missing() -> ApiError {
    let detail = "a valid token is needed, as the header Authorization: Bearer sci_...";
    ApiError::new(Code::Unauthorized, detail).with_header(
        header::WWW_AUTHENTICATE,
        HeaderValue::from_static("Bearer realm=\"sci-recon\""),
    )
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderMap, HeaderValue, Method};

    use super::{
        Credential, HOST_SESSION, SECURE_SESSION, SESSION, Secret, check_name, check_site,
        without_lab,
    };

    fn credential(headers: &HeaderMap) -> Option<Credential> {
        super::credential(headers, false)
    }

    fn headers(name: &'static str, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name.parse().unwrap(), HeaderValue::from_str(value).unwrap())])
    }

    #[test]
    fn pages_of_other_sites_are_told_by_what_browsers_say() {
        let check = |method: Method, lines: &[(&'static str, &str)]| {
            let lines = lines.iter().map(|(name, value)| headers(name, value));
            let all: HeaderMap =
                lines.flatten().map(|(name, value)| (name.unwrap(), value)).collect();
            check_name(&all, &["bench.example".into()]).is_ok()
                && check_site(&method, &all, &["http://pages.example".parse().unwrap()]).is_ok()
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
        let other = ("sec-fetch-site", "cross-site");
        assert!(check(Method::POST, &[own, ("origin", "http://pages.example"), other]));
    }

    #[test]
    fn a_token_comes_as_a_header_and_a_session_as_a_cookie() {
        let [token, session] = [Secret::random().unwrap(), Secret::random().unwrap()];
        let text = token.reveal();
        let bearer = headers("authorization", &format!("bearer {text}"));
        assert_eq!(credential(&bearer), Some(Credential::Token(token.clone())));
        let mut both = headers("cookie", &format!("a=b; {SESSION}={}; c=d", session.reveal()));
        assert_eq!(credential(&both), Some(Credential::Session(session.clone())));
        assert_eq!(super::credential(&both, true), None, "another host may have set it");
        for name in [HOST_SESSION, SECURE_SESSION] {
            let planted = format!("{SESSION}={text}; {name}={}", session.reveal());
            let cookies = headers("cookie", &planted);
            let expected = Some(Credential::Session(session.clone()));
            assert_eq!(super::credential(&cookies, true), expected);
            assert_eq!(credential(&cookies), expected);
        }
        both.extend(bearer);
        assert_eq!(credential(&both), Some(Credential::Token(token.clone())));
        for bad in [format!("Basic {text}"), text.to_owned(), "Bearer".into(), "Bearer x".into()] {
            assert_eq!(credential(&headers("authorization", &bad)), None, "{bad}");
        }
    }

    #[test]
    fn the_lab_is_taken_out_of_the_query() {
        let of = |text: &str| {
            let (labs, rest) = without_lab(&text.parse().unwrap());
            (labs.join(" "), rest.to_string())
        };
        assert_eq!(of("/v1/jobs?limit=2&lab=a&x=1"), ("a".into(), "/v1/jobs?limit=2&x=1".into()));
        assert_eq!(of("/v1/jobs?lab=%2A").0, "*");
        assert_eq!(of("/v1/jobs?lab=a&lab=b"), ("a b".into(), "/v1/jobs?".into()));
        assert_eq!(of("/v1/jobs?label=a"), (String::new(), "/v1/jobs?label=a".into()));
        assert_eq!(of("/v1/jobs"), (String::new(), "/v1/jobs".into()));
    }
}
