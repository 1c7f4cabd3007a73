//! Table `workers`: which worker processes live.

use std::time::Duration;

use serde::Serialize;
use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::{from_row, sql, sql_as};
use crate::error::Result;
use engine::job::{CalibrationId, JobId, Timestamp, WorkerId};

#[derive(Debug, Clone, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Worker")]
pub struct WorkerRow {
    pub id: WorkerId,
    pub pid: u32,
    pub version: String,
    #[serde(flatten)]
    pub place: WorkerPlace,
    pub started_at: Timestamp,
    pub seen_at: Timestamp,
    /// The running task.
    pub task: Option<WorkerTask>,
}

from_row!(WorkerRow, row => {
    id,
    pid,
    version,
    place = WorkerPlace::from_row(row)?,
    started_at,
    seen_at,
    task = match row.read::<Option<String>>("kind")? {
        Some(_) => Some(WorkerTask::from_row(row)?),
        None => None,
    },
});

/// The claimant of a task, which decides what it may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claimant<'a> {
    /// A worker of this machine that does all there is.
    Local,
    /// One that leaves the tiles to other machines.
    WithoutTiles,
    /// One on a GPU, which takes tiles and pilots alone.
    Gpu,
    /// One on the CPU beside those on a GPU, which takes all other tasks.
    Host,
    /// One that takes short tasks alone, so that they wait for no tile. It begins no job: a job would be shown as
    /// running though nobody computes it.
    Light,
    /// The only one that checks networks of users, one after the other. Such a check may hang until its time is over, and
    /// must delay nothing else.
    Networks,
    /// The hub, for this pool of workers on other machines: tiles alone, under a lease that does not
    /// run out.
    Pool(&'a str),
}

/// The machine and device of a worker. Host and pool are empty for a worker of this machine.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, schemars::JsonSchema)]
pub struct WorkerPlace {
    pub host: Option<String>,
    pub pool: Option<String>,
    /// Device of its networks: cpu, gpu or cuda:N.
    pub device: Option<String>,
}

from_row!(WorkerPlace, row => { host, pool, device });

#[derive(Debug, Clone, Serialize, schemars::JsonSchema)]
pub struct WorkerTask {
    /// The job of the task.
    pub job: Option<JobId>,
    /// The calibration of the task.
    pub calibration: Option<CalibrationId>,
    pub kind: String,
    pub snapshot: Option<u32>,
    pub tile: Option<u32>,
    pub stage: Option<String>,
}

from_row!(WorkerTask, row => { job, calibration, kind, snapshot, tile, stage });

impl Store {
    /// Records that a worker has started, which takes the tasks that `claimant` may have. It has the version of this program.
    pub async fn worker_started(
        &self,
        id: WorkerId,
        pid: u32,
        WorkerPlace { host, pool, device }: &WorkerPlace,
        claimant: Claimant<'_>,
    ) -> Result<()> {
        let now = Timestamp::now();
        sql!(
            "INSERT INTO workers (id, pid, version, host, pool, device, started_at, seen_at, light, tiles, others)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
             ON CONFLICT (id) DO UPDATE SET seen_at = excluded.seen_at",
            [
                id,
                pid,
                env!("CARGO_PKG_VERSION"),
                host,
                pool,
                device,
                now,
                now,
                matches!(claimant, Claimant::Light | Claimant::Networks),
                matches!(claimant, Claimant::Local | Claimant::Gpu | Claimant::Pool(_)),
                !matches!(claimant, Claimant::Gpu | Claimant::Pool(_))
            ]
        )
        .execute(self.writer()?)
        .await?;
        Ok(())
    }

    /// Records that a worker lives though it has no task; a heartbeat says the same of one that has.
    pub async fn worker_seen(&self, id: WorkerId) -> Result<()> {
        seen(&mut *self.writer()?.acquire().await?, id).await
    }

