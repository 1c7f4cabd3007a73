//! Error answers: problem details (RFC 9457).

use std::sync::LazyLock;

use axum::Json;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use strum::{EnumString, IntoStaticStr, VariantArray};

use engine::intake::{IntakeError, Refusal, RefusalCode};
use engine::job::InvalidField;
use formats::{DiskTrouble, FormatError};
use store::StoreError;

/// The status that tus 1.0 defines for a wrong checksum.
static CHECKSUM_STATUS: LazyLock<StatusCode> =
    LazyLock::new(|| StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST));

/// Defines the codes of errors from a table: status, title, and whether a retry may succeed. The name of a code is the
/// variant in snake case. Programs rely on it, so it never changes.
macro_rules! codes {
    ($($code:ident: $status:expr, $title:literal, $retryable:literal;)*) => {
        #[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr, VariantArray)]
        #[strum(serialize_all = "snake_case", const_into_str)]
        pub enum Code {
            $($code,)*
        }

        impl Code {
            /// The status, the title, and whether the same request may succeed later.
            pub(super) fn row(self) -> (StatusCode, &'static str, bool) {
                match self {
                    $(Self::$code => ($status, $title, $retryable),)*
                }
            }
        }
    };
}

codes! {
    MalformedJson: StatusCode::BAD_REQUEST, "Body is not valid JSON", false;
    MalformedRequest: StatusCode::BAD_REQUEST, "Request can't be parsed", false;
    InvalidQuery: StatusCode::BAD_REQUEST, "Invalid query parameter", false;
    EmptyBody: StatusCode::BAD_REQUEST, "Body is empty", false;
    Unauthorized: StatusCode::UNAUTHORIZED, "Authentication required", false;
    Forbidden: StatusCode::FORBIDDEN, "Role of the token is too low", false;
    ForeignSite: StatusCode::FORBIDDEN, "Request from another site", false;
    NotFound: StatusCode::NOT_FOUND, "Not found", false;
    NotReady: StatusCode::NOT_FOUND, "Not ready yet", true;
    CalibrationNotReady: StatusCode::CONFLICT, "Calibration is not ready", true;
    MeasurementNotReady: StatusCode::CONFLICT, "Measurement is not ready", true;
    MethodNotAllowed: StatusCode::METHOD_NOT_ALLOWED, "Method not allowed", false;
    NotAcceptable: StatusCode::NOT_ACCEPTABLE, "No acceptable media type", false;
    UploadStalled: StatusCode::REQUEST_TIMEOUT, "Upload stalled", true;
    OffsetMismatch: StatusCode::CONFLICT, "Offset does not match the bytes received so far", false;
    TusVersion: StatusCode::PRECONDITION_FAILED, "Unsupported version of tus", false;
    PreconditionFailed: StatusCode::PRECONDITION_FAILED, "Resource has changed", false;
    UploadBusy: StatusCode::LOCKED, "Upload is locked by another request", true;
    UploadDamaged: StatusCode::GONE, "Bytes of the upload are lost", false;
    ChecksumMismatch: *CHECKSUM_STATUS, "Checksum does not match", true;
    InUse: StatusCode::CONFLICT, "Resource is in use", false;
    IllegalState: StatusCode::CONFLICT, "Not possible in this state", false;
    TooLarge: StatusCode::PAYLOAD_TOO_LARGE, "Body is too large", false;
    UnsupportedMediaType: StatusCode::UNSUPPORTED_MEDIA_TYPE, "Unsupported media type", false;
    RangeNotSatisfiable: StatusCode::RANGE_NOT_SATISFIABLE, "Range is outside the file", false;
    InvalidRequest: StatusCode::UNPROCESSABLE_ENTITY, "Invalid request", false;
    InvalidContent: StatusCode::UNPROCESSABLE_ENTITY, "Invalid file", false;
    SizeMismatch: StatusCode::UNPROCESSABLE_ENTITY, "Sizes do not match", false;
    HashMismatch: StatusCode::UNPROCESSABLE_ENTITY, "Hash does not match", true;
    IdempotencyKeyReused: StatusCode::UNPROCESSABLE_ENTITY, "Idempotency key belongs to another request", false;
    TooManyUploads: StatusCode::TOO_MANY_REQUESTS, "Too many uploads", true;
    TooManyWaiters: StatusCode::TOO_MANY_REQUESTS, "Too many waiting requests", true;
    TooManyChecks: StatusCode::TOO_MANY_REQUESTS, "Too many files wait for a check", true;
    RateLimited: StatusCode::TOO_MANY_REQUESTS, "Too many requests", true;
    QueueFull: StatusCode::TOO_MANY_REQUESTS, "Job queue is full", true;
    Internal: StatusCode::INTERNAL_SERVER_ERROR, "Internal error", true;
    TaskFailed: StatusCode::INTERNAL_SERVER_ERROR, "Task failed", true;
    OutOfMemory: StatusCode::INTERNAL_SERVER_ERROR, "Worker ran out of memory", true;
    WorkerCrashed: StatusCode::INTERNAL_SERVER_ERROR, "Worker crashed", true;
    WorkerLost: StatusCode::INTERNAL_SERVER_ERROR, "Workers stopped too often", true;
    MovieFailed: StatusCode::INTERNAL_SERVER_ERROR, "Movie can't be encoded", false;
    FileDamaged: StatusCode::INTERNAL_SERVER_ERROR, "Stored file is damaged", false;
    Unavailable: StatusCode::SERVICE_UNAVAILABLE, "Service is unavailable", true;
    TimedOut: StatusCode::SERVICE_UNAVAILABLE, "Request timed out", true;
    InsufficientStorage: StatusCode::INSUFFICIENT_STORAGE, "Disk is full", true;
    QuotaExceeded: StatusCode::FORBIDDEN, "Quota is exceeded", false;
}

