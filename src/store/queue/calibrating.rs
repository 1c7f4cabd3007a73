//! Table `calibration_tasks`: masks from raw captures, and reports, as workers do them.
//!
//! The same rules as in [`super`]: a claim is held under a lease, has a number, and what an
//! earlier attempt says later is refused. A calibration has one task, no jobs wait in line for it,
//! and a job can't refer to it before its masks are there; so it stands in a table of its own.

use std::path::PathBuf;
use std::time::Duration;

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::complete::millis;
use super::lease::{Loss, MAX_FAILURES, MAX_LOSSES};
use crate::job::{CalibrationId, CalibrationReport, Captures, Lab, Label, Timestamp, WorkerId};
use crate::store::error::StoreError;
use crate::store::rows::{json, number, parsed};
use crate::store::tables::blobs::Origin;
use crate::store::tables::calibrations::label;
use crate::store::tables::workers;
use crate::store::{Calibration, Heartbeat, NewCalibration, StagedBlob, Store};

/// The right to work on a calibration, until it runs out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CalibrationLease {
    /// The calibration.
    pub calibration: CalibrationId,
    /// The number of this attempt, from 1.
    pub attempt: u32,
    /// For how long each heartbeat renews it.
    pub length: Duration,
}

/// What is to be done for a calibration.
#[derive(Debug, Clone)]
pub enum CalibrationWork {
    /// Masks are to be made of these captures, and a report.
    Captures(Captures),
    /// The masks are there, a planar array at this place: a report is to be made.
    Report(PathBuf),
}

/// A claimed calibration.
#[derive(Debug, Clone)]
pub struct ClaimedCalibration {
    /// The right to it.
    pub lease: CalibrationLease,
    /// The user's name for it.
    pub name: Option<Label>,
    /// What is to be done.
    pub work: CalibrationWork,
}

/// What was made for a calibration.
#[derive(Debug)]
pub struct CalibrationDone {
    /// The masks and what is known of them, if they were made of captures.
    pub masks: Option<(NewCalibration, StagedBlob)>,
    /// The report.
    pub report: CalibrationReport,
    /// Pictures by name, as PNG.
    pub maps: Vec<(String, Vec<u8>)>,
}

impl Store {
    /// Records a calibration that is to be made of captures.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if an upload is gone.
    pub async fn add_captures(
        &self,
        lab: &Lab,
        name: Option<&Label>,
        captures: &Captures,
    ) -> Result<CalibrationId, StoreError> {
        let id = CalibrationId::new();
        let text = serde_json::to_string(captures).map_err(|error| StoreError::Corrupt {
            column: "captures",
            value: error.to_string(),
        })?;
        let mut transaction = self.write().await?;
        insert(&mut transaction, lab, id, name, Some(&text)).await?;
        for (_, upload) in captures.uploads() {
            sqlx::query(
                "INSERT INTO calibration_captures (calibration, sha256) VALUES (?, ?)
                 ON CONFLICT DO NOTHING",
            )
            .bind(id.to_string())
            .bind(upload.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(|error| {
                crate::store::tables::calibrations::gone_if_foreign_key(
                    error,
                    "blob",
                    upload.to_string(),
                )
            })?;
        }
        transaction.commit().await?;
        Ok(id)
    }

    /// Hands out the next calibration to be worked on, if there is one.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn claim_calibration(
        &self,
        worker: WorkerId,
        length: Duration,
    ) -> Result<Option<ClaimedCalibration>, StoreError> {
        let now = Timestamp::now().0;
        // Without the lock: most of the time there is nothing to do.
        let work = sqlx::query(
            "SELECT 1 FROM calibration_tasks WHERE (state = 'ready' AND ready_at <= ?1)
                 OR (state = 'running' AND lease_until < ?1) LIMIT 1",
        )
        .bind(now)
        .fetch_optional(&self.readers)
        .await?;
        if work.is_none() {
            return Ok(None);
        }
        let mut transaction = self.write().await?;
        lose(&mut transaction, &Lost::Silent(now), "the worker fell silent", false).await?;
        let row = sqlx::query(
            "UPDATE calibration_tasks SET state = 'running', worker = ?1, lease_until = ?2,
                 attempt = attempt + 1, fraction = 0
             WHERE calibration = (SELECT calibration FROM calibration_tasks
                                  WHERE state = 'ready' AND ready_at <= ?3
                                  ORDER BY calibration LIMIT 1)
             RETURNING calibration, lab, name, captures, attempt,
                 (SELECT prepared FROM calibrations WHERE id = calibration) AS prepared",
        )
        .bind(worker.to_string())
        .bind(now + millis(length))
        .bind(now)
        .fetch_optional(&mut *transaction)
        .await?;
        workers::seen(&mut transaction, worker).await?;
        transaction.commit().await?;
        row.as_ref().map(|row| self.claimed(row, length)).transpose()
    }

