//! `/v1/models`: end-to-end networks, each for one calibration.

use axum::Json;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::error::{ApiError, Result};
use super::extract::{Body, Caller, Params, QueryOf};
use super::page::{ListQuery, PageBody};
use crate::job::{CalibrationId, Label, ModelId, Sha256};
use crate::store::{Filter, Model, NewModel};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ModelRequest {
    name: Option<Label>,
    calibration: CalibrationId,
    file: Sha256,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    Body(request): Body<ModelRequest>,
) -> Result<Response> {
    let ModelRequest { name, calibration, file } = request;
    let found = app.store.calibration(&access.lab, calibration).await;
    let masks = found.map_err(|error| ApiError::reference("/calibration", error))?.facts;
    app.store
        .upload(&access.lab, file)
        .await
        .map_err(|error| ApiError::reference("/file", error))?;
    let facts = app.checker.check(&app.store.dir().blob(&file), &masks).await?;
    let new = NewModel { name, calibration, file, facts };
    let model = app.store.add_model(&access.lab, new).await?;
    let location = [(header::LOCATION, format!("/v1/models/{}", model.id))];
    Ok((StatusCode::CREATED, location, Json(model)).into_response())
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<ModelId>>,
) -> Result<Json<PageBody<Model>>> {
    let filter = Filter { calibration: query.calibration, after: query.cursor };
    let page = app.store.models(&access.lab, filter, query.limit.get()).await?;
    Ok(Json(PageBody::new(page, |item| item.id.to_string(), |item| item)))
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
) -> Result<Json<Model>> {
    Ok(Json(app.store.model(&access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<ModelId>,
) -> Result<StatusCode> {
    app.store.delete_model(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