pub type Result<T, E = ApiError> = std::result::Result<T, E>;

/// Largest estimate in `Retry-After`, in seconds.
pub(super) const MAX_RETRY_SECONDS: f64 = 600.0;

tokio::task_local! {
    /// The identifier of the request that is being answered.
    pub(super) static REQUEST_ID: String;
}

/// An error that becomes the answer to a request.
#[derive(Debug)]
pub struct ApiError {
    code: Code,
    /// False if this request can never succeed, although others with the same code may succeed later.
    may_succeed_later: bool,
    detail: String,
    errors: Vec<InvalidField>,
    reason: Option<String>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

/// The names of all codes.
fn codes() -> Vec<&'static str> {
    Code::VARIANTS.iter().map(|code| code.into_str()).collect()
}

/// The body of an error (RFC 9457).
#[derive(Debug, Serialize, schemars::JsonSchema)]
pub struct Problem {
    /// A name of the code that holds everywhere. The header `Link` of an error leads to a page that explains it.
    r#type: String,
    title: &'static str,
    status: u16,
    /// The fault, its place, and what to do.
    detail: String,
    /// Stable identifier, for programs to rely on.
    #[schemars(extend("x-extensible-enum" = codes()))]
    code: &'static str,
    /// True if the same request may succeed later.
    retryable: bool,
    /// The request, by its `X-Request-Id`.
    #[serde(skip_serializing_if = "Option::is_none")]
    instance: Option<String>,
    /// With `invalid_content`, the fault of the file: `unknown_format`, `unsupported_content`, `truncated`, `malformed`,
    /// `over_limit`, `missing_array`, `axes_ambiguous`, `no_axes`, `invalid_full_scale`, `not_finite`,
    /// `above_full_scale`, `all_masks_zero`, `mask_frame_zero` or `snapshot_zero`.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    /// JSON pointer to the first of `errors`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pointer: Option<String>,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    errors: Vec<InvalidField>,
}

impl ApiError {
    /// An error with a detail: the fault, its place, and what to do.
    pub fn new(code: Code, detail: impl Into<String>) -> Self {
        let (detail, errors, headers) = (detail.into(), Vec::new(), Vec::new());
        Self { code, may_succeed_later: true, detail, errors, reason: None, headers }
    }

    /// Errors in several fields of a request.
    pub fn fields(code: Code, errors: Vec<InvalidField>) -> Self {
        let texts: Vec<&str> = errors.iter().map(|error| error.detail.as_str()).collect();
        Self { errors: errors.clone(), ..Self::new(code, texts.join("; ")) }
    }

    /// An error in one field of a request.
    pub fn field(pointer: &str, detail: impl Into<String>) -> Self {
        Self::fields(Code::InvalidRequest, vec![InvalidField::new(pointer, detail)])
    }

    /// An error of a reference in a request. If the resource does not exist, the field is invalid (422, not 404).
    pub fn reference(pointer: &str, error: StoreError) -> Self {
        match error {
            StoreError::NotFound { .. } => Self::field(pointer, error.to_string()),
            error => error.into(),
        }
    }

