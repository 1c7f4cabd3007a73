//! Calibrations, measurements and models that have passed their checks: the columns `prepared` and `facts` of `requests`.

use std::fmt::{Debug, Display};
use std::str::FromStr;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::Store;
use crate::columns::{Columns, FromRow, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, refuse_if_used};
use crate::tables::keys::ResourceKind;
use crate::tables::requests::{self, Request};
use engine::job::{
    CalibrationId, CalibrationRequest, CorrectedMasks, Dispersion, Finding, InvalidId, JobModel,
    Lab, Label, MaskInputs, MeasurementId, MeasurementInputs, MeasurementRequest, ModelFacts,
    ModelId, ModelRequest, Mosaic, Reading, ResourceId, Sequence, Sha256, Timestamp,
};

/// The identifier of a calibration, a measurement or a model.
pub trait Resource:
    Copy
    + Debug
    + Display
    + Send
    + Sync
    + Into<ResourceId>
    + From<ResourceId>
    + FromStr<Err = InvalidId>
{
    const KIND: ResourceKind;
    /// The request for one.
    type Request: Debug + Clone + PartialEq + Serialize + DeserializeOwned + Send + Sync;
    /// The facts that are known once it has passed its check.
    type Facts: Debug + Clone + PartialEq + Serialize + DeserializeOwned + Send + Sync;
}

impl Resource for CalibrationId {
    const KIND: ResourceKind = ResourceKind::Calibration;
    type Request = CalibrationRequest;
    type Facts = NewCalibration;
}

impl Resource for MeasurementId {
    const KIND: ResourceKind = ResourceKind::Measurement;
    type Request = MeasurementRequest;
    type Facts = NewMeasurement;
}

impl Resource for ModelId {
    const KIND: ResourceKind = ResourceKind::Model;
    type Request = ModelRequest;
    type Facts = NewModel;
}

/// A calibration, measurement or model that is ready.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadyResource<Id: Resource> {
    pub id: Id,
    pub name: Option<Label>,
    /// Hash of the file that jobs read: masks [B, H, W] on [0, 1], or snapshots [S, H, W] with the full scale divided
    /// out, as planar f32. For a model: the hash of its ONNX file.
    pub prepared: Sha256,
    pub created_at: Timestamp,
    pub request: Id::Request,
    pub facts: Id::Facts,
}

pub type Calibration = ReadyResource<CalibrationId>;
pub type Measurement = ReadyResource<MeasurementId>;
pub type Model = ReadyResource<ModelId>;

/// A calibration, measurement or model that a lab asked for.
#[derive(Debug, Clone)]
pub enum FoundResource<Id: Resource> {
    Ready(ReadyResource<Id>),
    /// It is being checked or made, or was refused.
    Pending(Box<Request>),
}

impl<Id: Resource> FromRow for FoundResource<Id> {
    fn from_row(row: &SqliteRow) -> Result<Self> {
        let Some(facts) = row.read_json("facts")? else {
            return Ok(Self::Pending(Box::new(Request::from_row(row)?)));
        };
        let (id, name) = (row.read::<ResourceId>("id")?.into(), row.read("name")?);
        let (prepared, created_at) = (row.read("prepared")?, row.read("created_at")?);
        let Json(request) = row.read("request")?;
        Ok(Self::Ready(ReadyResource { id, name, prepared, created_at, request, facts }))
    }
}

/// Facts of a calibration whose masks have passed their check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NewCalibration {
    /// Hash of the upload, or of the npy file of masks that the service has made.
    pub masks: Sha256,
    pub format: String,
    pub sample: String,
    /// How the axes of the array were read; none for pictures.
    pub axes: Option<String>,
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub full_scale: f32,
    /// Mean of all mask values on [0, 1].
    pub mask_mean: f64,
    /// Pixels that are dark in all frames. They carry no information.
    pub dead_pixels: u64,
    /// Values below 0, set to 0.
    pub clipped_negatives: u64,
    /// The colours of the sensor's pixels; none for a grey one.
    pub mosaic: Option<Mosaic>,
    /// The part of the masks' file that was read; `None` for captures.
    pub reading: Option<Reading>,
    /// Displacement of the bands of a spectral camera, with which the masks were made of one mask.
    pub dispersion: Option<Dispersion>,
    /// The registration that has corrected the masks, and their origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub corrected: Option<CorrectedMasks>,
}

