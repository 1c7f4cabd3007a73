//! Tiles that are out with workers on other machines, as the hub of the cluster accounts for them.
//!
//! A tile goes out as one message, which may be delivered to several workers one after the other, when the first ones
//! fall silent. Each delivery that a worker begins with is a separate attempt. No lease runs out here: the message
//! server finds the silent ones.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Value, json};
use sqlx::SqliteConnection;

use super::claim::ClaimedTask;
use super::lease::{self, Heartbeat, Lease, Loss};
use crate::Store;
use crate::columns::{Columns, from_row, sql, sql_as};
use crate::error::StoreError;
use crate::tables::{tasks, workers};
use engine::job::{
    JobId, JobState, TaskId, TaskProgress, TaskStage, TaskState, Timestamp, WorkerId,
};

/// A tile that is out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemoteTask {
    pub task: TaskId,
    pub job: JobId,
    /// The pool that it went to.
    pub pool: String,
    /// The attempt that runs, or waits to.
    pub attempt: u32,
    /// The attempt that the message names.
    pub message: u32,
    /// Where the message is; none until it is published.
    pub place: Option<MessagePlace>,
    /// The last delivery that a worker has begun with; 0 for none.
    pub delivery: u32,
    /// The worker that has it; before that, the hub.
    pub worker: WorkerId,
    /// When that attempt began.
    pub started_at: Timestamp,
    /// False once its job is cancelled or has failed.
    pub wanted: bool,
}

/// Place of a message: its stream, named by the time of its creation (a lost disk means a new stream), and its number
/// there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MessagePlace {
    pub stream: String,
    pub seq: i64,
}

impl RemoteTask {
    /// The right to it.
    #[must_use]
    pub fn lease(&self) -> Lease {
        let (task, attempt, worker) = (self.task, self.attempt, self.worker);
        Lease { task, attempt, worker, length: Duration::ZERO }
    }
}

/// The answer to a worker that wants to begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Begun {
    /// Begin, with this number of the attempt; true if another worker had it and fell silent.
    Go(u32, bool),
    /// The task is done, given up, not wanted or in another message by now.
    Over,
    /// Another worker has begun with a later delivery.
    Lost,
}

/// A worker's report on its tile.
#[derive(Debug, Clone)]
pub struct RemoteBeat {
    pub task: TaskId,
    pub attempt: u32,
    pub worker: WorkerId,
    /// The pool of the worker that reports.
    pub pool: String,
    pub progress: TaskProgress,
    /// Convergence history, if it has changed.
    pub history: Option<String>,
}

/// The tiles that are out. CROSS JOIN has SQLite begin at `remote_tasks`, which holds few rows.
macro_rules! rows {
    () => {
        "SELECT task, pool, r.attempt AS message, stream, seq, delivery, t.job, t.attempt,
             t.worker, j.state AS job_state,
             (SELECT started_at FROM attempts a WHERE a.task = r.task AND a.attempt = t.attempt)
                 AS started_at
         FROM remote_tasks r CROSS JOIN tasks t ON t.id = task JOIN jobs j ON j.id = t.job"
    };
}

from_row!(RemoteTask, row => {
    task,
    job,
    pool,
    attempt,
    message,
    place = match (row.read("stream")?, row.read("seq")?) {
        (Some(stream), Some(seq)) => Some(MessagePlace { stream, seq }),
        _ => None,
    },
    delivery,
    worker,
    started_at,
    wanted = is_wanted(row.read("job_state")?),
});

impl Store {
    /// The tiles that are out.
    pub async fn remote_tasks(&self) -> Result<Vec<RemoteTask>, StoreError> {
        sql_as!(rows!()).fetch_all(&self.readers).await
    }

    /// A tile that is out; none if it is not.
    pub async fn remote_task(&self, task: TaskId) -> Result<Option<RemoteTask>, StoreError> {
        let found = sql_as!(concat!(rows!(), " WHERE task = ?"), [task]);
        found.fetch_optional(&self.readers).await
    }

    /// The jobs among these that neither wait nor run.
    pub async fn unwanted_jobs(&self, jobs: &[JobId]) -> Result<Vec<JobId>, StoreError> {
        if jobs.is_empty() {
            return Ok(Vec::new());
        }
        let found = sql_as!(
            "SELECT value FROM json_each(?) WHERE NOT EXISTS
                 (SELECT 1 FROM jobs WHERE id = value AND state IN (?, ?))",
            [list(jobs), JobState::Queued, JobState::Running]
        );
        found.fetch_all(&self.readers).await
    }

