//! How to reach the message server, and as whom.

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

use crate::job::Pool;

/// How long the server may take to answer.
const ANSWER: Duration = Duration::from_secs(5);
/// Time between two signs of life of a connection; after two without an answer it is made anew.
const PING: Duration = Duration::from_secs(5);
/// The longest pause between two tries to connect.
const PAUSE: Duration = Duration::from_secs(2);

/// Refusals in a row after which a credential is taken for revoked; a server that has just started may not know
/// all credentials yet.
const REFUSALS: u32 = 3;

/// Why the cluster can't be worked with.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum ClusterError {
    #[error("{what} is no address of a NATS server ({reason}); one is nats://host:4222")]
    Address { what: String, reason: String },
    #[error("the credential {path}: {reason}")]
    Credential { path: String, reason: String },
    #[error("no NATS server answers at {url}: {reason}")]
    Unreachable { url: String, reason: String },
    #[error(
        "the NATS server at {url} refuses the credential (authorization violation): it is missing, revoked, past its \
         end, or of another cluster; `sci-recon cluster worker list` shows which are good"
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
    /// An error of the message server, while something was tried; for `map_err`.
    pub fn nats<E: std::fmt::Display>(action: &'static str) -> impl Fn(E) -> Self {
        move |error| Self::Nats { action, reason: error.to_string() }
    }
}

/// What a credential file holds beside the key: see `sci-recon cluster worker create`.
#[derive(Debug, Default)]
pub struct Credential {
    /// The lines before the key: the address, the pool.
    url: Option<String>,
    pool: Option<Pool>,
    /// The prefix of the subjects of answers, which the rights name.
    inbox: Option<String>,
    /// The certificate of the authority that the server is trusted by, as PEM.
    authority: Option<String>,
    /// The whole text, in which NATS finds its token and key.
    text: String,
}

