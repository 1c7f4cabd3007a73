//! Storage of identifiers, states and times in SQLite columns.
//!
//! These trait implementations must be in this crate, because neither the traits nor the types belong to the store.

use sqlx::encode::IsNull;
use sqlx::error::BoxDynError;
use sqlx::sqlite::{Sqlite, SqliteArgumentsBuffer, SqliteTypeInfo, SqliteValueRef};
use sqlx::{Decode, Encode, Type};

use super::{
    CalibrationId, JobId, JobState, Lab, Label, MeasurementId, ModelId, PartialId, Role, Sequence,
    Sha256, TaskId, TaskStage, TaskState, Timestamp, TokenId, WorkerId,
};

/// Stores types in a column of type `$other`, with conversions in both directions.
macro_rules! column {
    ($($type:ty),* as $other:ty, $write:expr, $read:expr) => {$(
        impl Type<Sqlite> for $type {
            fn type_info() -> SqliteTypeInfo {
                <$other as Type<Sqlite>>::type_info()
            }

            fn compatible(stored: &SqliteTypeInfo) -> bool {
                <$other as Type<Sqlite>>::compatible(stored)
            }
        }

        impl Encode<'_, Sqlite> for $type {
            fn encode_by_ref(&self, to: &mut SqliteArgumentsBuffer) -> Result<IsNull, BoxDynError> {
                let write: fn(&Self) -> $other = $write;
                write(self).encode(to)
            }
        }

        impl Decode<'_, Sqlite> for $type {
            fn decode(value: SqliteValueRef<'_>) -> Result<Self, BoxDynError> {
                let read: fn($other) -> Result<Self, BoxDynError> = $read;
                read(Decode::<Sqlite>::decode(value)?)
            }
        }
    )*};
}

column!(Timestamp as i64, |time| time.0, |milliseconds| Ok(Timestamp(milliseconds)));
column!(
    Sha256,
    Lab,
    Label,
    Role,
    CalibrationId,
    MeasurementId,
    ModelId,
    JobId,
    TaskId,
    PartialId,
    TokenId,
    WorkerId,
    JobState,
    TaskState,
    TaskStage,
    Sequence as String,
    ToString::to_string,
    |text| Ok(text.parse()?)
);
