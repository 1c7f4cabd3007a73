//! The report of a calibration: as JSON, as a page, and its maps as PNG.

use axum::http::HeaderMap;
use axum::response::Response;

use super::app::App;
use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::{Caller, Params};
use engine::intake::report_page;
use engine::job::{CalibrationId, CalibrationReport, Lab};

pub(super) async fn json(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    headers: HeaderMap,
) -> Result<Response> {
    let report = report(&app, &access.lab, id).await?;
    conditional::json(&report, &headers)
}

pub(super) async fn html(
    Caller(app, access): Caller,
    Params(id): Params<CalibrationId>,
    headers: HeaderMap,
) -> Result<Response> {
    let report = report(&app, &access.lab, id).await?;
    let name = app.store.calibration(&access.lab, id).await?.name;
    let title = name.map_or_else(|| id.to_string(), |name| name.as_str().to_owned());
    Ok(conditional::page(&headers, report_page(&title, &report)))
}

pub(super) async fn map(
    Caller(app, access): Caller,
    Params((id, name)): Params<(CalibrationId, String)>,
    headers: HeaderMap,
) -> Result<Response> {
    let report = report(&app, &access.lab, id).await?;
    let plain = name.strip_suffix(".png");
    let plain = plain.filter(|name| report.maps.iter().any(|map| map == name));
    let missing = || {
        let names: Vec<String> = report.maps.iter().map(|map| format!("{map}.png")).collect();
        ApiError::new(Code::NotFound, format!("there is no such map; the maps are {names:?}"))
    };
    let png = app.store.map(id, plain.ok_or_else(missing)?).await?;
    Ok(conditional::content(&headers, "image/png", png.ok_or_else(missing)?))
}

async fn report(app: &App, lab: &Lab, id: CalibrationId) -> Result<CalibrationReport> {
    // Checks first that the calibration belongs to the lab.
    app.store.calibration(lab, id).await?;
    if let Some(report) = app.store.report(id).await? {
        return Ok(report);
    }
    Err(match app.store.report_failure(id).await? {
        Some(reason) => {
            let detail = format!("the report of the calibration can't be made: {reason}");
            ApiError::new(Code::ReportFailed, detail)
        }
        None => {
            ApiError::new(Code::NotReady, "the report is not ready yet; try again in a few seconds")
        }
    })
}