    /// The workers that gave a sign of life within `age`, except the light one: it adds nothing to the speed of jobs.
    pub async fn live_workers(&self, age: Duration) -> Result<Vec<WorkerRow>> {
        sql_as!(
            "SELECT workers.id, pid, version, host, pool, device, started_at, seen_at,
                 coalesce(job, (SELECT id FROM jobs WHERE id = thing)) AS job,
                 (SELECT id FROM requests WHERE id = thing AND what = 'calibration') AS calibration,
                 kind, snapshot, tile, stage
             FROM workers LEFT JOIN tasks ON worker = workers.id AND state = 'running'
             WHERE seen_at >= ? AND workers.light = 0 ORDER BY workers.id",
            [since(age)]
        )
        .fetch_all(&self.readers)
        .await
    }

    /// Number of workers that take tiles and gave a sign of life within `age`.
    pub async fn live_tile_workers(&self, age: Duration) -> Result<usize> {
        let live = "SELECT count(*) FROM workers WHERE seen_at >= ? AND tiles = 1";
        sql_as!(live, [since(age)]).fetch_one(&self.readers).await
    }

    /// Number of workers of this machine that compute now or in a moment: those that gave a sign of life within `age`, but
    /// at most as many as there are running tasks and tiles that are ready, and workers for those. Short tasks do not count.
    pub async fn busy_workers(&self, age: Duration) -> Result<usize> {
        let busy = "WITH live AS (SELECT count(*) AS workers, total(tiles) AS for_tiles FROM workers
                                  WHERE seen_at >= ? AND light = 0 AND host IS NULL),
                         running AS (SELECT count(*) AS tasks,
                                         total(kind IN ('tile', 'pilot')) AS tiles FROM tasks
                                     WHERE state = 'running' AND light = 0 AND lease_until IS NOT NULL)
                    SELECT CAST(min(workers, tasks - running.tiles + min(for_tiles, running.tiles
                        + (SELECT count(*) FROM (SELECT 1 FROM tasks INDEXED BY tasks_tiles
                                                 WHERE state = 'ready' AND kind IN ('tile', 'pilot')
                                                 LIMIT (SELECT workers FROM live))))) AS INTEGER)
                    FROM live, running";
        sql_as!(busy, [since(age)]).fetch_one(&self.readers).await
    }

    /// The last sign of life of any worker that takes tiles; none if there was none.
    pub async fn last_tile_worker(&self) -> Result<Option<Timestamp>> {
        let last = "SELECT max(seen_at) FROM (SELECT seen_at FROM workers WHERE tiles = 1
                                              UNION ALL SELECT seen_at FROM tile_workers)";
        sql_as!(last).fetch_one(&self.readers).await
    }

    /// The last sign of life of a worker; `None` if it is unknown.
    pub async fn last_sign(&self, id: WorkerId) -> Result<Option<Timestamp>> {
        let seen = sql_as!("SELECT seen_at FROM workers WHERE id = ?", [id]);
        seen.fetch_optional(&self.readers).await
    }

    /// Forgets the workers that gave no sign of life within `age`: nobody saw their end.
    pub async fn forget_workers(&self, age: Duration) -> Result<()> {
        sql!("DELETE FROM workers WHERE seen_at < ?", [since(age)]).execute(self.writer()?).await?;
        Ok(())
    }
}

pub async fn remove(connection: &mut SqliteConnection, id: WorkerId) -> Result<()> {
    sql!("DELETE FROM workers WHERE id = ?", [id]).execute(connection).await?;
    Ok(())
}

pub async fn seen(connection: &mut SqliteConnection, id: WorkerId) -> Result<()> {
    sql!("UPDATE workers SET seen_at = ? WHERE id = ?", [Timestamp::now(), id])
        .execute(connection)
        .await?;
    Ok(())
}

pub fn since(age: Duration) -> i64 {
    Timestamp::now().0 - i64::try_from(age.as_millis()).unwrap_or(i64::MAX / 2)
}
