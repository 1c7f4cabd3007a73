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

/// Defines the codes of errors from a table: status, title, whether a retry may succeed, and the meaning with instructions for
/// the user. The name of a code is the variant in snake case. Programs rely on it, so it never changes.
macro_rules! codes {
    ($($code:ident: $status:expr, $title:literal, $retryable:literal, $meaning:literal;)*) => {
        #[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr, VariantArray)]
        #[strum(serialize_all = "snake_case", const_into_str)]
        pub enum Code {
            $($code,)*
        }

        impl Code {
            /// The status, the title, whether the same request may succeed later, and the meaning.
            pub(super) fn row(self) -> (StatusCode, &'static str, bool, &'static str) {
                match self {
                    $(Self::$code => ($status, $title, $retryable, $meaning),)*
                }
            }
        }
    };
}

codes! {
    MalformedJson: StatusCode::BAD_REQUEST, "Body is not valid JSON", false,
        "The body is not valid JSON. The detail has the line and the column.";
    MalformedRequest: StatusCode::BAD_REQUEST, "Request can't be parsed", false,
        "A header, a form or the body can't be parsed, or the body is incomplete. The detail says which.";
    InvalidQuery: StatusCode::BAD_REQUEST, "Invalid query parameter", false,
        "A query parameter is unknown, or its value is invalid.";
    EmptyBody: StatusCode::BAD_REQUEST, "Body is empty", false,
        "The request needs a body.";
    Unauthorized: StatusCode::UNAUTHORIZED, "Authentication required", false,
        "Send a token as Authorization: Bearer. Unknown, misspelled, expired and revoked tokens get the same \
         answer. An administrator of the service can create a new token.";
    Forbidden: StatusCode::FORBIDDEN, "Token does not permit the request", false,
        "The role of the token is too low, or the token is for one lab only. Role read may read, submit may also change, \
         and admin may also read the metrics. A token for all labs may name another lab.";
    ForeignSite: StatusCode::FORBIDDEN, "Request from another site", false,
        "A service without tokens answers only requests to its own host names, and rejects changes from pages of \
         other sites. Use the address of the service, create a token, or start the service with --host NAME.";
    NotFound: StatusCode::NOT_FOUND, "Not found", false,
        "No resource has this address or identifier, or it belongs to another lab.";
    NotReady: StatusCode::NOT_FOUND, "Not ready yet", true,
        "The job or the calibration has not reached this step yet. Its state shows the progress.";
    CalibrationNotReady: StatusCode::CONFLICT, "Calibration is not ready", true,
        "The masks of the calibration are still being computed or checked. Wait until its state is ready. A failed \
         calibration never becomes ready; its error has the reason.";
    MeasurementNotReady: StatusCode::CONFLICT, "Measurement is not ready", true,
        "The measurement is still being checked. Wait until its state is ready. A failed measurement never becomes \
         ready; its problem has the reason.";
    MethodNotAllowed: StatusCode::METHOD_NOT_ALLOWED, "Method not allowed", false,
        "The header Allow lists the methods of this address.";
    NotAcceptable: StatusCode::NOT_ACCEPTABLE, "No acceptable media type", false,
        "The header Accept excludes all media types that this address has. The detail lists them.";
    UploadStalled: StatusCode::REQUEST_TIMEOUT, "Upload stalled", true,
        "The service received no data for too long. Send the file again, preferably as a resumable upload \
         (/v1/uploads).";
    OffsetMismatch: StatusCode::CONFLICT, "Offset does not match the bytes received so far", false,
        "Send HEAD to the upload: Upload-Offset is the offset of the next piece.";
    TusVersion: StatusCode::PRECONDITION_FAILED, "Unsupported version of tus", false,
        "Send the header Tus-Resumable: 1.0.0.";
    PreconditionFailed: StatusCode::PRECONDITION_FAILED, "Resource has changed", false,
        "The resource has changed since the state that If-Match names. Read it again, and decide whether the change \
         is still needed.";
    UploadBusy: StatusCode::LOCKED, "Upload is locked by another request", true,
        "Another request is writing to this upload. Wait until it ends.";
    UploadDamaged: StatusCode::GONE, "Bytes of the upload are lost", false,
        "The received bytes are lost or damaged on the disk of the service. Send the file again.";
    ChecksumMismatch: *CHECKSUM_STATUS, "Checksum does not match", true,
        "The piece was damaged in transit. Send it again.";
    InUse: StatusCode::CONFLICT, "Resource is in use", false,
        "Other resources refer to this one. Delete those first; the detail counts them.";
    IllegalState: StatusCode::CONFLICT, "Not possible in this state", false,
        "The state of the resource does not allow this. For example, a succeeded job can't be cancelled.";
    TooLarge: StatusCode::PAYLOAD_TOO_LARGE, "Body is too large", false,
        "The body is larger than the limit in the detail.";
    UnsupportedMediaType: StatusCode::UNSUPPORTED_MEDIA_TYPE, "Unsupported media type", false,
        "The header Content-Type or Content-Encoding has an unsupported value. The detail has the right one.";
    RangeNotSatisfiable: StatusCode::RANGE_NOT_SATISFIABLE, "Range is outside the file", false,
        "The range begins after the end of the file.";
    InvalidRequest: StatusCode::UNPROCESSABLE_ENTITY, "Invalid request", false,
        "Each item of errors names a field and its allowed values.";
    InvalidContent: StatusCode::UNPROCESSABLE_ENTITY, "Invalid file", false,
        "The file is invalid. The detail describes the fault; reason is a short name of it.";
    SizeMismatch: StatusCode::UNPROCESSABLE_ENTITY, "Sizes do not match", false,
        "Rows, columns or frames of related resources differ.";
    HashMismatch: StatusCode::UNPROCESSABLE_ENTITY, "Hash does not match", true,
        "The received bytes have another SHA-256 than the request states. Send them again.";
    IdempotencyKeyReused: StatusCode::UNPROCESSABLE_ENTITY, "Idempotency key belongs to another request", false,
        "The key was used for a different request. Use a new key for each new resource.";
    TooManyUploads: StatusCode::TOO_MANY_REQUESTS, "Too many uploads", true,
        "The service or the lab has too many uploads at the same time, or too many incomplete resumable uploads. \
         Retry after the seconds in Retry-After.";
    TooManyWaiters: StatusCode::TOO_MANY_REQUESTS, "Too many waiting requests", true,
        "Too many requests of the lab wait for jobs. Send the request without wait, or listen to /v1/events, which \
         reports changes of all jobs.";
    TooManyChecks: StatusCode::TOO_MANY_REQUESTS, "Too many files wait for a check", true,
        "Too many files of the lab wait for a check. Retry when some checks are finished.";
    RateLimited: StatusCode::TOO_MANY_REQUESTS, "Too many requests", true,
        "The token has sent more requests than allowed in a minute. Continue after the seconds in Retry-After.";
    QueueFull: StatusCode::TOO_MANY_REQUESTS, "Job queue is full", true,
        "Too many jobs are in the queue. Retry later, or cancel some jobs.";
    Internal: StatusCode::INTERNAL_SERVER_ERROR, "Internal error", true,
        "The log of the service has the cause, under the identifier of the request.";
    TaskFailed: StatusCode::INTERNAL_SERVER_ERROR, "Task failed", true,
        "Do what the detail says. If it names nothing that you can change, retry the job.";
    OutOfMemory: StatusCode::INTERNAL_SERVER_ERROR, "Worker ran out of memory", true,
        "Use smaller tiles, fewer workers or a machine with more memory, then retry the job.";
    WorkerCrashed: StatusCode::INTERNAL_SERVER_ERROR, "Worker crashed", true,
        "Retry the job. If the worker crashes again, report it with the log of the service.";
    WorkerLost: StatusCode::INTERNAL_SERVER_ERROR, "Workers stopped too often", true,
        "Workers were killed or stopped responding. Make sure that they keep running, then retry the job.";
    MovieFailed: StatusCode::INTERNAL_SERVER_ERROR, "Movie can't be encoded", false,
        "A worker has tried three times; the detail has the reason. To try again, create the movie again.";
    ReportFailed: StatusCode::INTERNAL_SERVER_ERROR, "Report can't be made", false,
        "The workers have tried as often as they may; the detail has the reason. The masks are stored, and jobs can \
         use them. To try again, create the calibration again.";
    FileDamaged: StatusCode::INTERNAL_SERVER_ERROR, "Stored file is damaged", false,
        "The file is lost or damaged on the disk of the service, so it is not sent. Retry its job to create the \
         file again.";
    Unavailable: StatusCode::SERVICE_UNAVAILABLE, "Service is unavailable", true,
        "The service is shutting down, or has no capacity at the moment.";
    TimedOut: StatusCode::SERVICE_UNAVAILABLE, "Request timed out", true,
        "The request took longer than the limit of the service.";
    InsufficientStorage: StatusCode::INSUFFICIENT_STORAGE, "Disk is full", true,
        "Delete jobs and uploads that are not needed, or use a larger disk.";
    QuotaExceeded: StatusCode::FORBIDDEN, "Quota is exceeded", false,
        "Delete uploads, jobs, or prepared arrays, or ask for a higher limit. The detail has the numbers.";
}

