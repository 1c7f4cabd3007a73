//! `/v1/calibrations`: masks of optical settings.

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::access::Access;
use super::app::App;
use super::error::ApiError;
use super::extract::{Body, Params, QueryOf};
use super::intake::{self, Prepared};
use super::page::{Limit, PageBody};
use crate::formats::validate::MaskStatistics;
use crate::job::{CalibrationId, Label, Sha256};
use crate::store::{Calibration, NewCalibration};

/// The body of `POST /v1/calibrations`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CalibrationRequest {
    name: Option<Label>,
    /// The upload with the masks.
    masks: Sha256,
    /// The stored number that means 1.
    full_scale: Option<f32>,
}

/// The query of the list.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<CalibrationId>,
}

/// `POST /v1/calibrations`
pub(super) async fn create(
    State(app): State<App>,
    access: Access,
    Body(request): Body<CalibrationRequest>,
) -> Result<Response, ApiError> {
    let (masks, full_scale) = (request.masks, request.full_scale);
    app.store.upload(&access.lab, masks).await.map_err(|error| missing("/masks", error))?;
    let prepared =
        intake::run(&app, move |store, limits| intake::masks(store, limits, &masks, full_scale));
    let Prepared { info, statistics, file } = prepared.await?;
    let facts = facts(request, &info, &statistics);
    let calibration = app.store.add_calibration(&access.lab, facts, file).await?;
    let location = [(header::LOCATION, format!("/v1/calibrations/{}", calibration.id))];
    Ok((StatusCode::CREATED, location, Json(calibration)).into_response())
}

fn facts(
    request: CalibrationRequest,
    info: &crate::formats::StackInfo,
    statistics: &MaskStatistics,
) -> NewCalibration {
    NewCalibration {
        name: request.name,
        masks: request.masks,
        format: info.format.name().to_owned(),
        sample: info.sample.name().to_owned(),
        frames: statistics.frames,
        height: statistics.height,
        width: statistics.width,
        full_scale: statistics.full_scale.value(),
        mask_mean: statistics.mean,
        dead_pixels: statistics.dead_pixels,
        clipped_negatives: statistics.clipped_negative,
    }
}

/// An upload or calibration that a body names and that is not there is an error of the body.
pub(super) fn missing(pointer: &str, error: crate::store::StoreError) -> ApiError {
    match error {
        crate::store::StoreError::NotFound { .. } => ApiError::field(pointer, error.to_string()),
        error => error.into(),
    }
}

/// `GET /v1/calibrations`
pub(super) async fn list(
    State(app): State<App>,
    access: Access,
    QueryOf(query): QueryOf<ListQuery>,
) -> Result<Json<PageBody<Calibration>>, ApiError> {
    let page = app.store.calibrations(&access.lab, query.cursor, query.limit.get()).await?;
    Ok(Json(PageBody::new(page, |item| item.id.to_string(), |item| item)))
}

/// `GET /v1/calibrations/{calibration}`
pub(super) async fn show(
    State(app): State<App>,
    access: Access,
    Params(id): Params<CalibrationId>,
) -> Result<Json<Calibration>, ApiError> {
    Ok(Json(app.store.calibration(&access.lab, id).await?))
}

/// `DELETE /v1/calibrations/{calibration}`
pub(super) async fn delete(
    State(app): State<App>,
    access: Access,
    Params(id): Params<CalibrationId>,
) -> Result<StatusCode, ApiError> {
    app.store.delete_calibration(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
