//! Requests for calibrations, measurements and models, which are made from uploads. A task of the queue checks the uploads;
//! the answer waits for it for a limited time. The handlers below serve all three kinds.

use std::str::FromStr;
use std::time::Duration;

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::access::Access;
use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Code, Problem, REQUEST_ID, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{Limit, ListQuery, PageBody, Renaming};
use engine::job::{CheckLimits, InvalidId, JobState, Lab, ResourceId, Submission};
use store::{
    Filter, FoundResource, Inserted, NewRequest, Page, Request, RequestKey, Resource, ResourceKind,
    StoreError,
};

/// Default time for which a request waits for a check.
const PATIENCE: Duration = Duration::from_secs(10);

/// State of a calibration or measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "ResourceState")]
pub(super) enum ResourceState {
    /// Files are being checked, or masks computed from captures.
    Preparing,
    Ready,
    /// The check failed; `problem` says why.
    Failed,
}

/// A kind of resource that is made from uploads: its identifiers, and its requests and answers.
pub(super) trait ResourceApi: Resource + DeserializeOwned + 'static {
    /// The address of the list.
    const PATH: &'static str;
    const SUBMISSION: fn(Self::Request) -> Submission;
    type Body: Serialize + Send;

    fn body(found: FoundResource<Self>) -> Result<Self::Body>;
}

pub(super) async fn create<Id: ResourceApi>(
    Caller(app, access): Caller,
    context: RequestContext,
    Body(request): Body<Id::Request>,
) -> Result<Response> {
    let (key, wait) = (request_key(&context.headers, &request)?, context.wait());
    let submission = Id::SUBMISSION(request);
    let inserted = make(&app, &access, submission, key.as_ref(), wait.time(PATIENCE)).await?;
    let (status, id) = created::<Id>(inserted);
    let found = app.store.resource(&access.lab, id).await?;
    let is_ready = matches!(found, FoundResource::Ready(_));
    let status = if is_ready { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("{}/{id}", Id::PATH))];
    Ok(wait.applied((location, changed(status, &Id::body(found)?)?).into_response()))
}

pub(super) async fn body<Id: ResourceApi>(app: &App, lab: &Lab, id: Id) -> Result<Id::Body> {
    Id::body(app.store.resource(lab, id).await?)
}

pub(super) async fn list<Id: ResourceApi>(
    caller: Caller,
    QueryOf(query): QueryOf<ListQuery<Id>>,
    request: RequestContext,
) -> Result<Response> {
    page(caller, query.limit, query.filter(), &request).await
}

/// A page of a list.
pub(super) async fn page<Id: ResourceApi>(
    Caller(app, access): Caller,
    limit: Limit,
    filter: Filter<Id>,
    request: &RequestContext,
) -> Result<Response> {
    let Page { items, more } = app.store.resources(&access.lab, filter, limit.get()).await?;
    let id = |found: &FoundResource<Id>| match found {
        FoundResource::Ready(resource) => resource.id.to_string(),
        FoundResource::Pending(request) => request.id.to_string(),
    };
    let shown = |found| Ok((id(&found), Id::body(found)?));
    let items = items.into_iter().map(shown).collect::<Result<Vec<_>>>()?;
    PageBody::new(Page { items, more }, |(id, _)| id.clone(), |(_, body)| body).answer(request)
}

pub(super) async fn show<Id: ResourceApi>(
    Caller(app, access): Caller,
    Params(id): Params<Id>,
    request: RequestContext,
) -> Result<Response> {
    let wait = request.wait();
    if let Some(time) = app.wait(wait) {
        let resource = (Id::KIND, id.into());
        app.events.settled(&app.store, &access.lab, resource, time).await?;
    }
    Ok(wait.applied(request.json(&body(&app, &access.lab, id).await?)?))
}

pub(super) async fn rename<Id: ResourceApi>(
    Caller(app, access): Caller,
    Params(id): Params<Id>,
    request: RequestContext,
    Body(renaming): Body<Renaming>,
) -> Result<Response> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    app.store.rename(&access.lab, id, renaming.name.as_ref()).await?;
    changed(StatusCode::OK, &body(&app, &access.lab, id).await?)
}

