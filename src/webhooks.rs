//! Notifications of webhooks: when a job ends, its address gets a signed POST, as specified by Standard Webhooks
//! (<https://www.standardwebhooks.com>).

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use reqwest::redirect::Policy;
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;

use engine::job::{Timestamp, Webhook};
use store::{Job, Notification, Store, StoreError};

/// Time between two searches for unsent notifications.
const TICK: Duration = Duration::from_secs(1);
/// Time that a receiver has to answer.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Notifications that are sent at the same time.
const MOST: usize = 64;
/// Notifications of a lab that begin in a tick. A lab with a receiver that never answers has `TIMEOUT / TICK` times as
/// many in progress, fewer than [`MOST`].
const MOST_OF_LAB: u32 = 4;
/// Pauses after failed attempts, from the end of [`TIMEOUT`]. After the last one the notification is given up.
const PAUSES: [Duration; 9] = [
    Duration::from_secs(5),
    Duration::from_secs(10),
    Duration::from_secs(60),
    Duration::from_secs(300),
    Duration::from_secs(1800),
    Duration::from_secs(2 * 3600),
    Duration::from_secs(6 * 3600),
    Duration::from_secs(12 * 3600),
    Duration::from_secs(24 * 3600),
];

/// Sends notifications until it is dropped. `allowed` are the hosts that the administrator allows.
pub async fn send(store: Store, allowed: Vec<String>) {
    // A redirection could lead to a host that is not allowed.
    let client = crate::http_client().and_then(|client| {
        let client = client.timeout(TIMEOUT).redirect(Policy::none()).build();
        client.map_err(|error| error.to_string())
    });
    let client = match client {
        Ok(client) => client,
        Err(error) => {
            tracing::error!(%error, "webhooks can't be notified");
            return;
        }
    };
    let allowed: Arc<[String]> = allowed.into();
    let mut running = JoinSet::new();
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        while running.try_join_next().is_some() {}
        let free = MOST.saturating_sub(running.len());
        let due = match store.take_notifications(free, MOST_OF_LAB, next_attempt).await {
            Ok(due) => due,
            Err(error) => {
                tracing::error!(%error, "no notification is sent: the attempt can't be recorded");
                continue;
            }
        };
        for notification in due {
            let (store, client, allowed) = (store.clone(), client.clone(), allowed.clone());
            running.spawn(async move {
                if let Err(error) = notify(&store, &client, &allowed, &notification).await {
                    tracing::error!(%error, "the result of a notification can't be recorded");
                }
            });
        }
    }
}

/// Time of the attempt after one that begins now; `None` if that is the last one.
fn next_attempt(attempts: u32) -> Option<Timestamp> {
    let pause = PAUSES.get((attempts as usize).checked_sub(1)?)?;
    Some(Timestamp::now().after(TIMEOUT + *pause))
}

/// Sends a notification, and records how this ended.
async fn notify(
    store: &Store,
    client: &Client,
    allowed: &[String],
    &Notification { id, job, attempts }: &Notification,
) -> Result<(), StoreError> {
    let job = store.job_of_any_lab(job).await?;
    let Some(webhook) = &job.spec.webhook else { return store.notified(id).await };
    let secret = store.webhook_secret(&job.lab, false).await?;
    let failure = match post(client, allowed, webhook, id, &job, &secret).await {
        Ok(()) => {
            tracing::info!(job = %job.id, host = %webhook.place(), "the webhook was notified");
            return store.notified(id).await;
        }
        Err(failure) => failure,
    };
    let (host, reason) = (webhook.place(), &failure.reason);
    let is_final = failure.is_final || next_attempt(attempts).is_none();
    if is_final {
        tracing::error!(job = %job.id, host, reason, "the notification was given up");
    } else {
        tracing::warn!(job = %job.id, host, reason, "the webhook was not notified");
    }
    store.not_notified(id, reason, is_final).await
}

/// Why a notification was not received.
struct Failure {
    reason: String,
    /// True if a repetition would fail, too.
    is_final: bool,
}

async fn post(
    client: &Client,
    allowed: &[String],
    webhook: &Webhook,
    id: i64,
    job: &Job,
    secret: &[u8],
) -> Result<(), Failure> {
    if !webhook.is_allowed(allowed) {
        let reason = format!("the administrator does not allow the host {}", webhook.place());
        return Err(Failure { reason, is_final: false });
    }
    let body = message(job).to_string();
    let id = format!("{}.{id}", job.id);
    let seconds = Timestamp::now().0 / 1000;
    let answer = client
        .post(webhook.as_str())
        .header("content-type", "application/json")
        .header("user-agent", concat!("sci-recon/", env!("CARGO_PKG_VERSION")))
        .header("webhook-id", &id)
        .header("webhook-timestamp", seconds)
        .header("webhook-signature", format!("v1,{}", signature(secret, &id, seconds, &body)))
        .body(body)
        .send()
        .await;
    match answer.map(|answer| answer.status()) {
        Ok(status) if status.is_success() => Ok(()),
        Ok(status) => {
            let reason = format!("the receiver answered {status}");
            Err(Failure { reason, is_final: status == StatusCode::GONE })
        }
        Err(error) => {
            // The address may contain a secret of the receiver.
            let error = error.without_url();
            let cause = std::iter::successors(error.source(), |cause| (*cause).source()).last();
            let reason = cause.map_or(error.to_string(), |cause| format!("{error}: {cause}"));
            Err(Failure { reason, is_final: false })
        }
    }
}

/// The body of a notification.
fn message(job: &Job) -> Value {
    json!({
        "type": "job.ended",
        "timestamp": job.finished_at,
        "data": {
            "id": job.id,
            "href": format!("/v1/jobs/{}", job.id),
            "lab": job.lab,
            "label": job.spec.label,
            "state": job.state,
            "error": job.error,
            "warnings": job.spec.warnings,
            "verdict": job.verdict(),
            "verdict_text": job.verdict_text(),
            "assessment": job.assessment,
        },
    })
}

/// The HMAC-SHA256 of identifier, time and body, in base64.
fn signature(secret: &[u8], id: &str, seconds: i64, body: &str) -> String {
    // The HMAC accepts keys of any length.
    let Ok(mut hmac) = Hmac::<sha2::Sha256>::new_from_slice(secret) else { return String::new() };
    hmac.update(format!("{id}.{seconds}.{body}").as_bytes());
    STANDARD.encode(hmac.finalize().into_bytes())
}

/// A secret as receivers configure it.
#[must_use]
pub fn secret_text(secret: &[u8]) -> String {
    format!("whsec_{}", STANDARD.encode(secret))
}

#[cfg(test)]
mod tests {
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;

    use super::signature;

    /// The example of the specification of Standard Webhooks.
    #[test]
    fn signatures_follow_the_specification() {
        let secret = STANDARD.decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
        let body = r#"{"test": 2432232314}"#;
        let signed = signature(&secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, body);
        assert_eq!(signed, "g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }
}
