//! A client of the service for lab machines, which retries over unreliable connections.

mod download;
mod job;
mod unreachable;
mod upload;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Args;
use rand::RngExt;
use reqwest::header::LOCATION;
use reqwest::redirect::Policy;
use reqwest::{Method, Request, RequestBuilder, Response, StatusCode};
use serde_json::Value;

use super::CliError;
use super::fields::{Role, as_options};
use engine::job::with_causes;

pub(super) use download::rename_new;
pub(super) use job::{Job, Wanted};

/// Attempts at a request. With the pauses, they take about five minutes.
const MAX_ATTEMPTS: u32 = 16;
/// Longest pause between two attempts, in seconds.
const MAX_PAUSE: f64 = 30.0;

/// Address and token of a service.
#[derive(Debug, Args)]
pub struct ServiceArguments {
    /// Address of the service. For https, the certificate must be signed by an authority that this system trusts.
    /// The variable SSL_CERT_FILE names a PEM file with another authority.
    #[arg(
        long,
        env = "SCI_RECON_URL",
        value_name = "URL",
        default_value = "http://127.0.0.1:8080"
    )]
    url: String,
    /// The token of the lab. Set it in the environment or the configuration file: other users of this machine can see
    /// the command line.
    #[arg(long, env = "SCI_RECON_TOKEN", value_name = "TOKEN", hide_env_values = true)]
    token: Option<String>,
}

/// Failure of a request.
#[derive(Debug, thiserror::Error)]
pub(super) enum ClientError {
    /// The service was unreachable or unavailable for minutes. A later attempt may succeed.
    #[error("{0}")]
    Temporary(String),
    /// No service can be reached at this address, and waiting will not change that.
    #[error("{0}")]
    Unreachable(String),
    /// The service refuses the request permanently.
    #[error("the service refuses the request ({status} {code}): {detail}")]
    Refused { status: StatusCode, code: String, detail: String },
    /// An error on this machine.
    #[error("{0}")]
    Local(#[from] CliError),
}

pub(super) type Result<T, E = ClientError> = std::result::Result<T, E>;

impl ClientError {
    /// A refusal of a file, with the options of the command line in place of the fields of the API.
    pub(super) fn about(self, role: Role, file: &Path) -> Self {
        match self {
            Self::Refused { status, code, detail } => {
                let detail = format!("{}: {}", file.display(), as_options(&detail, role));
                Self::Refused { status, code, detail }
            }
            other => other,
        }
    }
}

impl From<ClientError> for CliError {
    fn from(error: ClientError) -> Self {
        match error {
            ClientError::Local(error) => error,
            ClientError::Refused { status, .. } if status.is_client_error() => {
                Self::Input(error.to_string())
            }
            ClientError::Unreachable(reason) => Self::Input(reason),
            other => Self::Failure(other.to_string()),
        }
    }
}

/// A connection to a service.
#[derive(Debug, Clone)]
pub(super) struct Client {
    url: String,
    token: Option<String>,
    http: reqwest::Client,
    /// True once the service has answered, so that address and certificate are known to be right.
    has_answered: Arc<AtomicBool>,
}

impl Client {
    pub(super) fn new(arguments: &ServiceArguments) -> Result<Self, CliError> {
        let token = arguments.token.clone().filter(|token| !token.is_empty());
        Self::at(&arguments.url, token)
    }

    /// A client of the service at `url`.
    pub(super) fn at(url: &str, token: Option<String>) -> Result<Self, CliError> {
        let wrong = |error: &dyn std::fmt::Display| {
            CliError::Input(format!("{url:?} is not an address of a service: {error}"))
        };
        let parsed = reqwest::Url::parse(url).map_err(|error| wrong(&error))?;
        if !["http", "https"].contains(&parsed.scheme()) {
            return Err(wrong(&"it must begin with http:// or https://"));
        }
        let http = crate::http_client()
            .map_err(CliError::Input)?
            // A token is not sent to another place, and the API redirects nothing.
            .redirect(Policy::none())
            .connect_timeout(Duration::from_secs(10))
            .tcp_keepalive(Duration::from_secs(30))
            // The check of a large file takes minutes.
            .read_timeout(Duration::from_secs(300))
            .build()
            .map_err(|error| CliError::Failure(with_causes(&error)))?;
        let url = url.trim_end_matches('/').to_owned();
        Ok(Self { url, token, http, has_answered: Arc::default() })
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.url));
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Sends a request, and repeats it after an interruption or a temporary refusal. The request must be idempotent.
    async fn send(&self, request: impl Fn() -> RequestBuilder) -> Result<Response> {
        let mut attempt = 0;
        loop {
            let next = built(request())?;
            let is_head = next.method() == Method::HEAD;
            let sent = self.http.execute(next).await;
            self.has_answered.fetch_or(sent.is_ok(), Ordering::Relaxed);
            let error = match sent {
                Ok(response) if response.status().is_success() => return Ok(response),
                Ok(response) if response.status().is_redirection() => self.moved(&response),
                Ok(response) if is_head => self.reason(request(), response.status()).await?,
                Ok(response) => refusal(response).await,
                Err(error) => self.interruption(&error),
            };
            wait_to_retry(error, &mut attempt).await?;
        }
    }

