//! Records every change that a request makes or attempts.

use axum::extract::{Request, State};
use axum::http::header;
use axum::middleware::Next;
use axum::response::Response;

use super::access::Admitted;
use super::client::Client;
use super::sign_ins::request_id;
use crate::audit::{Actor, AuditLog, Entry, Outcome};

/// Longest recorded identifier, in characters.
const MAX_OBJECT: usize = 100;

/// Records a request that changes something, with the status of its answer. `route` is the path with parameters.
pub(super) async fn record(
    State((log, route)): State<(AuditLog, &'static str)>,
    request: Request,
    next: Next,
) -> Response {
    if request.method().is_safe() {
        return next.run(request).await;
    }
    let mut change = Change::new(log, route, &request);
    let response = next.run(request).await;
    change.answered(&response);
    response
}

/// A change in progress. It is recorded when this is dropped, also if the client disconnects before the answer.
struct Change {
    log: AuditLog,
    admitted: Admitted,
    entry: Entry,
}

impl Change {
    fn new(log: AuditLog, route: &str, request: &Request) -> Self {
        let action = format!("{} {route}", request.method());
        let parts = route.split('/').zip(request.uri().path().split('/'));
        let object = parts.into_iter().find(|(name, _)| name.starts_with('{'));
        let entry = Entry {
            object: object.map(|(_, part)| part.chars().take(MAX_OBJECT).collect()),
            request: request_id(request.headers()),
            address: request.extensions().get::<Client>().map(|client| client.address),
            ..Entry::new(Actor::Anyone, action, Outcome::Interrupted)
        };
        Self { log, admitted: Admitted::of(request), entry }
    }

    fn answered(&mut self, response: &Response) {
        let status = response.status().as_u16();
        self.entry.status = Some(status);
        self.entry.outcome = Outcome::from_status(status);
        // A created resource is named by its location.
        if self.entry.object.is_none() {
            let location = response.headers().get(header::LOCATION);
            let path = location.and_then(|location| location.to_str().ok());
            let id = path.and_then(|path| path.rsplit('/').next());
            self.entry.object = id.map(str::to_owned);
        }
    }
}

impl Drop for Change {
    fn drop(&mut self) {
        // A request without access changes nothing.
        let Some(access) = self.admitted.get() else { return };
        let entry = &mut self.entry;
        entry.actor = match (&access.session, access.token) {
            (Some(_), _) => Actor::Session,
            (None, Some(_)) => Actor::Token,
            (None, None) => Actor::Anyone,
        };
        (entry.lab, entry.token, entry.note) = (Some(access.lab), access.token, access.note);
        self.log.record(&self.entry);
    }
}
