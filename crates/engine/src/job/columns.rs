//! How identifiers, states and times lie in columns of SQLite. Here and not in the store, since only
//! the crate of a type may say how a foreign crate sees it.

use sqlx::encode::IsNull;
use sqlx::error::BoxDynError;
use sqlx::sqlite::{Sqlite, SqliteArgumentsBuffer, SqliteTypeInfo, SqliteValueRef};
use sqlx::{Decode, Encode, Type};

use super::{
    CalibrationId, JobId, JobState, Lab, Label, MeasurementId, ModelId, PartialId, Role, Sequence,
    Sha256, TaskId, TaskStage, TaskState, ThingId, Timestamp, TokenId, WorkerId,
};

/// How a type lies in a column: as another one, and how it becomes that one and is read of it.
macro_rules! column {
    ($($type:ty),* as $other:ty, $write:expr, $read:expr) => {$(
        impl Type<Sqlite> for $type {
            fn type_info() -> SqliteTypeInfo {
                <$other as Type<Sqlite>>::type_info()
            }

            fn compatible(found: &SqliteTypeInfo) -> bool {
                <$other as Type<Sqlite>>::compatible(found)
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

column!(Timestamp as i64, |time| time.0, |millis| Ok(Timestamp(millis)));
column!(
    Sha256,
    Lab,
    Label,
    Role,
    CalibrationId,
    MeasurementId,
    ModelId,
    JobId,
    ThingId,
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
