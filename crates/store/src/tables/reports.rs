//! Tables `calibration_reports` and `calibration_maps`: reports on masks, and their pictures.

use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::{Json, sql, sql_as};
use crate::error::Result;
use engine::job::{CalibrationId, CalibrationReport, TaskKind};

impl Store {
    /// The report of a calibration; none if it is not made yet.
    pub async fn report(&self, id: CalibrationId) -> Result<Option<CalibrationReport>> {
        let report = sql_as!("SELECT report FROM calibration_reports WHERE calibration = ?", [id]);
        Ok(report.fetch_optional(&self.readers).await?.map(|Json(report)| report))
    }

    /// The reason why the report of a calibration is not made; none unless all attempts have failed.
    pub async fn report_failure(&self, id: CalibrationId) -> Result<Option<String>> {
        let failed = "SELECT coalesce(reason, 'no reason is known') FROM tasks
            JOIN attempts ON task = id AND attempts.attempt = tasks.attempt
            WHERE thing = ? AND kind = ? AND state = 'failed'";
        let kind: &str = TaskKind::Calibration.into_str();
        sql_as!(failed, [id, kind]).fetch_optional(&self.readers).await
    }

    /// A picture of a report, as PNG; none if there is none of this name.
    pub async fn map(&self, id: CalibrationId, name: &str) -> Result<Option<Vec<u8>>> {
        let png = "SELECT png FROM calibration_maps WHERE calibration = ? AND name = ?";
        sql_as!(png, [id, name]).fetch_optional(&self.readers).await
    }
}

/// Writes a report with its pictures, which are PNGs by name.
pub async fn insert(
    connection: &mut SqliteConnection,
    id: CalibrationId,
    report: &CalibrationReport,
    maps: Vec<(String, Vec<u8>)>,
) -> Result<()> {
    sql!(
        "INSERT OR REPLACE INTO calibration_reports (calibration, report) VALUES (?, ?)",
        [id, Json(report)]
    )
    .execute(&mut *connection)
    .await?;
    for (name, png) in maps {
        sql!(
            "INSERT OR REPLACE INTO calibration_maps (calibration, name, png) VALUES (?, ?, ?)",
            [id, name, png]
        )
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}
