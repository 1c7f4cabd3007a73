//! Leases of tasks, and all ends of an attempt other than success.
//!
//! Failures and losses are counted separately. A *failure* is caused by the task: an error that the worker reported, or
//! a fault that killed it. A few failures are enough to give up, and so are a few kills by the kernel for lack of
//! memory. A *loss* may have any cause: a SIGKILL, a power cut, an expired lease. Many are tolerated before the task
//! counts as the cause. Both are bounded, so a task that kills its workers ends.

use std::time::Duration;

use sqlx::SqliteConnection;
use strum::Display;

use super::job;
use crate::Store;
use crate::columns::{Columns, sql, sql_as};
use crate::error::Result;
use crate::tables::tasks::{self, Owner};
use crate::tables::{requests, sums, workers};
use engine::intake::{Refusal, RefusalCode};
use engine::job::{
    JobState, RunSpec, TaskId, TaskKind, TaskProgress, TaskState, Timestamp, WorkerId,
};

/// So many failures of a task, and it is given up, and its job or calibration with it.
pub const MAX_FAILURES: u32 = 3;
/// Kills for lack of memory after which a task is given up in the same way.
pub const MAX_STARVED: u32 = 5;
/// So many losses of a task, and it is given up in the same way.
pub const MAX_LOSSES: u32 = 25;
/// Number of workers that may end during one check, for any reason, before it is given up.
const MAX_CHECK_DEATHS: u32 = 5;
/// The pause of a task that waits for room on the disk, in milliseconds.
const POSTPONED: i64 = 10_000;
/// No lease lasts longer (in milliseconds): one that ends later was given before the clock was set back.
pub(super) const LONGEST_LEASE: i64 = 600_000;

/// The right to work on a task, until it runs out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    pub task: TaskId,
    /// The number of this attempt, from 1.
    pub attempt: u32,
    pub worker: WorkerId,
    /// For how long each heartbeat renews it.
    pub length: Duration,
}

