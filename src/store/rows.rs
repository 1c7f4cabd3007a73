//! From columns to types, with an error that names the column; pages; and what rows refer to.

use std::fmt::Display;
use std::str::FromStr;

use serde::Serialize;
use serde::de::DeserializeOwned;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::error::StoreError;
use crate::job::{CalibrationId, MeasurementId, ModelId, Sha256};

/// One page of a list, and whether to go on after it.
#[derive(Debug, Clone)]
pub struct Page<T> {
    /// The items, newest first.
    pub items: Vec<T>,
    /// True if there are more.
    pub more: bool,
}

impl<T> Page<T> {
    /// A page of at most `limit` items from up to `limit + 1` rows.
    pub(super) fn cut(
        rows: &[SqliteRow],
        limit: u32,
        read: impl Fn(&SqliteRow) -> Result<T, StoreError>,
    ) -> Result<Self, StoreError> {
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        let items = rows.iter().take(limit).map(read).collect::<Result<_, _>>()?;
        Ok(Self { items, more: rows.len() > limit })
    }
}

/// The column as text, parsed.
pub(super) fn parsed<T: FromStr>(row: &SqliteRow, column: &'static str) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    value.parse().map_err(|_| StoreError::Corrupt { column, value })
}

/// As [`parsed`], for a column that may be empty.
pub(super) fn parsed_if<T: FromStr>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<Option<T>, StoreError> {
    let value: Option<String> = row.try_get(column)?;
    let parse = |value: String| value.parse().map_err(|_| StoreError::Corrupt { column, value });
    value.map(parse).transpose()
}

/// The column as a whole number of another type.
pub(super) fn number<T: TryFrom<i64>>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<T, StoreError> {
    let value: i64 = row.try_get(column)?;
    value.try_into().map_err(|_| corrupt(column, value))
}

/// As [`number`], for a column that may be empty.
pub(super) fn number_if<T: TryFrom<i64>>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<Option<T>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.map(|value| value.try_into().map_err(|_| corrupt(column, value))).transpose()
}

/// The column as a number of the precision that arrays have.
#[allow(clippy::cast_possible_truncation)] // it was an f32 when it was stored
pub(super) fn single(row: &SqliteRow, column: &'static str) -> Result<f32, StoreError> {
    Ok(row.try_get::<f64, _>(column)? as f32)
}

/// The column as JSON of a type.
pub(super) fn json<T: DeserializeOwned>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    serde_json::from_str(&value).map_err(|_| StoreError::Corrupt { column, value })
}

/// As [`json`], for a column that may be empty.
pub(super) fn json_if<T: DeserializeOwned>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<Option<T>, StoreError> {
    let value: Option<String> = row.try_get(column)?;
    value.map(|_| json(row, column)).transpose()
}

/// A value as a column of JSON.
pub(super) fn to_json(column: &'static str, value: &impl Serialize) -> Result<String, StoreError> {
    serde_json::to_string(value).map_err(|error| corrupt(column, error))
}

fn corrupt(column: &'static str, value: impl Display) -> StoreError {
    StoreError::Corrupt { column, value: value.to_string() }
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
) -> Result<(), StoreError> {
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
        let found = sqlx::query(query).bind(&id).fetch_optional(&mut *connection).await?;
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
) -> Result<(), StoreError> {
    let row = sqlx::query(query).bind(id).fetch_one(connection).await?;
    let users = number(&row, "users")?;
    if users > 0 { Err(StoreError::InUse { what, by, users }) } else { Ok(()) }
}
