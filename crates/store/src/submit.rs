//! What comes in: jobs, calibrations and measurements, each written whole or not at all.

use super::Store;
use super::error::Result;
use super::queue::graph;
use super::rows::{Reference, require};
use super::staging::StagedBlob;
use super::tables::blobs::Origin;
use super::tables::calibrations::{self, Asked, Calibration, NewCalibration};
use super::tables::checks::Source;
use super::tables::keys::{self, Inserted, Made, RequestKey};
use super::tables::measurements::{self, Measurement, NewMeasurement};
use super::tables::{jobs, quota};
use engine::job::{
    CalibrationId, Captures, JobId, JobSpec, Lab, Label, MeasurementId, Mosaic, Timestamp, TokenId,
    planned_seconds,
};

#[derive(Debug, Clone)]
pub struct NewJob {
    /// So many jobs may wait and run, with this one.
    pub most_jobs: u64,
    pub lab: Lab,
    pub spec: JobSpec,
    pub key: Option<RequestKey>,
}

/// Captures of which a calibration is to be made.
#[derive(Debug, Clone, Copy)]
pub struct NewCaptures<'a> {
    pub name: Option<&'a Label>,
    pub captures: &'a Captures,
    /// Of the masks.
    pub bytes: u64,
    /// Planned processor seconds.
    pub cost: f64,
    /// The colours of the sensor's pixels.
    pub mosaic: Option<Mosaic>,
}

impl Store {
    /// Accepts a job: the job and its tasks, or nothing.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::QueueFull`]; [`StoreError::Quota`];
    /// [`StoreError::NotFound`] if
    /// the measurement or the model is gone.
    pub async fn add_job(&self, new: NewJob) -> Result<Inserted> {
        let mut transaction = self.write().await?;
        let key = new.key.as_ref();
        if let Some(before) = keys::found(&mut transaction, &new.lab, Made::Job, key).await? {
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
        keys::insert(&mut transaction, &new.lab, Made::Job, key, id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// Records a calibration and puts its prepared masks in place. Its report is made by a worker.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::Quota`]; [`StoreError::NotFound`] if the upload, or the
    /// check that it comes of, is gone.
    pub async fn add_calibration(
        &self,
        (lab, token): (&Lab, Option<TokenId>),
        facts: NewCalibration,
        prepared: StagedBlob,
        source: Source<'_, CalibrationId>,
    ) -> Result<Inserted<CalibrationId>> {
        let mut calibration = Calibration {
            id: CalibrationId::new(),
            prepared: prepared.sha256(),
            created_at: Timestamp::now(),
            facts,
        };
        let mut transaction = self.write().await?;
        if let Some(before) = source.before(&mut transaction, lab, Made::Calibration).await? {
            return Ok(Inserted::Before(before));
        }
        if let Some((id, at, name)) = source.promised(&mut transaction, Made::Calibration).await? {
            (calibration.id, calibration.created_at, calibration.facts.name) = (id, at, name);
        }
        let (id, facts) = (calibration.id, &calibration.facts);
        require(&mut transaction, &[Reference::Blob(facts.masks)]).await?;
        quota::check(&mut transaction, lab, token, prepared.size()).await?;
        self.publish(&mut transaction, prepared, Origin::Prepared).await?;
        calibrations::insert(&mut transaction, (lab, token), &calibration).await?;
        let name = facts.name.as_ref();
        let asked = Asked { id, token, name, captures: None, bytes: 0, mosaic: facts.mosaic };
        calibrations::insert_request(&mut transaction, lab, &asked).await?;
        let cost = planned_seconds(0, facts.frames, facts.height * facts.width);
        graph::insert_calibration(&mut transaction, lab, id, cost).await?;
        source.settle(&mut transaction, lab, (Made::Calibration, id)).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// Records a calibration whose masks, and their report, are to be made of captures.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::Quota`].
    pub async fn add_captures(
        &self,
        (lab, token): (&Lab, Option<TokenId>),
        NewCaptures { name, captures, bytes, cost, mosaic }: NewCaptures<'_>,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<CalibrationId>> {
        let id = CalibrationId::new();
        let mut transaction = self.write().await?;
        if let Some(before) = keys::found(&mut transaction, lab, Made::Calibration, key).await? {
            return Ok(Inserted::Before(before));
        }
        quota::check(&mut transaction, lab, token, bytes).await?;
        let asked = Asked { id, token, name, captures: Some(captures), bytes, mosaic };
        calibrations::insert_request(&mut transaction, lab, &asked).await?;
        graph::insert_calibration(&mut transaction, lab, id, cost).await?;
        keys::insert(&mut transaction, lab, Made::Calibration, key, id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// Records a measurement and puts its prepared snapshots in place.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::Quota`]; [`StoreError::NotFound`] if the upload, the
    /// calibration, or the check that it comes of, is gone.
    pub async fn add_measurement(
        &self,
        (lab, token): (&Lab, Option<TokenId>),
        facts: NewMeasurement,
        prepared: StagedBlob,
        source: Source<'_, MeasurementId>,
    ) -> Result<Inserted<MeasurementId>> {
        let mut measurement = Measurement {
            id: MeasurementId::new(),
            prepared: prepared.sha256(),
            created_at: Timestamp::now(),
            facts,
        };
        let mut transaction = self.write().await?;
        if let Some(before) = source.before(&mut transaction, lab, Made::Measurement).await? {
            return Ok(Inserted::Before(before));
        }
        if let Some((id, at, name)) = source.promised(&mut transaction, Made::Measurement).await? {
            (measurement.id, measurement.created_at, measurement.facts.name) = (id, at, name);
        }
        let facts = &measurement.facts;
        let references = [Reference::Calibration(facts.calibration), Reference::Blob(facts.data)];
        require(&mut transaction, &references).await?;
        quota::check(&mut transaction, lab, token, prepared.size()).await?;
        self.publish(&mut transaction, prepared, Origin::Prepared).await?;
        measurements::insert(&mut transaction, (lab, token), &measurement).await?;
        source.settle(&mut transaction, lab, (Made::Measurement, measurement.id)).await?;
        transaction.commit().await?;
        Ok(Inserted::New(measurement.id))
    }
}
