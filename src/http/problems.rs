//! `/problems/{code}`: a page that explains a code of an error. The header `Link` of an error leads to it.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use maud::{DOCTYPE, html};

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::Params;

/// Content security policy: the browser loads the style sheet of the service, and no scripts.
const POLICY: &str = "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

pub(super) async fn show(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    let no_code = |_| ApiError::new(Code::NotFound, "no error of this service has this code");
    let code: Code = name.parse().map_err(no_code)?;
    let text = page(code).into_bytes();
    let mut response = conditional::content(&headers, "text/html; charset=utf-8", text);
    let policy = HeaderValue::from_static(POLICY);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(response)
}

fn page(code: Code) -> String {
    let (status, title, retryable) = code.row();
    let outcome = if retryable { "may succeed later" } else { "would fail again" };
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (code.into_str()) }
                link rel="stylesheet" href="../dashboard/style.css";
            }
            body {
                main {
                    h1 { (title) }
                    p { code { (code.into_str()) } ", status " (status.as_u16()) ". " (meaning(code)) }
                    p { "The same request " (outcome) ", unless " code { "retryable" } " of the answer is different." }
                    p { a href="../docs" { "The API reference" } " lists all codes." }
                }
            }
        }
    }
    .into_string()
}

/// Meaning of a code, and instructions for the user.
pub(super) fn meaning(code: Code) -> &'static str {
    match code {
        Code::MalformedJson => {
            "The body is not valid JSON. The detail has the line and the column."
        }
        Code::MalformedRequest => {
            "A header, a form or the body can't be parsed, or the body is incomplete. The detail says which."
        }
        Code::InvalidQuery => "A query parameter is unknown, or its value is invalid.",
        Code::EmptyBody => "The request needs a body.",
        Code::Unauthorized => {
            "Send a token as Authorization: Bearer. Unknown, misspelled, expired and revoked tokens get the \
             same answer. An administrator of the service can create a new token."
        }
        Code::Forbidden => {
            "The role of the token is too low. Role read may read, submit may also change, and admin may \
             access all labs."
        }
        Code::ForeignSite => {
            "A service without tokens answers only requests to its own host names, and rejects changes from \
             pages of other sites. Use the address of the service, create a token, or start the service with \
             --host NAME."
        }
        Code::NotFound => {
            "No resource has this address or identifier, or it belongs to another lab."
        }
        Code::NotReady => {
            "The job or the calibration has not reached this step yet. Its state shows the progress."
        }
        Code::CalibrationNotReady => {
            "The masks of the calibration are still being computed or checked. Wait until its state is \
             ready. A failed calibration never becomes ready; its error has the reason."
        }
        Code::MeasurementNotReady => {
            "The measurement is still being checked. Wait until its state is ready. A failed measurement \
             never becomes ready; its problem has the reason."
        }
        Code::NotAcceptable => {
            "The header Accept excludes all media types that this address has. The detail lists them."
        }
        Code::MethodNotAllowed => "The header Allow lists the methods of this address.",
        Code::UploadStalled => {
            "The service received no data for too long. Send the file again, preferably as a resumable \
             upload (/v1/uploads)."
        }
        Code::OffsetMismatch => {
            "Send HEAD to the upload: Upload-Offset is the offset of the next piece."
        }
        Code::TusVersion => "Send the header Tus-Resumable: 1.0.0.",
        Code::PreconditionFailed => {
            "The resource has changed since the state that If-Match names. Read it again, and decide whether \
             the change is still needed."
        }
        Code::UploadBusy => "Another request is writing to this upload. Wait until it ends.",
        Code::UploadDamaged => {
            "The received bytes are lost or damaged on the disk of the service. Send the file again."
        }
        Code::ChecksumMismatch => "The piece was damaged in transit. Send it again.",
        Code::InUse => {
            "Other resources refer to this one. Delete those first; the detail counts them."
        }
        Code::IllegalState => {
            "The state of the resource does not allow this. For example, a succeeded job can't be cancelled."
        }
        Code::TooLarge => "The body is larger than the limit in the detail.",
        Code::UnsupportedMediaType => {
            "The header Content-Type or Content-Encoding has an unsupported value. The detail has the right \
             one."
        }
        Code::RangeNotSatisfiable => "The range begins after the end of the file.",
        Code::InvalidRequest => "Each item of errors names a field and its allowed values.",
        Code::InvalidContent => {
            "The file is invalid. The detail describes the fault; reason is a short name of it."
        }
        Code::SizeMismatch => "Rows, columns or frames of related resources differ.",
        Code::HashMismatch => {
            "The received bytes have another SHA-256 than the request states. Send them again."
        }
        Code::IdempotencyKeyReused => {
            "The key was used for a different request. Use a new key for each new resource."
        }
        Code::TooManyUploads => {
            "The service or the lab has too many uploads at the same time, or too many incomplete \
             resumable uploads. Retry after the seconds in Retry-After."
        }
        Code::TooManyWaiters => {
            "Too many requests of the lab wait for jobs. Send the request without wait, or listen to \
             /v1/events, which reports changes of all jobs."
        }
        Code::TooManyChecks => {
            "Too many files of the lab wait for a check. Retry when some checks are finished."
        }
        Code::RateLimited => {
            "The token has sent more requests than allowed in a minute. Continue after the seconds in Retry- \
             After."
        }
        Code::QueueFull => "Too many jobs are in the queue. Retry later, or cancel some jobs.",
        Code::Internal => {
            "The log of the service has the cause, under the identifier of the request."
        }
        Code::TaskFailed => "Fix the cause in the detail, then retry the job.",
        Code::OutOfMemory => {
            "Use smaller tiles, fewer workers or a machine with more memory, then retry the job."
        }
        Code::WorkerCrashed => {
            "Retry the job. If the worker crashes again, report it with the log of the service."
        }
        Code::WorkerLost => {
            "Workers were killed or stopped responding. Make sure that they keep running, then retry the \
             job."
        }
        Code::MovieFailed => {
            "A worker has tried three times; the detail has the reason. To try again, create the movie \
             again."
        }
        Code::FileDamaged => {
            "The file is lost or damaged on the disk of the service, so it is not sent. Retry its job to \
             create the file again."
        }
        Code::Unavailable => "The service is shutting down, or has no capacity at the moment.",
        Code::TimedOut => "The request took longer than the limit of the service.",
        Code::InsufficientStorage => {
            "Delete jobs and uploads that are not needed, or use a larger disk."
        }
        Code::QuotaExceeded => {
            "Delete uploads, jobs, or prepared arrays, or ask for a higher limit. The detail has the \
             numbers."
        }
    }
}
