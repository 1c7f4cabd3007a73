//! `/v1/models`: end-to-end networks, each for one calibration.

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, once, request_key};
use super::intake;
use super::page::{ListQuery, PageBody, Renaming};
use engine::job::{CalibrationId, Label, ModelId, Sha256};
use store::{Inserted, Made, Model, NewModel, RequestKey};

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ModelRequest {
    name: Option<Label>,
    calibration: CalibrationId,
    file: Sha256,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<ModelRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let (status, id) = created(make(&app, &access, request, key.as_ref()).await?);
    let location = [(header::LOCATION, format!("/v1/models/{id}"))];
    let model = app.store.model(&access.lab, id).await?;
    Ok((status, location, Json(model)).into_response())
}

/// Makes one, or finds the one that was made with the same key.
async fn make(
    app: &App,
    access: &Access,
    request: ModelRequest,
    key: Option<&RequestKey>,
) -> Result<Inserted<ModelId>> {
    let insert = insert(app, access, request, key);
    once(app, &access.lab, (Made::Model, key), insert).await
}

/// Checks a network and registers it.
async fn insert(
    app: &App,
    access: &Access,
    request: ModelRequest,
    key: Option<&RequestKey>,
) -> Result<Inserted<ModelId>> {
    let ModelRequest { name, calibration, file } = request;
    let lab = &access.lab;
    let found = app.store.calibration(lab, calibration).await;
    let masks = found.map_err(|error| ApiError::reference("/calibration", error))?.facts;
    app.store.upload(lab, file).await.map_err(|error| ApiError::reference("/file", error))?;
    let path = intake::upload(app, file).await.map_err(|error| error.at("/file"))?;
    let facts = app.checker.check(lab, &path, &masks).await?;
    let new = NewModel { name, calibration, file, facts };
    Ok(app.store.add_model(lab, new, key).await?)
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
