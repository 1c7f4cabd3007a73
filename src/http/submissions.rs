//! Requests for what is made of uploads. The check of the uploads is a task of the queue; the answer waits for it for
//! a while.

use std::str::FromStr;
use std::time::Duration;

use serde::Serialize;

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Code, Problem, REQUEST_ID, Result};
use engine::job::{CheckLimits, InvalidId, Lab, Submission, ThingId};
use store::{Inserted, Made, NewRequest, Request, RequestKey, StoreError};

/// How long a request waits for a check by default.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);

/// State of a calibration or measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "ResourceState")]
pub(super) enum Stage {
    /// Files are being checked, or masks computed from captures.
    Preparing,
    Ready,
    /// The check failed; `problem` says why.
    Failed,
}

/// State of a pending request; if it failed, the reason in words and as a problem.
pub(super) fn pending(request: &Request) -> (Stage, Option<String>, Option<Problem>) {
    let Some(refusal) = request.refusal.clone() else { return (Stage::Preparing, None, None) };
    let detail = refusal.detail.clone();
    let problem = || ApiError::from(refusal).problem();
    // The answer to the original request would have had the same problem.
    let problem = match request.origin.clone() {
        Some(origin) => REQUEST_ID.sync_scope(origin, problem),
        None => problem(),
    };
    (Stage::Failed, Some(detail), Some(problem))
}

/// Has something made, or finds what was made with the same key. Waits so long for the check of its uploads.
/// Errors: why the request is refused, if that is known in time; nothing of it stays on record then.
pub(super) async fn make<Id>(
    app: &App,
    access: &Access,
    submission: Submission,
    key: Option<&RequestKey>,
    patience: Duration,
) -> Result<Inserted<Id>>
where
    Id: Into<ThingId> + From<ThingId> + FromStr<Err = InvalidId> + Copy,
{
    let invalid = |errors| ApiError::fields(Code::InvalidRequest, errors);
    submission.check().map_err(invalid)?;
    let (lab, what) = (&access.lab, Made::of(&submission));
    loop {
        let made = match app.store.made_with(lab, what, key).await? {
            Some(id) => Inserted::Before(id),
            None => submit(app, access, &submission, key).await?,
        };
        if patience.is_zero() {
            return Ok(made);
        }
        let is_new = matches!(made, Inserted::New(_));
        let thing = (what, made.id().into());
        let waiting = settled(app.clone(), lab.clone(), thing, is_new, patience);
        // Runs to completion even if the client disconnects.
        let waiting = match REQUEST_ID.try_with(Clone::clone) {
            Ok(id) => tokio::spawn(REQUEST_ID.scope(id, waiting)),
            Err(_) => tokio::spawn(waiting),
        };
        let there = waiting.await.unwrap_or_else(|_| Err(StoreError::Interrupted.into()))?;
        // A request with this key was refused meanwhile: the key is free again.
        if there || is_new {
            return Ok(made);
        }
    }
}

/// Puts a request on record, and its check in the queue.
async fn submit<Id>(
    app: &App,
    access: &Access,
    submission: &Submission,
    key: Option<&RequestKey>,
) -> Result<Inserted<Id>>
where
    Id: From<ThingId> + FromStr<Err = InvalidId>,
{
    vet(app, &access.lab, submission).await?;
    let settings = &app.settings;
    let limits = CheckLimits {
        max_file_bytes: settings.max_upload_bytes,
        min_free_bytes: settings.min_free_bytes,
        seconds: settings.check_time().as_secs_f64(),
    };
    let origin = REQUEST_ID.try_with(Clone::clone).ok();
    let new = NewRequest { submission: submission.clone(), limits, origin };
    Ok(app.store.request((&access.lab, access.token), &new, key).await?)
}

/// Waits for a check. False if its request was deleted.
/// Errors: why the uploads are refused. The HTTP request that made the record then removes it; others with the same
/// key leave it for that one to read.
async fn settled(
    app: App,
    lab: Lab,
    (what, id): (Made, ThingId),
    is_new: bool,
    patience: Duration,
) -> Result<bool> {
    if let Err(error) = app.events.checked(&app.store, &lab, (what, id), patience).await {
        // Enough requests of the lab wait: the answer is that the check goes on.
        tracing::debug!(?error, "a check is not waited for");
    }
    let Some(request) = app.store.find_request(&lab, id).await? else { return Ok(false) };
    let Some(refusal) = request.refusal else { return Ok(true) };
    if !is_new || app.store.drop_refused(id).await? {
        return Err(refusal.into());
    }
    Ok(app.store.find_request(&lab, id).await?.is_some())
}

/// Refuses a request that names what is not there.
async fn vet(app: &App, lab: &Lab, submission: &Submission) -> Result<()> {
    if let Some(calibration) = submission.calibration() {
        let found = app.store.calibration(lab, calibration).await;
        found.map_err(|error| ApiError::reference("/calibration", error))?;
    }
    for (place, upload) in submission.uploads() {
        let found = app.store.upload(lab, upload).await;
        found.map_err(|error| ApiError::reference(&place, error))?;
    }
    Ok(())
}
