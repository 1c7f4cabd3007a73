//! `/v1/me`: identity, limits and usage of the caller.

use axum::response::Response;
use serde::Serialize;

use super::context::RequestContext;
use super::error::Result;
use super::extract::Caller;
use engine::job::{Lab, Role, Timestamp, TokenId};
use store::LabUse;

/// Identity, limits and usage of the caller.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Me")]
pub(super) struct MeBody {
    lab: Lab,
    role: Role,
    /// Identifier of the token; null on a service without tokens.
    token: Option<TokenId>,
    /// End of the life of the token; null: never.
    expires_at: Option<Timestamp>,
    /// True if the token gives access to all labs.
    all_labs: bool,
    limits: LimitsBody,
    #[serde(rename = "use")]
    usage: UseBody,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "MeLimits")]
struct LimitsBody {
    /// Largest size of an upload.
    upload_bytes: u64,
    /// Bytes of uploads, with the arrays prepared from them, that the token may keep; null: no limit.
    token_bytes: Option<u64>,
    /// Bytes that the lab may keep; null: no limit.
    lab_bytes: Option<u64>,
    /// Jobs of the lab that may wait and run; none: no limit for this lab.
    lab_jobs: Option<u64>,
    /// Memory of a worker; jobs that need more are refused.
    worker_memory_bytes: u64,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "MeUse")]
struct UseBody {
    /// Bytes of uploads, with the arrays prepared from them, that the token keeps or has begun; null without a token.
    token_bytes: Option<u64>,
    #[serde(flatten)]
    lab: LabUse,
}

pub(super) async fn show(Caller(app, access): Caller, request: RequestContext) -> Result<Response> {
    let token_bytes = match access.token {
        Some(token) => Some(app.store.token_bytes(token).await?),
        None => None,
    };
    let lab = app.store.lab_use(&access.lab).await?;
    let (lab_bytes, lab_jobs) = app.store.limits(&access.lab).await?;
    request.json(&MeBody {
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
        usage: UseBody { token_bytes, lab },
    })
}