    /// The number of tiles that are out, by pool.
    pub async fn remote_counts(&self) -> Result<BTreeMap<String, u32>, StoreError> {
        let counts: Vec<(String, u32)> =
            sql_as!("SELECT pool, count(*) FROM remote_tasks GROUP BY pool", [])
                .fetch_all(&self.readers)
                .await?;
        Ok(counts.into_iter().collect())
    }

    /// The inputs of a tile that is out, to publish them again.
    pub async fn remote_work(&self, remote: &RemoteTask) -> Result<ClaimedTask, StoreError> {
        let row = sql!(
            "SELECT job, thing, kind, snapshot, snapshots, tile, cost FROM tasks WHERE id = ?",
            [remote.task]
        )
        .fetch_one(&self.readers)
        .await?;
        let kind = tasks::kind(&row)?;
        let work = self.work(tasks::owner(&row)?, kind).await?;
        Ok(ClaimedTask { lease: remote.lease(), kind, cost: row.read("cost")?, work })
    }

    /// Notes where the message of a tile is.
    pub async fn remote_published(
        &self,
        lease: &Lease,
        MessagePlace { stream, seq }: &MessagePlace,
    ) -> Result<(), StoreError> {
        sql!(
            "UPDATE remote_tasks SET stream = ?, seq = ? WHERE task = ? AND attempt = ?",
            [stream, seq, lease.task, lease.attempt]
        )
        .execute(self.writer()?)
        .await?;
        Ok(())
    }

    /// A worker of a pool wants to begin with a delivery of the message with the number `seq`, which
    /// names the attempt `message`. If another one had begun with an earlier delivery, that attempt is
    /// lost, and this is the next.
    pub async fn remote_begin(
        &self,
        task: TaskId,
        pool: &str,
        message: u32,
        seq: i64,
        delivery: u32,
        worker: WorkerId,
    ) -> Result<Begun, StoreError> {
        let mut transaction = self.write().await?;
        let found = sql_as!(concat!(rows!(), " WHERE task = ?"), [task]);
        let found: Option<RemoteTask> = found.fetch_optional(&mut *transaction).await?;
        // A server that was killed may have published twice what it has noted once.
        let is_this = |found: &RemoteTask| {
            let place = found.place.as_ref().is_none_or(|place| place.seq == seq);
            found.pool == pool && found.message == message && place && found.wanted
        };
        let Some(found) = found.filter(is_this) else { return Ok(Begun::Over) };
        if found.delivery == delivery {
            let same = found.worker == worker;
            return Ok(if same { Begun::Go(found.attempt, false) } else { Begun::Lost });
        }
        if found.delivery > delivery {
            return Ok(Begun::Lost);
        }
        let redelivered = found.delivery > 0;
        let mut attempt = found.attempt;
        if redelivered {
            let silent = "its worker on another machine fell silent";
            lease::lose(&mut transaction, task, &Loss::Lost(silent.into())).await?;
            match take_again(&mut transaction, &found, worker).await? {
                Some(next) => attempt = next,
                None => {
                    // That was one loss too many.
                    transaction.commit().await?;
                    return Ok(Begun::Over);
                }
            }
        } else {
            sql!("UPDATE tasks SET worker = ? WHERE id = ?", [worker, task])
                .execute(&mut *transaction)
                .await?;
            // What came before was waiting.
            sql!(
                "UPDATE attempts SET worker = ?, started_at = ? WHERE task = ? AND attempt = ?",
                [worker, Timestamp::now(), task, attempt]
            )
            .execute(&mut *transaction)
            .await?;
        }
        sql!("UPDATE remote_tasks SET delivery = ? WHERE task = ?", [delivery, task])
            .execute(&mut *transaction)
            .await?;
        transaction.commit().await?;
        Ok(Begun::Go(attempt, redelivered))
    }

