//! Failed sign-ins: their rate and their record.

use std::net::IpAddr;
use std::time::Instant;

use axum::http::{HeaderMap, Method};

use super::client::Client;
use super::error::ApiError;
use super::rate::Rates;
use super::throttle::Throttle;
use crate::audit::{Actor, AuditLog, Entry, Outcome};

/// Failed sign-ins of an address in a minute that are answered with 401; further ones are answered with 429.
const FAILED_SIGN_INS: u32 = 100;
/// Longest recorded path, in characters.
const MAX_PATH: usize = 100;

/// Failed sign-ins, which strangers can cause at any rate.
#[derive(Debug)]
pub(super) struct SignIns {
    log: AuditLog,
    rates: Rates<IpAddr>,
    throttle: Throttle,
}

impl SignIns {
    pub(super) fn new(log: AuditLog) -> Self {
        Self { log, rates: Rates::new(FAILED_SIGN_INS), throttle: Throttle::default() }
    }

    /// Records a failed sign-in.
    /// Errors: 429 if its address has sent too many.
    pub(super) fn failed(
        &self,
        client: Option<Client>,
        method: &Method,
        path: &str,
        headers: &HeaderMap,
    ) -> Result<(), ApiError> {
        let network = client.map(|client| Client::network(client.address));
        let rate = network.and_then(|network| self.rates.take(network, Instant::now()));
        let verdict = rate.map_or(Ok(()), |rate| {
            rate.check(|quota| format!("an address may fail to sign in {quota} times"))
        });
        let entry = Entry {
            address: client.map(|client| client.address),
            object: Some(format!("{method} {path}").chars().take(MAX_PATH).collect()),
            request: request_id(headers),
            status: Some(if verdict.is_ok() { 401 } else { 429 }),
            ..Entry::new(Actor::Anyone, "sign-in", Outcome::Refused)
        };
        let log = self.log.clone();
        let summarize = move |left_out| {
            let entry = Entry::new(Actor::Anyone, "sign-in", Outcome::Refused);
            log.record(&Entry { left_out: Some(left_out), ..entry });
        };
        self.throttle.pass(|| self.log.record(&entry), summarize);
        verdict
    }
}

/// The identifier that a request has in the log.
pub(super) fn request_id(headers: &HeaderMap) -> Option<String> {
    headers.get("x-request-id")?.to_str().ok().map(str::to_owned)
}