    /// Adds the JSON pointer to the field of the request.
    pub fn at(mut self, pointer: &str) -> Self {
        self.errors = vec![InvalidField::new(pointer, self.detail.clone())];
        self
    }

    /// Adds a header to the answer.
    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }

    /// States an estimate of the seconds after which the request may succeed.
    pub(super) fn retry_after(self, seconds: u64) -> Self {
        self.with_header(header::RETRY_AFTER, seconds.into())
    }

    /// The body of the answer.
    pub(super) fn problem(&self) -> Problem {
        let (status, title, retryable) = self.code.row();
        let code = self.code.into_str();
        Problem {
            r#type: format!("urn:sci-recon:problem:{code}"),
            title,
            status: status.as_u16(),
            detail: self.detail.clone(),
            code,
            retryable: retryable && self.may_succeed_later,
            instance: REQUEST_ID.try_with(|id| format!("urn:sci-recon:request:{id}")).ok(),
            reason: self.reason.clone(),
            pointer: self.errors.first().map(|error| error.pointer.clone()),
            errors: self.errors.clone(),
        }
    }

    pub(super) fn code(&self) -> Code {
        self.code
    }

    /// The problem of a failed job. It does not name the current request.
    pub(super) fn problem_of_job(&self) -> Problem {
        Problem { instance: None, ..self.problem() }
    }

    /// An internal error. The cause is logged and not sent to the client.
    pub fn internal(cause: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error = cause, "a request failed");
        Self::new(
            Code::Internal,
            "the service failed; its log has the cause under the identifier of this request",
        )
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let (status, _, retryable) = self.code.row();
        let retryable = retryable && self.may_succeed_later;
        let mut response = (status, Json(self.problem())).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if retryable && (status == StatusCode::TOO_MANY_REQUESTS || status.is_server_error()) {
            headers.insert(header::RETRY_AFTER, HeaderValue::from_static("5"));
        }
        let page = format!("</problems/{}>; rel=\"help\"", self.code.into_str());
        if let Ok(page) = HeaderValue::try_from(page) {
            headers.insert(header::LINK, page);
        }
        for (name, value) in self.headers {
            headers.insert(name, value);
        }
        response
    }
}

fn disk_error(trouble: DiskTrouble, cause: &(dyn std::error::Error + 'static)) -> ApiError {
    tracing::error!(error = cause, ?trouble, "no file can be written to the disk");
    Refusal::disk_trouble(trouble).into()
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        if let Some(trouble) = error.disk_trouble() {
            return disk_error(trouble, &error);
        }
        let code = match &error {
            StoreError::NotFound { .. } => Code::NotFound,
            StoreError::Unready { .. } => Code::CalibrationNotReady,
            StoreError::Unchecked { .. } => Code::MeasurementNotReady,
            StoreError::InUse { .. } | StoreError::FileInUse(_) => Code::InUse,
            StoreError::State(_) | StoreError::NotFinal(_) | StoreError::Ended(_) => {
                Code::IllegalState
            }
            StoreError::KeyReused { .. } => Code::IdempotencyKeyReused,
            StoreError::HashMismatch { .. } => Code::HashMismatch,
            StoreError::QueueFull { .. } => Code::QueueFull,
            StoreError::Quota { .. } => Code::QuotaExceeded,
            StoreError::ManyPartials(_) => Code::TooManyUploads,
            StoreError::ManyChecks { .. } => Code::TooManyChecks,
            StoreError::NoRoom { .. } | StoreError::NoShare { .. } => Code::InsufficientStorage,
            StoreError::Short { .. } => {
                tracing::error!(%error, "bytes of an upload are lost");
                Code::UploadDamaged
            }
            StoreError::Damaged { .. } => Code::FileDamaged,
            StoreError::Interrupted | StoreError::Restless(_) => Code::Unavailable,
            StoreError::DatabaseGone(_) => {
                tracing::error!(%error, "a change is refused");
                let detail = "the database of the service was removed or replaced, so nothing is changed: its \
                              administrator must restore it";
                return Self::new(Code::Unavailable, detail);
            }
            busy if busy.is_busy() => {
                tracing::warn!(%error, "the database is busy");
                let detail = "the database is busy and nothing was changed; try again";
                return Self::new(Code::Unavailable, detail);
            }
            StoreError::Database(_)
            | StoreError::Migrate(_)
            | StoreError::Upgrade { .. }
            | StoreError::Newer { .. }
            | StoreError::Io { .. }
            | StoreError::NoFolder(_)
            | StoreError::Taken(_)
            | StoreError::Refused { .. }
            | StoreError::Corrupt { .. } => return Self::internal(&error),
        };
        if let StoreError::ManyChecks { mean_seconds: Some(seconds), .. } = error {
            let seconds = seconds.clamp(1.0, MAX_RETRY_SECONDS).ceil() as u64;
            return Self::new(code, error.to_string()).retry_after(seconds);
        }
        // A failed calibration or measurement never becomes ready.
        let may_succeed_later = !matches!(
            error,
            StoreError::Unready { error: Some(_), .. }
                | StoreError::Unchecked { error: Some(_), .. }
        );
        Self { may_succeed_later, ..Self::new(code, error.to_string()) }
    }
}

