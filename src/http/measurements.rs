//! `/v1/measurements`: coded snapshots.

use std::time::Duration;

use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio_util::sync::CancellationToken;

use super::access::{Access, Owner};
use super::admission::Reservation;
use super::app::App;
use super::checks::{self, Checked, Stage, patience};
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, request_key};
use super::intake::{self, Desk, Prepared, Upload};
use super::page::{ListQuery, PageBody, Renaming, ShowQuery};
use engine::intake::Exposure;
use engine::job::{
    CalibrationId, Finding, InvalidField, Lab, Label, MeasurementId, Sequence, Sha256, Timestamp,
};
use formats::{Axes, StackInfo};
use store::{
    Check, Inserted, Made, Measurement, NewCheck, NewMeasurement, Page, RequestKey, Source,
    StagedBlob,
};

#[derive(Debug, Clone, Serialize, Deserialize)]
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

/// A measurement as it is shown. What is known of its data is null until they are checked.
#[derive(Debug, Serialize)]
pub(super) struct MeasurementBody {
    id: MeasurementId,
    state: Stage,
    error: Option<String>,
    /// The same as the problem with which the request would have been answered.
    problem: Option<Value>,
    created_at: Timestamp,
    name: Option<Label>,
    calibration: CalibrationId,
    data: Sha256,
    format: Option<String>,
    sample: Option<String>,
    axes: Option<String>,
    snapshots: Option<u32>,
    height: Option<usize>,
    width: Option<usize>,
    full_scale: Option<f32>,
    camera_fps: Option<f64>,
    exposure_s: Option<f64>,
    sequence: Option<Sequence>,
    dark: Vec<Sha256>,
    warnings: Vec<Finding>,
}

impl From<Measurement> for MeasurementBody {
    fn from(Measurement { id, created_at, facts, .. }: Measurement) -> Self {
        Self {
            id,
            state: Stage::Ready,
            error: None,
            problem: None,
            created_at,
            name: facts.name,
            calibration: facts.calibration,
            data: facts.data,
            format: Some(facts.format),
            sample: Some(facts.sample),
            axes: facts.axes,
            snapshots: Some(facts.snapshots),
            height: Some(facts.height),
            width: Some(facts.width),
            full_scale: Some(facts.full_scale),
            camera_fps: facts.camera_fps,
            exposure_s: facts.exposure_s,
            sequence: Some(facts.sequence),
            dark: facts.dark,
            warnings: facts.warnings,
        }
    }
}

impl TryFrom<Check> for MeasurementBody {
    type Error = ApiError;

    fn try_from(check: Check) -> Result<Self> {
        let unreadable = |error: serde_json::Error| ApiError::internal(&error);
        let asked: MeasurementRequest = serde_json::from_str(&check.request).map_err(unreadable)?;
        let error = check.error()?;
        Ok(Self {
            id: check.id.parse().map_err(|error| ApiError::internal(&error))?,
            state: Stage::unready(error.as_ref()),
            error,
            problem: checks::problem(check.problem)?,
            created_at: check.created_at,
            name: check.name,
            calibration: asked.calibration,
            data: asked.data,
            format: None,
            sample: None,
            axes: None,
            snapshots: None,
            height: None,
            width: None,
            full_scale: None,
            camera_fps: asked.camera_fps,
            exposure_s: asked.exposure_s,
            sequence: None,
            dark: asked.dark,
            warnings: Vec::new(),
        })
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<MeasurementRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let made = make(&app, &access, request, key.as_ref(), patience(&headers)).await?;
    let (status, id) = created(made);
    let body = body(&app, &access.lab, id).await?;
    let status = if body.state == Stage::Ready { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("/v1/measurements/{id}"))];
    Ok((status, location, Json(body)).into_response())
}

/// Makes one, or finds the one that was made with the same key. Waits so long for its check.
pub(super) async fn make(
    app: &App,
    access: &Access,
    request: MeasurementRequest,
    key: Option<&RequestKey>,
    patience: Duration,
) -> Result<Inserted<MeasurementId>> {
    checks::made(app, access, request, key, patience).await
}

impl Checked for MeasurementRequest {
    const WHAT: Made = Made::Measurement;
    type Id = MeasurementId;
    type Passed = (NewMeasurement, StagedBlob, Reservation);

    fn new_id() -> MeasurementId {
        MeasurementId::new()
    }

