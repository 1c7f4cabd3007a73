//! Credentials for the message server, and connections to it.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use async_nats::connection::State;
use async_nats::jetstream::Context;
use async_nats::jetstream::context::ContextBuilder;
use async_nats::{Client, ClientError, ConnectErrorKind, ConnectOptions, Event, ServerAddr};
use serde::Serialize;
use tempfile::NamedTempFile;

use engine::job::{Pool, with_causes};

/// Timeout of requests to the server.
const ANSWER: Duration = Duration::from_secs(5);
/// Time between two pings. After two without an answer, the client reconnects.
const PING: Duration = Duration::from_secs(5);
/// Longest pause between two attempts to connect.
const MAX_PAUSE: Duration = Duration::from_secs(2);

/// Consecutive refusals after which a credential counts as revoked. A server that has just started may not know all
/// credentials yet.
const REFUSALS: u32 = 3;

/// Failure of the message server, its credentials or its configuration.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages describe the variants
pub enum ClusterError {
    #[error("{what} is not an address of a NATS server such as nats://host:4222 ({reason})")]
    Address { what: String, reason: String },
    #[error("the credential {path}: {reason}")]
    Credential { path: String, reason: String },
    #[error("no NATS server answers at {url}: {reason}")]
    Unreachable { url: String, reason: String },
    #[error(
        "the NATS server at {url} refuses the credential (authorization violation): it is missing, revoked, expired, \
        or belongs to another cluster (`sci-recon cluster worker list` shows the valid ones); if all credentials are \
        refused, the NATS server has not read its configuration or its store: see its log"
    )]
    Unauthorized { url: String },
    #[error("NATS: can't {action}: {reason}")]
    Nats { action: &'static str, reason: String },
    #[error("the server refuses this worker: {0}")]
    Refused(String),
    #[error("{path}: {reason}")]
    Authority { path: String, reason: String },
    #[error("the cache {path}: {reason}")]
    Cache { path: String, reason: String },
}

impl ClusterError {
    /// Wraps an error of the message server during `action`; for `map_err`.
    pub fn nats<E: std::fmt::Display>(action: &'static str) -> impl Fn(E) -> Self {
        move |error| Self::Nats { action, reason: error.to_string() }
    }
}

/// The content of a credential file. `sci-recon cluster worker create` writes it.
#[derive(Debug, Default)]
pub struct Credential {
    /// The address of the message server.
    url: Option<String>,
    pool: Option<Pool>,
    /// Prefix of the subjects to which the user may receive answers.
    inbox: Option<String>,
    /// The certificate of the authority that signed the server's certificate, as PEM.
    authority: Option<String>,
    /// The complete text, from which the NATS client reads token and key.
    text: String,
}

impl Credential {
    /// Reads a file.
    /// Errors: [`ClusterError::Credential`] if it can't be read.
    pub fn read(path: &Path) -> Result<Self, ClusterError> {
        let wrong = |reason: String| {
            let path = path.display().to_string();
            ClusterError::Credential { path, reason }
        };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let field = |name: &str| {
            let mut values =
                text.lines().filter_map(|line| line.strip_prefix(name)?.strip_prefix(": "));
            values.next().map(|value| value.trim().to_owned())
        };
        let pool = field("pool").map(|name| name.parse()).transpose();
        let pool = pool.map_err(|error: engine::job::InvalidText| wrong(error.to_string()))?;
        let authority = text.find("-----BEGIN CERTIFICATE-----").and_then(|start| {
            let mark = "-----END CERTIFICATE-----\n";
            let end = text.rfind(mark)? + mark.len();
            Some(text.get(start..end)?.to_owned())
        });
        Ok(Self { url: field("url"), pool, inbox: field("inbox"), authority, text })
    }

    /// The pool that the file names.
    pub fn pool(&self) -> Option<&Pool> {
        self.pool.as_ref()
    }
}

/// Addresses of the message server, and the credential for it.
#[derive(Debug, Clone)]
pub struct Access {
    /// The addresses for messages, without passwords, separated by commas.
    urls: String,
    servers: Vec<ServerAddr>,
    options: ConnectOptions,
    /// The authority's certificate. The NATS client reads this file at each new connection.
    authority: Option<Arc<NamedTempFile>>,
    /// Consecutive attempts at which the server has refused the credential.
    refusals: Arc<AtomicU32>,
}

impl Access {
    /// Access to the servers in `urls`, separated by commas, or to those that the credential names. Does not connect.
    /// Errors: an address or the credential is invalid, or no address is known.
    pub fn new(
        urls: Option<&str>,
        credential: &Credential,
        name: &str,
    ) -> Result<Self, ClusterError> {
        let urls = urls.or(credential.url.as_deref()).ok_or_else(|| ClusterError::Address {
            what: "the empty text".into(),
            reason: "neither --nats nor the credential names an address".into(),
        })?;
        let servers: Result<Vec<ServerAddr>, ClusterError> = urls
            .split(',')
            .map(|url| {
                let wrong = |error: std::io::Error| ClusterError::Address {
                    what: format!("{url:?}"),
                    reason: error.to_string(),
                };
                url.trim().parse().map_err(wrong)
            })
            .collect();
        let refusals = Arc::new(AtomicU32::new(0));
        let counted = refusals.clone();
        let mut options = ConnectOptions::new()
            .name(name)
            .ping_interval(PING)
            .connection_timeout(ANSWER)
            .request_timeout(Some(ANSWER))
            // Allows a burst of messages before the loop that reads them catches up.
            .subscription_capacity(16_384)
            .reconnect_delay_callback(|tries| {
                MAX_PAUSE.min(Duration::from_millis(50 * u64::try_from(tries).unwrap_or(40)))
            })
            .event_callback(move |event| {
                count_refusals(&counted, &event);
                async move { log(&event) }
            });
        if let Some(inbox) = &credential.inbox {
            options = options.custom_inbox_prefix(inbox);
        }
        if credential.text.contains("-----BEGIN") {
            options = options.credentials(&credential.text).map_err(|error| {
                ClusterError::Credential { path: "file".into(), reason: error.to_string() }
            })?;
        }
        let authority = credential.authority.as_ref().map(|pem| {
            let mut file = NamedTempFile::new()?;
            file.write_all(pem.as_bytes())?;
            Ok(Arc::new(file))
        });
        let authority = authority.transpose().map_err(|error: std::io::Error| {
            ClusterError::Credential { path: "certificate".into(), reason: error.to_string() }
        })?;
        if let Some(file) = &authority {
            options = options.add_root_certificates(file.path().to_owned());
        }
        let shown: Vec<String> = urls.split(',').map(without_password).collect();
        Ok(Self { urls: shown.join(","), servers: servers?, options, authority, refusals })
    }

