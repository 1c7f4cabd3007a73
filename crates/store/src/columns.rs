//! Statements and their values: how the types of `engine` are stored in columns of SQLite.
//!
//! The orphan rule keeps a crate from implementing sqlx's traits for another crate's types. [`ToColumn`]
//! and [`FromColumn`] are local, so `engine` needs no database.

use std::fmt::{self, Display};
use std::marker::PhantomData;

use engine::job::{
    CalibrationId, JobId, JobState, Lab, Label, MeasurementId, ModelId, Mosaic, PartialId,
    ResourceId, Role, Sequence, Sha256, TaskId, TaskStage, TaskState, Timestamp, TokenId, WorkerId,
};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sqlx::query::Query;
use sqlx::sqlite::{
    Sqlite, SqliteArguments, SqliteExecutor, SqliteQueryResult, SqliteRow, SqliteValueRef,
};
use sqlx::{Decode, Row, TypeInfo, ValueRef};

use crate::error::{Result, StoreError};

/// A value as SQLite stores it.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Null,
    Integer(i64),
    Real(f64),
    Text(String),
    Bytes(Vec<u8>),
}

impl Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Null => f.write_str("NULL"),
            Self::Integer(value) => value.fmt(f),
            Self::Real(value) => value.fmt(f),
            Self::Text(value) => f.write_str(value),
            Self::Bytes(value) => write!(f, "{} bytes", value.len()),
        }
    }
}

impl Value {
    fn read(value: SqliteValueRef<'_>) -> Result<Self> {
        let decoded = match value.type_info().name() {
            _ if value.is_null() => return Ok(Self::Null),
            "REAL" => Decode::<Sqlite>::decode(value).map(Self::Real),
            "TEXT" => Decode::<Sqlite>::decode(value).map(Self::Text),
            "BLOB" => Decode::<Sqlite>::decode(value).map(Self::Bytes),
            _ => Decode::<Sqlite>::decode(value).map(Self::Integer),
        };
        decoded.map_err(|error| sqlx::Error::Decode(error).into())
    }
}

/// A type that can be bound to a statement.
pub trait ToColumn {
    /// # Errors
    /// If the value has no JSON.
    fn to_column(&self) -> Result<Value>;
}

/// A type that can be read from a column.
pub trait FromColumn: Sized {
    /// # Errors
    /// The value, if it is none of this type.
    fn from_column(value: Value) -> Result<Self, Value>;
}

impl<T: ToColumn + ?Sized> ToColumn for &T {
    fn to_column(&self) -> Result<Value> {
        (**self).to_column()
    }
}

impl<T: ToColumn> ToColumn for Option<T> {
    fn to_column(&self) -> Result<Value> {
        self.as_ref().map_or(Ok(Value::Null), ToColumn::to_column)
    }
}

impl<T: FromColumn> FromColumn for Option<T> {
    fn from_column(value: Value) -> Result<Self, Value> {
        if value == Value::Null { Ok(None) } else { T::from_column(value).map(Some) }
    }
}

impl ToColumn for str {
    fn to_column(&self) -> Result<Value> {
        Ok(Value::Text(self.to_owned()))
    }
}

impl ToColumn for bool {
    fn to_column(&self) -> Result<Value> {
        Ok(Value::Integer(i64::from(*self)))
    }
}

impl FromColumn for bool {
    fn from_column(value: Value) -> Result<Self, Value> {
        if let Value::Integer(number @ 0..=1) = value { Ok(number == 1) } else { Err(value) }
    }
}

/// Types that are one of SQLite's.
macro_rules! stored {
    ($($type:ty as $variant:ident),* $(,)?) => {$(
        impl ToColumn for $type {
            fn to_column(&self) -> Result<Value> {
                Ok(Value::$variant(self.clone()))
            }
        }
        impl FromColumn for $type {
            fn from_column(value: Value) -> Result<Self, Value> {
                if let Value::$variant(value) = value { Ok(value) } else { Err(value) }
            }
        }
    )*};
}

stored!(String as Text, Vec<u8> as Bytes);