/// Facts of a measurement that has passed its check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NewMeasurement {
    pub calibration: CalibrationId,
    pub data: Sha256,
    pub format: String,
    pub sample: String,
    /// How the axes of the array were read; none for pictures.
    pub axes: Option<String>,
    pub snapshots: u32,
    pub height: usize,
    pub width: usize,
    /// The stored number that means 1, where the scene's sum of frames is up to B.
    pub full_scale: f32,
    /// Snapshots that the camera takes in a second.
    pub camera_fps: Option<f64>,
    /// Exposure of one snapshot in seconds.
    pub exposure_s: Option<f64>,
    /// `contiguous` if the snapshots follow each other without a gap.
    pub sequence: Sequence,
    /// The uploads whose average was subtracted.
    pub dark: Vec<Sha256>,
    /// Findings of the check against the calibration.
    pub warnings: Vec<Finding>,
    /// The part of the file that was read.
    pub reading: Reading,
}

/// Facts of an end-to-end network that has passed its check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct NewModel {
    pub calibration: CalibrationId,
    pub file: Sha256,
    #[serde(flatten)]
    pub facts: ModelFacts,
}

impl Calibration {
    /// The origin of the masks.
    pub fn inputs(&self) -> MaskInputs {
        let NewCalibration { masks, axes, corrected, .. } = &self.facts;
        self.request.inputs(*masks, axes.clone(), corrected.clone())
    }
}

impl Measurement {
    /// The origin of the snapshots.
    pub fn inputs(&self) -> MeasurementInputs {
        self.request.inputs(self.facts.axes.clone())
    }
}

impl From<Model> for JobModel {
    fn from(model: Model) -> Self {
        let Model { id, name, facts: NewModel { calibration, file, facts }, .. } = model;
        let ModelFacts { fixed_size, trial, .. } = facts;
        Self { id, calibration, name, sha256: file, fixed_size, trial }
    }
}

impl Store {
    /// The lab's calibration with this identifier.
    /// Errors: [`StoreError::NotReady`] if its masks are not there.
    pub async fn calibration(&self, lab: &Lab, id: CalibrationId) -> Result<Calibration> {
        ready(id, self.resource(lab, id).await?)
    }

    /// The lab's measurement with this identifier.
    /// Errors: [`StoreError::NotReady`] if it has not passed its check.
    pub async fn measurement(&self, lab: &Lab, id: MeasurementId) -> Result<Measurement> {
        ready(id, self.resource(lab, id).await?)
    }

    /// The lab's model with this identifier. One that has not passed its check does not exist.
    pub async fn model(&self, lab: &Lab, id: ModelId) -> Result<Model> {
        match self.resource(lab, id).await? {
            FoundResource::Ready(model) => Ok(model),
            FoundResource::Pending(_) => Err(StoreError::missing("model", id)),
        }
    }

    /// The lab's calibration, measurement or model with this identifier, ready or pending.
    pub async fn resource<Id: Resource>(&self, lab: &Lab, id: Id) -> Result<FoundResource<Id>> {
        self.find_resource(Some(lab), id).await
    }

    /// A calibration or measurement of any lab, for workers, which serve all labs.
    pub(crate) async fn resource_of_any_lab<Id: Resource>(
        &self,
        id: Id,
    ) -> Result<ReadyResource<Id>> {
        ready(id, self.find_resource(None, id).await?)
    }

    async fn find_resource<Id: Resource>(
        &self,
        lab: Option<&Lab>,
        id: Id,
    ) -> Result<FoundResource<Id>> {
        let (resource, what): (ResourceId, _) = (id.into(), Id::KIND.into_str());
        let found = sql_as!(
            concat!(
                "SELECT * FROM ",
                requests::requests!(),
                " WHERE id = ?1 AND what = ?2 AND (?3 IS NULL OR lab = ?3)"
            ),
            [resource, what, lab]
        );
        let found = found.fetch_optional(&self.readers).await?;
        found.ok_or_else(|| StoreError::missing(what, id))
    }

