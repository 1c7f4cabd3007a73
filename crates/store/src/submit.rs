//! Submission of jobs, and of requests that process uploads. Each is written whole or not at all.

use std::str::FromStr;

use super::Store;
use super::error::Result;
use super::queue::graph;
use super::rows::{Reference, require};
use super::tables::keys::{self, Inserted, RequestKey, ResourceKind};
use super::tables::{jobs, quota, requests};
use engine::job::{
    CheckLimits, InvalidId, JobId, JobSpec, Lab, ResourceId, Submission, TaskKind, TokenId,
};

#[derive(Debug, Clone)]
pub struct NewJob {
    /// Jobs that may wait and run, this one included.
    pub most_jobs: u64,
    pub lab: Lab,
    pub spec: JobSpec,
    pub key: Option<RequestKey>,
}

/// A request for something that is made of uploads.
#[derive(Debug, Clone)]
pub struct NewRequest {
    pub submission: Submission,
    pub limits: CheckLimits,
    /// Identifier of the HTTP request.
    pub origin: Option<String>,
}

impl Store {
    /// Records a request for something that is made of uploads, and puts their check in the queue.
    /// Errors: [`StoreError::KeyReused`](crate::StoreError::KeyReused);
    /// [`StoreError::ManyChecks`](crate::StoreError::ManyChecks); [`StoreError::NotFound`](crate::StoreError::NotFound)
    /// if an upload, the calibration or the job was deleted.
    pub async fn request<Id>(
        &self,
        (lab, token): (&Lab, Option<TokenId>),
        NewRequest { submission, limits, origin }: &NewRequest,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<Id>>
    where
        Id: From<ResourceId> + FromStr<Err = InvalidId>,
    {
        let (what, id) = (ResourceKind::of(submission), ResourceId::new());
        let mut transaction = self.write().await?;
        if let Some(before) = keys::found(&mut transaction, lab, what, key).await? {
            return Ok(Inserted::Before(before));
        }
        quota::check_checks(&mut transaction, lab).await?;
        let new = (submission, limits, origin.as_deref());
        let bytes = requests::insert(&mut transaction, lab, token, id, new).await?;
        let cost = submission.check_cost(bytes);
        graph::insert_for(&mut transaction, lab, id, TaskKind::Check, cost).await?;
        keys::insert(&mut transaction, lab, what, key, id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id.into()))
    }

    /// Accepts a job: the job and its tasks, or nothing.
    /// Errors: [`StoreError::KeyReused`](crate::StoreError::KeyReused);
    /// [`StoreError::QueueFull`](crate::StoreError::QueueFull); [`StoreError::Quota`](crate::StoreError::Quota);
    /// [`StoreError::NotFound`](crate::StoreError::NotFound) if the measurement or the model was deleted.
    pub async fn add_job(&self, new: NewJob) -> Result<Inserted> {
        let mut transaction = self.write().await?;
        let key = new.key.as_ref();
        if let Some(before) =
            keys::found(&mut transaction, &new.lab, ResourceKind::Job, key).await?
        {
            return Ok(Inserted::Before(before));
        }
        quota::check_jobs(&mut transaction, &new.lab, new.most_jobs).await?;
        quota::check(&mut transaction, &new.lab, None, new.spec.disk_bytes()).await?;
        let mut references = vec![Reference::Measurement(new.spec.measurement)];
        references.extend(new.spec.model.as_ref().map(|model| Reference::Model(model.id)));
        require(&mut transaction, &references).await?;
        let id = JobId::new();
        jobs::insert(&mut transaction, id, &new.lab, &new.spec).await?;
        graph::insert(&mut transaction, &new.lab, id, &new.spec).await?;
        keys::insert(&mut transaction, &new.lab, ResourceKind::Job, key, id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }
}
