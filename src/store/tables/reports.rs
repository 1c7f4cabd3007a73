//! Tables `calibration_reports` and `calibration_maps`: what is told of masks, and its pictures.

use sqlx::{Row, SqliteConnection};

use crate::job::{CalibrationId, CalibrationReport};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{json, to_json};

impl Store {
    /// The report of a calibration; none if it is not made yet.
    pub async fn report(&self, id: CalibrationId) -> Result<Option<CalibrationReport>, StoreError> {
        let row = sqlx::query("SELECT report FROM calibration_reports WHERE calibration = ?")
            .bind(id.to_string())
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(|row| json(row, "report")).transpose()
    }

    /// A picture of a report, as PNG; none if there is none of this name.
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

/// Writes a report with its pictures, which are PNGs by name.
pub(in crate::store) async fn insert(
    connection: &mut SqliteConnection,
    id: CalibrationId,
    report: &CalibrationReport,
    maps: Vec<(String, Vec<u8>)>,
) -> Result<(), StoreError> {
    sqlx::query("INSERT OR REPLACE INTO calibration_reports (calibration, report) VALUES (?, ?)")
        .bind(id.to_string())
        .bind(to_json("report", report)?)
        .execute(&mut *connection)
        .await?;
    for (name, png) in maps {
        sqlx::query(
            "INSERT OR REPLACE INTO calibration_maps (calibration, name, png) VALUES (?, ?, ?)",
        )
        .bind(id.to_string())
        .bind(name)
        .bind(png)
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}
