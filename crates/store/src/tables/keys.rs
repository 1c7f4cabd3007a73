//! Table `request_keys`: idempotency keys. A request that is repeated with its key creates nothing new.

use std::fmt::Display;
use std::str::FromStr;

use sqlx::SqliteConnection;
use strum::IntoStaticStr;

use crate::Store;
use crate::columns::{sql, sql_as};
use crate::error::{Result, StoreError};
use engine::job::{InvalidId, JobId, Lab, Sha256};

/// The kind of resource that a key creates, named as in the column `what`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr)]
#[strum(serialize_all = "lowercase", const_into_str)]
pub enum ResourceKind {
    Calibration,
    Job,
    Measurement,
    Model,
    Upload,
}

/// A user's key against creating a resource twice, and the hash of the request that came with it.
#[derive(Debug, Clone)]
pub struct RequestKey {
    pub key: String,
    pub request: Sha256,
}

/// What became of something new.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Inserted<Id = JobId> {
    New(Id),
    /// The same request with the same key was accepted before.
    Before(Id),
}

impl<Id> Inserted<Id> {
    pub fn id(self) -> Id {
        match self {
            Self::New(id) | Self::Before(id) => id,
        }
    }
}

impl Store {
    /// The resource of this kind that the lab made with this key, if it made one and it is still there.
    /// Errors: [`StoreError::KeyReused`] if it asked for another one with it.
    pub async fn created_with<Id>(
        &self,
        lab: &Lab,
        what: ResourceKind,
        key: Option<&RequestKey>,
    ) -> Result<Option<Id>>
    where
        Id: FromStr<Err = InvalidId>,
    {
        let mut connection = self.readers.acquire().await?;
        found(&mut connection, lab, what, key).await
    }
}

/// As [`Store::created_with`].
pub async fn found<Id>(
    connection: &mut SqliteConnection,
    lab: &Lab,
    what: ResourceKind,
    key: Option<&RequestKey>,
) -> Result<Option<Id>>
where
    Id: FromStr<Err = InvalidId>,
{
    let Some(RequestKey { key, request }) = key else { return Ok(None) };
    let row: Option<(String, Sha256)> = sql_as!(
        "SELECT id, request FROM request_keys WHERE lab = ? AND what = ? AND key = ?",
        [lab, what.into_str(), key]
    )
    .fetch_optional(connection)
    .await?;
    let Some((id, asked)) = row else { return Ok(None) };
    if asked != *request {
        return Err(StoreError::KeyReused { key: key.clone(), what: what.into_str(), id });
    }
    match id.parse() {
        Ok(id) => Ok(Some(id)),
        Err(_) => Err(StoreError::Corrupt { column: "id", value: id }),
    }
}

/// Notes what a key has made.
pub async fn insert(
    connection: &mut SqliteConnection,
    lab: &Lab,
    what: ResourceKind,
    key: Option<&RequestKey>,
    id: impl Display,
) -> Result<()> {
    let Some(RequestKey { key, request }) = key else { return Ok(()) };
    sql!(
        "INSERT INTO request_keys (lab, what, key, request, id) VALUES (?, ?, ?, ?, ?)",
        [lab, what.into_str(), key, request, id.to_string()]
    )
    .execute(connection)
    .await?;
    Ok(())
}