    fn claimed(&self, row: &SqliteRow, length: Duration) -> Result<ClaimedCalibration, StoreError> {
        let captures: Option<String> = row.try_get("captures")?;
        let work = match captures {
            Some(_) => CalibrationWork::Captures(json(row, "captures")?),
            None => CalibrationWork::Report(self.dir().blob(&parsed(row, "prepared")?)),
        };
        let lease = CalibrationLease {
            calibration: parsed(row, "calibration")?,
            attempt: number(row, "attempt")?,
            length,
        };
        Ok(ClaimedCalibration { lease, name: label(row, "name")?, work })
    }

    /// Renews a lease, notes the progress, and asks whether to go on.
    ///
    /// # Errors
    /// If the database fails; the lease is not renewed then.
    pub async fn calibration_heartbeat(
        &self,
        lease: &CalibrationLease,
        worker: WorkerId,
        fraction: f64,
    ) -> Result<Heartbeat, StoreError> {
        let mut transaction = self.write().await?;
        workers::seen(&mut transaction, worker).await?;
        let renewed = sqlx::query(
            "UPDATE calibration_tasks SET lease_until = ?, fraction = ?
             WHERE calibration = ? AND attempt = ? AND state = 'running'",
        )
        .bind(Timestamp::now().0 + millis(lease.length))
        .bind(fraction.clamp(0.0, 1.0))
        .bind(lease.calibration.to_string())
        .bind(lease.attempt)
        .execute(&mut *transaction)
        .await?;
        transaction.commit().await?;
        Ok(if renewed.rows_affected() == 1 { Heartbeat::Continue } else { Heartbeat::Lost })
    }

    /// Stores what was made. Says [`Heartbeat::Lost`] if the calibration was deleted or claimed again;
    /// nothing is stored then.
    ///
    /// # Errors
    /// If a file or the database can't be written.
    pub async fn calibration_done(
        &self,
        lease: &CalibrationLease,
        done: CalibrationDone,
    ) -> Result<Heartbeat, StoreError> {
        let mut transaction = self.write().await?;
        let id = lease.calibration.to_string();
        let row = sqlx::query(
            "UPDATE calibration_tasks SET state = 'done', worker = NULL, lease_until = NULL,
                 fraction = 1, error = NULL
             WHERE calibration = ? AND attempt = ? AND state = 'running'
             RETURNING created_at, lab",
        )
        .bind(&id)
        .bind(lease.attempt)
        .fetch_optional(&mut *transaction)
        .await?;
        let Some(row) = row else { return Ok(Heartbeat::Lost) };
        if let Some((facts, staged)) = done.masks {
            let calibration = Calibration {
                id: lease.calibration,
                prepared: staged.sha256(),
                created_at: Timestamp(row.try_get("created_at")?),
                facts,
            };
            self.publish(&mut transaction, staged, Origin::Prepared).await?;
            let lab: Lab = parsed(&row, "lab")?;
            crate::store::tables::calibrations::insert(&mut transaction, &lab, &calibration)
                .await?;
            sqlx::query("DELETE FROM calibration_captures WHERE calibration = ?")
                .bind(&id)
                .execute(&mut *transaction)
                .await?;
        }
        let report = serde_json::to_string(&done.report)
            .map_err(|error| StoreError::Corrupt { column: "report", value: error.to_string() })?;
        sqlx::query(
            "INSERT OR REPLACE INTO calibration_reports (calibration, report) VALUES (?, ?)",
        )
        .bind(&id)
        .bind(report)
        .execute(&mut *transaction)
        .await?;
        for (name, png) in done.maps {
            sqlx::query(
                "INSERT OR REPLACE INTO calibration_maps (calibration, name, png) VALUES (?, ?, ?)",
            )
            .bind(&id)
            .bind(name)
            .bind(png)
            .execute(&mut *transaction)
            .await?;
        }
        transaction.commit().await?;
        Ok(Heartbeat::Continue)
    }

