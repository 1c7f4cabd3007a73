//! `/v1/measurements`: coded snapshots.

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, once, request_key};
use super::intake::{self, Prepared, Upload};
use super::page::{ListQuery, PageBody, Renaming};
use crate::formats::{Axes, StackInfo};
use crate::intake::Exposure;
use crate::job::{CalibrationId, Finding, InvalidField, Label, MeasurementId, Sequence, Sha256};
use crate::store::{Inserted, Made, Measurement, NewMeasurement, RequestKey};

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MeasurementRequest {
    name: Option<Label>,
    calibration: CalibrationId,
    data: Sha256,
    /// What the snapshots are called in a file of several arrays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    array: Option<Label>,
    /// The order of the array's axes; none for the only one that fits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    axes: Option<Axes>,
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
    /// Whether the snapshots follow one another; what the times say where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sequence: Option<Sequence>,
}

impl MeasurementRequest {
    pub(super) fn of_data(name: Option<Label>, calibration: CalibrationId, data: Sha256) -> Self {
        Self {
            name,
            calibration,
            data,
            array: None,
            axes: None,
            dark: Vec::new(),
            saturation: None,
            full_scale: None,
            camera_fps: None,
            exposure_s: None,
            sequence: None,
        }
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<MeasurementRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let (status, id) = created(make(&app, &access, request, key.as_ref()).await?);
    let location = [(header::LOCATION, format!("/v1/measurements/{id}"))];
    let measurement = app.store.measurement(&access.lab, id).await?;
    Ok((status, location, Json(measurement)).into_response())
}

/// Makes one, or finds the one that was made with the same key.
pub(super) async fn make(
    app: &App,
    access: &Access,
    request: MeasurementRequest,
    key: Option<&RequestKey>,
) -> Result<Inserted<MeasurementId>> {
    let insert = insert(app, access, request, key);
    once(app, &access.lab, (Made::Measurement, key), insert).await
}

/// Checks a measurement and puts it on record.
async fn insert(
    app: &App,
    access: &Access,
    request: MeasurementRequest,
    key: Option<&RequestKey>,
) -> Result<Inserted<MeasurementId>> {
    check_times(&request)?;
    let lab = &access.lab;
    let data = request.data;
    let calibration = app.store.calibration(lab, request.calibration).await;
    let calibration = calibration.map_err(|error| ApiError::reference("/calibration", error))?;
    app.store.upload(lab, data).await.map_err(|error| ApiError::reference("/data", error))?;
    let file = intake::upload(app, data).await.map_err(|error| error.at("/data"))?;
    let mut dark = Vec::with_capacity(request.dark.len());
    for (index, upload) in request.dark.iter().enumerate() {
        let place = format!("/dark/{index}");
        let there = app.store.upload(lab, *upload).await;
        there.map_err(|error| ApiError::reference(&place, error))?;
        dark.push(intake::upload(app, *upload).await.map_err(|error| error.at(&place))?);
    }
    let frames = calibration.facts.frames;
    let exposure = Exposure { dark, saturation: request.saturation };
    let MeasurementRequest { axes, full_scale, .. } = request;
    let of = Upload { array: request.array.clone(), axes, full_scale };
    let prepared = intake::run(app, access, move |desk| {
        intake::measurement(desk, &file, of, &exposure, &calibration)
    });
    let Prepared { info, full_scale, found, file, room } = prepared.await?;
    let facts = facts(request, &info, full_scale, frames, found);
    let made = app.store.add_measurement((lab, access.token), facts, file, key).await?;
    drop(room);
    Ok(made)
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
    frames: usize,
    warnings: Vec<Finding>,
) -> NewMeasurement {
    let told = Sequence::told_by(request.camera_fps, request.exposure_s, frames);
    NewMeasurement {
        name: request.name,
        calibration: request.calibration,
        data: request.data,
        format: info.format.to_string(),
        sample: info.sample.to_string(),
        axes: info.axes.map(|axes| axes.to_string()),
        // The limits on uploads keep the count far below this.
        snapshots: u32::try_from(info.frames).unwrap_or(u32::MAX),
        height: info.height,
        width: info.width,
        full_scale,
        camera_fps: request.camera_fps,
        exposure_s: request.exposure_s,
        sequence: request.sequence.unwrap_or(told),
        dark: request.dark,
        warnings,
    }
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<MeasurementId>>,
) -> Result<Json<PageBody<Measurement>>> {
    let limit = query.limit.get();
    let page = app.store.measurements(&access.lab, query.filter(), limit).await?;
    Ok(Json(PageBody::new(page, |item| item.id.to_string(), |item| item)))
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
) -> Result<Json<Measurement>> {
    Ok(Json(app.store.measurement(&access.lab, id).await?))
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    Body(renaming): Body<Renaming>,
) -> Result<Json<Measurement>> {
    app.store.rename_measurement(&access.lab, id, renaming.name.as_ref()).await?;
    Ok(Json(app.store.measurement(&access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
) -> Result<StatusCode> {
    app.store.delete_measurement(&access.lab, id).await?;
    Ok(StatusCode::NO_CONTENT)
}
