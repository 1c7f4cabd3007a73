//! Table `calibrations`.

use serde::Serialize;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::blobs::Origin;
use crate::job::{CalibrationId, Lab, Label, Sha256, Timestamp};
use crate::store::error::StoreError;
use crate::store::queue::calibrating;
use crate::store::rows::{integer, number, parsed, parsed_if, single};
use crate::store::{Page, StagedBlob, Store};

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

impl Store {
    /// Records a calibration and puts its prepared masks in place.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if the upload is gone; or if the file or the row can't be written.
    pub async fn add_calibration(
        &self,
        lab: &Lab,
        facts: NewCalibration,
        prepared: StagedBlob,
    ) -> Result<Calibration, StoreError> {
        let calibration = Calibration {
            id: CalibrationId::new(),
            prepared: prepared.sha256(),
            created_at: Timestamp::now(),
            facts,
        };
        let mut transaction = self.write().await?;
        self.publish(&mut transaction, prepared, Origin::Prepared).await?;
        insert(&mut transaction, lab, &calibration).await?;
        // Its report is made by a worker.
        let name = calibration.facts.name.as_ref();
        calibrating::insert(&mut transaction, lab, calibration.id, name, None).await?;
        transaction.commit().await?;
        Ok(calibration)
    }

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
            Err(missing @ StoreError::NotFound { .. }) => match self.unready(lab, id).await {
                Ok(Some(unready)) => Err(unready.into()),
                _ => Err(missing),
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

    /// A page of the lab's calibrations, newest first, older than `after`.
    ///
    /// # Errors
    /// If the database fails.
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
        let unready = self.unready(lab, id).await?.is_some();
        let mut transaction = self.write().await?;
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
        sqlx::query("DELETE FROM calibration_tasks WHERE calibration = ?")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await?;
        match row {
            Some(row) => self.release(&mut transaction, parsed(&row, "prepared")?).await?,
            // A worker that has its captures in hand finds that nobody wants them any more.
            None if unready => {}
            None => return Err(not_found(id)),
        }
        transaction.commit().await?;
        Ok(())
    }
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
    .await
    .map_err(|error| gone_if_foreign_key(error, "blob", facts.masks.to_string()))?;
    Ok(())
}

impl<T> Page<T> {
    /// A page of at most `limit` items from up to `limit + 1` rows.
    pub(in crate::store) fn cut(
        rows: &[SqliteRow],
        limit: u32,
        read: impl Fn(&SqliteRow) -> Result<T, StoreError>,
    ) -> Result<Self, StoreError> {
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        let items = rows.iter().take(limit).map(read).collect::<Result<_, _>>()?;
        Ok(Self { items, more: rows.len() > limit })
    }
}

/// Refuses to delete what others refer to: kind and identifier of the one, name of the others and
/// the query that counts them as `users`.
pub(in crate::store) async fn refuse_if_used(
    connection: &mut SqliteConnection,
    (what, id): (&'static str, String),
    (by, query): (&'static str, &'static str),
) -> Result<(), StoreError> {
    let row = sqlx::query(query).bind(id).fetch_one(connection).await?;
    let users = number(&row, "users")?;
    if users > 0 { Err(StoreError::InUse { what, by, users }) } else { Ok(()) }
}

/// What a foreign key refers to was deleted a moment ago: for the user, it is not there.
pub(in crate::store) fn gone_if_foreign_key(
    error: sqlx::Error,
    what: &'static str,
    id: String,
) -> StoreError {
    match &error {
        sqlx::Error::Database(inner) if inner.is_foreign_key_violation() => {
            StoreError::NotFound { what, id }
        }
        _ => error.into(),
    }
}

fn calibration(row: &SqliteRow) -> Result<Calibration, StoreError> {
    Ok(Calibration {
        id: parsed(row, "id")?,
        prepared: parsed(row, "prepared")?,
        created_at: Timestamp(row.try_get("created_at")?),
        facts: NewCalibration {
            name: label(row, "name")?,
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

/// The column as a label, if there is one.
pub(in crate::store) fn label(
    row: &SqliteRow,
    column: &'static str,
) -> Result<Option<Label>, StoreError> {
    parsed_if(row, column)
}

fn not_found(id: CalibrationId) -> StoreError {
    StoreError::NotFound { what: "calibration", id: id.to_string() }
}
