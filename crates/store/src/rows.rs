//! Statements, pages, and what rows refer to.

use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::error::{Result, StoreError};
use crate::columns::{Columns, FromColumn, FromRow, sql, sql_as};
use engine::job::{CalibrationId, JobId, Lab, MeasurementId, ModelId, Sha256, Timestamp};

/// One page of a list, and whether to go on after it.
#[derive(Debug, Clone)]
pub struct Page<T> {
    /// The items, newest first.
    pub items: Vec<T>,
    pub more: bool,
}

impl<T> Page<T> {
    /// A page of at most `limit` items of up to `limit + 1`.
    pub(super) fn cut(mut items: Vec<T>, limit: u32) -> Self {
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        let more = items.len() > limit;
        items.truncate(limit);
        Self { items, more }
    }
}

/// A resource that the service deleted because its time was over.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expired<Id> {
    pub lab: Lab,
    pub id: Id,
}

impl<Id: FromColumn> FromRow for Expired<Id> {
    fn from_row(row: &SqliteRow) -> Result<Self> {
        Ok(Self { lab: row.read("lab")?, id: row.read("id")? })
    }
}

/// When the things of a list were made.
#[derive(Debug, Clone, Copy, Default)]
pub struct Span {
    /// Only those made at this moment or later.
    pub from: Option<Timestamp>,
    /// Only those made before this moment.
    pub before: Option<Timestamp>,
}

/// Filter of a list of things that belong to calibrations.
#[derive(Debug, Clone, Copy)]
pub struct Filter<Id> {
    pub calibration: Option<CalibrationId>,
    pub created: Span,
    /// Only those older than this one.
    pub after: Option<Id>,
}

impl<Id> Default for Filter<Id> {
    fn default() -> Self {
        Self { calibration: None, created: Span::default(), after: None }
    }
}

/// A reference of a new row.
#[derive(Debug, Clone, Copy)]
pub(super) enum Reference {
    Blob(Sha256),
    Calibration(CalibrationId),
    Measurement(MeasurementId),
    Model(ModelId),
    Job(JobId),
}

const THING: &str = "SELECT 1 FROM requests WHERE id = ? AND facts IS NOT NULL";

/// Refuses a row with a missing reference: it may have been deleted a moment ago. SQLite would refuse it too, but does
/// not say which of its references is broken. The writer's lock keeps others from deleting it afterwards.
pub(super) async fn require(
    connection: &mut SqliteConnection,
    references: &[Reference],
) -> Result<()> {
    for reference in references {
        let (what, query, id) = match reference {
            Reference::Blob(id) => ("blob", "SELECT 1 FROM blobs WHERE sha256 = ?", id.to_string()),
            Reference::Calibration(id) => ("calibration", THING, id.to_string()),
            Reference::Measurement(id) => ("measurement", THING, id.to_string()),
            Reference::Model(id) => ("model", THING, id.to_string()),
            Reference::Job(id) => ("job", "SELECT 1 FROM jobs WHERE id = ?", id.to_string()),
        };
        let found = sql!(query, [id.as_str()]).fetch_optional(&mut *connection).await?;
        found.ok_or(StoreError::NotFound { what, id })?;
    }
    Ok(())
}

/// Refuses to delete what others refer to: kind and identifier of the one, name of the others and
/// the query that counts them as `users`.
pub(super) async fn refuse_if_used(
    connection: &mut SqliteConnection,
    what: &'static str,
    id: String,
    (by, query): (&'static str, &'static str),
) -> Result<()> {
    let users = sql_as!(query, [id]).fetch_one(connection).await?;
    if users > 0 { Err(StoreError::InUse { what, by, users }) } else { Ok(()) }
}
