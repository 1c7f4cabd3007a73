//! `/v1/samples`: creates a job of the clip that comes with the program, to try the service.

use std::fs::File;
use std::io;
use std::path::Path;

use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::context::changed;
use super::error::{ApiError, Result};
use super::extract::{Body, Caller, hashed_key, idempotency_key};
use super::intake;
use super::jobs::{self, JobBody};
use super::submissions::make;
use engine::intake::sample;
use engine::job::{
    Algorithm, CalibrationRequest, JobRequest, Label, MeasurementRequest, RegistrationRequest,
    Sha256, SnapshotSelection, Submission,
};
use store::{RequestKey, StagedBlob, Store};

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(schemars::JsonSchema)]
pub(super) struct SampleRequest {
    #[serde(default = "default_algorithm")]
    algorithm: Algorithm,
    label: Option<Label>,
}

fn default_algorithm() -> Algorithm {
    Algorithm::PnpTvFastdvdnet
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Sample")]
pub(super) struct SampleBody {
    /// The file of the masks.
    masks: Sha256,
    /// The file of the measurement.
    data: Sha256,
    /// The file of the true frames, which belong to the job.
    truth: Sha256,
    job: JobBody,
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<SampleRequest>,
) -> Result<Response> {
    // The prefix keeps the key apart from keys that the lab uses on other routes.
    let key = idempotency_key(&headers)?.map(|key| format!("/v1/samples {key}"));
    let store = app.store.clone();
    let staged = intake::run(&app, &access.lab, move || simulate(&store)).await?;
    app.admission.check_length(&access, staged.iter().map(StagedBlob::size).sum()).await?;
    let mut files = Vec::new();
    for file in staged {
        files.push(app.store.store_upload(&access.lab, access.token, file).await?.0.sha256);
    }
    let [masks, data, truth] = [files[0], files[1], files[2]];
    let request_key = |file: Sha256| key.clone().map(|key| RequestKey { key, request: file });
    // Each step needs the result of the previous one, so the checks get more time than usual.
    let time = 2 * app.settings.check_time();
    let calibration =
        CalibrationRequest { name: name(), masks: Some(masks), ..CalibrationRequest::default() };
    let masks_key = request_key(masks);
    let submission = Submission::Calibration(calibration);
    let calibration = make(&app, &access, submission, masks_key.as_ref(), time).await?;
    let measurement = MeasurementRequest::new(name(), calibration.id(), data);
    let data_key = request_key(data);
    let submission = Submission::Measurement(measurement);
    let measurement = make(&app, &access, submission, data_key.as_ref(), time).await?;
    let job = JobRequest {
        measurement: measurement.id(),
        calibration: None,
        snapshots: SnapshotSelection::All,
        sequence: None,
        algorithm: request.algorithm,
        model: None,
        schedule: None,
        tile: None,
        registration: RegistrationRequest::Off,
        priority: 0,
        truth: Some(truth),
        label: request.label,
        webhook: None,
    };
    let key = hashed_key(key, &job)?;
    let (status, job) = jobs::make(&app, &access, job, key).await?;
    let location = [(header::LOCATION, job.address())];
    let body = SampleBody { masks, data, truth, job };
    Ok((location, changed(status, &body)?).into_response())
}

fn name() -> Option<Label> {
    "sample".parse().ok()
}

/// Simulates masks, a measurement and true frames, in this order. Blocks.
fn simulate(store: &Store) -> Result<[StagedBlob; 3]> {
    let folder = store.staged_dir()?;
    let files = sample(folder.path())?;
    let staged = |path: &Path| -> Result<StagedBlob> {
        let mut writer = store.blob_writer()?;
        File::open(path)
            .and_then(|mut file| io::copy(&mut file, &mut writer))
            .map_err(|error| ApiError::internal(&error))?;
        Ok(writer.finish()?)
    };
    Ok([staged(&files.masks)?, staged(&files.measurement)?, staged(&files.truth)?])
}
