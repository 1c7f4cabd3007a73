//! Table `checks`: calibrations of ready masks, and measurements, whose check outlasts their request, or did not pass.

use std::fmt::Display;
use std::str::FromStr;

use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::{from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, Reference, listed, require};
use crate::tables::keys::{self, Inserted, Made, RequestKey};
use engine::job::{
    CalibrationId, InvalidId, Lab, Label, MeasurementId, Sha256, Timestamp, TokenId,
};

/// A check that goes on after its request was answered.
#[derive(Debug, Clone)]
pub struct NewCheck {
    pub name: Option<Label>,
    /// That of a measurement.
    pub calibration: Option<CalibrationId>,
    /// As JSON.
    pub request: String,
    /// The uploads that are checked.
    pub files: Vec<Sha256>,
}

/// A check that goes on, or did not pass.
#[derive(Debug, Clone)]
pub struct Check {
    /// Of what is to be made.
    pub id: String,
    pub lab: Lab,
    pub token: Option<TokenId>,
    pub name: Option<Label>,
    /// As JSON.
    pub request: String,
    /// Why it did not pass, as JSON; none while it goes on.
    pub problem: Option<String>,
    pub created_at: Timestamp,
}

from_row!(Check, row => { id, lab, token, name, request, problem, created_at });

/// What of a check changes.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckMark {
    failed: bool,
    name: Option<Label>,
}

/// What a new calibration or measurement comes of.
#[derive(Debug, Clone, Copy)]
pub enum Source<'a, Id> {
    /// A request, with the user's key if it has one.
    Request(Option<&'a RequestKey>),
    /// The check of this identifier, in whose place it comes.
    Check(Id),
}

impl<Id: Copy + Display + FromStr<Err = InvalidId>> Source<'_, Id> {
    /// What was made with the same key before.
    /// Errors: [`StoreError::KeyReused`].
    pub async fn before(
        self,
        connection: &mut SqliteConnection,
        lab: &Lab,
        what: Made,
    ) -> Result<Option<Id>> {
        match self {
            Self::Request(key) => keys::found(connection, lab, what, key).await,
            Self::Check(_) => Ok(None),
        }
    }

    /// The identifier that is promised already, when it was asked for, and how it is called now.
    /// Errors: [`StoreError::NotFound`] if the check was deleted meanwhile.
    pub async fn promised(
        self,
        connection: &mut SqliteConnection,
        what: Made,
    ) -> Result<Option<(Id, Timestamp, Option<Label>)>> {
        let Self::Check(id) = self else { return Ok(None) };
        let asked = sql_as!("SELECT created_at, name FROM checks WHERE id = ?", [id.to_string()]);
        let asked = asked.fetch_optional(connection).await?;
        let (at, name) = asked.ok_or_else(|| StoreError::missing(what.into_str(), id))?;
        Ok(Some((id, at, name)))
    }

    /// Notes that it is there now.
    pub async fn settle(
        self,
        connection: &mut SqliteConnection,
        lab: &Lab,
        (what, id): (Made, Id),
    ) -> Result<()> {
        match self {
            Self::Request(key) => keys::insert(connection, lab, what, key, id).await,
            Self::Check(id) => delete(connection, id).await.map(drop),
        }
    }
}

impl Check {
    /// Why it did not pass, in words.
    pub fn error(&self) -> Result<Option<String>> {
        let Some(problem) = &self.problem else { return Ok(None) };
        let corrupt = || StoreError::Corrupt { column: "problem", value: problem.clone() };
        let problem: serde_json::Value = serde_json::from_str(problem).map_err(|_| corrupt())?;
        Ok(Some(problem["detail"].as_str().ok_or_else(corrupt)?.to_owned()))
    }
}