    /// A page of the lab's calibrations, measurements or models, newest first. Models that are not ready are left out.
    pub async fn resources<Id: Resource>(
        &self,
        lab: &Lab,
        filter: Filter<Id>,
        limit: u32,
    ) -> Result<Page<FoundResource<Id>>> {
        let after: Option<ResourceId> = filter.after.map(Into::into);
        let items = sql_as!(
            concat!(
                "SELECT * FROM ",
                requests::requests!(),
                " WHERE what = ? AND lab = ? AND id < coalesce(?, 'g') AND (what <> 'model' OR facts IS NOT NULL)
                   AND calibration IS coalesce(?, calibration)
                   AND created_at >= coalesce(?, created_at) AND created_at < coalesce(?, created_at + 1)
                 ORDER BY id DESC LIMIT ?"
            ),
            [
                Id::KIND.into_str(),
                lab,
                after,
                filter.calibration,
                filter.created.from,
                filter.created.before,
                i64::from(limit) + 1
            ]
        );
        Ok(Page::cut(items.fetch_all(&self.readers).await?, limit))
    }

    /// Gives a calibration, a measurement or a model another name, or none.
    pub async fn rename<Id: Resource>(
        &self,
        lab: &Lab,
        id: Id,
        name: Option<&Label>,
    ) -> Result<()> {
        let (resource, what): (ResourceId, _) = (id.into(), Id::KIND.into_str());
        let renamed = "UPDATE requests SET name = ? WHERE id = ? AND lab = ? AND what = ?";
        let renamed = sql!(renamed, [name, resource, lab, what]).execute(self.writer()?).await?;
        let found = renamed.rows_affected() > 0;
        if found { Ok(()) } else { Err(StoreError::missing(what, id)) }
    }

    /// Deletes a calibration, a measurement or a model that nothing refers to, with its tasks: a worker that has one
    /// learns this from its next heartbeat.
    pub async fn delete<Id: Resource>(&self, lab: &Lab, id: Id) -> Result<()> {
        let (resource, what): (ResourceId, _) = (id.into(), Id::KIND.into_str());
        let mut transaction = self.write().await?;
        let found = "SELECT prepared FROM requests WHERE id = ? AND lab = ? AND what = ?";
        let found = sql_as!(found, [resource, lab, what]).fetch_optional(&mut *transaction).await?;
        let prepared: Option<Sha256> = found.ok_or_else(|| StoreError::missing(what, id))?;
        for users in users(Id::KIND) {
            refuse_if_used(&mut transaction, what, id.to_string(), *users).await?;
        }
        sql!("DELETE FROM requests WHERE id = ?", [resource]).execute(&mut *transaction).await?;
        if let Some(prepared) = prepared {
            self.release(&mut transaction, prepared).await?;
        }
        self.commit_removals(transaction).await
    }
}

fn ready<Id: Resource>(id: Id, found: FoundResource<Id>) -> Result<ReadyResource<Id>> {
    match found {
        FoundResource::Ready(resource) => Ok(resource),
        FoundResource::Pending(request) => Err(StoreError::NotReady {
            what: Id::KIND.into_str(),
            id: id.to_string(),
            error: request.refusal.map(|refusal| refusal.detail),
        }),
    }
}

/// Names of the resources that may refer to a resource of this kind, each with a query that counts them.
fn users(what: ResourceKind) -> &'static [(&'static str, &'static str)] {
    match what {
        ResourceKind::Calibration => &[
            (
                "measurements",
                "SELECT count(*) FROM requests
                 WHERE calibration = ? AND what = 'measurement' AND refusal IS NULL",
            ),
            (
                "models",
                "SELECT count(*) FROM requests
                 WHERE calibration = ? AND what = 'model' AND refusal IS NULL",
            ),
        ],
        ResourceKind::Measurement => &[("jobs", "SELECT count(*) FROM jobs WHERE measurement = ?")],
        ResourceKind::Model => &[("jobs", "SELECT count(*) FROM jobs WHERE model = ?")],
        ResourceKind::Job | ResourceKind::Upload => &[],
    }
}

/// Records the facts of a resource that has passed its check.
pub async fn record<Id: Resource>(
    connection: &mut SqliteConnection,
    id: Id,
    prepared: Sha256,
    facts: &Id::Facts,
) -> Result<()> {
    let resource: ResourceId = id.into();
    sql!(
        "UPDATE requests SET prepared = ?, facts = ? WHERE id = ?",
        [prepared, Json(facts), resource]
    )
    .execute(&mut *connection)
    .await?;
    let kept = requests::find(connection, resource).await?.submission.kept_uploads();
    requests::fulfil(connection, resource, &kept).await
}
