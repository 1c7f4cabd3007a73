//! Errors as the user sees them: problem+json (RFC 9457).

use std::sync::LazyLock;

use axum::Json;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use crate::formats::FormatError;
use crate::intake::IntakeError;
use crate::job::InvalidField;
use crate::store::StoreError;

/// What can be wrong. The name in [`Code::row`] never changes, for programs to rely on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the table says it
pub enum Code {
    MalformedJson,
    MalformedRequest,
    InvalidQuery,
    EmptyBody,
    Unauthorized,
    Forbidden,
    NotFound,
    NotReady,
    CalibrationNotReady,
    MethodNotAllowed,
    UploadStalled,
    OffsetMismatch,
    TusVersion,
    UploadBusy,
    UploadDamaged,
    ChecksumMismatch,
    InUse,
    IllegalState,
    TooLarge,
    UnsupportedMediaType,
    RangeNotSatisfiable,
    InvalidRequest,
    InvalidContent,
    SizeMismatch,
    HashMismatch,
    IdempotencyKeyReused,
    TooManyUploads,
    QueueFull,
    Internal,
    Unavailable,
    TimedOut,
    InsufficientStorage,
    QuotaExceeded,
}

/// tus 1.0 has a status of its own for this.
static CHECKSUM_STATUS: LazyLock<StatusCode> =
    LazyLock::new(|| StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST));

impl Code {
    /// The table: status, stable name, title, and whether the same request may succeed later.
    #[rustfmt::skip]
    pub fn row(self) -> (StatusCode, &'static str, &'static str, bool) {
        use StatusCode as S;
        match self {
            Self::MalformedJson => (S::BAD_REQUEST, "malformed_json", "The body is not JSON", false),
            Self::MalformedRequest => (S::BAD_REQUEST, "malformed_request", "The request can't be read", false),
            Self::InvalidQuery => (S::BAD_REQUEST, "invalid_query", "A query parameter is wrong", false),
            Self::EmptyBody => (S::BAD_REQUEST, "empty_body", "The body is empty", false),
            Self::Unauthorized => (S::UNAUTHORIZED, "unauthorized", "Who is there?", false),
            Self::Forbidden => (S::FORBIDDEN, "forbidden", "The token does not allow it", false),
            Self::NotFound => (S::NOT_FOUND, "not_found", "There is no such thing", false),
            Self::NotReady => (S::NOT_FOUND, "not_ready", "It is not there yet", true),
            Self::CalibrationNotReady => (S::CONFLICT, "calibration_not_ready", "The masks are not there", true),
            Self::MethodNotAllowed => (S::METHOD_NOT_ALLOWED, "method_not_allowed", "Not with this method", false),
            Self::UploadStalled => (S::REQUEST_TIMEOUT, "upload_stalled", "The upload came to a halt", true),
            Self::OffsetMismatch => (S::CONFLICT, "offset_mismatch", "The piece does not follow", false),
            Self::TusVersion => (S::PRECONDITION_FAILED, "tus_version", "Not in this version of tus", false),
            Self::UploadBusy => (S::LOCKED, "upload_busy", "Another request is at it", true),
            Self::UploadDamaged => (S::GONE, "upload_damaged", "Bytes of the upload are lost", false),
            Self::ChecksumMismatch => (*CHECKSUM_STATUS, "checksum_mismatch", "The piece has come damaged", true),
            Self::InUse => (S::CONFLICT, "in_use", "Something else needs it", false),
            Self::IllegalState => (S::CONFLICT, "illegal_state", "Not in this state", false),
            Self::TooLarge => (S::PAYLOAD_TOO_LARGE, "too_large", "The body is too large", false),
            Self::UnsupportedMediaType => (S::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", "Not in this media type", false),
            Self::RangeNotSatisfiable => (S::RANGE_NOT_SATISFIABLE, "range_not_satisfiable", "The range is outside", false),
            Self::InvalidRequest => (S::UNPROCESSABLE_ENTITY, "invalid_request", "The request does not fit", false),
            Self::InvalidContent => (S::UNPROCESSABLE_ENTITY, "invalid_content", "The file does not fit", false),
            Self::SizeMismatch => (S::UNPROCESSABLE_ENTITY, "size_mismatch", "The sizes do not fit", false),
            Self::HashMismatch => (S::UNPROCESSABLE_ENTITY, "hash_mismatch", "The bytes are not those named", true),
            Self::IdempotencyKeyReused => (S::UNPROCESSABLE_ENTITY, "idempotency_key_reused", "The key was used for another request", false),
            Self::TooManyUploads => (S::TOO_MANY_REQUESTS, "too_many_uploads", "Too many uploads at once", true),
            Self::QueueFull => (S::TOO_MANY_REQUESTS, "queue_full", "Enough jobs wait", true),
            Self::Internal => (S::INTERNAL_SERVER_ERROR, "internal", "The service has failed", true),
            Self::Unavailable => (S::SERVICE_UNAVAILABLE, "unavailable", "The service can't serve this now", true),
            Self::TimedOut => (S::SERVICE_UNAVAILABLE, "timed_out", "The answer took too long", true),
            Self::InsufficientStorage => (S::INSUFFICIENT_STORAGE, "insufficient_storage", "The disk is full", true),
            Self::QuotaExceeded => (S::INSUFFICIENT_STORAGE, "quota_exceeded", "The token's limit is reached", false),
        }
    }
}

/// What the functions of this folder give.
pub type Result<T, E = ApiError> = std::result::Result<T, E>;

/// An error on its way to the user.
#[derive(Debug)]
pub struct ApiError {
    code: Code,
    detail: String,
    errors: Vec<InvalidField>,
    reason: Option<&'static str>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

/// The body of an error.
#[derive(Debug, Serialize)]
struct Problem<'a> {
    r#type: String,
    title: &'a str,
    status: u16,
    detail: &'a str,
    code: &'a str,
    retryable: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<&'a str>,
    /// Where the first of `errors` stands, for programs that look at one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pointer: Option<&'a str>,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    errors: &'a [InvalidField],
}

impl ApiError {
    /// An error with what is wrong, where, and what would be right.
    pub fn new(code: Code, detail: impl Into<String>) -> Self {
        let (detail, errors, headers) = (detail.into(), Vec::new(), Vec::new());
        Self { code, detail, errors, reason: None, headers }
    }

