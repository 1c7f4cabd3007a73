//! Tables `notifications` and `webhook_secrets`. A trigger adds a notification when a job with a webhook ends, in the same
//! transaction.

use rand::Rng;

use super::jobs::Job;
use crate::Store;
use crate::columns::{from_row, sql, sql_as};
use crate::error::Result;
use engine::job::{JobId, Lab, Timestamp};

/// A notification that is to be sent.
#[derive(Debug, Clone)]
pub struct Notification {
    /// Distinguishes the ends of a job that was retried.
    pub id: i64,
    pub job: JobId,
    /// Attempts so far.
    pub attempts: u32,
}

from_row!(Notification, row => { id, job, attempts });

/// A notification that has not been received yet.
#[derive(Debug, Clone)]
pub struct Delivery {
    /// Attempts so far.
    pub attempts: u32,
    /// Time of the next attempt; `None` if it was given up.
    pub next_at: Option<Timestamp>,
    /// Why the last attempt failed.
    pub error: Option<String>,
}

from_row!(Delivery, row => { attempts, next_at, error });

impl Store {
    /// Up to `limit` notifications whose time has come, the oldest first.
    pub async fn due_notifications(&self, limit: u32) -> Result<Vec<Notification>> {
        let due = sql_as!(
            "SELECT id, job, attempts FROM notifications WHERE next_at <= ? ORDER BY next_at, id LIMIT ?",
            [Timestamp::now(), limit]
        );
        due.fetch_all(&self.readers).await
    }

    /// Removes a notification that was received. One about a later end of the same job stays.
    pub async fn notified(&self, id: i64) -> Result<()> {
        sql!("DELETE FROM notifications WHERE id = ?", [id]).execute(&self.writer).await?;
        Ok(())
    }

    /// Records a failed attempt. The next one is at `next_at`; `None` gives up.
    pub async fn not_notified(
        &self,
        id: i64,
        error: &str,
        next_at: Option<Timestamp>,
    ) -> Result<()> {
        sql!(
            "UPDATE notifications SET attempts = attempts + 1, error = ?, next_at = ? WHERE id = ?",
            [error, next_at, id]
        )
        .execute(&self.writer)
        .await?;
        Ok(())
    }

    /// The notification about a job that has ended; `None` once it was received.
    pub async fn delivery(&self, job: &Job) -> Result<Option<Delivery>> {
        let found =
            sql_as!("SELECT attempts, next_at, error FROM notifications WHERE job = ?", [job.id]);
        found.fetch_optional(&self.readers).await
    }

    /// The key that signs the notifications of a lab. The first call, and each with `renew`, draws a new one.
    pub async fn webhook_secret(&self, lab: &Lab, renew: bool) -> Result<Vec<u8>> {
        const FOUND: &str = "SELECT secret FROM webhook_secrets WHERE lab = ?";
        if !renew && let Some(secret) = sql_as!(FOUND, [lab]).fetch_optional(&self.readers).await? {
            return Ok(secret);
        }
        let fresh: [u8; 32] = rand::rng().random();
        let mut transaction = self.write().await?;
        sql!(
            "INSERT INTO webhook_secrets VALUES (?1, ?2)
             ON CONFLICT (lab) DO UPDATE SET secret = iif(?3, excluded.secret, secret)",
            [lab, fresh.to_vec(), renew]
        )
        .execute(&mut *transaction)
        .await?;
        let secret = sql_as!(FOUND, [lab]).fetch_one(&mut *transaction).await?;
        transaction.commit().await?;
        Ok(secret)
    }
}
