//! How tasks wait for each other: cutting a job into tasks, and making ready what waited.

use serde_json::{Value, json};
use sqlx::SqliteConnection;

use crate::columns::sql;
use crate::error::{Result, StoreError};
use crate::tables::{labs, results, sums, tasks};
use engine::job::{JobId, JobSpec, Lab, ResourceId, RunSpec, TaskId, TaskKind, TaskState};

/// The priority of most jobs. Checks, calibrations and movies take the turns of their lab, and precede its jobs, which take
/// longer.
const THING_PRIORITY: i32 = 0;

pub async fn insert(
    connection: &mut SqliteConnection,
    lab: &Lab,
    job: JobId,
    spec: &JobSpec,
) -> Result<()> {
    let tasks = spec
        .tasks()
        .map_err(|error| StoreError::Corrupt { column: "spec", value: error.to_string() })?;
    // One statement for all: tens of thousands of single ones would hold the lock for seconds.
    let rows: Vec<Value> = tasks
        .into_iter()
        .enumerate()
        .map(|(ordinal, (kind, cost))| {
            let id = TaskId::new().to_string();
            let state = first_state(kind).into_str();
            json!([
                id,
                ordinal,
                kind.into_str(),
                kind.snapshot(),
                kind.tile(),
                state,
                cost,
                kind.snapshots(),
                u8::from(kind.is_light(cost))
            ])
        })
        .collect();
    sql!(
        "INSERT INTO tasks (id, job, lab, ordinal, kind, snapshot, tile, state, priority, cost,
             snapshots, light)
         SELECT value ->> 0, ?1, ?4, value ->> 1, value ->> 2, value ->> 3, value ->> 4, value ->> 5,
             ?2, value ->> 6, value ->> 7, value ->> 8
         FROM json_each(?3)",
        [job, spec.priority, Value::from(rows).to_string(), lab]
    )
    .execute(&mut *connection)
    .await?;
    labs::know(connection, lab).await?;
    sums::recount(connection, job).await
}

/// Writes a task that makes a resource, or something of it, with its planned CPU-seconds.
pub async fn insert_for(
    connection: &mut SqliteConnection,
    lab: &Lab,
    resource: ResourceId,
    kind: TaskKind,
    cost: f64,
) -> Result<()> {
    // The ordinal is the order of the tasks of one resource.
    let ordinal = i32::from(kind != TaskKind::Check);
    sql!(
        "INSERT INTO tasks (id, thing, lab, ordinal, kind, light, snapshot, state, priority, cost)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            TaskId::new(),
            resource,
            lab,
            ordinal,
            kind.into_str(),
            kind.is_light(cost),
            kind.snapshot(),
            first_state(kind),
            THING_PRIORITY,
            cost
        ]
    )
    .execute(&mut *connection)
    .await?;
    labs::know(connection, lab).await
}

/// The state of a task that waits for its turn alone, or for others.
fn first_state(kind: TaskKind) -> TaskState {
    match kind {
        TaskKind::Prepare
        | TaskKind::Check
        | TaskKind::Calibration
        | TaskKind::Movie { .. }
        | TaskKind::Gif { .. } => TaskState::Ready,
        TaskKind::Preview { .. }
        | TaskKind::Pilot
        | TaskKind::Tile { .. }
        | TaskKind::White
        | TaskKind::Assemble { .. }
        | TaskKind::Manifest => TaskState::Blocked,
    }
}

/// Sets the planned cost of the tiles of a job to a share of it.
pub(super) async fn scale_tiles(
    connection: &mut SqliteConnection,
    job: JobId,
    share: f64,
) -> Result<()> {
    sql!("UPDATE tasks SET cost = cost * ? WHERE job = ? AND kind = 'tile'", [share, job])
        .execute(connection)
        .await?;
    Ok(())
}

