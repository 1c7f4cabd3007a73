//! Table `tasks`: cutting a job into tasks, and reading what they made.

use std::path::PathBuf;

use serde_json::{Value, json};
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{JobId, JobSpec, Sha256, TaskId, TaskKind};
use crate::recon::{pilot, preview};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{json as from_json, number, number_if, parsed};

/// The stored result of a tile.
#[derive(Debug, Clone)]
pub struct TileResult {
    /// The tile's index in the plan.
    pub tile: u32,
    /// Where its file lies.
    pub path: PathBuf,
    /// The hash that the file should have.
    pub sha256: Sha256,
    /// What the worker told about it.
    pub record: Value,
}

/// What is known of a task that is done.
#[derive(Debug, Clone)]
pub struct TaskRecord {
    /// What it was.
    pub kind: TaskKind,
    /// What the worker told about it.
    pub record: Value,
    /// Seconds of the successful attempt.
    pub seconds: f64,
    /// The number of the successful attempt, from 1.
    pub attempt: u32,
}

/// CPU-seconds for each voxel that is read, or blended and written in all formats (measured).
const READ_S: f64 = 12e-9;
const WRITE_S: f64 = 110e-9;
/// The same of a preview by blocks, and of one that is done whole (measured).
const PREVIEW_BLOCKS_S: f64 = 10e-9;
const PREVIEW_WHOLE_S: f64 = 120e-9;

/// Writes the tasks of a job.
pub(in crate::store) async fn insert(
    connection: &mut SqliteConnection,
    job: JobId,
    spec: &JobSpec,
) -> Result<(), StoreError> {
    // One statement for all: tens of thousands of single ones would hold the lock for seconds.
    let rows: Vec<Value> = plan(spec)?
        .into_iter()
        .enumerate()
        .map(|(ordinal, (kind, cost))| {
            let id = TaskId::new().to_string();
            json!([id, ordinal, kind.name(), kind.snapshot(), kind.tile(), cost])
        })
        .collect();
    sqlx::query(
        "INSERT INTO tasks (id, job, ordinal, kind, snapshot, tile, state, priority, cost)
         SELECT value ->> 0, ?1, value ->> 1, value ->> 2, value ->> 3, value ->> 4,
                CASE value ->> 2 WHEN 'prepare' THEN 'ready' ELSE 'blocked' END, ?2, value ->> 5
         FROM json_each(?3)",
    )
    .bind(job.to_string())
    .bind(spec.priority)
    .bind(Value::from(rows).to_string())
    .execute(connection)
    .await?;
    Ok(())
}

/// The tasks of a job with their planned CPU-seconds, in the order in which they are handed out.
#[allow(clippy::cast_precision_loss)] // counts far below 2^53
fn plan(spec: &JobSpec) -> Result<Vec<(TaskKind, f64)>, StoreError> {
    let tiles = spec
        .tile_plan()
        .map_err(|error| StoreError::Corrupt { column: "spec", value: error.to_string() })?;
    let pixels = (spec.shape.height * spec.shape.width) as f64;
    let frames = spec.shape.frames as f64;
    let per_voxel = spec.planned_ns_per_voxel() * 1e-9;
    let mut tasks = vec![(TaskKind::Prepare, pixels * (frames + 1.0) * READ_S)];
    let whole = preview::block(spec.shape.frames, spec.shape.height, spec.shape.width) == 1;
    let preview = pixels * frames * if whole { PREVIEW_WHOLE_S } else { PREVIEW_BLOCKS_S };
    tasks.extend(spec.snapshots.indices().map(|s| (TaskKind::Preview { snapshot: s }, preview)));
    if spec.schedule.adaptive {
        let voxels = pixels.min((pilot::SIDE * pilot::SIDE) as f64) * frames;
        // The preview of the first snapshot is there at once; the others may wait.
        tasks.insert(2, (TaskKind::Pilot, voxels * per_voxel));
    }
    for snapshot in spec.snapshots.indices() {
        let mut areas: Vec<_> = (0..).zip(tiles.tiles()).collect();
        areas.sort_by(|(a, _), (b, _)| place(*a).total_cmp(&place(*b)));
        for (tile, area) in areas {
            let voxels = (area.height * area.width) as f64 * frames;
            tasks.push((TaskKind::Tile { snapshot, tile }, voxels * per_voxel));
        }
        tasks.push((TaskKind::Assemble { snapshot }, pixels * frames * WRITE_S));
    }
    tasks.push((TaskKind::Manifest, 0.01));
    Ok(tasks)
}

