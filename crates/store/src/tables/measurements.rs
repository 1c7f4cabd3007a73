//! Table `measurements`.

use serde::Serialize;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, listed, refuse_if_used};
use crate::tables::checks;
use engine::job::{
    CalibrationId, Finding, Lab, Label, MeasurementId, Sequence, Sha256, Timestamp, TokenId,
};

/// What is known of a measurement when it has been checked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NewMeasurement {
    pub name: Option<Label>,
    pub calibration: CalibrationId,
    pub data: Sha256,
    pub format: String,
    pub sample: String,
    /// How the axes of the array were read; none for pictures.
    pub axes: Option<String>,
    pub snapshots: u32,
    pub height: usize,
    pub width: usize,
    /// The stored number that means 1, where the scene's sum of frames is up to B.
    pub full_scale: f32,
    /// Snapshots that the camera takes in a second.
    pub camera_fps: Option<f64>,
    /// Exposure of one snapshot in seconds.
    pub exposure_s: Option<f64>,
    /// Whether the snapshots follow one another without a gap.
    pub sequence: Sequence,
    /// The uploads whose average was subtracted.
    pub dark: Vec<Sha256>,
    /// What the check against the calibration found.
    pub warnings: Vec<Finding>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measurement {
    pub id: MeasurementId,
    /// Hash of the prepared snapshots: a planar file of f32 [S, H, W], full scale divided out.
    #[serde(skip)]
    pub prepared: Sha256,
    pub created_at: Timestamp,
    #[serde(flatten)]
    pub facts: NewMeasurement,
}

impl Store {
    /// The lab's measurement with this identifier.
    /// Errors: [`StoreError::Unchecked`] if it has not passed its check.
    pub async fn measurement(&self, lab: &Lab, id: MeasurementId) -> Result<Measurement> {
        match self.find_measurement(Some(lab), id).await {
            Err(missing @ StoreError::NotFound { .. }) => {
                match self.measurement_check(lab, id).await? {
                    Some(check) => Err(StoreError::Unchecked { id, error: check.error()? }),
                    // It may have passed between the two looks.
                    None => self.find_measurement(Some(lab), id).await.map_err(|_| missing),
                }
            }
            found => found,
        }
    }

    /// As [`Self::measurement`]; without a lab, for those who work for all of them.
    pub(crate) async fn find_measurement(
        &self,
        lab: Option<&Lab>,
        id: MeasurementId,
    ) -> Result<Measurement> {
        let row = sql!(
            "SELECT * FROM measurements WHERE id = ?1 AND (?2 IS NULL OR lab = ?2)",
            [id, lab]
        )
        .fetch_optional(&self.readers)
        .await?;
        measurement(&row.ok_or_else(|| StoreError::missing("measurement", id))?)
    }

    pub async fn measurements(
        &self,
        lab: &Lab,
        filter: Filter<MeasurementId>,
        limit: u32,
    ) -> Result<Page<Measurement>> {
        let rows =
            listed!(sql, "measurements WHERE", lab, filter, limit).fetch_all(&self.readers).await?;
        Ok(Page::cut(rows.iter().map(measurement).collect::<Result<_, _>>()?, limit))
    }

    /// Gives a measurement another name, or none.
    pub async fn rename_measurement(
        &self,
        lab: &Lab,
        id: MeasurementId,
        name: Option<&Label>,
    ) -> Result<()> {
        let mut transaction = self.write().await?;
        let renamed =
            sql!("UPDATE measurements SET name = ? WHERE id = ? AND lab = ?", [name, id, lab])
                .execute(&mut *transaction)
                .await?;
        if renamed.rows_affected() == 0
            && !checks::rename(&mut transaction, (lab, id), name).await?
        {
            return Err(StoreError::missing("measurement", id));
        }
        Ok(transaction.commit().await?)
    }

    /// Deletes a measurement that no job refers to.
    pub async fn delete_measurement(&self, lab: &Lab, id: MeasurementId) -> Result<()> {
        let mut transaction = self.write().await?;
        if checks::delete_of(&mut transaction, lab, id).await? {
            return Ok(transaction.commit().await?);
        }
        let own = "SELECT 1 FROM measurements WHERE id = ? AND lab = ?";
        let own = sql!(own, [id, lab]).fetch_optional(&mut *transaction).await?;
        own.ok_or_else(|| StoreError::missing("measurement", id))?;
        let jobs = "SELECT count(*) AS users FROM jobs WHERE measurement = ?";
        refuse_if_used(&mut transaction, ("measurement", id.to_string()), ("jobs", jobs)).await?;
        let prepared = sql_as!("DELETE FROM measurements WHERE id = ? RETURNING prepared", [id]);
        let prepared = prepared.fetch_optional(&mut *transaction).await?;
        let prepared = prepared.ok_or_else(|| StoreError::missing("measurement", id))?;
        self.release(&mut transaction, prepared).await?;
        transaction.commit().await?;
        Ok(())
    }
}

pub async fn insert(
    connection: &mut SqliteConnection,
    (lab, token): (&Lab, Option<TokenId>),
    measurement: &Measurement,
) -> Result<()> {
    let facts = &measurement.facts;
    sql!(
        "INSERT INTO measurements (lab, token, id, name, calibration, data, prepared, format, sample, axes,
             snapshots, height, width, full_scale, camera_fps, exposure_s, dark, warnings,
             created_at, sequence)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            lab,
            token,
            measurement.id,
            &facts.name,
            facts.calibration,
            facts.data,
            measurement.prepared,
            &facts.format,
            &facts.sample,
            &facts.axes,
            facts.snapshots,
            facts.height,
            facts.width,
            facts.full_scale,
            facts.camera_fps,
            facts.exposure_s,
            Json(&facts.dark),
            Json(&facts.warnings),
            measurement.created_at,
            facts.sequence
        ]
    )
    .execute(connection)
    .await?;
    Ok(())
}

fn measurement(row: &SqliteRow) -> Result<Measurement> {
    Ok(Measurement {
        id: row.read("id")?,
        prepared: row.read("prepared")?,
        created_at: row.read("created_at")?,
        facts: NewMeasurement {
            name: row.read("name")?,
            calibration: row.read("calibration")?,
            data: row.read("data")?,
            format: row.read("format")?,
            sample: row.read("sample")?,
            axes: row.read("axes")?,
            snapshots: row.read("snapshots")?,
            height: row.read("height")?,
            width: row.read("width")?,
            full_scale: row.read("full_scale")?,
            camera_fps: row.read("camera_fps")?,
            exposure_s: row.read("exposure_s")?,
            sequence: row.read("sequence")?,
            dark: row.read_json("dark")?.unwrap_or_default(),
            warnings: row.read_json("warnings")?.unwrap_or_default(),
        },
    })
}
