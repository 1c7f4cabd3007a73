//! Table `models`.

use serde::Serialize;

use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::{Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Filter, Page, listed, refuse_if_used};
use crate::tables::keys::Made;
use crate::tables::requests;
use engine::job::{CalibrationId, JobModel, Lab, Label, ModelFacts, ModelId, Sha256, Timestamp};

/// Facts of an end-to-end network that has passed its check.
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
        self.model(lab, id).await?;
        let mut transaction = self.write().await?;
        requests::rename(&mut transaction, (lab, Made::Model, id.into()), name).await?;
        sql!("UPDATE models SET name = ? WHERE id = ?", [name, id])
            .execute(&mut *transaction)
            .await?;
        Ok(transaction.commit().await?)
    }

    /// Deletes a model that no job refers to. Its file is left to [`Self::collect`].
    pub async fn delete_model(&self, lab: &Lab, id: ModelId) -> Result<()> {
        self.model(lab, id).await?;
        let mut transaction = self.write().await?;
        let jobs = "SELECT count(*) AS users FROM jobs WHERE model = ?";
        refuse_if_used(&mut transaction, ("model", id.to_string()), ("jobs", jobs)).await?;
        requests::delete(&mut transaction, (lab, Made::Model, id.into())).await?;
        sql!("DELETE FROM models WHERE id = ?", [id]).execute(&mut *transaction).await?;
        transaction.commit().await?;
        Ok(())
    }
}

/// Writes the row of a model that has passed its check.
pub async fn insert_made(
    connection: &mut SqliteConnection,
    id: ModelId,
    facts: &ModelFacts,
) -> Result<()> {
    sql!(
        "INSERT INTO models (id, lab, name, calibration, file, facts, created_at)
         SELECT id, lab, name, calibration, request ->> '$.file', ?, created_at
         FROM requests WHERE id = ?",
        [Json(facts), id]
    )
    .execute(&mut *connection)
    .await?;
    requests::fulfil(connection, id.into()).await
}
