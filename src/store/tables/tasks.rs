//! Tiles of a job as they are worked on: their states and how the solver went.

use serde::Serialize;
use serde_json::Value;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use crate::job::JobId;
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{json, number};

/// Where a tile stands.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileState {
    /// Its index in the plan.
    pub tile: u32,
    /// State of its task.
    pub state: String,
    /// What its worker is doing.
    pub stage: Option<String>,
    /// Iterations of the attempt that runs or ran last.
    pub iterations: u32,
    /// Deep passes of that attempt.
    pub passes: u32,
    /// The share of the planned cost that is behind it.
    pub fraction: f64,
    /// How often workers took it up.
    pub attempts: u32,
    /// `||y - H v|| / ||y||` of a tile that is done.
    pub residual: Option<f64>,
}

/// How the solver went on a tile.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileHistory {
    /// The tile's index in the plan.
    pub tile: u32,
    /// State of its task.
    pub state: String,
    /// \[iteration, residual, change, sigma or null\], by iteration; many iterations are thinned out.
    pub points: Vec<Value>,
}

impl Store {
    /// The tiles of a snapshot, in the order of the plan.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn tile_states(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Vec<TileState>, StoreError> {
        let rows = sqlx::query(
            "SELECT tile, state, stage, iterations, passes, fraction, attempt,
                 CASE state WHEN 'done' THEN record ->> 'residual' END AS residual
             FROM tasks WHERE job = ? AND kind = 'tile' AND snapshot = ? ORDER BY tile",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .fetch_all(&self.readers)
        .await?;
        rows.iter().map(state).collect()
    }

    /// How the solver went on a tile; none if there is no such tile.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn tile_history(
        &self,
        job: JobId,
        snapshot: u32,
        tile: u32,
    ) -> Result<Option<TileHistory>, StoreError> {
        let row = sqlx::query(
            "SELECT tile, state, coalesce(history, '[]') AS history
             FROM tasks WHERE job = ? AND kind = 'tile' AND snapshot = ? AND tile = ?",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .bind(tile)
        .fetch_optional(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            let (tile, state) = (number(row, "tile")?, row.try_get("state")?);
            Ok(TileHistory { tile, state, points: json(row, "history")? })
        };
        row.as_ref().map(read).transpose()
    }
}

fn state(row: &SqliteRow) -> Result<TileState, StoreError> {
    Ok(TileState {
        tile: number(row, "tile")?,
        state: row.try_get("state")?,
        stage: row.try_get("stage")?,
        iterations: number(row, "iterations")?,
        passes: number(row, "passes")?,
        fraction: row.try_get("fraction")?,
        attempts: number(row, "attempt")?,
        residual: row.try_get("residual")?,
    })
}
