//! Errors as the user sees them: problem+json (RFC 9457).

use std::sync::LazyLock;

use axum::Json;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::Value;
use strum::{EnumString, IntoStaticStr, VariantArray};

use engine::intake::{IntakeError, Refusal, RefusalCode};
use engine::job::InvalidField;
use formats::{DiskTrouble, FormatError};
use store::StoreError;

/// tus 1.0 has a status of its own for this.
static CHECKSUM_STATUS: LazyLock<StatusCode> =
    LazyLock::new(|| StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST));

/// What can be wrong, from a table of the status, the title, and whether the same request may succeed
/// later. The name, which is the variant's in snake case, never changes, for programs to rely on.
macro_rules! codes {
    ($($code:ident: $status:expr, $title:literal, $retryable:literal;)*) => {
        #[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr, VariantArray)]
        #[strum(serialize_all = "snake_case", const_into_str)]
        pub enum Code {
            $($code,)*
        }

        impl Code {
            /// Its status, its title, and whether the same request may succeed later.
            pub(super) fn row(self) -> (StatusCode, &'static str, bool) {
                match self {
                    $(Self::$code => ($status, $title, $retryable),)*
                }
            }
        }
    };
}

codes! {
    MalformedJson: StatusCode::BAD_REQUEST, "The body is not JSON", false;
    MalformedRequest: StatusCode::BAD_REQUEST, "The request can't be read", false;
    InvalidQuery: StatusCode::BAD_REQUEST, "A query parameter is wrong", false;
    EmptyBody: StatusCode::BAD_REQUEST, "The body is empty", false;
    Unauthorized: StatusCode::UNAUTHORIZED, "Who is there?", false;
    Forbidden: StatusCode::FORBIDDEN, "The token does not allow it", false;
    ForeignSite: StatusCode::FORBIDDEN, "Not for a page of another site", false;
    NotFound: StatusCode::NOT_FOUND, "There is no such thing", false;
    NotReady: StatusCode::NOT_FOUND, "It is not there yet", true;
    CalibrationNotReady: StatusCode::CONFLICT, "The masks are not there", true;
    MeasurementNotReady: StatusCode::CONFLICT, "The measurement is not checked", true;
    MethodNotAllowed: StatusCode::METHOD_NOT_ALLOWED, "Not with this method", false;
    UploadStalled: StatusCode::REQUEST_TIMEOUT, "The upload came to a halt", true;
    OffsetMismatch: StatusCode::CONFLICT, "The piece does not follow", false;
    TusVersion: StatusCode::PRECONDITION_FAILED, "Not in this version of tus", false;
    PreconditionFailed: StatusCode::PRECONDITION_FAILED, "It is in another state", false;
    UploadBusy: StatusCode::LOCKED, "Another request is at it", true;
    UploadDamaged: StatusCode::GONE, "Bytes of the upload are lost", false;
    ChecksumMismatch: *CHECKSUM_STATUS, "The piece has come damaged", true;
    InUse: StatusCode::CONFLICT, "Something else needs it", false;
    IllegalState: StatusCode::CONFLICT, "Not in this state", false;
    TooLarge: StatusCode::PAYLOAD_TOO_LARGE, "The body is too large", false;
    UnsupportedMediaType: StatusCode::UNSUPPORTED_MEDIA_TYPE, "Not in this media type", false;
    RangeNotSatisfiable: StatusCode::RANGE_NOT_SATISFIABLE, "The range is outside", false;
    InvalidRequest: StatusCode::UNPROCESSABLE_ENTITY, "The request does not fit", false;
    InvalidContent: StatusCode::UNPROCESSABLE_ENTITY, "The file does not fit", false;
    SizeMismatch: StatusCode::UNPROCESSABLE_ENTITY, "The sizes do not fit", false;
    HashMismatch: StatusCode::UNPROCESSABLE_ENTITY, "The bytes are not those named", true;
    IdempotencyKeyReused: StatusCode::UNPROCESSABLE_ENTITY, "The key was used for another request", false;
    TooManyUploads: StatusCode::TOO_MANY_REQUESTS, "Too many uploads at once", true;
    TooManyWaiters: StatusCode::TOO_MANY_REQUESTS, "Too many requests wait", true;
    TooManyChecks: StatusCode::TOO_MANY_REQUESTS, "Enough files wait to be checked", true;
    QueueFull: StatusCode::TOO_MANY_REQUESTS, "Enough jobs wait", true;
    Internal: StatusCode::INTERNAL_SERVER_ERROR, "The service has failed", true;
    MovieFailed: StatusCode::INTERNAL_SERVER_ERROR, "The movie can't be made", false;
    FileDamaged: StatusCode::INTERNAL_SERVER_ERROR, "The stored file is damaged", false;
    Unavailable: StatusCode::SERVICE_UNAVAILABLE, "The service can't serve this now", true;
    TimedOut: StatusCode::SERVICE_UNAVAILABLE, "The answer took too long", true;
    InsufficientStorage: StatusCode::INSUFFICIENT_STORAGE, "The disk is full", true;
    QuotaExceeded: StatusCode::INSUFFICIENT_STORAGE, "A limit is reached", false;
}

