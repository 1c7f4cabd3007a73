//! Table `calibrations`: calibrations with masks.

use serde::Serialize;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, FromRow, Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, refuse_if_used};
use crate::tables::keys::Made;
use crate::tables::requests::{self, Asked};
use engine::job::{
    CalibrationId, Dispersion, Lab, Label, Mosaic, Reading, Sha256, Timestamp, TokenId,
};

/// Facts of a calibration whose masks have passed their check.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NewCalibration {
    pub name: Option<Label>,
    pub masks: Sha256,
    pub format: String,
    pub sample: String,
    /// How the axes of the array were read; none for pictures.
    pub axes: Option<String>,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub full_scale: f32,
    /// Mean of all mask values on [0, 1].
    pub mask_mean: f64,
    /// Pixels that are dark in all frames. They carry no information.
    pub dead_pixels: u64,
    /// Values below 0, set to 0.
    pub clipped_negatives: u64,
    /// The colours of the sensor's pixels; none for a grey one.
    pub mosaic: Option<Mosaic>,
    /// The part of the masks' file that was read; `None` for captures.
    pub reading: Option<Reading>,
    /// Displacement of the bands of a spectral camera, with which the masks were made of one mask.
    pub dispersion: Option<Dispersion>,
}

from_row!(NewCalibration, row => {
    name,
    masks,
    format,
    sample,
    axes,
    frames,
    height,
    width,
    full_scale,
    mask_mean,
    dead_pixels,
    clipped_negatives,
    mosaic,
    reading = row.read_json("reading")?,
    dispersion = row.read_json("dispersion")?,
});

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Calibration {
    pub id: CalibrationId,
    /// Hash of the prepared masks: a planar file of f32 [B, H, W] on [0, 1].
    #[serde(skip)]
    pub prepared: Sha256,
    pub created_at: Timestamp,
    #[serde(flatten)]
    pub facts: NewCalibration,
}

from_row!(Calibration, row => {
    id,
    prepared,
    created_at,
    facts = NewCalibration::from_row(row)?,
});

impl Store {
    /// The lab's calibration with this identifier.
    /// Errors: [`StoreError::Unready`] if its masks are not there.
    pub async fn calibration(&self, lab: &Lab, id: CalibrationId) -> Result<Calibration> {
        match self.asked_calibration(lab, id).await? {
            Asked::Ready(calibration) => Ok(calibration),
            Asked::Pending(request) => {
                let error = request.refusal.map(|refusal| refusal.detail);
                Err(StoreError::Unready { id, error })
            }
        }
    }

    /// The lab's calibration with this identifier, ready or pending.
    pub async fn asked_calibration(
        &self,
        lab: &Lab,
        id: CalibrationId,
    ) -> Result<Asked<Calibration>> {
        // In this order: it may become ready between the two looks.
        let request = self.find_request(lab, id).await?;
        match self.find_calibration(Some(lab), id).await {
            Err(missing @ StoreError::NotFound { .. }) => match request {
                Some(request) => Ok(Asked::Pending(Box::new(request))),
                None => Err(missing),
            },
            found => Ok(Asked::Ready(found?)),
        }
    }

    /// As [`Self::calibration`]; without a lab, for workers, which serve all labs.
    pub(crate) async fn find_calibration(
        &self,
        lab: Option<&Lab>,
        id: CalibrationId,
    ) -> Result<Calibration> {
        let calibration = sql_as!(
            "SELECT * FROM calibrations WHERE id = ?1 AND (?2 IS NULL OR lab = ?2)",
            [id, lab]
        )
        .fetch_optional(&self.readers)
        .await?;
        calibration.ok_or_else(|| StoreError::missing("calibration", id))
    }

    /// A page of the lab's calibrations, newest first.
    pub async fn calibrations(
        &self,
        lab: &Lab,
        filter: Filter<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Asked<Calibration>>> {
        let facts = "SELECT * FROM calibrations WHERE id IN (SELECT value FROM json_each(?))";
        let read = |row: &SqliteRow| {
            let calibration = Calibration::from_row(row)?;
            Ok((calibration.id.into(), calibration))
        };
        self.asked((lab, Made::Calibration), filter.untyped(), limit, facts, read).await
    }

    /// Gives a calibration another name, or none.
    pub async fn rename_calibration(
        &self,
        lab: &Lab,
        id: CalibrationId,
        name: Option<&Label>,
    ) -> Result<()> {
        let mut transaction = self.write().await?;
        requests::rename(&mut transaction, (lab, Made::Calibration, id.into()), name).await?;
        sql!("UPDATE calibrations SET name = ? WHERE id = ?", [name, id])
            .execute(&mut *transaction)
            .await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Deletes a calibration that no measurement and no model refers to.
    pub async fn delete_calibration(&self, lab: &Lab, id: CalibrationId) -> Result<()> {
        let mut transaction = self.write().await?;
        requests::delete(&mut transaction, (lab, Made::Calibration, id.into())).await?;
        for users in requests::USERS {
            refuse_if_used(&mut transaction, ("calibration", id.to_string()), users).await?;
        }
        let prepared = sql_as!("DELETE FROM calibrations WHERE id = ? RETURNING prepared", [id]);
        if let Some(prepared) = prepared.fetch_optional(&mut *transaction).await? {
            self.release(&mut transaction, prepared).await?;
        }
        self.commit_removals(transaction).await
    }
}

/// Writes the row of a calibration after its masks were made or checked.
pub async fn insert_made(
    connection: &mut SqliteConnection,
    id: CalibrationId,
    prepared: Sha256,
    facts: NewCalibration,
) -> Result<()> {
    let request = "SELECT lab, token, name, request ->> '$.mosaic' AS mosaic, created_at
                   FROM requests WHERE id = ?";
    let row = sql!(request, [id]).fetch_one(&mut *connection).await?;
    let lab: Lab = row.read("lab")?;
    let (token, created_at) = (row.read("token")?, row.read("created_at")?);
    let (name, mosaic) = (row.read("name")?, row.read("mosaic")?);
    // It may have been renamed since the worker began, which knows nothing of colours.
    let facts = NewCalibration { name, mosaic, ..facts };
    insert(connection, (&lab, token), &Calibration { id, prepared, created_at, facts }).await?;
    requests::fulfil(connection, id.into()).await
}

/// Writes the row of a calibration that has masks.
async fn insert(
    connection: &mut SqliteConnection,
    (lab, token): (&Lab, Option<TokenId>),
    calibration: &Calibration,
) -> Result<()> {
    let facts = &calibration.facts;
    sql!(
        "INSERT INTO calibrations (lab, token, id, name, masks, prepared, format, sample, axes, frames, height,
             width, full_scale, mask_mean, dead_pixels, clipped_negatives, created_at, mosaic, reading, dispersion)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            lab,
            token,
            calibration.id,
            &facts.name,
            facts.masks,
            calibration.prepared,
            &facts.format,
            &facts.sample,
            &facts.axes,
            facts.frames,
            facts.height,
            facts.width,
            facts.full_scale,
            facts.mask_mean,
            facts.dead_pixels,
            facts.clipped_negatives,
            calibration.created_at,
            facts.mosaic.map(|mosaic| mosaic.to_string()),
            facts.reading.map(Json),
            facts.dispersion.clone().map(Json)
        ]
    )
    .execute(connection)
    .await?;
    Ok(())
}
