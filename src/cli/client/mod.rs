//! What a lab machine says to the service, over connections that break.

mod download;
mod job;
mod unreachable;
mod upload;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Args;
use rand::Rng;
use reqwest::{RequestBuilder, Response, StatusCode};
use serde_json::Value;

use super::CliError;

pub(super) use download::place;
pub(super) use job::{Job, Wanted};

/// About five minutes until the last try.
const TRIES: u32 = 16;
/// The longest pause between two tries, in seconds.
const LONGEST: f64 = 30.0;

/// Which service.
#[derive(Debug, Args)]
pub struct ServiceArguments {
    /// Address of the service. For https, the certificate must be signed by an authority that this system trusts;
    /// the variable SSL_CERT_FILE names a PEM file with another one.
    #[arg(
        long,
        env = "SCI_RECON_URL",
        value_name = "URL",
        default_value = "http://127.0.0.1:8080"
    )]
    url: String,
    /// The token of the lab; better in the environment or the configuration file than on the command line, which
    /// others on this machine can see.
    #[arg(long, env = "SCI_RECON_TOKEN", value_name = "TOKEN", hide_env_values = true)]
    token: Option<String>,
}

/// Why the service did not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub(super) enum ClientError {
    /// It can't be reached, or can't serve this now, for minutes.
    #[error("{0}")]
    Passing(String),
    /// There is no service that can be spoken to under this address, and waiting will not change it.
    #[error("{0}")]
    Unreachable(String),
    /// It refuses this request, and will again.
    #[error("the service refuses it ({status} {code}): {detail}")]
    Refused { status: StatusCode, code: String, detail: String },
    /// Something is wrong here.
    #[error("{0}")]
    Here(#[from] CliError),
}

pub(super) type Result<T, E = ClientError> = std::result::Result<T, E>;

impl From<ClientError> for CliError {
    fn from(error: ClientError) -> Self {
        match error {
            ClientError::Here(error) => error,
            ClientError::Refused { status, .. } if status.is_client_error() => {
                Self::Input(error.to_string())
            }
            ClientError::Unreachable(reason) => Self::Input(reason),
            other => Self::Failure(other.to_string()),
        }
    }
}

/// A service.
#[derive(Debug, Clone)]
pub(super) struct Client {
    url: String,
    token: Option<String>,
    http: reqwest::Client,
    /// True once the service has answered: its address and certificate were right then.
    has_answered: Arc<AtomicBool>,
}

impl Client {
    pub(super) fn new(arguments: &ServiceArguments) -> Result<Self, CliError> {
        let token = arguments.token.clone().filter(|token| !token.is_empty());
        Self::at(&arguments.url, token)
    }

    /// The service at an address, for those who have this token.
    pub(super) fn at(url: &str, token: Option<String>) -> Result<Self, CliError> {
        let wrong = |error: &dyn std::fmt::Display| {
            CliError::Input(format!("{url:?} is no address of a service: {error}"))
        };
        let parsed = reqwest::Url::parse(url).map_err(|error| wrong(&error))?;
        if !["http", "https"].contains(&parsed.scheme()) {
            return Err(wrong(&"it must begin with http:// or https://"));
        }
        let http = reqwest::Client::builder()
            .connect_timeout(Duration::from_secs(10))
            .tcp_keepalive(Duration::from_secs(30))
            // The check of a large file takes minutes.
            .read_timeout(Duration::from_secs(300))
            .build()
            .map_err(|error| CliError::Failure(told(&error)))?;
        let url = url.trim_end_matches('/').to_owned();
        Ok(Self { url, token, http, has_answered: Arc::default() })
    }