    /// A request with fields that are wrong.
    pub fn fields(code: Code, errors: Vec<InvalidField>) -> Self {
        let texts: Vec<&str> = errors.iter().map(|error| error.detail.as_str()).collect();
        Self { errors: errors.clone(), ..Self::new(code, texts.join("; ")) }
    }

    /// A request with one field that is wrong.
    pub fn field(pointer: &str, detail: impl Into<String>) -> Self {
        Self::fields(Code::InvalidRequest, vec![InvalidField::new(pointer, detail)])
    }

    /// What a request names and is not there is an error of the request.
    pub fn reference(pointer: &str, error: StoreError) -> Self {
        match error {
            StoreError::NotFound { .. } => Self::field(pointer, error.to_string()),
            error => error.into(),
        }
    }

    /// The same error with the place in the request.
    pub fn at(mut self, pointer: &str) -> Self {
        self.errors = vec![InvalidField::new(pointer, self.detail.clone())];
        self
    }

    /// The same error with a header in the answer.
    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }

    /// An error of ours: the log gets the cause, the user does not.
    pub fn internal(cause: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error = cause, "a request failed");
        Self::new(Code::Internal, "an error of the service; its log says more")
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let (status, code, title, retryable) = self.code.row();
        let problem = Problem {
            r#type: format!("urn:sci-recon:problem:{code}"),
            title,
            status: status.as_u16(),
            detail: &self.detail,
            code,
            retryable,
            reason: self.reason,
            pointer: self.errors.first().map(|error| error.pointer.as_str()),
            errors: &self.errors,
        };
        let mut response = (status, Json(problem)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if retryable && (status == StatusCode::TOO_MANY_REQUESTS || status.is_server_error()) {
            headers.insert(header::RETRY_AFTER, HeaderValue::from_static("5"));
        }
        headers.extend(self.headers);
        response
    }
}

fn disk_full(cause: &(dyn std::error::Error + 'static)) -> ApiError {
    tracing::error!(error = cause, "the disk is full");
    ApiError::new(Code::InsufficientStorage, "the disk of the service is full")
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        let code = match &error {
            StoreError::NotFound { .. } => Code::NotFound,
            StoreError::Unready { .. } => Code::CalibrationNotReady,
            StoreError::InUse { .. } => Code::InUse,
            StoreError::State(_) | StoreError::NotFinal(_) => Code::IllegalState,
            StoreError::KeyReused { .. } => Code::IdempotencyKeyReused,
            StoreError::HashMismatch { .. } => Code::HashMismatch,
            StoreError::QueueFull { .. } => Code::QueueFull,
            StoreError::Short { .. } => {
                tracing::error!(%error, "bytes of an upload are lost");
                Code::UploadDamaged
            }
            StoreError::Interrupted => Code::Unavailable,
            full if full.is_disk_full() => return disk_full(full),
            StoreError::Database(_)
            | StoreError::Migrate(_)
            | StoreError::Io { .. }
            | StoreError::NoFolder(_)
            | StoreError::Taken(_)
            | StoreError::Refused { .. }
            | StoreError::Corrupt { .. } => return Self::internal(&error),
        };
        Self::new(code, error.to_string())
    }
}

impl From<FormatError> for ApiError {
    fn from(error: FormatError) -> Self {
        if error.is_disk_full() {
            return disk_full(&error);
        }
        if !error.is_callers_fault() {
            return Self::internal(&error);
        }
        let refused = Self::new(Code::InvalidContent, error.to_string());
        let refused = Self { reason: Some(error.code()), ..refused };
        match error {
            FormatError::FullScale(_) => refused.at("/full_scale"),
            _ => refused,
        }
    }
}

impl From<IntakeError> for ApiError {
    fn from(error: IntakeError) -> Self {
        let (place, error) = match error {
            IntakeError::Format { place, source } => (place, source.into()),
            IntakeError::Size { place, detail } => (place, Self::new(Code::SizeMismatch, detail)),
            IntakeError::Content { place, detail } => {
                (place, Self::new(Code::InvalidContent, detail))
            }
            IntakeError::Stopped => return StoreError::Interrupted.into(),
        };
        if place.is_empty() { error } else { error.at(&place) }
    }
}
