//! From columns to types, with an error that names the column.

use std::fmt::Display;
use std::str::FromStr;

use serde::de::DeserializeOwned;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::error::StoreError;

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

fn corrupt(column: &'static str, value: impl Display) -> StoreError {
    StoreError::Corrupt { column, value: value.to_string() }
}

/// A length or count as SQLite keeps it.
pub(super) fn integer(value: impl TryInto<i64>) -> i64 {
    // Every count here is bounded far below this by the limits on uploads.
    value.try_into().unwrap_or(i64::MAX)
}
