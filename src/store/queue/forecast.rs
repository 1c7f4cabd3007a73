//! The order in which waiting jobs are served, and what that means in seconds.

use std::collections::HashMap;
use std::time::Duration;

use sqlx::{AssertSqlSafe, Row};

use crate::job::{JobId, JobState, TaskState};
use crate::store::Store;
use crate::store::error::Result;
use crate::store::rows::sql_as;

/// Workers that were silent for longer do not count.
const WORKER_AGE: Duration = Duration::from_secs(15);

/// What the last tiles took, and what they spent of the plan: they may converge early.
const LAST_TILES: &str = "SELECT sum(seconds) AS seconds, sum(spent) AS spent FROM (
    SELECT seconds, cost * fraction AS spent FROM tasks
    WHERE state = ? AND kind = 'tile' ORDER BY job DESC, ordinal DESC LIMIT 32)";
/// The same of tasks that mostly read and write.
const LAST_OTHERS: &str = "SELECT sum(seconds) AS seconds, sum(cost) AS spent FROM (
    SELECT seconds, cost FROM tasks
    WHERE state = ? AND kind IN ('prepare', 'preview', 'assemble')
    ORDER BY job DESC, ordinal DESC LIMIT 32)";

/// What is ahead of every unfinished job.
#[derive(Debug)]
pub struct Forecast {
    workers: u32,
    /// Seconds that a planned CPU-second of a tile takes.
    rate: f64,
    /// The same of all other tasks: reading and writing are not as fast as computing is.
    others_rate: f64,
    /// The same for jobs with tiles that are done: their tiles converge about as early as each other.
    own_rates: HashMap<JobId, f64>,
    ahead: HashMap<JobId, Ahead>,
}

/// Planned CPU-seconds that are left of some tasks of a job.
#[derive(Debug, Clone, Copy)]
pub struct Left {
    /// Of all of them.
    pub(in crate::store) sum: f64,
    /// Of the one that has most left.
    pub(in crate::store) longest: f64,
}

/// What is served before a job.
#[derive(Debug, Clone, Copy)]
struct Ahead {
    /// Planned CPU-seconds.
    cost: f64,
    /// The job's place among those that wait, from 1; none if it does not wait.
    position: Option<usize>,
}

impl Forecast {
    /// Seconds until a job ends, of whose tiles and other tasks so much is left; none if no worker
    /// lives.
    pub(in crate::store) fn eta_seconds(
        &self,
        job: JobId,
        tiles: Left,
        others: Left,
    ) -> Option<f64> {
        let workers = f64::from(self.workers);
        let ahead = self.ahead.get(&job).map_or(0.0, |ahead| ahead.cost);
        let own = self.own_rates.get(&job).unwrap_or(&self.rate);
        let left = self.rate * ahead + self.others_rate * others.sum + own * tiles.sum;
        let longest = (self.others_rate * others.longest).max(own * tiles.longest);
        let seconds = left / workers + (1.0 - 1.0 / workers) * longest;
        (self.workers > 0).then_some(seconds)
    }

    /// The job's place among those that wait, from 1.
    pub(in crate::store) fn position(&self, job: JobId) -> Option<usize> {
        self.ahead.get(&job)?.position
    }
}

impl Store {
    /// What is ahead of every unfinished job; none if there is no such job.
    pub(in crate::store) async fn forecast(&self) -> Result<Option<Forecast>> {
        // Only states that stand in the text let SQLite see that the index holds all that is asked for.
        let left = [TaskState::Blocked, TaskState::Ready, TaskState::Running]
            .map(|state| state.into_str());
        let query = format!(
            "SELECT job, sum(cost * (1 - fraction)) AS cost,
                 (SELECT state FROM jobs WHERE id = job) AS state
             FROM tasks INDEXED BY tasks_left
             WHERE state IN ('{}') AND job IS NOT NULL
             GROUP BY priority, job ORDER BY priority DESC, job",
            left.join("', '")
        );
        let rows = sqlx::query(AssertSqlSafe(query)).fetch_all(&self.readers).await?;
        if rows.is_empty() {
            return Ok(None);
        }
        let (mut cost, mut waiting, mut ahead) = (0.0, 0, HashMap::with_capacity(rows.len()));
        for row in &rows {
            let waits = row.try_get::<JobState, _>("state")? == JobState::Queued;
            waiting += usize::from(waits);
            ahead.insert(row.try_get("job")?, Ahead { cost, position: waits.then_some(waiting) });
            cost += row.try_get::<f64, _>("cost")?;
        }
        let workers = self.live_workers(WORKER_AGE).await?.len();
        let workers = u32::try_from(workers).unwrap_or(u32::MAX);
        let rate = self.seconds_per_cost(LAST_TILES).await?;
        let others_rate = self.seconds_per_cost(LAST_OTHERS).await?;
        let own_rates = self.own_rates().await?;
        Ok(Some(Forecast { workers, rate, others_rate, own_rates, ahead }))
    }

    /// Seconds that a planned CPU-second of a tile has taken in each job that runs, what converged
    /// early included.
    async fn own_rates(&self) -> Result<HashMap<JobId, f64>> {
        let rates: Vec<(JobId, f64)> = sql_as!(
            "SELECT job, sum(seconds) / sum(cost) FROM tasks
             WHERE job IN (SELECT id FROM jobs WHERE state = ?)
               AND kind = 'tile' AND state = ? AND seconds > 0
             GROUP BY job HAVING sum(cost) > 0",
            [JobState::Running, TaskState::Done]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(rates.into_iter().collect())
    }

    /// Seconds that a planned CPU-second takes on this machine: measured on tasks that are done, by what
    /// they really did and not by what was planned; 1 before there are any.
    async fn seconds_per_cost(&self, of_last_tasks: &'static str) -> Result<f64> {
        let sums: (Option<f64>, Option<f64>) =
            sql_as!(of_last_tasks, [TaskState::Done]).fetch_one(&self.readers).await?;
        Ok(match sums {
            (Some(seconds), Some(spent)) if spent > 0.0 && seconds > 0.0 => seconds / spent,
            _ => 1.0,
        })
    }
}
