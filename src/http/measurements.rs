//! `/v1/measurements`: coded snapshots.

use axum::Json;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf};
use super::intake::{self, Prepared};
use super::page::{ListQuery, PageBody};
use crate::formats::StackInfo;
use crate::intake::Exposure;
use crate::job::{CalibrationId, Finding, InvalidField, Label, MeasurementId, Sha256};
use crate::store::{Filter, Measurement, NewMeasurement};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MeasurementRequest {
    name: Option<Label>,
    calibration: CalibrationId,
    data: Sha256,
    /// Captures of the dark, the LCoS all black, at the measurement's exposure: their average is
    /// subtracted.
    #[serde(default)]
    dark: Vec<Sha256>,
    /// The stored number from which on a pixel is full.
    saturation: Option<u32>,
    full_scale: Option<f32>,
    /// Snapshots in a second.
    camera_fps: Option<f64>,
    /// Seconds of one snapshot.
    exposure_s: Option<f64>,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    Body(request): Body<MeasurementRequest>,
) -> Result<Response> {
    check_times(&request)?;
    let (data, full_scale) = (request.data, request.full_scale);
    let calibration = app.store.calibration(&access.lab, request.calibration).await;
    let calibration = calibration.map_err(|error| ApiError::reference("/calibration", error))?;
    app.store
        .upload(&access.lab, data)
        .await
        .map_err(|error| ApiError::reference("/data", error))?;
    for (index, dark) in request.dark.iter().enumerate() {
        let there = app.store.upload(&access.lab, *dark).await;
        there.map_err(|error| ApiError::reference(&format!("/dark/{index}"), error))?;
    }
    let exposure = Exposure {
        dark: request.dark.iter().map(|dark| app.store.dir().blob(dark)).collect(),
        saturation: request.saturation,
    };
    let prepared = intake::run(&app, move |store, limits| {
        intake::measurement(store, limits, &data, full_scale, &exposure, &calibration)
    });
    let Prepared { info, full_scale, found, file } = prepared.await?;
    let facts = facts(request, &info, full_scale, found);
    let measurement = app.store.add_measurement(&access.lab, facts, file).await?;
    let location = [(header::LOCATION, format!("/v1/measurements/{}", measurement.id))];
    Ok((StatusCode::CREATED, location, Json(measurement)).into_response())
}

/// Refuses times that can't be: they become the times of frames.
fn check_times(request: &MeasurementRequest) -> Result<()> {
    let checks = [
        ("/camera_fps", request.camera_fps, 1e9, "snapshots in a second"),
        ("/exposure_s", request.exposure_s, 1e5, "seconds"),
    ];
    let mut errors = Vec::new();
    for (pointer, value, most, unit) in checks {
        if let Some(value) = value
            && !(value > 0.0 && value <= most)
        {
            let detail = format!("{value} {unit} can't be; it must be above 0 and at most {most}");
            errors.push(InvalidField::new(pointer, detail));
        }
    }
    if errors.is_empty() { Ok(()) } else { Err(ApiError::fields(Code::InvalidRequest, errors)) }
}

fn facts(
    request: MeasurementRequest,
    info: &StackInfo,
    full_scale: f32,
    warnings: Vec<Finding>,
) -> NewMeasurement {
    NewMeasurement {
        name: request.name,
        calibration: request.calibration,
        data: request.data,
        format: info.format.to_string(),
        sample: info.sample.to_string(),
        // The limits on uploads keep the count far below this.
        snapshots: u32::try_from(info.frames).unwrap_or(u32::MAX),
        height: info.height,
        width: info.width,
        full_scale,
        camera_fps: request.camera_fps,
        exposure_s: request.exposure_s,
        dark: request.dark,
        warnings,
    }
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<MeasurementId>>,
) -> Result<Json<PageBody<Measurement>>> {
    let filter = Filter { calibration: query.calibration, after: query.cursor };
    let page = app.store.measurements(&access.lab, filter, query.limit.get()).await?;
    Ok(Json(PageBody::new(page, |item| item.id.to_string(), |item| item)))
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
) -> Result<Json<Measurement>> {
    Ok(Json(app.store.measurement(&access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
) -> Result<StatusCode> {
    app.store.delete_measurement(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
