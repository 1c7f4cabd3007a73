//! `/v1/models`: end-to-end networks, each trained for one calibration.

use std::time::Duration;

use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::context::changed;
use super::error::{ApiError, Code, Result};
use super::extract::{Body, Caller, created, request_key};
use super::submissions::{ResourceApi, make};
use engine::job::{Label, ModelId, ModelRequest, Submission, Timestamp};
use store::{FoundResource, NewModel, StoreError};

/// Time for which a request waits for the check of a network, including checks that run before it. A client can't poll a
/// pending model, because it has no state.
const PATIENCE: Duration = Duration::from_secs(900);

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Model")]
pub(super) struct ModelBody {
    id: ModelId,
    created_at: Timestamp,
    name: Option<Label>,
    #[serde(flatten)]
    facts: NewModel,
}

impl ResourceApi for ModelId {
    const PATH: &'static str = "/v1/models";
    const SUBMISSION: fn(ModelRequest) -> Submission = Submission::Model;
    type Body = ModelBody;

    /// Errors: 404 if the network has not passed its check.
    fn body(found: FoundResource<Self>) -> Result<ModelBody> {
        match found {
            FoundResource::Ready(model) => Ok(ModelBody {
                id: model.id,
                created_at: model.created_at,
                name: model.name,
                facts: model.facts,
            }),
            FoundResource::Pending(request) => {
                Err(StoreError::NotFound { what: "model", id: request.id.to_string() }.into())
            }
        }
    }
}

pub(super) async fn create(
    Caller(app, access): Caller,
    headers: HeaderMap,
    Body(request): Body<ModelRequest>,
) -> Result<Response> {
    let key = request_key(&headers, &request)?;
    let inserted = make(&app, &access, Submission::Model(request), key.as_ref(), PATIENCE).await?;
    let (status, id) = created::<ModelId>(inserted);
    let location = [(header::LOCATION, format!("/v1/models/{id}"))];
    let found = app.store.resource(&access.lab, id).await?;
    if let FoundResource::Pending(_) = found {
        let detail = "the check of the network takes long: send the request again, with an Idempotency-Key, to wait for it";
        return Err(ApiError::new(Code::TimedOut, detail));
    }
    Ok((location, changed(status, &ModelId::body(found)?)?).into_response())
}