impl From<Refusal> for ApiError {
    fn from(Refusal { code, detail, pointer, reason }: Refusal) -> Self {
        let code = match code {
            RefusalCode::InvalidRequest => Code::InvalidRequest,
            RefusalCode::InvalidContent => Code::InvalidContent,
            RefusalCode::SizeMismatch => Code::SizeMismatch,
            RefusalCode::UploadDamaged => Code::UploadDamaged,
            RefusalCode::QuotaExceeded => Code::QuotaExceeded,
            RefusalCode::InsufficientStorage => Code::InsufficientStorage,
            RefusalCode::TimedOut => Code::TimedOut,
            RefusalCode::Unavailable => Code::Unavailable,
            RefusalCode::Internal => Code::Internal,
        };
        let refused = Self { reason, ..Self::new(code, detail) };
        match pointer {
            Some(pointer) => refused.at(&pointer),
            None => refused,
        }
    }
}

impl From<FormatError> for ApiError {
    fn from(error: FormatError) -> Self {
        IntakeError::from(error).into()
    }
}

impl From<IntakeError> for ApiError {
    fn from(error: IntakeError) -> Self {
        match Refusal::try_from(error) {
            Ok(refusal) => refusal.into(),
            Err(IntakeError::Stopped) => StoreError::Interrupted.into(),
            Err(error) => Self::internal(&error),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::Value;
    use strum::VariantArray;

    use super::Code;

    /// The codes that a text names in backticks.
    fn named(text: &str) -> impl Iterator<Item = &str> {
        text.split('`').skip(1).step_by(2).filter(|word| word.parse::<Code>().is_ok())
    }

    #[test]
    fn the_contract_has_every_code_under_its_status_and_no_other() {
        let contract: Value = serde_yaml_ng::from_str(include_str!("../../openapi.yaml")).unwrap();
        let codes = Code::VARIANTS.iter().map(|code| code.into_str());
        let listed = &contract["components"]["schemas"]["Problem"]["properties"]["code"];
        let listed = listed["x-extensible-enum"].as_array().unwrap();
        assert_eq!(
            listed.iter().map(|code| code.as_str().unwrap()).collect::<BTreeSet<_>>(),
            codes.collect()
        );
        // The codes that the answers of all operations name, with their status.
        let mut documented = BTreeSet::new();
        for path in contract["paths"].as_object().unwrap().values() {
            for operation in path.as_object().unwrap().values() {
                let Some(answers) = operation["responses"].as_object() else { continue };
                for (status, answer) in answers {
                    let place = answer["$ref"].as_str().map(|place| place.trim_start_matches('#'));
                    let answer = place.map_or(answer, |place| contract.pointer(place).unwrap());
                    let text = answer["description"].as_str().unwrap();
                    documented.extend(named(text).map(|code| (status.clone(), code)));
                }
            }
        }
        // Codes of failed jobs are not answers to requests.
        let reasons = &contract["components"]["schemas"]["JobProblem"]["description"];
        let reasons = named(reasons.as_str().unwrap());
        documented.extend(reasons.map(|code| ("500".to_owned(), code)));
        // The operations do not list 405; the introduction describes it.
        let about = contract["info"]["description"].as_str().unwrap();
        assert!(about.contains("405 (`method_not_allowed`)"));
        documented.insert(("405".into(), "method_not_allowed"));
        let status = |code: &Code| code.row().0.as_u16().to_string();
        let sent = Code::VARIANTS.iter().map(|code| (status(code), code.into_str()));
        assert_eq!(documented, sent.collect());
    }
}