    /// Notes what workers on other machines have told, in one transaction, and that they and those that
    /// have nothing to do are alive. Gives the answers of the tiles, in their order.
    pub async fn remote_beats(
        &self,
        beats: &[RemoteBeat],
        workers: &[WorkerId],
    ) -> Result<Vec<Heartbeat>, StoreError> {
        let mut transaction = self.write().await?;
        sql!(
            "UPDATE workers SET seen_at = ? WHERE id IN (SELECT value FROM json_each(?))",
            [Timestamp::now(), list(workers)]
        )
        .execute(&mut *transaction)
        .await?;
        let mut answers = Vec::with_capacity(beats.len());
        for RemoteBeat { task, attempt, worker, pool, progress, history } in beats {
            let row = sql!(
                "UPDATE tasks SET stage = ?, iterations = ?, passes = ?, fraction = ?,
                     history = coalesce(?, history)
                 WHERE id = ? AND attempt = ? AND state = ?
                   -- A worker that began while the server was down is not on record.
                   AND EXISTS (SELECT 1 FROM remote_tasks WHERE task = id AND pool = ?
                                   AND (delivery = 0 OR tasks.worker = ?))
                 RETURNING (SELECT state FROM jobs WHERE id = tasks.job) AS job_state",
                [
                    progress.stage,
                    progress.iterations,
                    progress.passes,
                    progress.fraction.clamp(0.0, 1.0),
                    history,
                    task,
                    attempt,
                    TaskState::Running,
                    pool,
                    worker
                ]
            )
            .fetch_optional(&mut *transaction)
            .await?;
            answers.push(match row {
                None => Heartbeat::Lost,
                Some(row) if is_wanted(row.read("job_state")?) => Heartbeat::Continue,
                Some(_) => Heartbeat::Cancelled,
            });
        }
        transaction.commit().await?;
        Ok(answers)
    }

    /// Takes a tile back that was lost on its way out or back.
    pub async fn remote_lost(&self, remote: &RemoteTask, reason: &str) -> Result<(), StoreError> {
        self.part(&remote.lease(), &Loss::Lost(reason.to_owned())).await
    }

    /// Records that the process of a tile's worker died: of a fault, or killed from outside.
    pub async fn remote_died(
        &self,
        remote: &RemoteTask,
        how: &str,
        fault: bool,
    ) -> Result<(), StoreError> {
        let reason = format!("the worker process died: {how}");
        let loss = if fault { Loss::Crashed(reason) } else { Loss::Lost(reason) };
        self.part(&remote.lease(), &loss).await
    }

    /// For a server without a hub: what an earlier one has handed out can't come back.
    pub async fn disown_remote(&self) -> Result<(), StoreError> {
        for remote in self.remote_tasks().await? {
            self.give_back(&remote.lease()).await?;
        }
        Ok(())
    }

    /// Removes a worker on another machine that has left.
    pub async fn remote_worker_left(&self, id: WorkerId) -> Result<(), StoreError> {
        workers::remove(&mut *self.writer()?.acquire().await?, id).await
    }
}

/// Gives a tile that was lost a moment ago to the worker that has its message now. Gives the number of
/// the attempt; none if the tile is not to be tried again.
async fn take_again(
    connection: &mut SqliteConnection,
    found: &RemoteTask,
    worker: WorkerId,
) -> Result<Option<u32>, StoreError> {
    let attempt: Option<u32> = sql_as!(
        "UPDATE tasks SET state = ?, worker = ?, attempt = attempt + 1, stage = ?, history = NULL
         WHERE id = ? AND state = ? RETURNING attempt",
        [TaskState::Running, worker, TaskStage::Reading, found.task, TaskState::Ready]
    )
    .fetch_optional(&mut *connection)
    .await?;
    let Some(attempt) = attempt else { return Ok(None) };
    sql!(
        "INSERT INTO attempts (task, attempt, worker, started_at) VALUES (?, ?, ?, ?)",
        [found.task, attempt, worker, Timestamp::now()]
    )
    .execute(&mut *connection)
    .await?;
    let place = found.place.as_ref();
    sql!(
        "INSERT INTO remote_tasks (task, pool, attempt, stream, seq) VALUES (?, ?, ?, ?, ?)",
        [
            found.task,
            found.pool.as_str(),
            found.message,
            place.map(|place| place.stream.as_str()),
            place.map(|place| place.seq)
        ]
    )
    .execute(connection)
    .await?;
    Ok(Some(attempt))
}

fn is_wanted(job: Option<JobState>) -> bool {
    matches!(job, Some(JobState::Queued | JobState::Running))
}

/// Identifiers as a JSON array.
fn list(ids: &[impl ToString]) -> String {
    Value::from_iter(ids.iter().map(|id| json!(id.to_string()))).to_string()
}
