//! `/v1/me`: who asks, what is allowed, and what is taken up of it.

use axum::Json;
use serde::Serialize;

use super::error::Result;
use super::extract::Caller;
use engine::job::{Lab, Role, Timestamp, TokenId};
use store::LabUse;

#[derive(Debug, Serialize)]
pub(super) struct MeBody {
    lab: Lab,
    role: Role,
    /// None on a service without tokens.
    token: Option<TokenId>,
    /// From when on the token is worth nothing; none: never.
    expires_at: Option<Timestamp>,
    /// True if the data of every lab may be asked for.
    all_labs: bool,
    limits: LimitsBody,
    #[serde(rename = "use")]
    taken: UseBody,
}

#[derive(Debug, Serialize)]
struct LimitsBody {
    /// Of one upload.
    upload_bytes: u64,
    /// Of uploads that the token may keep; none: no limit.
    token_bytes: Option<u64>,
    /// That the lab may keep; none: no limit.
    lab_bytes: Option<u64>,
    /// Jobs of the lab that may wait and run; none: no limit for this lab.
    lab_jobs: Option<u64>,
    /// Memory of a worker: jobs that need more are refused.
    worker_memory_bytes: u64,
}

#[derive(Debug, Serialize)]
struct UseBody {
    /// Of uploads that the token keeps or has begun; none without a token.
    token_bytes: Option<u64>,
    #[serde(flatten)]
    lab: LabUse,
}

pub(super) async fn show(Caller(app, access): Caller) -> Result<Json<MeBody>> {
    let token_bytes = match access.token {
        Some(token) => Some(app.store.token_bytes(token).await?),
        None => None,
    };
    let lab = app.store.lab_use(&access.lab).await?;
    let (lab_bytes, lab_jobs) = app.store.limits(&access.lab).await?;
    Ok(Json(MeBody {
        lab: access.lab,
        role: access.role,
        token: access.token,
        expires_at: access.expires_at,
        all_labs: access.all_labs,
        limits: LimitsBody {
            upload_bytes: app.settings.max_upload_bytes,
            token_bytes: access.max_bytes,
            lab_bytes,
            lab_jobs,
            worker_memory_bytes: app.settings.worker_memory_bytes,
        },
        taken: UseBody { token_bytes, lab },
    }))
}
