//! `/v1/models`: end-to-end networks, each trained for one calibration.

use std::time::Duration;

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::app::App;
use super::context::{RequestContext, changed};
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{ListQuery, PageBody, Renaming};
use super::submissions::make;
use engine::job::{Lab, ModelId, ModelRequest, Submission};
use store::{Model, StoreError};

/// Time for which a request waits for the check of a network, including checks that run before it. A client can't poll a
/// pending model, because it has no state.
const PATIENCE: Duration = Duration::from_secs(900);

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<ModelRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let inserted = make(&app, &access, Submission::Model(request), key.as_ref(), PATIENCE).await?;
    let (status, id) = created::<ModelId>(inserted);
    let location = [(header::LOCATION, format!("/v1/models/{id}"))];
    let model = app.store.model(&access.lab, id).await.map_err(|error| match error {
        StoreError::NotFound { .. } => {
            let detail =
                "the check of the network takes long: send the request again, with an Idempotency-Key, to wait for it";
            ApiError::new(Code::TimedOut, detail)
        }
        error => error.into(),
    })?;
    Ok((location, changed(status, &model)?).into_response())
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<ModelId>>,
    request: RequestContext,
) -> Result<Response> {
    let limit = query.limit.get();
    let page = app.store.models(&access.lab, query.filter(), limit).await?;
    PageBody::new(page, |item| item.id.to_string(), |item| item).answer(&request)
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
    request: RequestContext,
) -> Result<Response> {
    request.json(&body(&app, &access.lab, id).await?)
}

async fn body(app: &App, lab: &Lab, id: ModelId) -> Result<Model> {
    Ok(app.store.model(lab, id).await?)
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
    request: RequestContext,
    Body(renaming): Body<Renaming>,
) -> Result<Response> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.rename_model(&access.lab, id, renaming.name.as_ref()).await?;
    changed(StatusCode::OK, &body(&app, &access.lab, id).await?)
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
    request: RequestContext,
) -> Result<StatusCode> {
    let _guard =
        request.precondition((&app.changes, &access.lab), body(&app, &access.lab, id)).await?;
    app.store.delete_model(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
