//! Tables `calibrations`, and `calibration_requests`: masks that are there, and what was asked for.
//!
//! Every calibration has a row of what was asked for, captures or only a report, and a task that does
//! it. It has one in `calibrations` from when its masks are there.

use serde::Serialize;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{CalibrationId, Captures, Lab, Label, Sha256, TaskState, Timestamp};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{
    Page, Reference, integer, json, number, parsed, parsed_if, refuse_if_used, require, single,
    to_json,
};

/// What is known of a calibration when its masks have been checked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NewCalibration {
    /// The user's name for it.
    pub name: Option<Label>,
    /// The upload with the masks.
    pub masks: Sha256,
    /// Format of the upload, such as `npy`.
    pub format: String,
    /// Sample type of the upload, such as `uint16`.
    pub sample: String,
    /// Mask frames (B).
    pub frames: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// The stored number that means 1.
    pub full_scale: f32,
    /// Mean of all mask values on [0, 1].
    pub mask_mean: f64,
    /// Pixels that are dark in all frames, of which nothing can be known.
    pub dead_pixels: u64,
    /// Values below 0, set to 0.
    pub clipped_negatives: u64,
}

/// A calibration on record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Calibration {
    /// Its identifier.
    pub id: CalibrationId,
    /// Hash of the prepared masks: a planar file of f32 [B, H, W] on [0, 1].
    #[serde(skip)]
    pub prepared: Sha256,
    /// When it was made.
    pub created_at: Timestamp,
    /// What is known of it.
    #[serde(flatten)]
    pub facts: NewCalibration,
}

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
    /// The lab's calibration with this identifier.
    ///
    /// # Errors
    /// [`StoreError::NotFound`]; [`StoreError::Unready`] if its masks are not there.
    pub async fn calibration(
        &self,
        lab: &Lab,
        id: CalibrationId,
    ) -> Result<Calibration, StoreError> {
        match self.find_calibration(Some(lab), id).await {
            Err(missing @ StoreError::NotFound { .. }) => match self.unready(lab, id).await? {
                Some(Unready { id, error, .. }) => Err(StoreError::Unready { id, error }),
                None => Err(missing),
            },
            found => found,
        }
    }

    /// As [`Self::calibration`]; without a lab, for those who work for all of them.
    pub(in crate::store) async fn find_calibration(
        &self,
        lab: Option<&Lab>,
        id: CalibrationId,
    ) -> Result<Calibration, StoreError> {
        let row =
            sqlx::query("SELECT * FROM calibrations WHERE id = ?1 AND (?2 IS NULL OR lab = ?2)")
                .bind(id.to_string())
                .bind(lab.map(Lab::as_str))
                .fetch_optional(&self.readers)
                .await?;
        row.as_ref().map(calibration).transpose()?.ok_or_else(|| not_found(id))
    }

    /// The lab's calibration with this identifier if its masks are not there; none otherwise.
    pub async fn unready(
        &self,
        lab: &Lab,
        id: CalibrationId,
    ) -> Result<Option<Unready>, StoreError> {
        Ok(self.find_unready(lab, Some(id), None, 1).await?.items.pop())
    }

    /// A page of the lab's calibrations whose masks are not there, newest first, older than `after`.
    pub async fn all_unready(
        &self,
        lab: &Lab,
        after: Option<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Unready>, StoreError> {
        self.find_unready(lab, None, after, limit).await
    }

    async fn find_unready(
        &self,
        lab: &Lab,
        only: Option<CalibrationId>,
        after: Option<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Unready>, StoreError> {
        let rows = sqlx::query(
            "SELECT calibration, name, captures, created_at, state, fraction,
                 (SELECT reason FROM attempts WHERE task = tasks.id AND attempt = tasks.attempt) AS reason
             FROM calibration_requests JOIN tasks USING (calibration)
             WHERE lab = ?1 AND captures IS NOT NULL AND state <> ?2
               AND (?3 IS NULL OR calibration = ?3) AND (?4 IS NULL OR calibration < ?4)
             ORDER BY calibration DESC LIMIT ?5",
        )
        .bind(lab.as_str())
        .bind(TaskState::Done.name())
        .bind(only.map(|id| id.to_string()))
        .bind(after.map(|id| id.to_string()))
        .bind(i64::from(limit) + 1)
        .fetch_all(&self.readers)
        .await?;
        Page::cut(&rows, limit, unready)
    }

    /// A page of the lab's calibrations, newest first, older than `after`.
    pub async fn calibrations(
        &self,
        lab: &Lab,
        after: Option<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Calibration>, StoreError> {
        let rows = sqlx::query(
            "SELECT * FROM calibrations WHERE lab = ?1 AND (?2 IS NULL OR id < ?2)
             ORDER BY id DESC LIMIT ?3",
        )
        .bind(lab.as_str())
        .bind(after.map(|id| id.to_string()))
        .bind(i64::from(limit) + 1)
        .fetch_all(&self.readers)
        .await?;
        Page::cut(&rows, limit, calibration)
    }

    /// Deletes a calibration that no measurement and no model refers to.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::InUse`].
    pub async fn delete_calibration(&self, lab: &Lab, id: CalibrationId) -> Result<(), StoreError> {
        let mut transaction = self.write().await?;
        // Its task goes with it: a worker that has it in hand finds that nobody wants it any more.
        let asked =
            sqlx::query("DELETE FROM calibration_requests WHERE calibration = ? AND lab = ?")
                .bind(id.to_string())
                .bind(lab.as_str())
                .execute(&mut *transaction)
                .await?;
        if asked.rows_affected() == 0 {
            return Err(not_found(id));
        }
        for users in [
            ("measurements", "SELECT count(*) AS users FROM measurements WHERE calibration = ?"),
            ("models", "SELECT count(*) AS users FROM models WHERE calibration = ?"),
        ] {
            refuse_if_used(&mut transaction, ("calibration", id.to_string()), users).await?;
        }
        let row = sqlx::query("DELETE FROM calibrations WHERE id = ? RETURNING prepared")
            .bind(id.to_string())
            .fetch_optional(&mut *transaction)
            .await?;
        if let Some(row) = row {
            self.release(&mut transaction, parsed(&row, "prepared")?).await?;
        }
        transaction.commit().await?;
        Ok(())
    }
}

/// Writes the row of a calibration whose masks were made of its captures, which it needs no more.
pub(in crate::store) async fn insert_made(
    connection: &mut SqliteConnection,
    id: CalibrationId,
    prepared: Sha256,
    facts: NewCalibration,
) -> Result<(), StoreError> {
    let row = sqlx::query("SELECT lab, created_at FROM calibration_requests WHERE calibration = ?")
        .bind(id.to_string())
        .fetch_one(&mut *connection)
        .await?;
    let created_at = Timestamp(row.try_get("created_at")?);
    let calibration = Calibration { id, prepared, created_at, facts };
    insert(connection, &parsed(&row, "lab")?, &calibration).await?;
    sqlx::query("DELETE FROM calibration_captures WHERE calibration = ?")
        .bind(id.to_string())
        .execute(connection)
        .await?;
    Ok(())
}

/// Writes down what is asked for: masks of captures (as JSON), or without them a report.
pub(in crate::store) async fn insert_request(
    connection: &mut SqliteConnection,
    lab: &Lab,
    id: CalibrationId,
    name: Option<&Label>,
    captures: Option<&Captures>,
) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO calibration_requests (calibration, lab, name, captures, created_at)
         VALUES (?, ?, ?, ?, ?)",
    )
    .bind(id.to_string())
    .bind(lab.as_str())
    .bind(name.map(Label::as_str))
    .bind(captures.map(|captures| to_json("captures", captures)).transpose()?)
    .bind(Timestamp::now().0)
    .execute(&mut *connection)
    .await?;
    for (_, upload) in captures.iter().flat_map(|captures| captures.uploads()) {
        require(connection, &[Reference::Blob(upload)]).await?;
        sqlx::query(
            "INSERT INTO calibration_captures (calibration, sha256) VALUES (?, ?)
             ON CONFLICT DO NOTHING",
        )
        .bind(id.to_string())
        .bind(upload.to_string())
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

/// Writes the row of a calibration whose masks are there.
pub(in crate::store) async fn insert(
    connection: &mut SqliteConnection,
    lab: &Lab,
    calibration: &Calibration,
) -> Result<(), StoreError> {
    let facts = &calibration.facts;
    sqlx::query(
        "INSERT INTO calibrations (lab, id, name, masks, prepared, format, sample, frames, height,
             width, full_scale, mask_mean, dead_pixels, clipped_negatives, created_at)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(lab.as_str())
    .bind(calibration.id.to_string())
    .bind(facts.name.as_ref().map(Label::as_str))
    .bind(facts.masks.to_string())
    .bind(calibration.prepared.to_string())
    .bind(&facts.format)
    .bind(&facts.sample)
    .bind(integer(facts.frames))
    .bind(integer(facts.height))
    .bind(integer(facts.width))
    .bind(f64::from(facts.full_scale))
    .bind(facts.mask_mean)
    .bind(integer(facts.dead_pixels))
    .bind(integer(facts.clipped_negatives))
    .bind(calibration.created_at.0)
    .execute(connection)
    .await?;
    Ok(())
}

fn calibration(row: &SqliteRow) -> Result<Calibration, StoreError> {
    Ok(Calibration {
        id: parsed(row, "id")?,
        prepared: parsed(row, "prepared")?,
        created_at: Timestamp(row.try_get("created_at")?),
        facts: NewCalibration {
            name: parsed_if(row, "name")?,
            masks: parsed(row, "masks")?,
            format: row.try_get("format")?,
            sample: row.try_get("sample")?,
            frames: number(row, "frames")?,
            height: number(row, "height")?,
            width: number(row, "width")?,
            full_scale: single(row, "full_scale")?,
            mask_mean: row.try_get("mask_mean")?,
            dead_pixels: number(row, "dead_pixels")?,
            clipped_negatives: number(row, "clipped_negatives")?,
        },
    })
}

fn unready(row: &SqliteRow) -> Result<Unready, StoreError> {
    let captures: Captures = json(row, "captures")?;
    let failed = parsed::<TaskState>(row, "state")? == TaskState::Failed;
    Ok(Unready {
        id: parsed(row, "calibration")?,
        name: parsed_if(row, "name")?,
        frames: captures.masks.len(),
        fraction: row.try_get("fraction")?,
        // The reason of the last attempt; one that is tried again is none for a user.
        error: if failed { row.try_get("reason")? } else { None },
        created_at: Timestamp(row.try_get("created_at")?),
    })
}

fn not_found(id: CalibrationId) -> StoreError {
    StoreError::NotFound { what: "calibration", id: id.to_string() }
}
