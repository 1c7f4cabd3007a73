//! Calibrations as users see them while their masks are made, and the reports and pictures of those whose
//! are.

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::calibrations::label;
use crate::job::{CalibrationId, CalibrationReport, Captures, Lab, Label, Timestamp};
use crate::store::error::StoreError;
use crate::store::rows::{json, parsed};
use crate::store::{Page, Store};

/// A calibration whose masks are not there.
#[derive(Debug, Clone)]
pub struct Unready {
    /// Its identifier.
    pub id: CalibrationId,
    /// The user's name for it.
    pub name: Option<Label>,
    /// Its patterns.
    pub frames: usize,
    /// How much of the work is done, on \[0,1\].
    pub fraction: f64,
    /// Why there will be no masks; none while they are made.
    pub error: Option<String>,
    /// When it was asked for.
    pub created_at: Timestamp,
}

impl Store {
    /// The lab's calibration if its masks are not there; none if they are.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if there is no such calibration at all.
    pub async fn unready(
        &self,
        lab: &Lab,
        id: CalibrationId,
    ) -> Result<Option<Unready>, StoreError> {
        let row = sqlx::query("SELECT * FROM calibration_tasks WHERE calibration = ? AND lab = ?")
            .bind(id.to_string())
            .bind(lab.as_str())
            .fetch_optional(&self.readers)
            .await?;
        let row =
            row.ok_or_else(|| StoreError::NotFound { what: "calibration", id: id.to_string() })?;
        let state: String = row.try_get("state")?;
        let captures: Option<String> = row.try_get("captures")?;
        if captures.is_none() || state == "done" { Ok(None) } else { unready(&row).map(Some) }
    }

    /// A page of the lab's calibrations whose masks are not there, newest first, older than `after`.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn all_unready(
        &self,
        lab: &Lab,
        after: Option<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Unready>, StoreError> {
        let rows = sqlx::query(
            "SELECT * FROM calibration_tasks
             WHERE lab = ?1 AND captures IS NOT NULL AND state <> 'done'
               AND (?2 IS NULL OR calibration < ?2)
             ORDER BY calibration DESC LIMIT ?3",
        )
        .bind(lab.as_str())
        .bind(after.map(|id| id.to_string()))
        .bind(i64::from(limit) + 1)
        .fetch_all(&self.readers)
        .await?;
        Page::cut(&rows, limit, unready)
    }

    /// The report of a calibration; none if it is not made yet.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn report(&self, id: CalibrationId) -> Result<Option<CalibrationReport>, StoreError> {
        let row = sqlx::query("SELECT report FROM calibration_reports WHERE calibration = ?")
            .bind(id.to_string())
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(|row| json(row, "report")).transpose()
    }

    /// A picture of a report, as PNG; none if there is none of this name.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn map(&self, id: CalibrationId, name: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let row =
            sqlx::query("SELECT png FROM calibration_maps WHERE calibration = ? AND name = ?")
                .bind(id.to_string())
                .bind(name)
                .fetch_optional(&self.readers)
                .await?;
        Ok(row.as_ref().map(|row| row.try_get("png")).transpose()?)
    }
}

fn unready(row: &SqliteRow) -> Result<Unready, StoreError> {
    let captures: Captures = json(row, "captures")?;
    let state: String = row.try_get("state")?;
    let error: Option<String> = row.try_get("error")?;
    Ok(Unready {
        id: parsed(row, "calibration")?,
        name: label(row, "name")?,
        frames: captures.masks.len(),
        fraction: row.try_get("fraction")?,
        error: if state == "failed" { error } else { None },
        created_at: Timestamp(row.try_get("created_at")?),
    })
}
