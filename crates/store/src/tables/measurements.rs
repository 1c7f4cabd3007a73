//! Table `measurements`.

use serde::Serialize;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, refuse_if_used};
use crate::tables::keys::Made;
use crate::tables::requests::{self, Asked};
use engine::job::{
    CalibrationId, Finding, Lab, Label, MeasurementId, Sequence, Sha256, Timestamp, TokenId,
};

/// Facts of a measurement that has passed its check.
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
    /// `contiguous` if the snapshots follow each other without a gap.
    pub sequence: Sequence,
    /// The uploads whose average was subtracted.
    pub dark: Vec<Sha256>,
    /// Findings of the check against the calibration.
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
        match self.asked_measurement(lab, id).await? {
            Asked::Ready(measurement) => Ok(measurement),
            Asked::Pending(request) => {
                let error = request.refusal.map(|refusal| refusal.detail);
                Err(StoreError::Unchecked { id, error })
            }
        }
    }

    /// The lab's measurement with this identifier, ready or pending.
    pub async fn asked_measurement(
        &self,
        lab: &Lab,
        id: MeasurementId,
    ) -> Result<Asked<Measurement>> {
        // In this order: it may become ready between the two looks.
        let request = self.find_request(lab, id).await?;
        match self.find_measurement(Some(lab), id).await {
            Err(missing @ StoreError::NotFound { .. }) => match request {
                Some(request) => Ok(Asked::Pending(Box::new(request))),
                None => Err(missing),
            },
            found => Ok(Asked::Ready(found?)),
        }
    }

    /// As [`Self::measurement`]; without a lab, for workers, which serve all labs.
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

    /// A page of the lab's measurements, newest first.
    pub async fn measurements(
        &self,
        lab: &Lab,
        filter: Filter<MeasurementId>,
        limit: u32,
    ) -> Result<Page<Asked<Measurement>>> {
        let facts = "SELECT * FROM measurements WHERE id IN (SELECT value FROM json_each(?))";
        let read = |row: &SqliteRow| {
            let measurement = measurement(row)?;
            Ok((measurement.id.into(), measurement))
        };
        self.asked((lab, Made::Measurement), filter.untyped(), limit, facts, read).await
    }

    /// Gives a measurement another name, or none.
    pub async fn rename_measurement(
        &self,
        lab: &Lab,
        id: MeasurementId,
        name: Option<&Label>,
    ) -> Result<()> {
        let mut transaction = self.write().await?;
        requests::rename(&mut transaction, (lab, Made::Measurement, id.into()), name).await?;
        sql!("UPDATE measurements SET name = ? WHERE id = ?", [name, id])
            .execute(&mut *transaction)
            .await?;
        Ok(transaction.commit().await?)
    }

    /// Deletes a measurement that no job refers to.
    pub async fn delete_measurement(&self, lab: &Lab, id: MeasurementId) -> Result<()> {
        let mut transaction = self.write().await?;
        requests::delete(&mut transaction, (lab, Made::Measurement, id.into())).await?;
        let jobs = "SELECT count(*) AS users FROM jobs WHERE measurement = ?";
        refuse_if_used(&mut transaction, ("measurement", id.to_string()), ("jobs", jobs)).await?;
        let prepared = sql_as!("DELETE FROM measurements WHERE id = ? RETURNING prepared", [id]);
        if let Some(prepared) = prepared.fetch_optional(&mut *transaction).await? {
            self.release(&mut transaction, prepared).await?;
        }
        self.commit_removals(transaction).await
    }
}

/// Writes the row of a measurement that has passed its check.
pub async fn insert_made(
    connection: &mut SqliteConnection,
    id: MeasurementId,
    prepared: Sha256,
    facts: NewMeasurement,
) -> Result<()> {
    let request = "SELECT lab, token, name, created_at FROM requests WHERE id = ?";
    let (lab, token, name, created_at): (Lab, Option<TokenId>, Option<Label>, Timestamp) =
        sql_as!(request, [id]).fetch_one(&mut *connection).await?;
    // It may have been renamed since the worker began.
    let facts = NewMeasurement { name, ..facts };
    insert(connection, (&lab, token), &Measurement { id, prepared, created_at, facts }).await?;
    requests::fulfil(connection, id.into()).await
}

async fn insert(
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
