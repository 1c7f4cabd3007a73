//! Statements, pages, and what rows refer to.

use std::str::FromStr;

use serde::de::DeserializeOwned;
use sqlx::sqlite::SqliteRow;
use sqlx::types::Json;
use sqlx::{Row, SqliteConnection};

use super::error::{Result, StoreError};
use engine::job::{CalibrationId, MeasurementId, ModelId, Sha256, ThingId, Timestamp};

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

/// When the things of a list were made.
#[derive(Debug, Clone, Copy, Default)]
pub struct Span {
    /// Only those made at this moment or later.
    pub from: Option<Timestamp>,
    /// Only those made before this moment.
    pub before: Option<Timestamp>,
}

/// Which things a list holds that belong to calibrations.
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

impl<Id: Into<ThingId>> Filter<Id> {
    /// Drops the kind of the things from the filter.
    pub(super) fn untyped(self) -> Filter<ThingId> {
        let Self { calibration, created, after } = self;
        Filter { calibration, created, after: after.map(Into::into) }
    }
}

/// A statement with the values for its places, in order.
macro_rules! sql {
    ($text:expr, [$($value:expr),* $(,)?]) => { sqlx::query($text)$(.bind($value))* };
}

/// As `sql!`, for rows that are read as a type.
macro_rules! sql_as {
    ($text:expr, [$($value:expr),* $(,)?]) => { sqlx::query_as($text)$(.bind($value))* };
}

/// As `sql!`, for rows of one column.
macro_rules! sql_scalar {
    ($text:expr, [$($value:expr),* $(,)?]) => { sqlx::query_scalar($text)$(.bind($value))* };
}

/// A page of what belongs to calibrations and labs, newest first, with one more item than the page has, by `sql!`
/// or `sql_as!`. The table is followed by WHERE and what else must hold.
macro_rules! listed {
    ($statement:ident, $place:expr, $lab:expr, $filter:expr, $limit:expr) => {
        $statement!(
            sqlx::AssertSqlSafe(format!(
                "SELECT * FROM {} lab = ?1 AND (?2 IS NULL OR id < ?2)
                   AND (?3 IS NULL OR calibration = ?3)
                   AND (?5 IS NULL OR created_at >= ?5) AND (?6 IS NULL OR created_at < ?6)
                 ORDER BY id DESC LIMIT ?4",
                $place
            )),
            [
                $lab,
                $filter.after,
                $filter.calibration,
                i64::from($limit) + 1,
                $filter.created.from,
                $filter.created.before
            ]
        )
    };
}

pub(super) use {listed, sql, sql_as, sql_scalar};

/// The column as a length.
pub(super) fn number(row: &SqliteRow, column: &'static str) -> Result<usize> {
    let value: i64 = row.try_get(column)?;
    value.try_into().map_err(|_| StoreError::Corrupt { column, value: value.to_string() })
}

/// The column as a length, where a row is read as a type.
pub(super) fn length(row: &SqliteRow, column: &'static str) -> sqlx::Result<usize> {
    let value: i64 = row.try_get(column)?;
    let decode = |source| sqlx::Error::ColumnDecode { index: column.into(), source };
    usize::try_from(value).map_err(|error| decode(error.into()))
}

/// The value whose text the column holds; none where it is NULL.
pub(super) fn parsed<T>(row: &SqliteRow, column: &'static str) -> sqlx::Result<Option<T>>
where
    T: FromStr<Err: std::error::Error + Send + Sync + 'static>,
{
    let text: Option<String> = row.try_get(column)?;
    let decode = |source| sqlx::Error::ColumnDecode { index: column.into(), source };
    text.map(|text| text.parse().map_err(|error: T::Err| decode(Box::new(error)))).transpose()
}

/// The column as a list in JSON; an empty one where there is none.
pub(super) fn list<T: DeserializeOwned>(
    row: &SqliteRow,
    column: &str,
) -> Result<Vec<T>, sqlx::Error> {
    Ok(row.try_get::<Option<Json<_>>, _>(column)?.map_or_else(Vec::new, |Json(list)| list))
}

/// A length or count as SQLite keeps it.
pub(super) fn integer(value: impl TryInto<i64>) -> i64 {
    // Every count here is bounded far below this by the limits on uploads.
    value.try_into().unwrap_or(i64::MAX)
}

/// What a new row refers to.
#[derive(Debug, Clone, Copy)]
pub(super) enum Reference {
    Blob(Sha256),
    Calibration(CalibrationId),
    Measurement(MeasurementId),
    Model(ModelId),
}

/// Refuses a row that refers to what is not there: it may have been deleted a moment ago. SQLite
/// would refuse it too, but does not say which of its references is broken. With the writer's lock
/// held, what is there stays there.
pub(super) async fn require(
    connection: &mut SqliteConnection,
    references: &[Reference],
) -> Result<()> {
    for reference in references {
        let (what, query, id) = match reference {
            Reference::Blob(id) => ("blob", "SELECT 1 FROM blobs WHERE sha256 = ?", id.to_string()),
            Reference::Calibration(id) => {
                ("calibration", "SELECT 1 FROM calibrations WHERE id = ?", id.to_string())
            }
            Reference::Measurement(id) => {
                ("measurement", "SELECT 1 FROM measurements WHERE id = ?", id.to_string())
            }
            Reference::Model(id) => ("model", "SELECT 1 FROM models WHERE id = ?", id.to_string()),
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
    (what, id): (&'static str, String),
    (by, query): (&'static str, &'static str),
) -> Result<()> {
    let users = sql_scalar!(query, [id]).fetch_one(connection).await?;
    if users > 0 { Err(StoreError::InUse { what, by, users }) } else { Ok(()) }
}
