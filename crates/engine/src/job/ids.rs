//! Identifiers: one type per kind of resource. All are version 7 UUIDs, so they sort by creation time.

use std::str::FromStr;

use derive_more::Display;
use serde_with::{DeserializeFromStr, SerializeDisplay};
use uuid::Uuid;

use super::text::text_schema;

/// A text is not an identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not an identifier; identifiers are lower-case UUIDs with hyphens")]
pub struct InvalidId {
    /// The beginning of the text, at most 60 characters.
    pub text: String,
}

macro_rules! identifiers {
    ($($(#[$doc:meta])* $name:ident,)*) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[derive(Display, SerializeDisplay, DeserializeFromStr)]
        pub struct $name(Uuid);

        impl $name {
            /// A new identifier, greater than all earlier ones of this process.
            #[allow(clippy::new_without_default)] // each call returns a different value
            pub fn new() -> Self {
                Self(Uuid::now_v7())
            }
        }

        text_schema!($name, "Id", {
            "type": "string",
            "description": "A UUID in lower case with hyphens.",
            "pattern": "^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$",
            "example": "019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d",
        });

        impl FromStr for $name {
            type Err = InvalidId;

            fn from_str(text: &str) -> Result<Self, InvalidId> {
                // Only the canonical spelling, so that each resource has one address.
                Uuid::parse_str(text)
                    .ok()
                    .filter(|id| id.as_hyphenated().to_string() == text)
                    .map(Self)
                    .ok_or_else(|| InvalidId { text: text.chars().take(60).collect() })
            }
        }
    )*};
}

/// Converts the identifiers of resources to and from [`ResourceId`].
macro_rules! resource_ids {
    ($($name:ident),*) => {$(
        impl From<$name> for ResourceId {
            fn from(id: $name) -> Self {
                Self(id.0)
            }
        }

        impl From<ResourceId> for $name {
            fn from(id: ResourceId) -> Self {
                Self(id.0)
            }
        }
    )*};
}

resource_ids!(CalibrationId, MeasurementId, ModelId, JobId);

identifiers! {
    /// The calibration, measurement, model or job that a task creates, or for which it creates something.
    ResourceId,
    /// A calibration: the masks of one optical setting.
    CalibrationId,
    /// A measurement: one or more snapshots taken with one calibration.
    MeasurementId,
    /// A model: an end-to-end network registered for a calibration.
    ModelId,
    /// A job: the reconstruction of some snapshots of one measurement.
    JobId,
    /// A task: a unit of work of one worker.
    TaskId,
    /// A resumable upload that is not complete.
    PartialId,
    /// A token. This is not its secret.
    TokenId,
    /// A worker process.
    WorkerId,
}

#[cfg(test)]
mod tests {
    use super::JobId;

    #[test]
    fn ids_print_parse_and_sort_by_time() {
        let ids: Vec<JobId> = (0..100).map(|_| JobId::new()).collect();
        assert!(ids.is_sorted());
        assert_eq!(ids[3].to_string().parse::<JobId>().unwrap(), ids[3]);
    }

    #[test]
    fn only_the_canonical_spelling_is_accepted() {
        let id = JobId::new().to_string();
        for bad in [id.to_uppercase(), id.replace('-', ""), format!("{{{id}}}"), String::new()] {
            assert!(bad.parse::<JobId>().is_err(), "{bad}");
        }
    }
}
