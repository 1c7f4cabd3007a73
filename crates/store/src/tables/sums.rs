//! Table `job_sums`: sums over the tasks of each job, recounted whenever one of them ends.

use sqlx::SqliteConnection;

use crate::columns::sql;
use crate::error::Result;
use engine::job::{JobId, TaskState};

pub async fn recount(connection: &mut SqliteConnection, job: JobId) -> Result<()> {
    sql!(
        "INSERT OR REPLACE INTO job_sums (job, cost, tiles_left, tiles_longest, others_left,
             others_longest, tiles_total, tiles_done, tile_seconds, tile_cost, prepared,
             previews_done, snapshots_done, iterations, passes)
         SELECT ?1, sum(cost),
             sum(iif(is_solved, left, 0.0)), max(iif(is_solved, left, 0.0)),
             sum(iif(is_solved, 0.0, left)), max(iif(is_solved, 0.0, left)),
             sum(is_tile), sum(is_tile AND is_done),
             sum(iif(is_tile AND is_done, coalesce(seconds, 0.0), 0.0)),
             sum(iif(is_tile AND is_done, cost, 0.0)),
             sum(kind = 'prepare' AND is_done), sum(kind = 'preview' AND result IS NOT NULL),
             sum(kind = 'assemble' AND is_done),
             sum(iif(is_done, iterations, 0)), sum(iif(is_done, passes, 0))
         FROM (SELECT kind, cost, seconds, iterations, passes, result, kind = 'tile' AS is_tile,
                   kind IN ('tile', 'pilot') AS is_solved, state = ?2 AS is_done, iif(state = ?2, 0.0, cost) AS left
               FROM tasks WHERE job = ?1)
         HAVING count(*) > 0",
        [job, TaskState::Done]
    )
    .execute(connection)
    .await?;
    Ok(())
}