impl Store {
    /// Notes that the check of a request goes on.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::NotFound`] if an upload is gone.
    pub async fn add_check<Id>(
        &self,
        (lab, token): (&Lab, Option<TokenId>),
        (what, id): (Made, Id),
        new: &NewCheck,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<Id>>
    where
        Id: Display + FromStr<Err = InvalidId>,
    {
        let mut transaction = self.write().await?;
        if let Some(before) = keys::found(&mut transaction, lab, what, key).await? {
            return Ok(Inserted::Before(before));
        }
        let name = id.to_string();
        sql!(
            "INSERT INTO checks (id, what, lab, token, name, calibration, request, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            [
                &name,
                what.into_str(),
                lab,
                token,
                &new.name,
                new.calibration,
                &new.request,
                Timestamp::now()
            ]
        )
        .execute(&mut *transaction)
        .await?;
        let calibration = new.calibration.map(Reference::Calibration);
        require(&mut transaction, calibration.as_slice()).await?;
        for file in &new.files {
            require(&mut transaction, &[Reference::Blob(*file)]).await?;
            let files = "INSERT INTO check_files (id, sha256) VALUES (?, ?) ON CONFLICT DO NOTHING";
            sql!(files, [&name, file]).execute(&mut *transaction).await?;
        }
        keys::insert(&mut transaction, lab, what, key, &name).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// Notes that the check did not pass, and why, as JSON; its key is free again, as after any refusal. Nothing
    /// if it was deleted meanwhile.
    pub async fn fail_check(&self, id: impl Display, problem: &str) -> Result<()> {
        let (mut transaction, id) = (self.write().await?, id.to_string());
        sql!("UPDATE checks SET problem = ? WHERE id = ?", [problem, &id])
            .execute(&mut *transaction)
            .await?;
        sql!("DELETE FROM request_keys WHERE id = ?", [&id]).execute(&mut *transaction).await?;
        // The user may delete them now.
        sql!("DELETE FROM check_files WHERE id = ?", [&id]).execute(&mut *transaction).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// The checks that an earlier server did not bring to their end, oldest first.
    pub async fn open_checks(&self, what: Made) -> Result<Vec<Check>> {
        let open = "SELECT * FROM checks WHERE problem IS NULL AND what = ? ORDER BY id";
        Ok(sql_as!(open, [what.into_str()]).fetch_all(&self.readers).await?)
    }

    /// Counts that a check is begun once more; says how often it was.
    pub async fn begin_check(&self, id: &str) -> Result<u32> {
        let count = "UPDATE checks SET begun = begun + 1 WHERE id = ? RETURNING begun";
        Ok(sql_as!(count, [id]).fetch_one(&self.writer).await?)
    }

    /// The check of the lab's measurement with this identifier; none if it has passed, or there is none.
    pub async fn measurement_check(&self, lab: &Lab, id: MeasurementId) -> Result<Option<Check>> {
        let check = "SELECT * FROM checks WHERE what = 'measurement' AND lab = ? AND id = ?";
        Ok(sql_as!(check, [lab, id]).fetch_optional(&self.readers).await?)
    }

    /// A page of the lab's measurements that have not passed their check, newest first.
    pub async fn measurement_checks(
        &self,
        lab: &Lab,
        filter: Filter<MeasurementId>,
        limit: u32,
    ) -> Result<Page<Check>> {
        let items = listed!(sql_as, "checks WHERE what = 'measurement' AND", lab, filter, limit)
            .fetch_all(&self.readers)
            .await?;
        Ok(Page::cut(items, limit))
    }

    /// A mark of each measurement that has not passed its check, which changes when that does.
    pub async fn check_marks(
        &self,
    ) -> Result<std::collections::HashMap<(Lab, MeasurementId), CheckMark>> {
        let rows: Vec<(Lab, MeasurementId, bool, Option<Label>)> = sql_as!(
            "SELECT lab, id, problem IS NOT NULL, name FROM checks WHERE what = 'measurement'",
        )
        .fetch_all(&self.readers)
        .await?;
        let mark = |(lab, id, failed, name)| ((lab, id), CheckMark { failed, name });
        Ok(rows.into_iter().map(mark).collect())
    }
}

/// Removes a check: it has passed, and what it was for is there, or nobody wants that any more. False if there
/// is none.
pub async fn delete(connection: &mut SqliteConnection, id: impl Display) -> Result<bool> {
    let deleted = sql!("DELETE FROM checks WHERE id = ?", [id.to_string()]);
    Ok(deleted.execute(connection).await?.rows_affected() > 0)
}

/// Removes a check of the lab. False if it has none.
pub async fn delete_of(
    connection: &mut SqliteConnection,
    lab: &Lab,
    id: impl Display,
) -> Result<bool> {
    let deleted = sql!("DELETE FROM checks WHERE id = ? AND lab = ?", [id.to_string(), lab]);
    Ok(deleted.execute(connection).await?.rows_affected() > 0)
}

/// Gives what a check is for another name. False if the lab has no such check.
pub async fn rename(
    connection: &mut SqliteConnection,
    (lab, id): (&Lab, impl Display),
    name: Option<&Label>,
) -> Result<bool> {
    let renamed = "UPDATE checks SET name = ? WHERE id = ? AND lab = ?";
    let renamed = sql!(renamed, [name, id.to_string(), lab]).execute(connection).await?;
    Ok(renamed.rows_affected() > 0)
}
