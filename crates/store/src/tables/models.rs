//! Table `models`.

use serde::Serialize;

use crate::Store;
use crate::columns::{Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, Reference, listed, refuse_if_used, require};
use crate::tables::keys::{self, Inserted, Made, RequestKey};
use engine::job::{CalibrationId, JobModel, Lab, Label, ModelFacts, ModelId, Sha256, Timestamp};

/// What is known of an end-to-end network when it has been checked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NewModel {
    pub name: Option<Label>,
    pub calibration: CalibrationId,
    pub file: Sha256,
    #[serde(flatten)]
    pub facts: ModelFacts,
}

from_row!(NewModel, row => {
    name,
    calibration,
    file,
    facts = row.read::<Json<_>>("facts")?.0,
});

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Model {
    pub id: ModelId,
    pub created_at: Timestamp,
    #[serde(flatten)]
    pub content: NewModel,
}

from_row!(Model, row => { id, created_at, content = NewModel::from_row(row)? });

impl From<Model> for JobModel {
    fn from(model: Model) -> Self {
        let Model { id, content: NewModel { name, calibration, file, facts }, .. } = model;
        let ModelFacts { fixed_size, trial, .. } = facts;
        Self { id, calibration, name, sha256: file, fixed_size, trial }
    }
}

impl Store {
    /// Errors: [`StoreError::KeyReused`].
    pub async fn add_model(
        &self,
        lab: &Lab,
        content: NewModel,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<ModelId>> {
        let model = Model { id: ModelId::new(), created_at: Timestamp::now(), content };
        let NewModel { name, calibration, file, facts } = &model.content;
        let mut transaction = self.write().await?;
        if let Some(before) = keys::found(&mut transaction, lab, Made::Model, key).await? {
            return Ok(Inserted::Before(before));
        }
        let references = [Reference::Calibration(*calibration), Reference::Blob(*file)];
        require(&mut transaction, &references).await?;
        sql!(
            "INSERT INTO models (id, lab, name, calibration, file, facts, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
            [model.id, lab, &name, calibration, file, Json(facts), model.created_at]
        )
        .execute(&mut *transaction)
        .await?;
        keys::insert(&mut transaction, lab, Made::Model, key, model.id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(model.id))
    }

    pub async fn model(&self, lab: &Lab, id: ModelId) -> Result<Model> {
        let model = sql_as!("SELECT * FROM models WHERE id = ? AND lab = ?", [id, lab]);
        model.fetch_optional(&self.readers).await?.ok_or_else(|| StoreError::missing("model", id))
    }

    pub async fn models(
        &self,
        lab: &Lab,
        filter: Filter<ModelId>,
        limit: u32,
    ) -> Result<Page<Model>> {
        let items =
            listed!(sql_as, "models WHERE", lab, filter, limit).fetch_all(&self.readers).await?;
        Ok(Page::cut(items, limit))
    }

    /// Gives a model another name, or none.
    pub async fn rename_model(&self, lab: &Lab, id: ModelId, name: Option<&Label>) -> Result<()> {
        let renamed = sql!("UPDATE models SET name = ? WHERE id = ? AND lab = ?", [name, id, lab])
            .execute(&self.writer)
            .await?;
        match renamed.rows_affected() {
            0 => Err(StoreError::missing("model", id)),
            _ => Ok(()),
        }
    }

    /// Deletes a model that no job refers to. Its file is left to [`Self::collect`].
    pub async fn delete_model(&self, lab: &Lab, id: ModelId) -> Result<()> {
        self.model(lab, id).await?;
        let mut transaction = self.write().await?;
        let jobs = "SELECT count(*) AS users FROM jobs WHERE model = ?";
        refuse_if_used(&mut transaction, ("model", id.to_string()), ("jobs", jobs)).await?;
        let deleted =
            sql!("DELETE FROM models WHERE id = ?", [id]).execute(&mut *transaction).await?;
        if deleted.rows_affected() == 0 {
            return Err(StoreError::missing("model", id));
        }
        transaction.commit().await?;
        Ok(())
    }
}
