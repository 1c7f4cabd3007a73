//! `/v1/calibrations`: masks of optical settings.

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
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, Params, QueryOf, created, once, request_key};
use super::intake::{self, Desk, Prepared, Upload};
use super::page::{Limit, PageBody, Renaming, ShowQuery};
use engine::intake::plan;
use engine::job::{CalibrationId, Captures, Lab, Label, Mosaic, Sha256, Timestamp};
use formats::Axes;
use formats::validate::MaskStatistics;
use store::{
    Calibration, Filter, Inserted, Made, NewCalibration, NewCaptures, NewCheck, Page, RequestKey,
    Source, Span, StagedBlob, Unready,
};

/// The body of `POST /v1/calibrations`: masks, or the captures to make them of.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CalibrationRequest {
    name: Option<Label>,
    masks: Option<Sha256>,
    /// What the masks are called in a file of several arrays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    array: Option<Label>,
    /// The order of the array's axes; none for the only one that fits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    axes: Option<Axes>,
    full_scale: Option<f32>,
    captures: Option<Captures>,
    /// The colours of the sensor's pixels; a grey sensor has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    mosaic: Option<Mosaic>,
}

impl CalibrationRequest {
    pub(super) fn of_masks(name: Option<Label>, masks: Sha256) -> Self {
        Self {
            name,
            masks: Some(masks),
            array: None,
            axes: None,
            full_scale: None,
            captures: None,
            mosaic: None,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    #[serde(default)]
    limit: Limit,
    cursor: Option<CalibrationId>,
    created_after: Option<Timestamp>,
    created_before: Option<Timestamp>,
}

/// A calibration as it is shown. What is known of masks is null until they are there.
#[derive(Debug, Serialize)]
pub(super) struct CalibrationBody {
    id: CalibrationId,
    state: Stage,
    /// How much of the work is done, in percent.
    percent: f64,
    error: Option<String>,
    /// The same as the problem with which the request would have been answered.
    problem: Option<Value>,
    created_at: Timestamp,
    name: Option<Label>,
    masks: Option<Sha256>,
    format: Option<String>,
    sample: Option<String>,
    axes: Option<String>,
    frames: Option<usize>,
    height: Option<usize>,
    width: Option<usize>,
    full_scale: Option<f32>,
    mask_mean: Option<f64>,
    dead_pixels: Option<u64>,
    clipped_negatives: Option<u64>,
    mosaic: Option<Mosaic>,
}

impl From<Calibration> for CalibrationBody {
    fn from(calibration: Calibration) -> Self {
        let Calibration { id, created_at, facts, .. } = calibration;
        Self {
            id,
            state: Stage::Ready,
            percent: 100.0,
            error: None,
            problem: None,
            created_at,
            name: facts.name,
            masks: Some(facts.masks),
            format: Some(facts.format),
            sample: Some(facts.sample),
            axes: facts.axes,
            frames: Some(facts.frames),
            height: Some(facts.height),
            width: Some(facts.width),
            full_scale: Some(facts.full_scale),
            mask_mean: Some(facts.mask_mean),
            dead_pixels: Some(facts.dead_pixels),
            clipped_negatives: Some(facts.clipped_negatives),
            mosaic: facts.mosaic,
        }
    }
}

impl TryFrom<Unready> for CalibrationBody {
    type Error = ApiError;

    fn try_from(unready: Unready) -> Result<Self> {
        let Unready { id, name, frames, fraction, mosaic, error, problem, created_at } = unready;
        Ok(Self {
            id,
            state: Stage::unready(error.as_ref()),
            percent: (fraction * 1000.0).round() / 10.0,
            error,
            problem: checks::problem(problem)?,
            created_at,
            name,
            masks: None,
            format: None,
            sample: None,
            axes: None,
            frames,
            height: None,
            width: None,
            full_scale: None,
            mask_mean: None,
            dead_pixels: None,
            clipped_negatives: None,
            mosaic,
        })
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<CalibrationRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let (status, id) =
        created(make(&app, &access, request, key.as_ref(), patience(&headers)).await?);
    let body = body(&app, &access.lab, id).await?;
    let made = body.state == Stage::Ready;
    let status = if made { status } else { StatusCode::ACCEPTED };
    let location = [(header::LOCATION, format!("/v1/calibrations/{id}"))];
    Ok((status, location, Json(body)).into_response())
}

/// Makes one, or finds the one that was made with the same key. Waits so long for the check of ready masks.
pub(super) async fn make(
    app: &App,
    access: &Access,
    request: CalibrationRequest,
    key: Option<&RequestKey>,
    patience: Duration,
) -> Result<Inserted<CalibrationId>> {
    request.is_whole()?;
    if request.captures.is_none() {
        return checks::made(app, access, request, key, patience).await;
    }
    let insert = of_captures(app, access, request, key);
    once(app, &access.lab, (Made::Calibration, key), insert).await
}

impl CalibrationRequest {
    /// Refuses what does not go together.
    fn is_whole(&self) -> Result<()> {
        match (&self.masks, &self.captures) {
            (Some(_), None) => Ok(()),
            (None, Some(_)) if self.array.is_some() => {
                Err(ApiError::field("/array", "captures are pictures, not named arrays"))
            }
            (None, Some(_)) if self.axes.is_some() => {
                Err(ApiError::field("/axes", "captures are [frame, row, column]: leave axes out"))
            }
            (None, Some(_)) if self.full_scale.is_some() => {
                let detail = "captures have no full scale: white and black give their masks' scale";
                Err(ApiError::field("/full_scale", detail))
            }
            (None, Some(_)) => Ok(()),
            _ => Err(ApiError::field("", "name either masks or captures, not both or none")),
        }
    }

    /// The uploaded masks.
    fn masks(&self) -> Result<Sha256> {
        self.masks.ok_or_else(|| ApiError::field("/masks", "name the masks"))
    }
}

impl Checked for CalibrationRequest {
    const WHAT: Made = Made::Calibration;
    type Id = CalibrationId;
    type Passed = (NewCalibration, StagedBlob, Reservation);

    fn new_id() -> CalibrationId {
        CalibrationId::new()
    }

    fn draft(&self) -> NewCheck {
        NewCheck {
            name: self.name.clone(),
            calibration: None,
            request: String::new(),
            files: self.masks.into_iter().collect(),
        }
    }

    async fn vet(&self, app: &App, owner: &Owner) -> Result<()> {
        let there = app.store.upload(&owner.lab, self.masks()?).await;
        there.map_err(|error| ApiError::reference("/masks", error))?;
        Ok(())
    }

    async fn check(
        self,
        app: &App,
        owner: &Owner,
        stop: &CancellationToken,
    ) -> Result<Self::Passed> {
        let masks = self.masks()?;
        let file = intake::upload(app, masks).await.map_err(|error| error.at("/masks"))?;
        let of = Upload { array: self.array, axes: self.axes, full_scale: self.full_scale };
        let look = move |desk: &Desk| intake::masks(desk, &file, of);
        let prepared = intake::run(app, owner, stop, look).await?;
        check_mosaic(self.mosaic, (prepared.info.height, prepared.info.width))?;
        let facts = facts((self.name, self.mosaic), masks, &prepared);
        Ok((facts, prepared.file, prepared.room))
    }

    async fn keep(
        app: &App,
        owner: &Owner,
        (facts, file, room): Self::Passed,
        source: Source<'_, CalibrationId>,
    ) -> Result<Inserted<CalibrationId>> {
        let made =
            app.store.add_calibration((&owner.lab, owner.token), facts, file, source).await?;
        drop(room);
        Ok(made)
    }
}

/// What a request says of a calibration, however its masks come.
type Told = (Option<Label>, Option<Mosaic>);

/// Refuses the mosaic of a sensor that can't have one.
fn check_mosaic(mosaic: Option<Mosaic>, (height, width): (usize, usize)) -> Result<()> {
    if mosaic.is_none() || (height.is_multiple_of(2) && width.is_multiple_of(2)) {
        return Ok(());
    }
    let detail = format!(
        "the pictures are {height}x{width} (rows x columns); a mosaic has an even number of both: crop them so \
         that they begin with the first pixel of a cell"
    );
    Err(ApiError::field("/mosaic", &detail))
}

/// Puts captures in the queue, once they look as if they could be calibrated with.
async fn of_captures(
    app: &App,
    access: &Access,
    request: CalibrationRequest,
    key: Option<&RequestKey>,
) -> Result<Inserted<CalibrationId>> {
    let CalibrationRequest { name, captures: Some(captures), mosaic, .. } = request else {
        return Err(ApiError::field("/captures", "name the captures"));
    };
    let (lab, token) = (&access.lab, access.token);
    captures.check().map_err(|errors| ApiError::fields(Code::InvalidRequest, errors))?;
    for (place, upload) in captures.uploads() {
        app.store.upload(lab, upload).await.map_err(|error| ApiError::reference(&place, error))?;
        intake::upload(app, upload).await.map_err(|error| error.at(&place))?;
    }
    let store = app.store.clone();
    let (captures, plan) = intake::run(app, &access.owner(), &app.closing, move |desk| {
        let files = captures.map(|upload| store.dir().blob(upload));
        let plan = plan(&files, desk.limits())?;
        Ok((captures, plan))
    })
    .await?;
    check_mosaic(mosaic, plan.size)?;
    let asked = NewCaptures {
        name: name.as_ref(),
        captures: &captures,
        bytes: plan.bytes,
        cost: plan.seconds,
        mosaic,
    };
    let add = app.store.add_captures((lab, token), asked, key);
    // Twice: as they are measured, and on their scale.
    app.admission.with_room("the calibration", 2 * plan.bytes, add).await
}

async fn body(app: &App, lab: &Lab, id: CalibrationId) -> Result<CalibrationBody> {
    match app.store.unready(lab, id).await? {
        Some(unready) => unready.try_into(),
        None => Ok(app.store.calibration(lab, id).await?.into()),
    }
}

fn facts(
    (name, mosaic): Told,
    masks: Sha256,
    prepared: &Prepared<MaskStatistics>,
) -> NewCalibration {
    let Prepared { info, full_scale, found, .. } = prepared;
    NewCalibration {
        name,
        masks,
        format: info.format.to_string(),
        sample: info.sample.to_string(),
        axes: info.axes.map(|axes| axes.to_string()),
        frames: info.frames,
        height: info.height,
        width: info.width,
        full_scale: *full_scale,
        mask_mean: found.mean,
        dead_pixels: found.dead_pixels,
        clipped_negatives: found.clipped_negative,
        mosaic,
    }
}

pub(super) async fn list(
    Caller(app, access): Caller,
    QueryOf(query): QueryOf<ListQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let limit = query.limit.get();
    let created = Span { from: query.created_after, before: query.created_before };
    let filter = Filter { calibration: None, created, after: query.cursor };
    // In this order: what becomes ready between the two looks is named, and once.
    let unready = app.store.all_unready(&access.lab, filter, limit).await?;
    let ready = app.store.calibrations(&access.lab, filter, limit).await?;
    let mut items: Vec<CalibrationBody> = ready.items.into_iter().map(Into::into).collect();
    for item in unready.items {
        items.push(item.try_into()?);
    }
    items.sort_by_key(|item| std::cmp::Reverse(item.id));
    items.dedup_by_key(|item| item.id);
    let most = usize::try_from(limit).unwrap_or(usize::MAX);
    let more = ready.more || unready.more || items.len() > most;
    items.truncate(most);
    let id = |item: &CalibrationBody| item.id.to_string();
    conditional::json(&PageBody::new(Page { items, more }, id, |item| item), &headers)
}

pub(super) async fn show(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    QueryOf(query): QueryOf<ShowQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    if let Some(time) = query.wait(&app) {
        app.events.calibrated(&app.store, &access.lab, id, time).await?;
    }
    conditional::json(&body(&app, &access.lab, id).await?, &headers)
}

pub(super) async fn rename(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    Body(renaming): Body<Renaming>,
) -> Result<Json<CalibrationBody>> {
    app.store.rename_calibration(&access.lab, id, renaming.name.as_ref()).await?;
    Ok(Json(body(&app, &access.lab, id).await?))
}

pub(super) async fn delete(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
) -> Result<StatusCode> {
    app.store.delete_calibration(&access.lab, id).await?;
    app.checks.stop(id);
    Ok(StatusCode::NO_CONTENT)
}