    fn draft(&self) -> NewCheck {
        let mut files = self.dark.clone();
        files.push(self.data);
        let (name, calibration) = (self.name.clone(), Some(self.calibration));
        NewCheck { name, calibration, request: String::new(), files }
    }

    async fn vet(&self, app: &App, owner: &Owner) -> Result<()> {
        check_times(self)?;
        let lab = &owner.lab;
        let calibration = app.store.calibration(lab, self.calibration).await;
        calibration.map_err(|error| ApiError::reference("/calibration", error))?;
        let there = app.store.upload(lab, self.data).await;
        there.map_err(|error| ApiError::reference("/data", error))?;
        for (index, upload) in self.dark.iter().enumerate() {
            let there = app.store.upload(lab, *upload).await;
            there.map_err(|error| ApiError::reference(&format!("/dark/{index}"), error))?;
        }
        Ok(())
    }

    async fn check(
        self,
        app: &App,
        owner: &Owner,
        stop: &CancellationToken,
    ) -> Result<Self::Passed> {
        let calibration = app.store.calibration(&owner.lab, self.calibration).await;
        let calibration =
            calibration.map_err(|error| ApiError::reference("/calibration", error))?;
        let file = intake::upload(app, self.data).await.map_err(|error| error.at("/data"))?;
        let mut dark = Vec::with_capacity(self.dark.len());
        for (index, upload) in self.dark.iter().enumerate() {
            let place = |error: ApiError| error.at(&format!("/dark/{index}"));
            dark.push(intake::upload(app, *upload).await.map_err(place)?);
        }
        let frames = calibration.facts.frames;
        let exposure = Exposure { dark, saturation: self.saturation };
        let Self { axes, full_scale, .. } = self;
        let of = Upload { array: self.array.clone(), axes, full_scale };
        let look = move |desk: &Desk| intake::measurement(desk, &file, of, &exposure, &calibration);
        let Prepared { info, full_scale, found, file, room } =
            intake::run(app, owner, stop, look).await?;
        Ok((facts(self, &info, full_scale, frames, found), file, room))
    }

    async fn keep(
        app: &App,
        owner: &Owner,
        (facts, file, room): Self::Passed,
        source: Source<'_, MeasurementId>,
    ) -> Result<Inserted<MeasurementId>> {
        let made =
            app.store.add_measurement((&owner.lab, owner.token), facts, file, source).await?;
        drop(room);
        Ok(made)
    }
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
    let told = Sequence::from_camera(request.camera_fps, request.exposure_s, frames);
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

async fn body(app: &App, lab: &Lab, id: MeasurementId) -> Result<MeasurementBody> {
    match app.store.measurement_check(lab, id).await? {
        Some(check) => check.try_into(),
        None => Ok(app.store.measurement(lab, id).await?.into()),
    }
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery<MeasurementId>>,
) -> Result<Json<PageBody<MeasurementBody>>> {
    let (limit, filter) = (query.limit.get(), query.filter());
    // In this order: what passes its check between the two looks is named, and once.
    let unready = app.store.measurement_checks(&access.lab, filter, limit).await?;
    let ready = app.store.measurements(&access.lab, filter, limit).await?;
    let mut items: Vec<MeasurementBody> = ready.items.into_iter().map(Into::into).collect();
    for check in unready.items {
        items.push(check.try_into()?);
    }
    items.sort_by_key(|item| std::cmp::Reverse(item.id));
    items.dedup_by_key(|item| item.id);
    let most = usize::try_from(limit).unwrap_or(usize::MAX);
    let more = ready.more || unready.more || items.len() > most;
    items.truncate(most);
    Ok(Json(PageBody::new(Page { items, more }, |item| item.id.to_string(), |item| item)))
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    QueryOf(query): QueryOf<ShowQuery>,
) -> Result<Json<MeasurementBody>> {
    if let Some(time) = query.wait(&app) {
        app.events.measured(&app.store, &access.lab, id, time).await?;
    }
    Ok(Json(body(&app, &access.lab, id).await?))
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
    Body(renaming): Body<Renaming>,
) -> Result<Json<MeasurementBody>> {
    app.store.rename_measurement(&access.lab, id, renaming.name.as_ref()).await?;
    Ok(Json(body(&app, &access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<MeasurementId>,
) -> Result<StatusCode> {
    app.store.delete_measurement(&access.lab, id).await?;
    app.checks.stop(id);
    Ok(StatusCode::NO_CONTENT)
}