/// Integers. SQLite has none above `i64::MAX`; the limits on uploads keep counts far below it.
macro_rules! integers {
    ($($type:ty),*) => {$(
        impl ToColumn for $type {
            fn to_column(&self) -> Result<Value> {
                Ok(Value::Integer((*self).try_into().unwrap_or(i64::MAX)))
            }
        }
        impl FromColumn for $type {
            fn from_column(value: Value) -> Result<Self, Value> {
                let Value::Integer(number) = value else { return Err(value) };
                number.try_into().map_err(|_| value)
            }
        }
    )*};
}

integers!(i32, u32, i64, u64, usize);

/// Real numbers. A sum may also come as an integer.
macro_rules! reals {
    ($($type:ty),*) => {$(
        impl ToColumn for $type {
            fn to_column(&self) -> Result<Value> {
                Ok(Value::Real((*self).into()))
            }
        }
        impl FromColumn for $type {
            #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
            fn from_column(value: Value) -> Result<Self, Value> {
                match value {
                    Value::Real(number) => Ok(number as $type),
                    Value::Integer(number) => Ok(number as $type),
                    other => Err(other),
                }
            }
        }
    )*};
}

reals!(f32, f64);

/// Types that are stored as their text.
macro_rules! texts {
    ($($type:ty),* $(,)?) => {$(
        impl ToColumn for $type {
            fn to_column(&self) -> Result<Value> {
                Ok(Value::Text(self.to_string()))
            }
        }
        impl FromColumn for $type {
            fn from_column(value: Value) -> Result<Self, Value> {
                let Value::Text(text) = value else { return Err(value) };
                text.parse().map_err(|_| Value::Text(text))
            }
        }
    )*};
}

texts!(
    Sha256,
    Lab,
    Label,
    Role,
    CalibrationId,
    MeasurementId,
    ModelId,
    ResourceId,
    JobId,
    TaskId,
    PartialId,
    TokenId,
    WorkerId,
    JobState,
    TaskState,
    TaskStage,
    Sequence,
    Mosaic,
);

impl ToColumn for Timestamp {
    fn to_column(&self) -> Result<Value> {
        Ok(Value::Integer(self.0))
    }
}

impl FromColumn for Timestamp {
    fn from_column(value: Value) -> Result<Self, Value> {
        i64::from_column(value).map(Self)
    }
}

/// A value that is stored as JSON.
#[derive(Debug, Clone, PartialEq)]
pub struct Json<T>(pub T);

impl<T: Serialize> ToColumn for Json<T> {
    fn to_column(&self) -> Result<Value> {
        let text = serde_json::to_string(&self.0);
        Ok(Value::Text(text.map_err(|error| sqlx::Error::Encode(error.into()))?))
    }
}

impl<T: DeserializeOwned> FromColumn for Json<T> {
    fn from_column(value: Value) -> Result<Self, Value> {
        let Value::Text(text) = &value else { return Err(value) };
        serde_json::from_str(text)
            .map(Self)
            .map_err(|error| Value::Text(format!("{text} ({error})")))
    }
}