    fn request(&self, method: reqwest::Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.url));
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Sends a request, again after a cut or a passing refusal; it must do no harm when it arrives twice.
    async fn send(&self, request: impl Fn() -> RequestBuilder) -> Result<Response> {
        let mut attempt = 0;
        loop {
            let sent = request().send().await;
            self.has_answered.fetch_or(sent.is_ok(), Ordering::Relaxed);
            let error = match sent {
                Ok(response) if response.status().is_success() => return Ok(response),
                Ok(response) => refusal(response).await,
                Err(error) => self.cut(&error),
            };
            again(error, &mut attempt).await?;
        }
    }

    fn cut(&self, error: &reqwest::Error) -> ClientError {
        let text = format!("{} can't be reached: {}", self.url, told(error));
        // A service that has answered under this address is expected back.
        let lasting = !self.has_answered.load(Ordering::Relaxed);
        match unreachable::remedy(error).filter(|_| lasting) {
            Some(remedy) => ClientError::Unreachable(format!("{text}: {remedy}")),
            None => ClientError::Passing(text),
        }
    }

    /// Reads a JSON document, again where it was cut.
    async fn json(&self, request: impl Fn() -> RequestBuilder) -> Result<Value> {
        let mut attempt = 0;
        loop {
            match self.send(&request).await?.json().await {
                Ok(value) => return Ok(value),
                Err(error) => again(self.cut(&error), &mut attempt).await?,
            }
        }
    }

    pub(super) async fn get(&self, path: &str) -> Result<Value> {
        self.json(|| self.request(reqwest::Method::GET, path)).await
    }

    /// Gets a resource whose work may still run; the service answers at the end of the work, or after `wait` seconds.
    async fn get_ended(&self, path: &str, wait: u32) -> Result<Value> {
        let prefer = format!("wait={wait}");
        self.json(|| self.request(reqwest::Method::GET, path).header("Prefer", &prefer)).await
    }

    pub(super) async fn post(&self, path: &str, body: &Value) -> Result<Value> {
        self.json(|| self.request(reqwest::Method::POST, path).json(body)).await
    }

    /// Makes a thing once, however often it is asked for with the same key.
    pub(super) async fn create(&self, path: &str, body: &Value, key: &str) -> Result<Value> {
        let make = || self.request(reqwest::Method::POST, path).json(body);
        self.json(|| make().header("Idempotency-Key", key)).await
    }
}

/// Waits before the next try, and says so before the first pause; gives the error back where that would not help,
/// or has not.
async fn again(error: ClientError, attempt: &mut u32) -> Result<()> {
    *attempt += 1;
    match error {
        ClientError::Passing(reason) if *attempt < TRIES => {
            if *attempt == 1 {
                eprintln!("sci-recon: {reason}; trying again for about five minutes");
            }
        }
        error => return Err(error),
    }
    let seconds = (0.1 * f64::from(1 << (*attempt).min(10))).min(LONGEST);
    // Not all clients at once.
    let share = rand::rng().random_range(0.5..1.0);
    tokio::time::sleep(Duration::from_secs_f64(seconds * share)).await;
    Ok(())
}

/// What an answer says that is no success.
async fn refusal(response: Response) -> ClientError {
    let status = response.status();
    refused(status, &response.json().await.unwrap_or_default())
}

fn refused(status: StatusCode, problem: &Value) -> ClientError {
    let detail = problem["detail"].as_str().unwrap_or("no reason is given");
    let places = problem["errors"].as_array().into_iter().flatten();
    let places = places.map(|error| error["pointer"].as_str().unwrap_or_default());
    let places = places.filter(|place| !place.is_empty()).collect::<Vec<_>>().join(", ");
    let place = if places.is_empty() { places } else { format!("{places}: ") };
    let detail = format!("{place}{detail}");
    let code = problem["code"].as_str().unwrap_or_default().to_owned();
    // Of a service that starts, stops or is full, or of a proxy before it.
    let passing = [408, 423, 429, 502, 503, 504, 507].contains(&status.as_u16());
    // Masks that are not made yet; a fault of the service.
    let soon = [409, 500].contains(&status.as_u16()) && problem["retryable"] == true;
    if soon || (passing && problem["retryable"] != false) {
        return ClientError::Passing(format!("the service answers {status} {code}: {detail}"));
    }
    ClientError::Refused { status, code, detail }
}

/// An error with what it came of.
fn told(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        if !text.contains(&cause_text) {
            text += &format!(": {cause_text}");
        }
        source = cause.source();
    }
    text
}
