//! What users do with a job in the queue: cancel it, take it up again, delete it; and how it ends.

use sqlx::SqliteConnection;

use super::graph;
use crate::columns::{Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::jobs::{self, JobChanges};
use crate::tables::sums;
use crate::{Store, deletion, records};
use engine::job::{Assessment, IllegalTransition, JobId, JobState, Lab, TaskState};

impl Store {
    /// Cancels a job: at once if no worker has a task of it, else with the workers' next heartbeats. Cancelling twice
    /// is no error.
    /// Errors: [`StoreError::State`] if the job has succeeded or failed.
    pub async fn cancel_job(&self, lab: &Lab, id: JobId) -> Result<()> {
        self.job(lab, id).await?;
        let mut transaction = self.write().await?;
        let before = jobs::state(&mut transaction, id).await?;
        if matches!(before, JobState::Cancelling | JobState::Cancelled) {
            return Ok(());
        }
        let running = running_tasks(&mut transaction, id).await? > 0;
        let to = if running { JobState::Cancelling } else { JobState::Cancelled };
        jobs::set_state(&mut transaction, id, to, None).await?;
        graph::cancel_waiting(&mut transaction, id).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Changes the label of a job, and the priority of one that has not ended: of its tasks that wait, too.
    /// Errors: [`StoreError::Ended`] for the priority of a job that has ended.
    pub async fn change_job(&self, lab: &Lab, id: JobId, changes: &JobChanges) -> Result<()> {
        self.job(lab, id).await?;
        let mut transaction = self.write().await?;
        let state = jobs::state(&mut transaction, id).await?;
        if let Some(priority) = changes.priority {
            if state.is_final() {
                return Err(StoreError::Ended(state));
            }
            sql!(
                "UPDATE jobs SET priority = ?1, spec = json_set(spec, '$.priority', ?1) WHERE id = ?2",
                [priority, id]
            )
            .execute(&mut *transaction)
            .await?;
            sql!("UPDATE tasks SET priority = ? WHERE job = ?", [priority, id])
                .execute(&mut *transaction)
                .await?;
        }
        if let Some(label) = &changes.label {
            sql!(
                "UPDATE jobs SET label = ?1, spec = json_set(spec, '$.label', ?1) WHERE id = ?2",
                [label, id]
            )
            .execute(&mut *transaction)
            .await?;
        }
        if let Some(truth) = changes.truth {
            sql!(
                "UPDATE jobs SET truth = ?1, spec = json_set(spec, '$.truth', ?1) WHERE id = ?2",
                [truth, id]
            )
            .execute(&mut *transaction)
            .await?;
        }
        transaction.commit().await?;
        Ok(())
    }

    /// Retries a failed or cancelled job, or one with damaged results. Sound results are kept.
    /// Errors: [`StoreError::State`] if the job has not failed or been cancelled, and nothing is damaged.
    pub async fn retry_job(&self, lab: &Lab, id: JobId) -> Result<()> {
        self.job(lab, id).await?;
        let mut transaction = self.write().await?;
        let from = jobs::state(&mut transaction, id).await?;
        let damaged = records::damaged_snapshots(&mut transaction, id).await?;
        if from == JobState::Succeeded && damaged.is_empty() {
            return Err(IllegalTransition { from, to: JobState::Queued }.into());
        }
        jobs::set_state(&mut transaction, id, JobState::Queued, None).await?;
        graph::undo(&mut transaction, id, &damaged).await?;
        // Of results that will be others.
        self.drop_movies(&mut transaction, id, None).await?;
        graph::restart(&mut transaction, id).await?;
        sums::recount(&mut transaction, id).await?;
        self.commit_removals(transaction).await
    }

    /// Deletes a job that has ended, with its results.
    /// Errors: [`StoreError::NotFinal`] if it still runs or waits; [`StoreError::JobInUse`] while its masks become a
    /// calibration.
    pub async fn delete_job(&self, lab: &Lab, id: JobId) -> Result<()> {
        self.job(lab, id).await?;
        self.remove_job(id).await
    }

    /// As [`Self::delete_job`], whosever it is.
    pub(crate) async fn remove_job(&self, id: JobId) -> Result<()> {
        let mut transaction = self.write().await?;
        let state = jobs::state(&mut transaction, id).await?;
        if !state.is_final() || running_tasks(&mut transaction, id).await? > 0 {
            return Err(StoreError::NotFinal(state));
        }
        let calibration = "SELECT requests.id FROM requests JOIN jobs USING (lab)
                           WHERE jobs.id = ?1 AND what = 'calibration' AND facts IS NULL AND refusal IS NULL
                           AND request ->> 'registration_of' = ?1 LIMIT 1";
        let calibration = sql_as!(calibration, [id]).fetch_optional(&mut *transaction).await?;
        if let Some(calibration) = calibration {
            return Err(StoreError::JobInUse(calibration));
        }
        self.drop_tiles(&mut transaction, id).await?;
        self.drop_movies(&mut transaction, id, None).await?;
        sql!("DELETE FROM jobs WHERE id = ?", [id]).execute(&mut *transaction).await?;
        deletion::note_results(&mut transaction, id).await?;
        self.commit_removals(transaction).await
    }

    /// Marks a job as succeeded, unless it is being cancelled, and removes its tiles.
    pub(super) async fn succeed(
        &self,
        transaction: &mut SqliteConnection,
        id: JobId,
        assessment: Option<Assessment>,
    ) -> Result<()> {
        if jobs::state(transaction, id).await? == JobState::Running {
            jobs::set_state(transaction, id, JobState::Succeeded, None).await?;
            sql!("UPDATE jobs SET assessment = ? WHERE id = ?", [assessment.map(Json), id])
                .execute(&mut *transaction)
                .await?;
            self.drop_tiles(transaction, id).await?;
            shorten_records(transaction, id).await?;
        }
        Ok(())
    }

    /// Removes the tiles and previews of a job.
    async fn drop_tiles(&self, transaction: &mut SqliteConnection, id: JobId) -> Result<()> {
        let results = "SELECT DISTINCT result FROM tasks WHERE job = ? AND result IS NOT NULL";
        let results = sql_as!(results, [id]).fetch_all(&mut *transaction).await?;
        sql!("UPDATE tasks SET result = NULL WHERE job = ?", [id])
            .execute(&mut *transaction)
            .await?;
        for result in results {
            self.release(transaction, result).await?;
        }
        Ok(())
    }
}

/// Shortens the records of a job that has succeeded: other tables and the assemblies have the rest. About eight points
/// of each convergence history remain.
async fn shorten_records(connection: &mut SqliteConnection, id: JobId) -> Result<()> {
    sql!(
        "UPDATE tasks SET record = json_remove(record, '$.assessment'),
             history = (SELECT json_group_array(json(value)) FROM json_each(history)
                        WHERE key % (json_array_length(history) / 8 + 1) = 0
                           OR key = json_array_length(history) - 1)
         WHERE job = ? AND kind = 'tile'",
        [id]
    )
    .execute(&mut *connection)
    .await?;
    sql!(
        "UPDATE tasks SET record = json_remove(record, '$.files') WHERE job = ? AND kind = 'assemble'",
        [id]
    )
    .execute(&mut *connection)
    .await?;
    sql!("UPDATE tasks SET record = 'null' WHERE job = ? AND kind = 'manifest'", [id])
        .execute(&mut *connection)
        .await?;
    sql!(
        "DELETE FROM attempts WHERE outcome = 'done' AND task IN (SELECT id FROM tasks WHERE job = ?)",
        [id]
    )
    .execute(connection)
    .await?;
    Ok(())
}

/// True if the job's tasks are still to be done.
pub(super) async fn is_wanted(connection: &mut SqliteConnection, id: JobId) -> Result<bool> {
    Ok(matches!(jobs::state(connection, id).await?, JobState::Queued | JobState::Running))
}

pub(super) async fn fail(connection: &mut SqliteConnection, id: JobId, reason: &str) -> Result<()> {
    jobs::set_state(connection, id, JobState::Failed, Some(reason)).await?;
    graph::cancel_waiting(connection, id).await
}

/// Ends a job that was being cancelled, once no worker has a task of it.
pub(super) async fn settle(connection: &mut SqliteConnection, id: JobId) -> Result<()> {
    if jobs::state(connection, id).await? != JobState::Cancelling {
        return Ok(());
    }
    // A task that was completed a moment ago has made others ready: they are not wanted.
    graph::cancel_waiting(connection, id).await?;
    if running_tasks(connection, id).await? == 0 {
        jobs::set_state(connection, id, JobState::Cancelled, None).await?;
    }
    Ok(())
}

async fn running_tasks(connection: &mut SqliteConnection, id: JobId) -> Result<u64> {
    let count = "SELECT count(*) FROM tasks WHERE job = ? AND state = ?";
    sql_as!(count, [id, TaskState::Running]).fetch_one(connection).await
}
