//! How tasks and workers are parted other than by success, and when a task is given up.
//!
//! Two kinds of trouble are counted apart. A *failure* is the task's own doing (an error that the
//! worker told, a fault that killed it) and a few are enough to give up. A *loss* may be anyone's (a
//! SIGKILL, a power cut, a lease that ran out) and many are borne before the task is held to be the
//! cause. Both are bounded, so a task that kills its workers comes to an end.

use sqlx::SqliteConnection;

use super::claim::Lease;
use super::complete::held;
use super::graph;
use crate::job::{JobId, JobState, TaskId, TaskKind, Timestamp};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{number, parsed};
use crate::store::tables::jobs;

/// So many failures of a task, and its job has failed.
pub const MAX_FAILURES: u32 = 3;
/// So many losses of a task, and its job has failed.
pub const MAX_LOSSES: u32 = 25;

/// How a worker and its task were parted.
#[derive(Debug)]
pub(in crate::store) enum Loss {
    /// Given back unharmed.
    Released,
    /// The worker was killed or fell silent.
    Lost(String),
    /// The worker died of a fault.
    Crashed(String),
    /// The worker told an error; true if another attempt could do better.
    Failed(String, bool),
}

impl Store {
    /// Records that a task could not be done. With `retryable` it is tried again after a pause,
    /// [`MAX_FAILURES`] times in all; otherwise its job has failed, for this reason.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn fail(
        &self,
        lease: &Lease,
        reason: &str,
        retryable: bool,
    ) -> Result<(), StoreError> {
        self.part(lease, &Loss::Failed(reason.to_owned(), retryable)).await
    }

    /// Records that the worker has stopped because the job was cancelled.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn cancelled(&self, lease: &Lease) -> Result<(), StoreError> {
        self.part(lease, &Loss::Released).await
    }

    /// Gives a task back unharmed, as at a shutdown; the attempt does not count against it.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn release_task(&self, lease: &Lease) -> Result<(), StoreError> {
        self.part(lease, &Loss::Released).await
    }

    async fn part(&self, lease: &Lease, loss: &Loss) -> Result<(), StoreError> {
        let mut transaction = self.write().await?;
        if held(&mut transaction, lease).await?.is_some() {
            lose(&mut transaction, lease.task, loss).await?;
            transaction.commit().await?;
        }
        Ok(())
    }

    /// Has tiles done again whose stored results turned out to be damaged, and gives the assembly,
    /// which found it, back to wait for them. The damage counts as a failure of each tile.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn redo_tiles(&self, lease: &Lease, damaged: &[u32]) -> Result<(), StoreError> {
        let mut transaction = self.write().await?;
        let Some((job, kind)) = held(&mut transaction, lease).await? else {
            return Ok(());
        };
        let row = sqlx::query(
            "SELECT coalesce(max(failures), 0) AS worst FROM tasks
             WHERE job = ? AND kind = 'tile' AND snapshot = ?",
        )
        .bind(job.to_string())
        .bind(kind.snapshot())
        .fetch_one(&mut *transaction)
        .await?;
        if number::<u32>(&row, "worst")? >= MAX_FAILURES {
            let reason = format!("stored tiles {damaged:?} are damaged, again: is the disk sound?");
            lose(&mut transaction, lease.task, &Loss::Failed(reason, false)).await?;
            return Ok(transaction.commit().await?);
        }
        lose(&mut transaction, lease.task, &Loss::Released).await?;
        for tile in damaged {
            sqlx::query(
                "UPDATE tasks SET state = 'ready', result = NULL, failures = failures + 1
                 WHERE job = ? AND kind = 'tile' AND snapshot = ? AND tile = ? AND state = 'done'",
            )
            .bind(job.to_string())
            .bind(kind.snapshot())
            .bind(tile)
            .execute(&mut *transaction)
            .await?;
        }
        sqlx::query("UPDATE tasks SET state = 'blocked' WHERE id = ? AND state = 'ready'")
            .bind(lease.task.to_string())
            .execute(&mut *transaction)
            .await?;
        transaction.commit().await?;
        Ok(())
    }
}

/// Takes back the tasks of workers that have fallen silent. No lease lasts for ten minutes: one that
/// ends later was given before the clock was set back.
pub(in crate::store) async fn reap(
    connection: &mut SqliteConnection,
    now: i64,
) -> Result<(), StoreError> {
    let rows = sqlx::query(
        "SELECT id FROM tasks WHERE state = 'running'
                            AND lease_until NOT BETWEEN ?1 AND ?1 + 600000",
    )
    .bind(now)
    .fetch_all(&mut *connection)
    .await?;
    for row in &rows {
        let silent = Loss::Lost("the worker fell silent and its lease ran out".into());
        lose(connection, parsed(row, "id")?, &silent).await?;
    }
    Ok(())
}

