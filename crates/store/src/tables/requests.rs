//! Table `requests`: calibrations, measurements and models as labs asked for them.
//!
//! A request stands here for as long as the resource that it asked for, ready or not. Tasks of the queue fulfil it: a
//! check of its uploads, and, for a calibration, one that makes masks or a report. The resource's facts are added once they
//! are known; see `resources.rs`.

use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, FromRow, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Reference, require};
use crate::tables::keys::ResourceKind;
use engine::intake::Refusal;
use engine::job::{
    CheckLimits, Lab, Label, ResourceId, Sha256, Submission, TaskState, Timestamp, TokenId,
};

/// A request with its progress.
#[derive(Debug, Clone)]
pub struct Request {
    /// Identifier of the calibration, measurement or model.
    pub id: ResourceId,
    pub lab: Lab,
    pub token: Option<TokenId>,
    pub name: Option<Label>,
    pub submission: Submission,
    /// Identifier of the HTTP request.
    pub origin: Option<String>,
    /// Why nothing is made; none while there is hope.
    pub refusal: Option<Refusal>,
    pub created_at: Timestamp,
    /// Share of the work of its latest task that is done, on \[0,1\].
    pub fraction: f64,
}

impl ResourceKind {
    /// The kind of resource that a submission makes.
    pub fn of(submission: &Submission) -> Self {
        match submission {
            Submission::Calibration(_) => Self::Calibration,
            Submission::Measurement(_) => Self::Measurement,
            Submission::Model(_) => Self::Model,
        }
    }
}

impl FromRow for Request {
    fn from_row(row: &SqliteRow) -> Result<Self> {
        let text: String = row.read("request")?;
        // The column `what` holds the variant, because lists are filtered by it.
        let submission = match row.read::<String>("what")?.as_str() {
            "calibration" => serde_json::from_str(&text).map(Submission::Calibration),
            "measurement" => serde_json::from_str(&text).map(Submission::Measurement),
            _ => serde_json::from_str(&text).map(Submission::Model),
        };
        let decode = |error: serde_json::Error| StoreError::Corrupt {
            column: "request",
            value: format!("{text} ({error})"),
        };
        Ok(Self {
            id: row.read("id")?,
            lab: row.read("lab")?,
            token: row.read("token")?,
            name: row.read("name")?,
            submission: submission.map_err(decode)?,
            origin: row.read("origin")?,
            refusal: row.read_json("refusal")?,
            created_at: row.read("created_at")?,
            fraction: row.read::<Option<f64>>("fraction")?.unwrap_or_default(),
        })
    }
}

/// Requests with the progress of their latest tasks, to be followed by a condition.
macro_rules! requests {
    () => {
        "(SELECT *, (SELECT fraction FROM tasks WHERE thing = requests.id
                     ORDER BY ordinal DESC LIMIT 1) AS fraction FROM requests)"
    };
}

pub(super) use requests;

impl Store {
    /// The lab's request for this resource; none if there is none.
    pub async fn find_request(
        &self,
        lab: &Lab,
        id: impl Into<ResourceId>,
    ) -> Result<Option<Request>> {
        let request = concat!("SELECT * FROM ", requests!(), " WHERE id = ? AND lab = ?");
        let request = sql_as!(request, [id.into(), lab]);
        request.fetch_optional(&self.readers).await
    }

    /// True if the uploads of a request are checked, or the request was deleted.
    pub async fn is_checked(&self, id: impl Into<ResourceId>) -> Result<bool> {
        let check = "SELECT 1 FROM tasks WHERE thing = ? AND kind = 'check' AND state IN (?, ?)";
        let check = sql!(check, [id.into(), TaskState::Ready, TaskState::Running]);
        Ok(check.fetch_optional(&self.readers).await?.is_none())
    }

    /// True if a request is fulfilled, refused or deleted.
    pub async fn is_settled(&self, lab: &Lab, id: impl Into<ResourceId>) -> Result<bool> {
        let pending = "SELECT 1 FROM requests
                       WHERE id = ?1 AND lab = ?2 AND refusal IS NULL AND facts IS NULL";
        let pending = sql!(pending, [id.into(), lab]);
        Ok(pending.fetch_optional(&self.readers).await?.is_none())
    }

