//! Tables `calibrations`, and `calibration_requests`: masks that are there, and what was asked for.
//!
//! Every calibration has a row of what was asked for, captures or only a report, and a task that does
//! it. It has one in `calibrations` from when its masks are there.

use std::collections::HashMap;

use serde::Serialize;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, Reference, refuse_if_used, require};
use crate::tables::checks;
use engine::job::{
    CalibrationId, Captures, Lab, Label, Mosaic, Sha256, TaskState, Timestamp, TokenId,
};

/// What is known of a calibration when its masks have been checked.
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
    /// Pixels that are dark in all frames, of which nothing can be known.
    pub dead_pixels: u64,
    /// Values below 0, set to 0.
    pub clipped_negatives: u64,
    /// The colours of the sensor's pixels; none for a grey one.
    pub mosaic: Option<Mosaic>,
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

#[derive(Debug, Clone)]
pub struct Unready {
    pub id: CalibrationId,
    pub name: Option<Label>,
    /// None while nobody has looked into the file.
    pub frames: Option<usize>,
    /// How much of the work is done, on \[0,1\].
    pub fraction: f64,
    pub mosaic: Option<Mosaic>,
    /// Why there will be no masks; none while they are made.
    pub error: Option<String>,
    /// The same as a problem in JSON, where a file did not pass its check.
    pub problem: Option<String>,
    pub created_at: Timestamp,
}

/// What of a calibration changes; its report is there when its task is done.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationMark {
    state: TaskState,
    fraction: f64,
    name: Option<Label>,
}

impl Store {
    /// The lab's calibration with this identifier.
    /// Errors: [`StoreError::Unready`] if its masks are not there.
    pub async fn calibration(&self, lab: &Lab, id: CalibrationId) -> Result<Calibration> {
        match self.find_calibration(Some(lab), id).await {
            Err(missing @ StoreError::NotFound { .. }) => match self.unready(lab, id).await? {
                Some(Unready { id, error, .. }) => Err(StoreError::Unready { id, error }),
                // They may have come between the two looks.
                None => self.find_calibration(Some(lab), id).await.map_err(|_| missing),
            },
            found => found,
        }
    }

    /// As [`Self::calibration`]; without a lab, for those who work for all of them.
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

    /// The lab's calibration with this identifier if its masks are not there; none otherwise.
    pub async fn unready(&self, lab: &Lab, id: CalibrationId) -> Result<Option<Unready>> {
        let only = Filter { calibration: Some(id), ..Filter::default() };
        Ok(self.find_unready(lab, only, 1).await?.items.pop())
    }