pub(in crate::store) async fn end_attempt(
    connection: &mut SqliteConnection,
    task: TaskId,
    outcome: &'static str,
    reason: Option<&str>,
) -> Result<(), StoreError> {
    sqlx::query(
        "UPDATE attempts SET ended_at = ?, outcome = ?, reason = ?
         WHERE task = ? AND attempt = (SELECT attempt FROM tasks WHERE id = task)",
    )
    .bind(Timestamp::now().0)
    .bind(outcome)
    .bind(reason)
    .bind(task.to_string())
    .execute(connection)
    .await?;
    Ok(())
}

/// Parts a running task from its worker: it becomes ready again, or is cancelled with its job, or
/// is given up and its job with it.
pub(in crate::store) async fn lose(
    connection: &mut SqliteConnection,
    task: TaskId,
    loss: &Loss,
) -> Result<(), StoreError> {
    let row =
        sqlx::query("SELECT job, kind, snapshot, tile, failures, losses FROM tasks WHERE id = ?")
            .bind(task.to_string())
            .fetch_one(&mut *connection)
            .await?;
    let job: JobId = parsed(&row, "job")?;
    let (mut failures, mut losses): (u32, u32) =
        (number(&row, "failures")?, number(&row, "losses")?);
    let wanted =
        matches!(jobs::state(connection, job).await?, JobState::Queued | JobState::Running);
    let (outcome, reason, mut hopeless) = match loss {
        Loss::Released if wanted => ("released", None, false),
        Loss::Released => ("cancelled", None, false),
        Loss::Lost(reason) => ("lost", Some(reason.as_str()), false),
        Loss::Crashed(reason) => ("crashed", Some(reason.as_str()), false),
        Loss::Failed(reason, retryable) => ("failed", Some(reason.as_str()), !retryable),
    };
    match loss {
        Loss::Released => {}
        Loss::Lost(_) => losses += 1,
        Loss::Crashed(_) | Loss::Failed(..) => failures += 1,
    }
    hopeless |= failures >= MAX_FAILURES || losses >= MAX_LOSSES;
    end_attempt(connection, task, outcome, reason).await?;
    let state = match (wanted, hopeless) {
        (false, _) => "cancelled",
        (true, true) => "failed",
        (true, false) => "ready",
    };
    // After its own failure the task waits: 2, then 4 seconds.
    let ready_at = match loss {
        Loss::Crashed(_) | Loss::Failed(..) => Timestamp::now().0 + (1000 << failures),
        Loss::Released | Loss::Lost(_) => 0,
    };
    sqlx::query(
        "UPDATE tasks SET state = ?, worker = NULL, lease_until = NULL, stage = NULL, fraction = 0,
             iterations = 0, passes = 0, failures = ?, losses = ?, ready_at = ?
         WHERE id = ?",
    )
    .bind(state)
    .bind(failures)
    .bind(losses)
    .bind(ready_at)
    .bind(task.to_string())
    .execute(&mut *connection)
    .await?;
    if wanted && hopeless {
        let kind = graph::kind(&row)?;
        let error = failure_text(kind, failures, losses, reason.unwrap_or("no reason is known"));
        jobs::set_state(connection, job, JobState::Failed, Some(&error)).await?;
        jobs::cancel_waiting_tasks(connection, job).await?;
    }
    jobs::settle(connection, job).await
}

fn failure_text(kind: TaskKind, failures: u32, losses: u32, reason: &str) -> String {
    let place = match kind {
        TaskKind::Tile { snapshot, tile } => format!("tile {tile} of snapshot {snapshot}"),
        TaskKind::Assemble { snapshot } => format!("assembling snapshot {snapshot}"),
        TaskKind::Prepare => "preparing".into(),
        TaskKind::Preview { snapshot } => format!("the preview of snapshot {snapshot}"),
        TaskKind::Pilot => "the pilot".into(),
        TaskKind::Manifest => "writing the manifest".into(),
    };
    let attempts = failures + losses;
    let times = if attempts > 1 { format!(" ({attempts} attempts)") } else { String::new() };
    format!("{place}: {reason}{times}")
}