    /// Connects to one of the servers.
    /// Errors: no server answers, or none accepts the credential.
    pub async fn connect(&self) -> Result<Connection, ClusterError> {
        let connected = self.options.clone().connect(self.servers.as_slice()).await;
        let url = self.urls.clone();
        let client = connected.map_err(|error| {
            if error.kind() == ConnectErrorKind::AuthorizationViolation {
                return ClusterError::Unauthorized { url: url.clone() };
            }
            ClusterError::Unreachable { url: url.clone(), reason: with_causes(&error) }
        })?;
        let context =
            ContextBuilder::new().timeout(ANSWER).ack_timeout(ANSWER).build(client.clone());
        let (refusals, _authority) = (self.refusals.clone(), self.authority.clone());
        Ok(Connection { client, context, url, refusals, _authority })
    }
}

/// A connection that reconnects whenever it breaks.
#[derive(Debug, Clone)]
pub struct Connection {
    pub(super) client: Client,
    pub(super) context: Context,
    url: String,
    /// See [`Access`].
    refusals: Arc<AtomicU32>,
    _authority: Option<Arc<NamedTempFile>>,
}

impl Connection {
    /// True while the client is connected.
    pub(super) fn is_up(&self) -> bool {
        self.client.connection_state() == State::Connected
    }

    /// The error of a connection that broke, if the server now refuses the credential.
    pub(super) fn refusal(&self) -> Option<ClusterError> {
        let is_refused = self.refusals.load(Ordering::Relaxed) >= REFUSALS;
        is_refused.then(|| ClusterError::Unauthorized { url: self.url.clone() })
    }

    /// Publishes a message to the current subscribers, outside the streams.
    pub(super) async fn publish(
        &self,
        subject: String,
        message: &impl Serialize,
    ) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("send");
        let text = serde_json::to_vec(message).map_err(ClusterError::nats("write a message"))?;
        self.client.publish(subject, text.into()).await.map_err(failed)
    }
}

/// An address without the name and the password of a user.
fn without_password(url: &str) -> String {
    let (scheme, rest) = url.split_once("://").unwrap_or(("nats", url));
    rest.rsplit_once('@').map_or_else(|| url.to_owned(), |(_, host)| format!("{scheme}://{host}"))
}

fn count_refusals(refusals: &AtomicU32, event: &Event) {
    // The client reports the kind of the error as text.
    let refused = ConnectErrorKind::AuthorizationViolation.to_string();
    match event {
        Event::Connected => refusals.store(0, Ordering::Relaxed),
        Event::ClientError(ClientError::Other(text)) if *text == refused => {
            refusals.fetch_add(1, Ordering::Relaxed);
        }
        _ => {}
    }
}

fn log(event: &Event) {
    match event {
        Event::Connected => tracing::info!("connected to NATS"),
        Event::Disconnected => tracing::warn!("the connection to NATS is lost"),
        Event::ServerError(error) => tracing::error!(%error, "NATS refuses something"),
        event => tracing::warn!(%event, "NATS"),
    }
}

#[cfg(test)]
mod tests {
    use super::{Credential, without_password};

    #[test]
    fn messages_have_no_passwords() {
        for (url, shown) in [
            ("nats://user:secret@host:4222", "nats://host:4222"),
            ("user:se@cret@host", "nats://host"),
            ("tls://host:4222", "tls://host:4222"),
            ("host", "host"),
        ] {
            assert_eq!(without_password(url), shown);
        }
    }

    #[test]
    fn a_credential_file_contains_all_settings_of_a_worker() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("worker.creds");
        let text = "# made by a test\nurl: tls://nats.example:4222\npool: gpu\ninbox: _INBOX.x\n\
                    -----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n\
                    -----BEGIN NATS USER JWT-----\neyJ0\n------END NATS USER JWT------\n";
        std::fs::write(&path, text).unwrap();
        let credential = Credential::read(&path).unwrap();
        assert_eq!(credential.url.as_deref(), Some("tls://nats.example:4222"));
        assert_eq!(credential.pool().unwrap().as_str(), "gpu");
        assert_eq!(credential.inbox.as_deref(), Some("_INBOX.x"));
        let pem = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
        assert_eq!(credential.authority.as_deref(), Some(pem));
        std::fs::write(&path, "pool: A.B\n").unwrap();
        assert!(Credential::read(&path).unwrap_err().to_string().contains("A.B"));
    }
}