/// Reads columns of a row.
pub trait Columns {
    /// The column of this name.
    /// Errors: [`StoreError::Corrupt`] if its value is none of this type.
    fn read<T: FromColumn>(&self, column: &'static str) -> Result<T>;

    /// The column as JSON; none where it is NULL.
    fn read_json<T: DeserializeOwned>(&self, column: &'static str) -> Result<Option<T>> {
        Ok(self.read::<Option<Json<T>>>(column)?.map(|json| json.0))
    }
}

impl Columns for SqliteRow {
    fn read<T: FromColumn>(&self, column: &'static str) -> Result<T> {
        cell(self, column, column)
    }
}

fn cell<T: FromColumn>(
    row: &SqliteRow,
    index: impl sqlx::ColumnIndex<SqliteRow>,
    column: &'static str,
) -> Result<T> {
    let value = Value::read(row.try_get_raw(index)?)?;
    T::from_column(value).map_err(|value| StoreError::Corrupt { column, value: value.to_string() })
}

/// A type that can be read from the columns of a row, by name.
pub trait FromRow: Sized {
    /// # Errors
    /// [`StoreError::Corrupt`]
    fn from_row(row: &SqliteRow) -> Result<Self>;
}

impl<T: FromColumn> FromRow for T {
    fn from_row(row: &SqliteRow) -> Result<Self> {
        cell(row, 0, "the only column")
    }
}

/// Tuples are read by position.
macro_rules! tuples {
    ($(($($type:ident $index:tt),*))*) => {$(
        impl<$($type: FromColumn),*> FromRow for ($($type,)*) {
            fn from_row(row: &SqliteRow) -> Result<Self> {
                Ok(($(cell(row, $index, concat!("column ", $index))?,)*))
            }
        }
    )*};
}

tuples! {
    (A 0, B 1)
    (A 0, B 1, C 2)
    (A 0, B 1, C 2, D 3)
    (A 0, B 1, C 2, D 3, E 4)
    (A 0, B 1, C 2, D 3, E 4, F 5)
}

/// Implements [`FromRow`] for a struct: each field is the column of the same name, or the expression after `=`.
macro_rules! from_row {
    (@ $row:ident $field:ident) => { $row.read(stringify!($field))? };
    (@ $row:ident $field:ident $read:expr) => { $read };
    ($type:ty, $row:ident => { $($field:ident $(= $read:expr)?),* $(,)? }) => {
        impl $crate::columns::FromRow for $type {
            fn from_row($row: &sqlx::sqlite::SqliteRow) -> $crate::error::Result<Self> {
                use $crate::columns::Columns as _;
                Ok(Self { $($field: $crate::columns::from_row!(@ $row $field $($read)?)),* })
            }
        }
    };
}

/// The result type of a statement: a whole row, or a type that is read from it.
pub trait Yield: Sized {
    /// # Errors
    /// [`StoreError::Corrupt`]
    fn read(row: SqliteRow) -> Result<Self>;
}

impl Yield for SqliteRow {
    fn read(row: SqliteRow) -> Result<Self> {
        Ok(row)
    }
}

impl<T: FromRow> Yield for T {
    fn read(row: SqliteRow) -> Result<Self> {
        T::from_row(&row)
    }
}

/// A statement with its values. The text is constant, so that a test can prepare all of them.
pub struct Statement<T = SqliteRow> {
    query: Result<Query<'static, Sqlite, SqliteArguments>>,
    yields: PhantomData<fn() -> T>,
}

impl<T> Statement<T> {
    pub fn new(text: &'static str) -> Self {
        Self { query: Ok(sqlx::query(text)), yields: PhantomData }
    }

    #[must_use]
    pub fn bind(self, value: &impl ToColumn) -> Self {
        let bound = self.query.and_then(|query| {
            Ok(match value.to_column()? {
                Value::Null => query.bind(None::<i64>),
                Value::Integer(value) => query.bind(value),
                Value::Real(value) => query.bind(value),
                Value::Text(value) => query.bind(value),
                Value::Bytes(value) => query.bind(value),
            })
        });
        Self { query: bound, yields: PhantomData }
    }
}

impl<T: Yield> Statement<T> {
    pub async fn execute<'e>(self, executor: impl SqliteExecutor<'e>) -> Result<SqliteQueryResult> {
        Ok(self.query?.execute(executor).await?)
    }

    pub async fn fetch_all<'e>(self, executor: impl SqliteExecutor<'e>) -> Result<Vec<T>> {
        self.query?.fetch_all(executor).await?.into_iter().map(T::read).collect()
    }

    pub async fn fetch_one<'e>(self, executor: impl SqliteExecutor<'e>) -> Result<T> {
        T::read(self.query?.fetch_one(executor).await?)
    }

    pub async fn fetch_optional<'e>(self, executor: impl SqliteExecutor<'e>) -> Result<Option<T>> {
        self.query?.fetch_optional(executor).await?.map(T::read).transpose()
    }
}

/// A statement with the values for its places, in order, which is executed or yields rows.
macro_rules! sql {
    ($text:expr $(,)?) => { $crate::columns::Statement::<sqlx::sqlite::SqliteRow>::new($text) };
    ($text:expr, [$($value:expr),* $(,)?]) => { $crate::columns::sql!($text)$(.bind(&$value))* };
}

/// As `sql!`, for a statement that yields values of a type.
macro_rules! sql_as {
    ($text:expr $(,)?) => { $crate::columns::Statement::new($text) };
    ($text:expr, [$($value:expr),* $(,)?]) => { $crate::columns::sql_as!($text)$(.bind(&$value))* };
}

pub(crate) use {from_row, sql, sql_as};
