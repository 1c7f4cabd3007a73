//! `/problems/{code}`: what a code of an error means and what to do, at the address that errors name as
//! their `type`.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use maud::{DOCTYPE, html};

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::Params;

/// What the browser may load: our own style, and no script at all.
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
    let again = if retryable { "may succeed later" } else { "fails again" };
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
                    p { "The same request " (again) "; " code { "retryable" } " of the answer says so." }
                    p { a href="../openapi.yaml" { "The contract" } " has all codes." }
                }
            }
        }
    }
    .into_string()
}

/// What it means, and what to do.
pub(super) fn meaning(code: Code) -> &'static str {
    match code {
        Code::MalformedJson => "The body is no JSON. The detail has line and column.",
        Code::MalformedRequest => {
            "A header, the form or the body can't be read, or the body was broken off. The detail says \
             which."
        }
        Code::InvalidQuery => "A query parameter is unknown or has a value that can't be.",
        Code::EmptyBody => "A body is needed.",
        Code::Unauthorized => {
            "Send a token as Authorization: Bearer. One that is unknown, misspelled, expired or revoked is \
             answered in the same way; who looks after the service makes a new one."
        }
        Code::Forbidden => {
            "The role of the token is too low: read looks, submit changes, admin sees all."
        }
        Code::ForeignSite => {
            "A service without tokens answers only to its own names, and takes no changes from pages of \
             other sites. Ask at its address, make a token, or start it with --host NAME."
        }
        Code::NotFound => {
            "There is none with this identifier, or it belongs to another lab, or the address is wrong."
        }
        Code::NotReady => {
            "The job or the calibration has not come that far. Its state says how far it is."
        }
        Code::CalibrationNotReady => {
            "The masks of the calibration are still being made or checked; wait for the state ready. One that has \
             failed will never be ready: its error says why."
        }
        Code::MeasurementNotReady => {
            "The measurement is still being checked; wait for the state ready. One that has failed will never \
             be ready: its problem says why."
        }
        Code::MethodNotAllowed => "The header Allow names the methods that this address takes.",
        Code::UploadStalled => {
            "No byte came for too long. Send it again, best in pieces (/v1/uploads)."
        }
        Code::OffsetMismatch => "HEAD of the upload tells where the next piece begins.",
        Code::TusVersion => "Send the header Tus-Resumable: 1.0.0.",
        Code::PreconditionFailed => {
            "If-Match names a state that is over. Ask for the thing again, and decide anew."
        }
        Code::UploadBusy => "Another request writes to this upload. Wait for it, or for its end.",
        Code::UploadDamaged => {
            "Bytes that had come are no longer on the disk as they were. Send the file again."
        }
        Code::ChecksumMismatch => "The piece was damaged on its way. Send it again.",
        Code::InUse => "Others refer to it. Delete those first; the detail counts them.",
        Code::IllegalState => {
            "A job that has succeeded can't be cancelled, for one. Its state says more."
        }
        Code::TooLarge => "The limit stands in the detail.",
        Code::UnsupportedMediaType => "The header Content-Type is not the one that is needed.",
        Code::RangeNotSatisfiable => "The range begins behind the end of the file.",
        Code::InvalidRequest => "Each of errors names a field and says what would be right.",
        Code::InvalidContent => {
            "The file itself is wrong: the detail says in what way, reason in one word."
        }
        Code::SizeMismatch => "Rows, columns or frames differ between things that belong together.",
        Code::HashMismatch => {
            "The bytes have another SHA-256 than the one that was named. Send them again."
        }
        Code::IdempotencyKeyReused => {
            "The key belongs to another request. Take a new key for each thing that is to be made."
        }
        Code::TooManyUploads => {
            "All places for uploads are taken, or the lab has its share, or too many of its uploads in pieces \
             are not complete. Come back after Retry-After seconds."
        }
        Code::TooManyWaiters => {
            "So many requests of the lab wait for the end of jobs that this one may not. Ask without wait, or \
             listen to /v1/events, which tells of all jobs at once."
        }
        Code::TooManyChecks => {
            "So many files of the lab wait to be checked that this one may not. Come back when some are done."
        }
        Code::RateLimited => {
            "The token has sent more requests than it may in a minute. Continue after Retry-After seconds."
        }
        Code::QueueFull => {
            "So many jobs wait that no more are taken. Come back later, or cancel some."
        }
        Code::Internal => {
            "The log of the service has the cause, under the identifier of the request."
        }
        Code::TaskFailed => "Mend the cause that the detail names, then retry the job.",
        Code::OutOfMemory => {
            "Use smaller tiles, fewer workers or a machine with more memory, then retry the job."
        }
        Code::WorkerCrashed => {
            "Retry the job. If the worker crashes again, report it with the log of the service."
        }
        Code::WorkerLost => {
            "Workers were killed or fell silent. See that they keep running, then retry the job."
        }
        Code::MovieFailed => {
            "A worker has tried three times; the detail has its reason. Create the movie again for another try."
        }
        Code::FileDamaged => {
            "The disk of the service has lost or changed the file; no byte of it is sent. Retry its job, and it \
             is made again."
        }
        Code::Unavailable => "The service is stopping, or has no place for this just now.",
        Code::TimedOut => "The answer took longer than answers may.",
        Code::InsufficientStorage => {
            "Delete jobs and uploads that nobody needs, or ask for a larger disk."
        }
        Code::QuotaExceeded => {
            "Delete uploads, jobs or what was prepared, or have the limit raised. The detail has the numbers."
        }
    }
}