impl Credential {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ClusterError::Credential`] if it can't be read.
    pub fn read(path: &Path) -> Result<Self, ClusterError> {
        let wrong = |reason: String| {
            let path = path.display().to_string();
            ClusterError::Credential { path, reason }
        };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let line = |name: &str| {
            let mut found =
                text.lines().filter_map(|line| line.strip_prefix(name)?.strip_prefix(": "));
            found.next().map(|value| value.trim().to_owned())
        };
        let pool = line("pool").map(|name| name.parse()).transpose();
        let pool = pool.map_err(|error: crate::job::InvalidPool| wrong(error.to_string()))?;
        let authority = text.find("-----BEGIN CERTIFICATE-----").and_then(|start| {
            let mark = "-----END CERTIFICATE-----\n";
            let end = text.rfind(mark)? + mark.len();
            Some(text.get(start..end)?.to_owned())
        });
        Ok(Self { url: line("url"), pool, inbox: line("inbox"), authority, text })
    }

    /// The pool that it is for, if it says so.
    pub fn pool(&self) -> Option<&Pool> {
        self.pool.as_ref()
    }
}

/// Where the message server is, and as whom one comes.
#[derive(Debug, Clone)]
pub struct Access {
    /// As they were given, separated by commas.
    urls: String,
    servers: Vec<ServerAddr>,
    options: ConnectOptions,
    /// The file from which NATS reads the authority's certificate, at each new connection.
    authority: Option<Arc<NamedTempFile>>,
    /// Tries in a row in which the server has refused the credential.
    refusals: Arc<AtomicU32>,
}

impl Access {
    /// To the servers in `urls`, which are separated by commas; where there are none, to those that the
    /// credential names. Nothing is connected yet.
    ///
    /// # Errors
    /// Addresses or a credential that can't be.
    pub fn new(
        urls: Option<&str>,
        credential: &Credential,
        name: &str,
    ) -> Result<Self, ClusterError> {
        let urls = urls.or(credential.url.as_deref()).ok_or_else(|| ClusterError::Address {
            what: "nothing".into(),
            reason: "neither --nats nor the credential names one".into(),
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
            // A large history in a beat does not wait for the loop that reads.
            .subscription_capacity(16_384)
            .reconnect_delay_callback(|tries| {
                PAUSE.min(Duration::from_millis(50 * u64::try_from(tries).unwrap_or(40)))
            })
            .event_callback(move |event| {
                count_refusals(&counted, &event);
                async move { tell(&event) }
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
        Ok(Self { urls: urls.to_owned(), servers: servers?, options, authority, refusals })
    }

    /// Connects to one of the servers.
    ///
    /// # Errors
    /// If none answers, or takes the credential.
    pub async fn connect(&self) -> Result<Connection, ClusterError> {
        let connected = self.options.clone().connect(self.servers.as_slice()).await;
        let url = self.urls.clone();
        let client = connected.map_err(|error| {
            if error.kind() == ConnectErrorKind::AuthorizationViolation {
                return ClusterError::Unauthorized { url: url.clone() };
            }
            let mut reason = error.to_string();
            let mut source = std::error::Error::source(&error);
            while let Some(error) = source {
                let text = error.to_string();
                if !reason.contains(&text) {
                    reason += &format!(": {text}");
                }
                source = error.source();
            }
            ClusterError::Unreachable { url: url.clone(), reason }
        })?;
        let context =
            ContextBuilder::new().timeout(ANSWER).ack_timeout(ANSWER).build(client.clone());
        let (refusals, _authority) = (self.refusals.clone(), self.authority.clone());
        Ok(Connection { client, context, url, refusals, _authority })
    }
}

/// A connection, which is made anew whenever it breaks.
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
    /// Whether it is there at the moment.
    pub(super) fn is_up(&self) -> bool {
        self.client.connection_state() == State::Connected
    }

    /// The error of a connection that broke and can't be made anew, since the server refuses the credential.
    pub(super) fn refusal(&self) -> Option<ClusterError> {
        let is_refused = self.refusals.load(Ordering::Relaxed) >= REFUSALS;
        is_refused.then(|| ClusterError::Unauthorized { url: self.url.clone() })
    }

    /// Says something to whoever listens, without a stream.
    pub(super) async fn say(
        &self,
        subject: String,
        what: &impl Serialize,
    ) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("send");
        let text = serde_json::to_vec(what).map_err(ClusterError::nats("write a message"))?;
        self.client.publish(subject, text.into()).await.map_err(failed)
    }
}

fn count_refusals(refusals: &AtomicU32, event: &Event) {
    // The client passes the kind of the error on as text.
    let refused = ConnectErrorKind::AuthorizationViolation.to_string();
    match event {
        Event::Connected => refusals.store(0, Ordering::Relaxed),
        Event::ClientError(ClientError::Other(text)) if *text == refused => {
            refusals.fetch_add(1, Ordering::Relaxed);
        }
        _ => {}
    }
}

fn tell(event: &Event) {
    match event {
        Event::Connected => tracing::info!("connected to NATS"),
        Event::Disconnected => tracing::warn!("the connection to NATS is lost"),
        Event::ServerError(error) => tracing::error!(%error, "NATS refuses something"),
        event => tracing::warn!(%event, "NATS"),
    }
}

#[cfg(test)]
mod tests {
    use super::Credential;

    #[test]
    fn a_credential_file_names_all_that_a_worker_needs() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("worker.creds");
        let text = "# made by a test\nurl: tls://nats.example:4222\npool: gpu\ninbox: _INBOX.x\n\
                    -----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n\
                    -----BEGIN NATS USER JWT-----\neyJ0\n------END NATS USER JWT------\n";
        std::fs::write(&path, text).unwrap();
        let found = Credential::read(&path).unwrap();
        assert_eq!(found.url.as_deref(), Some("tls://nats.example:4222"));
        assert_eq!(found.pool().unwrap().as_str(), "gpu");
        assert_eq!(found.inbox.as_deref(), Some("_INBOX.x"));
        let pem = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
        assert_eq!(found.authority.as_deref(), Some(pem));
        std::fs::write(&path, "pool: A.B\n").unwrap();
        assert!(Credential::read(&path).unwrap_err().to_string().contains("A.B"));
    }
}
