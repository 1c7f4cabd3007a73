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
    /// Attempts so far, with the present one.
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
    /// Takes up to `most` notifications whose time has come, and up to `most_of_lab` of each lab; labs take turns. Their
    /// attempts are recorded before they are sent, so that none is repeated without a pause when the database fails.
    /// `next_at` gives the time of the attempt after the next, by the number of those so far; `None` gives up.
    pub async fn take_notifications(
        &self,
        most: usize,
        most_of_lab: u32,
        next_at: impl Fn(u32) -> Option<Timestamp>,
    ) -> Result<Vec<Notification>> {
        const DUE: &str = "
            SELECT id, job, attempts + 1 AS attempts FROM (
                SELECT n.*, row_number() OVER (PARTITION BY jobs.lab ORDER BY n.next_at, n.id) AS turn
                FROM notifications n JOIN jobs ON jobs.id = n.job WHERE n.next_at <= ?1
            ) WHERE turn <= ?2 ORDER BY turn, next_at, id LIMIT ?3";
        let (now, most) = (Timestamp::now(), most as u64);
        let due: Vec<Notification> =
            sql_as!(DUE, [now, most_of_lab, most]).fetch_all(&self.readers).await?;
        if due.is_empty() {
            return Ok(due);
        }
        let mut transaction = self.write().await?;
        for Notification { id, attempts, .. } in &due {
            sql!(
                "UPDATE notifications SET attempts = ?, next_at = ? WHERE id = ?",
                [*attempts, next_at(*attempts), *id]
            )
            .execute(&mut *transaction)
            .await?;
        }
        transaction.commit().await?;
        Ok(due)
    }

    /// Removes a notification that was received. One about a later end of the same job stays.
    pub async fn notified(&self, id: i64) -> Result<()> {
        sql!("DELETE FROM notifications WHERE id = ?", [id]).execute(self.writer()?).await?;
        Ok(())
    }

    /// Records why an attempt failed. If it `is_final`, the notification is given up.
    pub async fn not_notified(&self, id: i64, error: &str, is_final: bool) -> Result<()> {
        sql!(
            "UPDATE notifications SET error = ?, next_at = iif(?, NULL, next_at) WHERE id = ?",
            [error, is_final, id]
        )
        .execute(self.writer()?)
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
