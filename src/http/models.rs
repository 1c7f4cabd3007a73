//! `/v1/models`: end-to-end networks, each for one calibration.

use std::time::Duration;

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::page::{ListQuery, PageBody, Renaming};
use super::submissions::make;
use engine::job::{ModelId, ModelRequest, Submission};
use store::{Model, StoreError};

/// How long a request waits for the check of a network, which may wait for others. It has no state to be asked for.
const PATIENCE: Duration = Duration::from_secs(900);

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<ModelRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let made = make(&app, &access, Submission::Model(request), key.as_ref(), PATIENCE).await?;
    let (status, id) = created::<ModelId>(made);
    let location = [(header::LOCATION, format!("/v1/models/{id}"))];
    let model = app.store.model(&access.lab, id).await.map_err(|error| match error {
        StoreError::NotFound { .. } => {
            let detail =
                "the check of the network goes on: send the request again, with an Idempotency-Key";
            ApiError::new(Code::TimedOut, detail)
        }
        error => error.into(),
    })?;
    Ok((status, location, Json(model)).into_response())
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<ModelId>>,
) -> Result<Json<PageBody<Model>>> {
    let limit = query.limit.get();
    let page = app.store.models(&access.lab, query.filter(), limit).await?;
    Ok(Json(PageBody::new(page, |item| item.id.to_string(), |item| item)))
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
) -> Result<Json<Model>> {
    Ok(Json(app.store.model(&access.lab, id).await?))
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
    Body(renaming): Body<Renaming>,
) -> Result<Json<Model>> {
    app.store.rename_model(&access.lab, id, renaming.name.as_ref()).await?;
    Ok(Json(app.store.model(&access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
) -> Result<StatusCode> {
    app.store.delete_model(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