    /// Records that a calibration could not be worked on. With `retryable` it is tried again, a few
    /// times; otherwise there will be no masks, for this reason.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn calibration_failed(
        &self,
        lease: &CalibrationLease,
        reason: &str,
        retryable: bool,
    ) -> Result<(), StoreError> {
        let now = Timestamp::now().0;
        sqlx::query(
            "UPDATE calibration_tasks SET worker = NULL, lease_until = NULL, fraction = 0,
                 failures = failures + 1, error = ?1, ready_at = ?2,
                 state = CASE WHEN ?3 AND failures + 1 < ?4 THEN 'ready' ELSE 'failed' END
             WHERE calibration = ?5 AND attempt = ?6 AND state = 'running'",
        )
        .bind(reason)
        .bind(now + 2000)
        .bind(retryable)
        .bind(MAX_FAILURES)
        .bind(lease.calibration.to_string())
        .bind(lease.attempt)
        .execute(&self.writer)
        .await?;
        Ok(())
    }

    /// Gives a calibration back unharmed, as at a shutdown.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn release_calibration(&self, lease: &CalibrationLease) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE calibration_tasks SET state = 'ready', worker = NULL, lease_until = NULL,
                 fraction = 0
             WHERE calibration = ? AND attempt = ? AND state = 'running'",
        )
        .bind(lease.calibration.to_string())
        .bind(lease.attempt)
        .execute(&self.writer)
        .await?;
        Ok(())
    }
}

/// Writes the row of a calibration to be worked on.
pub(in crate::store) async fn insert(
    connection: &mut SqliteConnection,
    lab: &Lab,
    id: CalibrationId,
    name: Option<&Label>,
    captures: Option<&str>,
) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO calibration_tasks (calibration, lab, name, captures, state, created_at)
         VALUES (?, ?, ?, ?, 'ready', ?)",
    )
    .bind(id.to_string())
    .bind(lab.as_str())
    .bind(name.map(Label::as_str))
    .bind(captures)
    .bind(Timestamp::now().0)
    .execute(connection)
    .await?;
    Ok(())
}

/// Which running tasks are lost.
enum Lost {
    /// Those of a worker that has ended.
    Of(WorkerId),
    /// Those whose lease ran out before this moment.
    Silent(i64),
}

/// Takes back what a worker that has ended had in hand.
pub(in crate::store) async fn worker_ended(
    connection: &mut SqliteConnection,
    worker: WorkerId,
    loss: &Loss,
) -> Result<(), StoreError> {
    let (reason, fault) = match loss {
        // It was told to end, and has given its work back itself if it could.
        Loss::Released => ("the worker ended", false),
        Loss::Lost(reason) => (reason.as_str(), false),
        Loss::Crashed(reason) | Loss::Failed(reason, _) => (reason.as_str(), true),
    };
    lose(connection, &Lost::Of(worker), reason, fault).await
}

/// Makes running tasks ready again, or gives them up after too many losses.
async fn lose(
    connection: &mut SqliteConnection,
    lost: &Lost,
    reason: &str,
    fault: bool,
) -> Result<(), StoreError> {
    let (worker, before) = match lost {
        Lost::Of(worker) => (Some(worker.to_string()), None),
        Lost::Silent(before) => (None, Some(*before)),
    };
    sqlx::query(
        "UPDATE calibration_tasks SET worker = NULL, lease_until = NULL, fraction = 0,
             failures = failures + ?1, losses = losses + 1,
             error = CASE WHEN failures + ?1 >= ?2 OR losses + 1 >= ?3 THEN ?4 ELSE error END,
             state = CASE WHEN failures + ?1 >= ?2 OR losses + 1 >= ?3 THEN 'failed' ELSE 'ready' END
         WHERE state = 'running' AND (worker = ?5 OR lease_until < ?6)",
    )
    .bind(fault)
    .bind(MAX_FAILURES)
    .bind(MAX_LOSSES)
    .bind(reason)
    .bind(worker)
    .bind(before)
    .execute(connection)
    .await?;
    Ok(())
}