pub type Result<T, E = ApiError> = std::result::Result<T, E>;

tokio::task_local! {
    /// The identifier of the request that is being answered.
    pub(super) static REQUEST_ID: String;
}

/// An error on its way to the user.
#[derive(Debug)]
pub struct ApiError {
    code: Code,
    /// False where another request of the same code may succeed later, and this one can't.
    has_hope: bool,
    detail: String,
    errors: Vec<InvalidField>,
    reason: Option<String>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

#[derive(Debug, Serialize)]
struct Problem<'a> {
    r#type: String,
    title: &'a str,
    status: u16,
    detail: &'a str,
    code: &'a str,
    retryable: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    instance: Option<String>,
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
        Self { code, has_hope: true, detail, errors, reason: None, headers }
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

    /// The body of the answer.
    pub(super) fn problem(&self) -> Value {
        let (status, title, retryable) = self.code.row();
        let code = self.code.into_str();
        let problem = Problem {
            r#type: format!("/problems/{code}"),
            title,
            status: status.as_u16(),
            detail: &self.detail,
            code,
            retryable: retryable && self.has_hope,
            instance: REQUEST_ID.try_with(|id| format!("urn:sci-recon:request:{id}")).ok(),
            reason: self.reason.as_deref(),
            pointer: self.errors.first().map(|error| error.pointer.as_str()),
            errors: &self.errors,
        };
        serde_json::json!(problem)
    }

    /// An error of ours: the log gets the cause, the user does not.
    pub fn internal(cause: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error = cause, "a request failed");
        Self::new(Code::Internal, "an error of the service; its log says more")
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let (status, _, retryable) = self.code.row();
        let retryable = retryable && self.has_hope;
        let mut response = (status, Json(self.problem())).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if retryable && (status == StatusCode::TOO_MANY_REQUESTS || status.is_server_error()) {
            headers.insert(header::RETRY_AFTER, HeaderValue::from_static("5"));
        }
        headers.extend(self.headers);
        response
    }
}

fn disk_error(trouble: DiskTrouble, cause: &(dyn std::error::Error + 'static)) -> ApiError {
    tracing::error!(error = cause, ?trouble, "the disk takes no files");
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
            StoreError::ManyChecks(_) => Code::TooManyChecks,
            StoreError::NoRoom { .. } | StoreError::NoShare { .. } => Code::InsufficientStorage,
            StoreError::Short { .. } => {
                tracing::error!(%error, "bytes of an upload are lost");
                Code::UploadDamaged
            }
            StoreError::Damaged { .. } => Code::FileDamaged,
            StoreError::Interrupted | StoreError::Restless(_) => Code::Unavailable,
            busy if busy.is_busy() => {
                tracing::warn!(%error, "the database is busy");
                let detail = "the database is busy; nothing was changed: try again";
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
        // What has failed will never be ready.
        let has_hope = !matches!(
            error,
            StoreError::Unready { error: Some(_), .. }
                | StoreError::Unchecked { error: Some(_), .. }
        );
        Self { has_hope, ..Self::new(code, error.to_string()) }
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

    /// Codes that a text names in backticks.
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
        // What each answer of each operation names, under its status.
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
        // No operation has the status for a method that a path does not take.
        let about = contract["info"]["description"].as_str().unwrap();
        assert!(about.contains("405 (`method_not_allowed`)"));
        documented.insert(("405".into(), "method_not_allowed"));
        let status = |code: &Code| code.row().0.as_u16().to_string();
        let sent = Code::VARIANTS.iter().map(|code| (status(code), code.into_str()));
        assert_eq!(documented, sent.collect());
    }
}