/// The place of a tile in the order of work. Multiples of the golden ratio go all over the picture: it
/// gets sharper everywhere, and the first tiles tell what the others may take.
fn place(tile: u32) -> f64 {
    (f64::from(tile) * 0.618_033_988_75).fract()
}

/// Sets the planned cost of the tiles of a job to a share of it.
pub(in crate::store) async fn scale_tiles(
    connection: &mut SqliteConnection,
    job: JobId,
    share: f64,
) -> Result<(), StoreError> {
    sqlx::query("UPDATE tasks SET cost = cost * ? WHERE job = ? AND kind = 'tile'")
        .bind(share)
        .bind(job.to_string())
        .execute(connection)
        .await?;
    Ok(())
}

/// Makes ready the tasks of a job that waited for `done`, if that was the last one they waited for.
pub(in crate::store) async fn unblock(
    connection: &mut SqliteConnection,
    job: JobId,
    done: TaskKind,
) -> Result<(), StoreError> {
    let query = match done {
        TaskKind::Prepare => sqlx::query(
            "UPDATE tasks SET state = 'ready'
             WHERE job = ?1 AND state = 'blocked'
               AND (kind IN ('preview', 'pilot')
                    OR kind = 'tile' AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1
                                                         AND kind = 'pilot' AND state <> 'done'))",
        ),
        TaskKind::Pilot => sqlx::query(
            "UPDATE tasks SET state = 'ready' WHERE job = ?1 AND kind = 'tile' AND state = 'blocked'",
        ),
        TaskKind::Tile { .. } => sqlx::query(
            "UPDATE tasks SET state = 'ready'
             WHERE job = ?1 AND kind = 'assemble' AND snapshot = ?2 AND state = 'blocked'
               AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1 AND kind = 'tile'
                                   AND snapshot = ?2 AND state <> 'done')",
        ),
        TaskKind::Assemble { .. } | TaskKind::Preview { .. } => sqlx::query(
            "UPDATE tasks SET state = 'ready'
             WHERE job = ?1 AND kind = 'manifest' AND state = 'blocked'
               AND NOT EXISTS (SELECT 1 FROM tasks WHERE job = ?1
                                   AND kind IN ('preview', 'assemble') AND state <> 'done')",
        ),
        TaskKind::Manifest => return Ok(()),
    };
    query.bind(job.to_string()).bind(done.snapshot()).execute(connection).await?;
    Ok(())
}

impl Store {
    /// The stored preview of a snapshot, while there is one: a prepared array of coarse frames.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn preview(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Option<(Sha256, PathBuf)>, StoreError> {
        let row = sqlx::query(
            "SELECT result FROM tasks
             WHERE job = ? AND kind = 'preview' AND snapshot = ? AND result IS NOT NULL",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .fetch_optional(&self.readers)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let sha256 = parsed(&row, "result")?;
        Ok(Some((sha256, self.dir().blob(&sha256))))
    }

    /// The stored tiles of a snapshot, in the order of the plan. The job's assembly has the right to
    /// count on all of them being there.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn tile_results(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Vec<TileResult>, StoreError> {
        let rows = sqlx::query(
            "SELECT tile, result, record FROM tasks
             WHERE job = ? AND kind = 'tile' AND snapshot = ? AND state = 'done' ORDER BY tile",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            let sha256 = parsed(row, "result")?;
            Ok(TileResult {
                tile: number(row, "tile")?,
                path: self.dir().blob(&sha256),
                sha256,
                record: from_json(row, "record")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// What is known of all tasks of a job that are done, in order.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn task_records(&self, job: JobId) -> Result<Vec<TaskRecord>, StoreError> {
        let rows = sqlx::query(
            "SELECT kind, snapshot, tile, record, seconds, attempt FROM tasks
             WHERE job = ? AND state = 'done' ORDER BY ordinal",
        )
        .bind(job.to_string())
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            Ok(TaskRecord {
                kind: kind(row)?,
                record: from_json(row, "record")?,
                seconds: row.try_get::<Option<f64>, _>("seconds")?.unwrap_or(0.0),
                attempt: number(row, "attempt")?,
            })
        };
        rows.iter().map(read).collect()
    }
}

/// The kind of the task in this row.
pub(in crate::store) fn kind(row: &SqliteRow) -> Result<TaskKind, StoreError> {
    let name: String = row.try_get("kind")?;
    TaskKind::from_parts(&name, number_if(row, "snapshot")?, number_if(row, "tile")?)
        .ok_or(StoreError::Corrupt { column: "kind", value: name })
}