impl Lease {
    /// When it runs out if it is renewed now.
    pub(super) fn until(length: Duration, now: i64) -> i64 {
        now + i64::try_from(length.as_millis()).unwrap_or(i64::MAX / 2)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    /// Go on; the lease is renewed.
    Continue,
    /// The job was cancelled or has failed: stop, and call [`Store::give_back`].
    Cancelled,
    /// The task is someone else's, as the lease ran out, or it was deleted with its calibration: stop,
    /// and drop everything.
    Lost,
}

/// The end of a worker, as its supervisor saw it.
#[derive(Debug, Clone)]
pub enum WorkerEnd {
    /// It ended in order and gave its task back, if it had one.
    Left,
    /// It was killed from outside: the task may be innocent.
    Killed,
    /// The kernel killed it for lack of memory, with this description: the task may be the cause.
    Starved(String),
    /// It ended because its GPU was lost. The task may be innocent.
    DeviceLost,
    /// It died of a fault, such as SIGSEGV or a panic: the task is under suspicion.
    Crashed(String),
}

/// The end of an attempt other than success.
#[derive(Debug)]
pub(super) enum Loss {
    Released,
    /// The machine can't do it now: the disk is full.
    Postponed(String),
    /// The worker was killed or fell silent.
    Lost(String),
    /// The worker was killed for lack of memory.
    Starved(String),
    Crashed(String),
    /// The worker told an error; true if another attempt could do better.
    Failed(String, bool),
}

#[derive(Debug, Clone, Copy, Display)]
#[strum(serialize_all = "snake_case")]
pub(super) enum Outcome {
    Done,
    Failed,
    Crashed,
    Lost,
    Cancelled,
    Released,
}

impl Store {
    /// Renews a lease, notes the progress and how the solver went (JSON as [`TileHistory::points`](crate::TileHistory)
    /// has it; without one, the last one stays), and returns whether to continue.
    pub async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat> {
        let mut transaction = self.write().await?;
        workers::seen(&mut transaction, lease.worker).await?;
        let row = sql!(
            "UPDATE tasks SET lease_until = ?, stage = ?, iterations = ?, passes = ?, fraction = ?,
                 history = coalesce(?, history)
             WHERE id = ? AND attempt = ? AND state = ?
             RETURNING (SELECT state FROM jobs WHERE id = tasks.job) AS job_state",
            [
                Lease::until(lease.length, Timestamp::now().0),
                progress.stage,
                progress.iterations,
                progress.passes,
                progress.fraction.clamp(0.0, 1.0),
                history,
                lease.task,
                lease.attempt,
                TaskState::Running
            ]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        transaction.commit().await?;
        let Some(row) = row else { return Ok(Heartbeat::Lost) };
        Ok(match row.read("job_state")? {
            None | Some(JobState::Queued | JobState::Running) => Heartbeat::Continue,
            Some(_) => Heartbeat::Cancelled,
        })
    }

    /// Records that a task could not be done. With `retryable` it is tried again after a pause,
    /// [`MAX_FAILURES`] times in all; otherwise its job or calibration has failed, for this reason.
    pub async fn fail(&self, lease: &Lease, reason: &str, retryable: bool) -> Result<()> {
        self.part(lease, &Loss::Failed(reason.to_owned(), retryable)).await
    }

    /// Gives a task back that can't be done now, for a reason that is not its own. It is tried again after a pause,
    /// without limit.
    pub async fn postpone(&self, lease: &Lease, reason: &str) -> Result<()> {
        self.part(lease, &Loss::Postponed(reason.to_owned())).await
    }

    /// Gives a task back unharmed, as at a shutdown or when its job was cancelled; the attempt does not
    /// count against it.
    pub async fn give_back(&self, lease: &Lease) -> Result<()> {
        self.part(lease, &Loss::Released).await
    }

    pub(super) async fn part(&self, lease: &Lease, loss: &Loss) -> Result<()> {
        let mut transaction = self.write().await?;
        if held(&mut transaction, lease).await?.is_some() {
            lose(&mut transaction, lease.task, loss).await?;
            transaction.commit().await?;
        }
        Ok(())
    }

    /// Has tiles done again whose stored results turned out to be damaged, and gives the assembly,
    /// which found it, back to wait for them; each is given by the first snapshot of its run, and its index.
    /// The damage counts as a failure of each tile.
    pub async fn redo_tiles(&self, lease: &Lease, damaged: &[(u32, u32)]) -> Result<()> {
        let mut transaction = self.write().await?;
        let Some((Owner::Job(job), kind)) = held(&mut transaction, lease).await? else {
            return Ok(());
        };
        let worst: u32 = sql_as!(
            "SELECT coalesce(max(failures), 0) FROM tasks
             WHERE job = ?1 AND kind = 'tile'
               AND (?2 IS NULL OR snapshot BETWEEN ?2 - ?3 + 1 AND ?2 AND ?2 < snapshot + snapshots)",
            [job, kind.snapshot(), RunSpec::LONGEST]
        )
        .fetch_one(&mut *transaction)
        .await?;
        if worst >= MAX_FAILURES {
            let reason = format!("stored tiles {damaged:?} are damaged, again: is the disk sound?");
            lose(&mut transaction, lease.task, &Loss::Failed(reason, false)).await?;
            return Ok(transaction.commit().await?);
        }
        lose(&mut transaction, lease.task, &Loss::Released).await?;
        for (run, tile) in damaged {
            sql!(
                "UPDATE tasks SET state = ?, result = NULL, failures = failures + 1
                 WHERE job = ? AND kind = 'tile' AND snapshot = ? AND tile = ? AND state = ?",
                [TaskState::Ready, job, run, tile, TaskState::Done]
            )
            .execute(&mut *transaction)
            .await?;
        }
        sql!(
            "UPDATE tasks SET state = ? WHERE id = ? AND state = ?",
            [TaskState::Blocked, lease.task, TaskState::Ready]
        )
        .execute(&mut *transaction)
        .await?;
        sums::recount(&mut transaction, job).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Records that a worker has ended, and frees its task at once instead of when its lease runs out.
    pub async fn worker_ended(&self, id: WorkerId, end: &WorkerEnd) -> Result<()> {
        let loss = match end {
            WorkerEnd::Left => Loss::Released,
            WorkerEnd::Killed => Loss::Lost("the worker process was killed".into()),
            WorkerEnd::DeviceLost => Loss::Lost("the GPU of the worker was lost".into()),
            WorkerEnd::Starved(how) => Loss::Starved(how.clone()),
            WorkerEnd::Crashed(how) => Loss::Crashed(format!("the worker process died: {how}")),
        };
        let mut transaction = self.write().await?;
        let tasks = "SELECT id FROM tasks WHERE worker = ? AND state = ?";
        let tasks = sql_as!(tasks, [id, TaskState::Running]);
        for task in tasks.fetch_all(&mut *transaction).await? {
            lose(&mut transaction, task, &loss).await?;
        }
        workers::remove(&mut transaction, id).await?;
        transaction.commit().await?;
        Ok(())
    }
}

/// Owner and kind of the task, if the lease is valid. A lease that ran out but was not claimed by anyone else is good:
/// the work is done, so it may as well count.
pub(super) async fn held(
    connection: &mut SqliteConnection,
    lease: &Lease,
) -> Result<Option<(Owner, TaskKind)>> {
    let row = sql!(
        "SELECT job, thing, kind, snapshot, snapshots, tile FROM tasks
         WHERE id = ? AND attempt = ? AND state = ?",
        [lease.task, lease.attempt, TaskState::Running]
    )
    .fetch_optional(connection)
    .await?;
    row.map(|row| Ok((tasks::owner(&row)?, tasks::kind(&row)?))).transpose()
}

/// Takes back the tasks of workers that have fallen silent.
pub(super) async fn reap(connection: &mut SqliteConnection, now: i64) -> Result<()> {
    let silent = Loss::Lost("the worker fell silent and its lease ran out".into());
    let tasks = "SELECT id FROM tasks WHERE state = 'running' AND lease_until NOT BETWEEN ? AND ?";
    let tasks = sql_as!(tasks, [now, now + LONGEST_LEASE]);
    for task in tasks.fetch_all(&mut *connection).await? {
        lose(connection, task, &silent).await?;
    }
    Ok(())
}

/// Closes the record of a task's last attempt.
pub(super) async fn end_attempt(
    connection: &mut SqliteConnection,
    task: TaskId,
    outcome: Outcome,
    reason: Option<&str>,
) -> Result<()> {
    sql!(
        "UPDATE attempts SET ended_at = ?, outcome = ?, reason = ?
         WHERE task = ? AND attempt = (SELECT attempt FROM tasks WHERE id = task)",
        [Timestamp::now(), outcome.to_string(), reason, task]
    )
    .execute(connection)
    .await?;
    Ok(())
}

/// Parts a running task from its worker: it becomes ready again, or is cancelled with its job, or
/// is given up and its job or calibration with it.
pub(super) async fn lose(
    connection: &mut SqliteConnection,
    task: TaskId,
    loss: &Loss,
) -> Result<()> {
    let row = sql!(
        "SELECT job, thing, kind, snapshot, snapshots, tile, failures, losses, starved
         FROM tasks WHERE id = ?",
        [task]
    )
    .fetch_one(&mut *connection)
    .await?;
    let owner = tasks::owner(&row)?;
    let (mut failures, mut losses): (u32, u32) = (row.read("failures")?, row.read("losses")?);
    let mut starved: u32 = row.read("starved")?;
    let wanted = match owner {
        Owner::Job(job) => job::is_wanted(connection, job).await?,
        // Its task would have been deleted with it.
        Owner::Resource(_) => true,
    };
    let (outcome, reason, mut hopeless) = match loss {
        Loss::Released if wanted => (Outcome::Released, None, false),
        Loss::Released => (Outcome::Cancelled, None, false),
        Loss::Postponed(reason) => (Outcome::Released, Some(reason.as_str()), false),
        Loss::Lost(reason) | Loss::Starved(reason) => (Outcome::Lost, Some(reason.as_str()), false),
        Loss::Crashed(reason) => (Outcome::Crashed, Some(reason.as_str()), false),
        Loss::Failed(reason, retryable) => (Outcome::Failed, Some(reason.as_str()), !retryable),
    };
    match loss {
        Loss::Released | Loss::Postponed(_) => {}
        Loss::Lost(_) => losses += 1,
        Loss::Starved(_) => starved += 1,
        Loss::Crashed(_) | Loss::Failed(..) => failures += 1,
    }
    let kind = tasks::kind(&row)?;
    hopeless |= failures >= MAX_FAILURES || losses >= MAX_LOSSES || starved >= MAX_STARVED;
    // A check reads what a stranger has sent, and is soon done: its workers die of it rather than by chance.
    let fatal = kind == TaskKind::Check && failures + losses + starved >= MAX_CHECK_DEATHS;
    hopeless |= fatal;
    end_attempt(connection, task, outcome, reason).await?;
    let state = match (wanted, hopeless) {
        (false, _) => TaskState::Cancelled,
        (true, true) => TaskState::Failed,
        (true, false) => TaskState::Ready,
    };
    // After its own failure the task waits: 2, then 4 seconds.
    let ready_at = match loss {
        Loss::Crashed(_) | Loss::Failed(..) => Timestamp::now().0 + (1000 << failures),
        // Others may need less by then.
        Loss::Starved(_) => Timestamp::now().0 + (1000 << starved),
        Loss::Postponed(_) => Timestamp::now().0 + POSTPONED,
        Loss::Released | Loss::Lost(_) => 0,
    };
    sql!(
        "UPDATE tasks SET state = ?, worker = NULL, lease_until = NULL, stage = NULL, fraction = 0,
             iterations = 0, passes = 0, failures = ?, losses = ?, starved = ?, ready_at = ?
         WHERE id = ?",
        [state, failures, losses, starved, ready_at, task]
    )
    .execute(&mut *connection)
    .await?;
    let job = match owner {
        Owner::Job(job) => job,
        Owner::Resource(id) if state == TaskState::Failed => {
            let refusal = match loss {
                Loss::Failed(reason, false) => Refusal::new(RefusalCode::InvalidContent, reason),
                _ if fatal => Refusal::new(
                    RefusalCode::Internal,
                    format!("the worker ended {MAX_CHECK_DEATHS} times while the file was checked"),
                ),
                _ => Refusal::new(RefusalCode::Internal, reason.unwrap_or("no reason is known")),
            };
            // A movie has no request; the reason is that of its last attempt.
            return requests::refuse(connection, id, &refusal).await;
        }
        Owner::Resource(_) => return Ok(()),
    };
    if state == TaskState::Failed {
        let error =
            failure_text(kind, failures + losses + starved, reason.unwrap_or("no reason is known"));
        job::fail(connection, job, &error).await?;
    }
    job::settle(connection, job).await
}

fn failure_text(kind: TaskKind, attempts: u32, reason: &str) -> String {
    let place = match kind {
        TaskKind::Tile { snapshot, snapshots: 1, tile } => {
            format!("tile {tile} of snapshot {snapshot}")
        }
        TaskKind::Tile { snapshot, snapshots, tile } => {
            let last = snapshot + snapshots.saturating_sub(1);
            format!("tile {tile} of snapshots {snapshot} to {last}")
        }
        TaskKind::Assemble { snapshot } => format!("assembling snapshot {snapshot}"),
        TaskKind::Prepare => "preparing".into(),
        TaskKind::White => "determining the white level".into(),
        TaskKind::Preview { snapshot } => format!("the preview of snapshot {snapshot}"),
        TaskKind::Pilot => "the pilot".into(),
        TaskKind::Manifest => "writing the manifest".into(),
        TaskKind::Check => "the check".into(),
        TaskKind::Calibration => "the calibration".into(),
        TaskKind::Movie { .. } | TaskKind::Gif { .. } => "the movie".into(),
    };
    let times = if attempts > 1 { format!(" ({attempts} attempts)") } else { String::new() };
    format!("{place}: {reason}{times}")
}