    /// A page of the lab's calibrations whose masks are not there, newest first.
    pub async fn all_unready(
        &self,
        lab: &Lab,
        filter: Filter<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Unready>> {
        self.find_unready(lab, filter, limit).await
    }

    async fn find_unready(
        &self,
        lab: &Lab,
        filter: Filter<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Unready>> {
        let rows = sql!(
            "WITH waiting AS (
                 SELECT asked.lab, calibration, name, captures, mosaic, created_at, state, fraction,
                     (SELECT reason FROM attempts
                      WHERE task = tasks.id AND attempt = tasks.attempt) AS reason, NULL AS problem
                 FROM calibration_requests AS asked JOIN tasks USING (calibration)
                 WHERE captures IS NOT NULL AND state <> ?2
                 UNION ALL
                 SELECT lab, id, name, NULL, request ->> '$.mosaic', created_at,
                     iif(problem IS NULL, ?8, ?9), 0.0, problem ->> '$.detail', problem
                 FROM checks WHERE what = 'calibration')
             SELECT * FROM waiting
             WHERE lab = ?1 AND (?3 IS NULL OR calibration = ?3) AND (?4 IS NULL OR calibration < ?4)
               AND (?6 IS NULL OR created_at >= ?6) AND (?7 IS NULL OR created_at < ?7)
             ORDER BY calibration DESC LIMIT ?5",
            [
                lab,
                TaskState::Done,
                filter.calibration,
                filter.after,
                i64::from(limit) + 1,
                filter.created.from,
                filter.created.before,
                TaskState::Running,
                TaskState::Failed
            ]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(Page::cut(rows.iter().map(unready).collect::<Result<_, _>>()?, limit))
    }

    /// A page of the lab's calibrations whose masks are there, newest first.
    pub async fn calibrations(
        &self,
        lab: &Lab,
        filter: Filter<CalibrationId>,
        limit: u32,
    ) -> Result<Page<Calibration>> {
        let items = sql_as!(
            "SELECT * FROM calibrations WHERE lab = ?1 AND (?2 IS NULL OR id < ?2)
               AND (?4 IS NULL OR created_at >= ?4) AND (?5 IS NULL OR created_at < ?5)
             ORDER BY id DESC LIMIT ?3",
            [lab, filter.after, i64::from(limit) + 1, filter.created.from, filter.created.before]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(Page::cut(items, limit))
    }

    /// A mark of each calibration that changes when it does, and whose they are.
    pub async fn calibration_marks(
        &self,
    ) -> Result<HashMap<(Lab, CalibrationId), CalibrationMark>> {
        let rows: Vec<(Lab, CalibrationId, TaskState, f64, Option<Label>)> = sql_as!(
            "SELECT asked.lab, calibration, state, fraction, name
             FROM calibration_requests AS asked JOIN tasks USING (calibration)
             UNION ALL
             SELECT lab, id, iif(problem IS NULL, ?, ?), 0.0, name FROM checks WHERE what = 'calibration'",
            [TaskState::Running, TaskState::Failed]
        )
        .fetch_all(&self.readers)
        .await?;
        let mark = |(lab, id, state, fraction, name)| {
            ((lab, id), CalibrationMark { state, fraction, name })
        };
        Ok(rows.into_iter().map(mark).collect())
    }

    /// Gives a calibration another name, or none.
    pub async fn rename_calibration(
        &self,
        lab: &Lab,
        id: CalibrationId,
        name: Option<&Label>,
    ) -> Result<()> {
        let mut transaction = self.write().await?;
        let renamed = sql!(
            "UPDATE calibration_requests SET name = ? WHERE calibration = ? AND lab = ?",
            [name, id, lab]
        )
        .execute(&mut *transaction)
        .await?;
        if renamed.rows_affected() == 0
            && !checks::rename(&mut transaction, (lab, id), name).await?
        {
            return Err(StoreError::missing("calibration", id));
        }
        sql!("UPDATE calibrations SET name = ? WHERE id = ?", [name, id])
            .execute(&mut *transaction)
            .await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Deletes a calibration that no measurement and no model refers to.
    pub async fn delete_calibration(&self, lab: &Lab, id: CalibrationId) -> Result<()> {
        let mut transaction = self.write().await?;
        // Its task goes with it: a worker that has it in hand finds that nobody wants it any more.
        let asked =
            sql!("DELETE FROM calibration_requests WHERE calibration = ? AND lab = ?", [id, lab])
                .execute(&mut *transaction)
                .await?;
        if asked.rows_affected() == 0 {
            if checks::delete_of(&mut transaction, lab, id).await? {
                return Ok(transaction.commit().await?);
            }
            return Err(StoreError::missing("calibration", id));
        }
        for users in [
            (
                "measurements",
                "SELECT (SELECT count(*) FROM measurements WHERE calibration = ?1)
                     + (SELECT count(*) FROM checks WHERE calibration = ?1 AND problem IS NULL) AS users",
            ),
            ("models", "SELECT count(*) AS users FROM models WHERE calibration = ?"),
        ] {
            refuse_if_used(&mut transaction, ("calibration", id.to_string()), users).await?;
        }
        let prepared = sql_as!("DELETE FROM calibrations WHERE id = ? RETURNING prepared", [id]);
        if let Some(prepared) = prepared.fetch_optional(&mut *transaction).await? {
            self.release(&mut transaction, prepared).await?;
        }
        transaction.commit().await?;
        Ok(())
    }
}

/// Writes the row of a calibration whose masks were made of its captures, which it needs no more.
pub async fn insert_made(
    connection: &mut SqliteConnection,
    id: CalibrationId,
    prepared: Sha256,
    facts: NewCalibration,
) -> Result<()> {
    let request = "SELECT lab, token, name, mosaic, created_at FROM calibration_requests WHERE calibration = ?";
    let row = sql!(request, [id]).fetch_one(&mut *connection).await?;
    let lab: Lab = row.read("lab")?;
    let (token, created_at) = (row.read("token")?, row.read("created_at")?);
    let (name, mosaic) = (row.read("name")?, row.read("mosaic")?);
    // It may have been renamed since the worker began, which knows nothing of colours.
    let facts = NewCalibration { name, mosaic, ..facts };
    insert(connection, (&lab, token), &Calibration { id, prepared, created_at, facts }).await?;
    sql!("DELETE FROM calibration_captures WHERE calibration = ?", [id])
        .execute(connection)
        .await?;
    Ok(())
}

/// What is asked for.
#[derive(Debug)]
pub struct Asked<'a> {
    pub id: CalibrationId,
    /// Whose limit it counts against.
    pub token: Option<TokenId>,
    pub name: Option<&'a Label>,
    /// Of which masks are to be made; without them a report is.
    pub captures: Option<&'a Captures>,
    /// Bytes of the masks that are to be made.
    pub bytes: u64,
    pub mosaic: Option<Mosaic>,
}

/// Writes down what is asked for.
pub async fn insert_request(
    connection: &mut SqliteConnection,
    lab: &Lab,
    &Asked { id, token, name, captures, bytes, mosaic }: &Asked<'_>,
) -> Result<()> {
    sql!(
        "INSERT INTO calibration_requests (calibration, lab, token, name, captures, prepared_bytes,
             created_at, mosaic)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        [
            id,
            lab,
            token,
            name,
            captures.map(Json),
            bytes,
            Timestamp::now(),
            mosaic.map(|mosaic| mosaic.to_string())
        ]
    )
    .execute(&mut *connection)
    .await?;
    for (_, upload) in captures.iter().flat_map(|captures| captures.uploads()) {
        require(connection, &[Reference::Blob(upload)]).await?;
        sql!(
            "INSERT INTO calibration_captures (calibration, sha256) VALUES (?, ?)
             ON CONFLICT DO NOTHING",
            [id, upload]
        )
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

/// Writes the row of a calibration whose masks are there.
pub async fn insert(
    connection: &mut SqliteConnection,
    (lab, token): (&Lab, Option<TokenId>),
    calibration: &Calibration,
) -> Result<()> {
    let facts = &calibration.facts;
    sql!(
        "INSERT INTO calibrations (lab, token, id, name, masks, prepared, format, sample, axes, frames, height,
             width, full_scale, mask_mean, dead_pixels, clipped_negatives, created_at, mosaic)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
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
            facts.mosaic.map(|mosaic| mosaic.to_string())
        ]
    )
    .execute(connection)
    .await?;
    Ok(())
}

fn unready(row: &SqliteRow) -> Result<Unready> {
    let captures: Option<Json<Captures>> = row.read("captures")?;
    let failed = row.read::<TaskState>("state")? == TaskState::Failed;
    Ok(Unready {
        id: row.read("calibration")?,
        name: row.read("name")?,
        frames: captures.map(|Json(captures)| captures.masks.len()),
        mosaic: row.read("mosaic")?,
        fraction: row.read("fraction")?,
        // The reason of the last attempt; one that is tried again is none for a user.
        error: if failed { row.read("reason")? } else { None },
        problem: row.read("problem")?,
        created_at: row.read("created_at")?,
    })
}