pub(super) async fn delete<Id: ResourceApi>(
    Caller(app, access): Caller,
    Params(id): Params<Id>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard = app.precondition(&request, &access.lab, body(&app, &access.lab, id)).await?;
    app.store.delete(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// State of a pending request; if it failed, the reason in words and as a problem.
pub(super) fn pending(request: &Request) -> (ResourceState, Option<String>, Option<Problem>) {
    let Some(refusal) = request.refusal.clone() else {
        return (ResourceState::Preparing, None, None);
    };
    let detail = refusal.detail.clone();
    let problem = || ApiError::from(refusal).problem();
    // The answer to the original request would have had the same problem.
    let problem = match request.origin.clone() {
        Some(origin) => REQUEST_ID.sync_scope(origin, problem),
        None => problem(),
    };
    (ResourceState::Failed, Some(detail), Some(problem))
}

/// Creates a resource, or returns the one that was created with the same key. Waits up to `patience` for the check of its
/// uploads.
///
/// Errors: the reason of a rejection that is known in time. The rejected request is deleted then.
pub(super) async fn make<Id>(
    app: &App,
    access: &Access,
    submission: Submission,
    key: Option<&RequestKey>,
    patience: Duration,
) -> Result<Inserted<Id>>
where
    Id: Into<ResourceId> + From<ResourceId> + FromStr<Err = InvalidId> + Copy,
{
    let invalid = |errors| ApiError::fields(Code::InvalidRequest, errors);
    submission.check().map_err(invalid)?;
    let (lab, what) = (&access.lab, ResourceKind::of(&submission));
    loop {
        let inserted = match app.store.created_with(lab, what, key).await? {
            Some(id) => Inserted::Before(id),
            None => submit(app, access, &submission, key).await?,
        };
        if patience.is_zero() {
            return Ok(inserted);
        }
        let is_new = matches!(inserted, Inserted::New(_));
        let resource = (what, inserted.id().into());
        let waiting = wait_for_check(app.clone(), lab.clone(), resource, is_new, patience);
        // Runs to completion even if the client disconnects.
        let waiting = match REQUEST_ID.try_with(Clone::clone) {
            Ok(id) => tokio::spawn(REQUEST_ID.scope(id, waiting)),
            Err(_) => tokio::spawn(waiting),
        };
        let exists = waiting.await.unwrap_or_else(|_| Err(StoreError::Interrupted.into()))?;
        // If an earlier request with this key was rejected in the meantime, the key is free and the loop tries again.
        if exists || is_new {
            return Ok(inserted);
        }
    }
}

/// Stores a request, and adds its check to the queue.
async fn submit<Id>(
    app: &App,
    access: &Access,
    submission: &Submission,
    key: Option<&RequestKey>,
) -> Result<Inserted<Id>>
where
    Id: From<ResourceId> + FromStr<Err = InvalidId>,
{
    check_references(app, &access.lab, submission).await?;
    let settings = &app.settings;
    let limits = CheckLimits {
        max_file_bytes: settings.max_upload_bytes,
        min_free_bytes: settings.min_free_bytes,
        seconds: settings.check_time().as_secs_f64(),
    };
    let origin = REQUEST_ID.try_with(Clone::clone).ok();
    let new = NewRequest { submission: submission.clone(), limits, origin };
    match app.store.request((&access.lab, access.token), &new, key).await {
        // A reference was deleted since its check, which states the place of the reference.
        Err(error @ StoreError::NotFound { .. }) => {
            check_references(app, &access.lab, submission).await?;
            Err(error.into())
        }
        inserted => Ok(inserted?),
    }
}

/// Waits for a check. Returns false if the request was deleted.
///
/// Errors: the reason why the uploads were rejected. The HTTP request that created the record then deletes it. Repeated
/// requests with the same key leave the record, so that the first one can read it.
async fn wait_for_check(
    app: App,
    lab: Lab,
    (what, id): (ResourceKind, ResourceId),
    is_new: bool,
    patience: Duration,
) -> Result<bool> {
    if let Err(error) = app.events.checked(&app.store, &lab, (what, id), patience).await {
        // Too many requests of the lab wait. The answer then has the state `preparing`.
        tracing::debug!(?error, "a request does not wait for its check");
    }
    let Some(request) = app.store.find_request(&lab, id).await? else { return Ok(false) };
    let Some(refusal) = request.refusal else { return Ok(true) };
    if !is_new || app.store.drop_refused(id).await? {
        return Err(refusal.into());
    }
    Ok(app.store.find_request(&lab, id).await?.is_some())
}

/// Rejects a request that refers to a calibration, job or upload that does not exist or does not fit.
async fn check_references(app: &App, lab: &Lab, submission: &Submission) -> Result<()> {
    if let Some(calibration) = submission.calibration() {
        let result = app.store.calibration(lab, calibration).await;
        result.map_err(|error| ApiError::reference("/calibration", error))?;
    }
    if let Some(id) = submission.registration_of() {
        let place = "/registration_of";
        let job = app.store.job(lab, id).await;
        let job = job.map_err(|error| ApiError::reference(place, error))?;
        if job.state != JobState::Succeeded {
            let state: &str = job.state.into();
            let detail = format!(
                "job {id} is {state}; a corrected calibration needs a job that has succeeded"
            );
            return Err(ApiError::new(Code::IllegalState, detail).at(place));
        }
        if job.spec.registered.and_then(|registered| registered.correction()).is_none() {
            let detail = format!(
                "job {id} has not moved its masks: use calibration {}",
                job.spec.calibration
            );
            return Err(ApiError::field(place, detail));
        }
    }
    for (pointer, upload) in submission.uploads() {
        let result = app.store.upload(lab, upload).await;
        result.map_err(|error| ApiError::reference(&pointer, error))?;
    }
    Ok(())
}