    /// Removes a request that its check refused. False if there is no such request, as of captures that passed the
    /// check and could not be used.
    pub async fn drop_refused(&self, id: impl Into<ResourceId>) -> Result<bool> {
        let dropped = "DELETE FROM requests WHERE id = ?1 AND refusal IS NOT NULL
                       AND NOT EXISTS (SELECT 1 FROM tasks WHERE thing = ?1 AND kind = 'calibration')";
        let dropped = sql!(dropped, [id.into()]).execute(self.writer()?).await?;
        Ok(dropped.rows_affected() > 0)
    }
}

/// Records a request, with the uploads that it needs. Returns their size in bytes.
/// Errors: [`StoreError::NotFound`] if an upload, the calibration or the job was deleted.
pub async fn insert(
    connection: &mut SqliteConnection,
    lab: &Lab,
    token: Option<TokenId>,
    id: ResourceId,
    (submission, limits, origin): (&Submission, &CheckLimits, Option<&str>),
) -> Result<u64> {
    let calibration = submission.calibration();
    let job = submission.registration_of().map(Reference::Job);
    let references: Vec<_> =
        calibration.map(Reference::Calibration).into_iter().chain(job).collect();
    require(connection, &references).await?;
    let text = match submission {
        Submission::Calibration(request) => serde_json::to_string(request),
        Submission::Measurement(request) => serde_json::to_string(request),
        Submission::Model(request) => serde_json::to_string(request),
    };
    let text =
        text.map_err(|error| StoreError::Corrupt { column: "request", value: error.to_string() })?;
    sql!(
        "INSERT INTO requests (id, what, lab, token, name, calibration, request, limits, origin, created_at)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            id,
            ResourceKind::of(submission).into_str(),
            lab,
            token,
            submission.name(),
            calibration,
            text,
            Json(limits),
            origin,
            Timestamp::now()
        ]
    )
    .execute(&mut *connection)
    .await?;
    for (_, file) in submission.uploads() {
        require(connection, &[Reference::Blob(file)]).await?;
        let files = "INSERT INTO request_files (id, sha256) VALUES (?, ?) ON CONFLICT DO NOTHING";
        sql!(files, [id, file]).execute(&mut *connection).await?;
    }
    let size =
        "SELECT coalesce(sum(size), 0) FROM request_files JOIN blobs USING (sha256) WHERE id = ?";
    sql_as!(size, [id]).fetch_one(connection).await
}

/// The request for this resource, whoever made it.
pub async fn find(connection: &mut SqliteConnection, id: ResourceId) -> Result<Request> {
    let request = sql_as!(concat!("SELECT * FROM ", requests!(), " WHERE id = ?"), [id]);
    let request = request.fetch_optional(connection).await?;
    request.ok_or_else(|| StoreError::missing("request", id))
}

/// The limits of a request's check.
pub async fn limits(connection: &mut SqliteConnection, id: ResourceId) -> Result<CheckLimits> {
    let limits = sql_as!("SELECT limits FROM requests WHERE id = ?", [id]);
    let Json(limits) = limits.fetch_one(connection).await?;
    Ok(limits)
}

/// Reserves disk space for the product of a request, until its row is written or the request is refused.
pub async fn promise(connection: &mut SqliteConnection, id: ResourceId, bytes: u64) -> Result<()> {
    sql!("UPDATE requests SET prepared_bytes = ? WHERE id = ?", [bytes, id])
        .execute(connection)
        .await?;
    Ok(())
}

/// Ends what a request held for being fulfilled: its promise, and its uploads except `kept`.
pub async fn fulfil(
    connection: &mut SqliteConnection,
    id: ResourceId,
    kept: &[Sha256],
) -> Result<()> {
    promise(connection, id, 0).await?;
    let unused = "DELETE FROM request_files
                  WHERE id = ? AND sha256 NOT IN (SELECT value FROM json_each(?))";
    sql!(unused, [id, Json(kept)]).execute(connection).await?;
    Ok(())
}

/// Records why nothing is made of a request. Its key is free again, as after any refusal. A calibration that has masks
/// and lacks its report stays unchanged.
pub async fn refuse(
    connection: &mut SqliteConnection,
    id: ResourceId,
    refusal: &Refusal,
) -> Result<()> {
    let refused =
        sql!("UPDATE requests SET refusal = ? WHERE id = ? AND facts IS NULL", [Json(refusal), id]);
    if refused.execute(&mut *connection).await?.rows_affected() > 0 {
        sql!("DELETE FROM request_keys WHERE id = ?", [id]).execute(&mut *connection).await?;
        fulfil(connection, id, &[]).await?;
    }
    Ok(())
}