/// Makes ready the tasks of a job that waited for `done`, if that was the last one they waited for.
pub(super) async fn unblock(
    connection: &mut SqliteConnection,
    job: JobId,
    done: TaskKind,
) -> Result<()> {
    // ?1 job, ?2 snapshot, ?3 to ?5 states: blocked, ready, done; ?6 snapshots, ?7 the longest run.
    let query = match done {
        TaskKind::Prepare => {
            "UPDATE tasks SET state = ?4
             WHERE job = ?1 AND state = ?3
               AND (kind IN ('preview', 'pilot')
                    OR kind = 'tile' AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1
                                                         AND kind = 'pilot' AND state <> ?5))"
        }
        TaskKind::Pilot => {
            "UPDATE tasks SET state = ?4 WHERE job = ?1 AND kind = 'tile' AND state = ?3"
        }
        TaskKind::Tile { .. } | TaskKind::White => {
            // The white level waits for all tiles, a snapshot for the white level and the tiles of all runs that
            // contain it.
            "UPDATE tasks AS waits SET state = ?4
             WHERE job = ?1 AND state = ?3
               AND (kind = 'white' AND NOT EXISTS (SELECT 1 FROM tasks
                                                   WHERE job = ?1 AND kind = 'tile' AND state <> ?5)
                 OR kind = 'assemble' AND (?2 IS NULL OR snapshot BETWEEN ?2 AND ?2 + ?6 - 1)
               AND EXISTS (SELECT 1 FROM tasks WHERE job = ?1 AND kind = 'white' AND state = ?5)
               AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1 AND kind = 'tile'
                                   AND snapshot BETWEEN waits.snapshot - ?7 + 1 AND waits.snapshot
                                   AND waits.snapshot < snapshot + snapshots AND state <> ?5))"
        }
        TaskKind::Assemble { .. } | TaskKind::Preview { .. } => {
            "UPDATE tasks SET state = ?4
             WHERE job = ?1 AND kind = 'manifest' AND state = ?3
               AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1
                                   AND kind IN ('preview', 'assemble') AND state <> ?5)"
        }
        TaskKind::Manifest
        | TaskKind::Check
        | TaskKind::Calibration
        | TaskKind::Movie { .. }
        | TaskKind::Gif { .. } => return Ok(()),
    };
    sql!(
        query,
        [
            job,
            done.snapshot(),
            TaskState::Blocked,
            TaskState::Ready,
            TaskState::Done,
            done.snapshots(),
            RunSpec::LONGEST
        ]
    )
    .execute(connection)
    .await?;
    Ok(())
}

/// Drops the results of these snapshots, which are damaged, so that [`restart`] makes them again: the tiles that are no
/// longer stored, the assembly, and the manifest of the job.
pub(super) async fn undo(
    connection: &mut SqliteConnection,
    job: JobId,
    snapshots: &[i64],
) -> Result<()> {
    if snapshots.is_empty() {
        return Ok(());
    }
    for snapshot in snapshots {
        sql!(
            "UPDATE tasks SET state = ? WHERE job = ? AND snapshot = ?
                 AND (kind = 'assemble' OR kind = 'tile' AND result IS NULL)",
            [TaskState::Cancelled, job, snapshot]
        )
        .execute(&mut *connection)
        .await?;
        sql!("DELETE FROM result_files WHERE job = ? AND snapshot = ?", [job, snapshot])
            .execute(&mut *connection)
            .await?;
    }
    sql!("DELETE FROM result_files WHERE job = ? AND snapshot = ?", [job, results::WHOLE_JOB])
        .execute(&mut *connection)
        .await?;
    sql!(
        "UPDATE tasks SET state = ? WHERE job = ? AND kind = 'manifest'",
        [TaskState::Cancelled, job]
    )
    .execute(connection)
    .await?;
    Ok(())
}

/// Has the tasks of a job that were given up or cancelled wait again, as at its start. Completed tasks stay completed.
pub(super) async fn restart(connection: &mut SqliteConnection, job: JobId) -> Result<()> {
    sql!(
        "UPDATE tasks SET failures = 0, losses = 0, starved = 0, ready_at = 0,
             state = CASE kind WHEN 'prepare' THEN ?2 ELSE ?3 END
         WHERE job = ?1 AND state IN (?4, ?5)",
        [job, TaskState::Ready, TaskState::Blocked, TaskState::Failed, TaskState::Cancelled]
    )
    .execute(&mut *connection)
    .await?;
    let done = sql!(
        "SELECT kind, snapshot, snapshots, min(tile) AS tile FROM tasks
         WHERE job = ? AND state = ? GROUP BY kind, snapshot",
        [job, TaskState::Done]
    )
    .fetch_all(&mut *connection)
    .await?;
    for row in &done {
        unblock(connection, job, tasks::kind(row)?).await?;
    }
    Ok(())
}

/// Cancels the tasks of a job that no worker has.
pub(super) async fn cancel_waiting(connection: &mut SqliteConnection, job: JobId) -> Result<()> {
    sql!(
        "UPDATE tasks SET state = ? WHERE job = ? AND state IN (?, ?)",
        [TaskState::Cancelled, job, TaskState::Blocked, TaskState::Ready]
    )
    .execute(connection)
    .await?;
    Ok(())
}