pub type Result<T, E = ApiError> = std::result::Result<T, E>;

/// Largest estimate in `Retry-After`, in seconds.
pub(super) const MAX_RETRY_SECONDS: f64 = 600.0;

/// An estimate in seconds, as `Retry-After` states it.
pub(super) fn retry_seconds(estimate: f64) -> u64 {
    estimate.clamp(1.0, MAX_RETRY_SECONDS).ceil() as u64
}

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
    /// `over_limit`, `missing_array`, `axes_ambiguous`, `no_axes`, `invalid_part`, `invalid_full_scale`,
    /// `not_finite`, `above_full_scale`, `bipolar_masks`, `all_masks_zero`, `mask_frame_zero` or `snapshot_zero`.
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

    /// As [`Self::retry_after`], if there is an estimate.
    fn retry_soon(self, estimate: Option<f64>) -> Self {
        match estimate {
            Some(estimate) => self.retry_after(retry_seconds(estimate)),
            None => self,
        }
    }

    /// The body of the answer.
    pub(super) fn problem(&self) -> Problem {
        let (status, title, retryable, _) = self.code.row();
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
        let (status, ..) = self.code.row();
        let mut response = (status, Json(self.problem())).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
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
        let retry_seconds = error.retry_seconds();
        let code = match &error {
            StoreError::NotFound { .. } => Code::NotFound,
            StoreError::NotReady { what: "calibration", .. } => Code::CalibrationNotReady,
            StoreError::NotReady { .. } => Code::MeasurementNotReady,
            StoreError::InUse { .. } | StoreError::JobInUse(_) | StoreError::FileInUse(_) => {
                Code::InUse
            }
            StoreError::State(_) | StoreError::NotFinal(_) | StoreError::Ended(_) => {
                Code::IllegalState
            }
            StoreError::KeyReused { .. } => Code::IdempotencyKeyReused,
            StoreError::HashMismatch { .. } => Code::HashMismatch,
            StoreError::QueueFull { .. } => Code::QueueFull,
            StoreError::Quota { .. } => Code::QuotaExceeded,
            StoreError::ManyPartials { .. } => Code::TooManyUploads,
            StoreError::ManyChecks { .. } => Code::TooManyChecks,
            StoreError::NoRoom { .. } | StoreError::NoShare { .. } => Code::InsufficientStorage,
            StoreError::Short { .. } => {
                tracing::error!(%error, "bytes of an upload are lost");
                Code::UploadDamaged
            }
            StoreError::Damaged { .. } => Code::FileDamaged,
            StoreError::Interrupted | StoreError::Restless(_) => Code::Unavailable,
            damage if damage.is_damage() => {
                tracing::error!(%error, "the database is damaged");
                let detail = "the database of the service is damaged: its administrator must restore a backup";
                return Self::new(Code::Unavailable, detail);
            }
            StoreError::DatabaseGone(_) => {
                tracing::error!(%error, "a change is refused");
                let detail = "the data folder or the database of the service was moved, removed, replaced or truncated, so \
                              nothing is changed: its administrator must restore it";
                return Self::new(Code::Unavailable, detail);
            }
            busy if busy.is_busy() => {
                tracing::warn!(%error, "the database is busy");
                let detail = "the database is busy and nothing was changed; try again";
                return Self::new(Code::Unavailable, detail).retry_soon(retry_seconds);
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
        // A failed calibration or measurement never becomes ready.
        let may_succeed_later = !matches!(error, StoreError::NotReady { error: Some(_), .. });
        Self { may_succeed_later, ..Self::new(code, error.to_string()) }.retry_soon(retry_seconds)
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
