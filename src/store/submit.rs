//! Table `jobs`: accepting a job, once, if there is a place for it.

use sqlx::SqliteConnection;

use super::Store;
use super::error::StoreError;
use super::queue::graph;
use super::rows::{integer, number, parsed};
use crate::job::{JobId, JobSpec, Lab, Label, Sha256, Timestamp};

/// A job to be accepted.
#[derive(Debug, Clone)]
pub struct NewJob {
    /// So many jobs may wait and run, with this one.
    pub most_jobs: u64,
    /// Whose it is.
    pub lab: Lab,
    /// What is to be done.
    pub spec: JobSpec,
    /// The hash of the request as it was sent.
    pub request: Sha256,
    /// The user's key against double submission.
    pub idempotency_key: Option<String>,
}

/// What became of a [`NewJob`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Inserted {
    /// It was accepted.
    New(JobId),
    /// The same request with the same key was accepted before.
    Before(JobId),
}

impl Store {
    /// Accepts a job: the job and its tasks, or nothing.
    ///
    /// # Errors
    /// [`StoreError::KeyReused`]; [`StoreError::QueueFull`]; [`StoreError::NotFound`] if the
    /// measurement or the model is gone.
    pub async fn add_job(&self, new: NewJob) -> Result<Inserted, StoreError> {
        let mut transaction = self.write().await?;
        if let Some(key) = &new.idempotency_key
            && let Some(job) = with_key(&mut transaction, &new.lab, key, new.request).await?
        {
            return Ok(Inserted::Before(job));
        }
        check_queue(&mut transaction, new.most_jobs).await?;
        let id = JobId::new();
        let disk_bytes = integer(new.spec.disk_bytes());
        let spec = serde_json::to_string(&new.spec)
            .map_err(|error| StoreError::Corrupt { column: "spec", value: error.to_string() })?;
        sqlx::query(
            "INSERT INTO jobs (id, calibration, measurement, label, spec, state, priority,
                 idempotency_key, request, created_at, lab, disk_bytes, model)
             VALUES (?, ?, ?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?, ?)",
        )
        .bind(id.to_string())
        .bind(new.spec.calibration.to_string())
        .bind(new.spec.measurement.to_string())
        .bind(new.spec.label.as_ref().map(Label::as_str))
        .bind(spec)
        .bind(new.spec.priority)
        .bind(new.idempotency_key.as_ref().map(|key| key_of(&new.lab, key)))
        .bind(new.request.to_string())
        .bind(Timestamp::now().0)
        .bind(new.lab.as_str())
        .bind(disk_bytes)
        .bind(new.spec.model.as_ref().map(|model| model.id.to_string()))
        .execute(&mut *transaction)
        .await
        .map_err(|error| {
            let mut id = new.spec.measurement.to_string();
            if let Some(model) = &new.spec.model {
                id += &format!(" or model {}", model.id);
            }
            super::tables::calibrations::gone_if_foreign_key(error, "measurement", id)
        })?;
        graph::insert(&mut transaction, id, &new.spec).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// The job that the lab made with this key, if it made one; an error if it asked for another.
    ///
    /// # Errors
    /// [`StoreError::KeyReused`].
    pub async fn job_with_key(
        &self,
        lab: &Lab,
        key: &str,
        request: Sha256,
    ) -> Result<Option<JobId>, StoreError> {
        let mut connection = self.readers.acquire().await?;
        with_key(&mut connection, lab, key, request).await
    }
}

/// Refuses a job if enough wait and run.
async fn check_queue(connection: &mut SqliteConnection, most: u64) -> Result<(), StoreError> {
    let row = sqlx::query(
        "SELECT count(*) AS jobs FROM jobs WHERE state IN ('queued', 'running', 'cancelling')",
    )
    .fetch_one(connection)
    .await?;
    let jobs = number(&row, "jobs")?;
    if jobs < most { Ok(()) } else { Err(StoreError::QueueFull { jobs, most }) }
}

/// A key as it is stored: good for one job of a lab.
fn key_of(lab: &Lab, key: &str) -> String {
    format!("{lab} {key}")
}

/// The job that the lab made with this key; an error if its request was another one.
async fn with_key(
    connection: &mut SqliteConnection,
    lab: &Lab,
    key: &str,
    request: Sha256,
) -> Result<Option<JobId>, StoreError> {
    let row = sqlx::query("SELECT id, request FROM jobs WHERE idempotency_key = ?")
        .bind(key_of(lab, key))
        .fetch_optional(connection)
        .await?;
    let Some(row) = row else { return Ok(None) };
    let job = parsed(&row, "id")?;
    if parsed::<Sha256>(&row, "request")? == request {
        Ok(Some(job))
    } else {
        Err(StoreError::KeyReused { key: key.to_owned(), job })
    }
}