    /// The reason why a HEAD request was refused. The answer has no body, so the request is repeated as GET. If that has
    /// another answer, no reason is known.
    async fn reason(&self, request: RequestBuilder, status: StatusCode) -> Result<ClientError> {
        let mut request = built(request)?;
        *request.method_mut() = Method::GET;
        Ok(match self.http.execute(request).await {
            Ok(response) if response.status() == status => refusal(response).await,
            Ok(_) => refused(status, &Value::Null),
            Err(error) => self.interruption(&error),
        })
    }

    /// The error of a redirection, with the address to state instead.
    fn moved(&self, response: &Response) -> ClientError {
        let place = response.headers().get(LOCATION).and_then(|place| place.to_str().ok());
        let place = place.and_then(|place| response.url().join(place).ok()).map(|place| {
            let place = place.to_string();
            let path = response.url().as_str().strip_prefix(&self.url).unwrap_or_default();
            place.strip_suffix(path).unwrap_or(&place).to_owned()
        });
        let place = place.as_deref().unwrap_or("another place");
        let text = format!("{} redirects to {place}: give that address as --url", self.url);
        ClientError::Unreachable(text)
    }

    fn interruption(&self, error: &reqwest::Error) -> ClientError {
        let text = format!("{} can't be reached: {}", self.url, with_causes(error));
        // A service that has answered at this address is expected to return.
        let may_be_permanent = !self.has_answered.load(Ordering::Relaxed);
        match unreachable::remedy(error).filter(|_| may_be_permanent) {
            Some(remedy) => ClientError::Unreachable(format!("{text}: {remedy}")),
            None => ClientError::Temporary(text),
        }
    }

    /// Sends a request and reads the JSON answer. Repeats both if the answer is interrupted.
    async fn json(&self, request: impl Fn() -> RequestBuilder) -> Result<Value> {
        let mut attempt = 0;
        loop {
            match self.send(&request).await?.json().await {
                Ok(value) => return Ok(value),
                Err(error) => wait_to_retry(self.interruption(&error), &mut attempt).await?,
            }
        }
    }

    pub(super) async fn get(&self, path: &str) -> Result<Value> {
        self.json(|| self.request(Method::GET, path)).await
    }

    /// Gets a resource that may not exist.
    pub(super) async fn find(&self, path: &str) -> Result<Option<Value>> {
        match self.get(path).await {
            Ok(value) => Ok(Some(value)),
            Err(ClientError::Refused { status: StatusCode::NOT_FOUND, .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Gets a resource whose work may still run; the service answers at the end of the work, or after `wait` seconds.
    async fn get_ended(&self, path: &str, wait: u32) -> Result<Value> {
        let prefer = format!("wait={wait}");
        self.json(|| self.request(Method::GET, path).header("Prefer", &prefer)).await
    }

    pub(super) async fn post(&self, path: &str, body: &Value) -> Result<Value> {
        self.json(|| self.request(Method::POST, path).json(body)).await
    }

    /// Creates a resource. Repeated requests with the same key create it once.
    pub(super) async fn create(&self, path: &str, body: &Value, key: &str) -> Result<Value> {
        let request = || self.request(Method::POST, path).json(body);
        self.json(|| request().header("Idempotency-Key", key)).await
    }
}

/// Waits before the next attempt, and prints a message before the first pause. Returns the error if it is permanent,
/// or after the last attempt.
async fn wait_to_retry(error: ClientError, attempt: &mut u32) -> Result<()> {
    *attempt += 1;
    match error {
        ClientError::Temporary(reason) if *attempt < MAX_ATTEMPTS => {
            if *attempt == 1 {
                eprintln!("sci-recon: {reason}; trying again for about five minutes");
            }
        }
        error => return Err(error),
    }
    let seconds = (0.1 * f64::from(1 << (*attempt).min(10))).min(MAX_PAUSE);
    // Random pauses spread the attempts of many clients.
    let share = rand::rng().random_range(0.5..1.0);
    tokio::time::sleep(Duration::from_secs_f64(seconds * share)).await;
    Ok(())
}

fn built(request: RequestBuilder) -> Result<Request, CliError> {
    request.build().map_err(|error| CliError::Failure(with_causes(&error)))
}

/// Reads the problem in an answer without success.
async fn refusal(response: Response) -> ClientError {
    let status = response.status();
    refused(status, &response.json().await.unwrap_or_default())
}

fn refused(status: StatusCode, problem: &Value) -> ClientError {
    let detail = problem["detail"].as_str().unwrap_or("no reason is given");
    let errors = problem["errors"].as_array().into_iter().flatten();
    let pointers = errors.map(|error| error["pointer"].as_str().unwrap_or_default());
    let pointers = pointers.filter(|pointer| !pointer.is_empty()).collect::<Vec<_>>().join(", ");
    let prefix = if pointers.is_empty() { pointers } else { format!("{pointers}: ") };
    let detail = format!("{prefix}{detail}");
    let code = problem["code"].as_str().unwrap_or_default().to_owned();
    // A service that starts, stops or is full, or its proxy, answers with these.
    let is_unavailable = [408, 423, 429, 502, 503, 504, 507].contains(&status.as_u16());
    // Masks that are not finished yet, or an internal error of the service.
    let is_retryable = [409, 500].contains(&status.as_u16()) && problem["retryable"] == true;
    if is_retryable || (is_unavailable && problem["retryable"] != false) {
        return ClientError::Temporary(format!("the service answers {status} {code}: {detail}"));
    }
    ClientError::Refused { status, code, detail }
}
