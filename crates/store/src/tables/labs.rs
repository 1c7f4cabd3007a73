//! Table `labs`: the share of the machine that each has, and its limits.

use std::collections::HashMap;

use serde::Serialize;
use sqlx::SqliteConnection;
use strum::VariantArray;

use crate::Store;
use crate::columns::{from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use engine::job::{JobState, Lab, Timestamp};

#[derive(Debug, Clone, PartialEq)]
pub struct LabRow {
    pub lab: Lab,
    /// Its weight when labs compete for the machine.
    pub share: f64,
    /// Bytes that it may keep here; none: the default.
    pub max_bytes: Option<u64>,
    /// Jobs that it may have waiting and running; none: the default.
    pub max_jobs: Option<u64>,
    /// Jobs that wait and run.
    pub jobs: u64,
}

from_row!(LabRow, row => { lab, share, max_bytes, max_jobs, jobs });

/// Use of the service by a lab.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, schemars::JsonSchema)]
pub struct LabUse {
    /// Uploaded files.
    pub uploads: u64,
    /// Bytes of the uploaded files.
    pub upload_bytes: u64,
    /// Bytes of the frames, movies and other files of its jobs.
    pub result_bytes: u64,
    /// Jobs that wait and run.
    pub jobs: u64,
}

from_row!(LabUse, row => { uploads, upload_bytes, result_bytes, jobs });

/// Figures of a lab for what watches the service.
#[derive(Debug, Clone, PartialEq)]
pub struct LabFigures {
    pub lab: Lab,
    pub jobs: HashMap<JobState, u64>,
    /// Jobs that have begun, in all, and the seconds that they waited.
    pub jobs_begun: u64,
    pub wait_seconds: f64,
    /// For how long its oldest job waits that has not begun; 0 if none waits.
    pub longest_wait: f64,
    /// Of tasks that are done, in all.
    pub cpu_seconds: f64,
    pub result_bytes: u64,
}

/// New entitlement of a lab; fields that are `None` stay unchanged.
#[derive(Debug, Clone, Copy, Default)]
pub struct Entitlement {
    /// Above 0.
    pub share: Option<f64>,
    /// Bytes, or none for no limit.
    pub max_bytes: Option<Option<u64>>,
    /// Jobs, or none for no limit.
    pub max_jobs: Option<Option<u64>>,
}

impl Store {
    pub async fn lab_use(&self, lab: &Lab) -> Result<LabUse> {
        let found = sql_as!(
            "SELECT
                 coalesce((SELECT files FROM files_of_labs WHERE lab = ?1 AND kind = 'upload'), 0)
                     AS uploads,
                 coalesce((SELECT bytes FROM files_of_labs WHERE lab = ?1 AND kind = 'upload'), 0)
                     AS upload_bytes,
                 (SELECT coalesce(sum(result_bytes), 0) FROM jobs_by_state WHERE lab = ?1)
                 + coalesce((SELECT bytes FROM files_of_labs WHERE lab = ?1 AND kind = 'movie'), 0)
                     AS result_bytes,
                 (SELECT coalesce(sum(jobs), 0) FROM jobs_by_state
                  WHERE lab = ?1 AND state IN ('queued', 'running', 'cancelling')) AS jobs",
            [lab]
        );
        found.fetch_one(&self.readers).await
    }

    /// All labs, by name.
    pub async fn labs(&self) -> Result<Vec<LabRow>> {
        self.find_labs(None).await
    }

    /// The lab of this name.
    /// Errors: [`StoreError::NotFound`] if there is none.
    pub async fn lab(&self, name: &str) -> Result<LabRow> {
        let found = self.find_labs(Some(name)).await?.pop();
        found.ok_or_else(|| StoreError::missing("lab", name))
    }

    async fn find_labs(&self, name: Option<&str>) -> Result<Vec<LabRow>> {
        let rows = sql_as!(
            "SELECT lab, share, max_bytes, max_jobs,
                 (SELECT coalesce(sum(jobs), 0) FROM jobs_by_state
                  WHERE jobs_by_state.lab = labs.lab AND state IN ('queued', 'running', 'cancelling'))
                     AS jobs
             FROM labs WHERE ?1 IS NULL OR lab = ?1 ORDER BY lab",
            [name]
        );
        rows.fetch_all(&self.readers).await
    }

    /// Figures of all labs, by name.
    pub async fn lab_figures(&self) -> Result<Vec<LabFigures>> {
        let rows: Vec<(Lab, u64, f64, f64, u64, Option<Timestamp>)> = sql_as!(
            "SELECT labs.lab, coalesce(jobs_begun, 0), coalesce(wait_seconds, 0.0),
                 coalesce(cpu_seconds, 0.0),
                 (SELECT coalesce(sum(result_bytes), 0) FROM jobs_by_state WHERE jobs_by_state.lab = labs.lab)
                 + coalesce((SELECT bytes FROM files_of_labs
                             WHERE files_of_labs.lab = labs.lab AND kind = 'movie'), 0),
                 (SELECT min(created_at) FROM jobs
                  WHERE jobs.lab = labs.lab AND finished_at IS NULL AND started_at IS NULL)
             FROM labs LEFT JOIN lab_totals USING (lab) ORDER BY labs.lab",
        )
        .fetch_all(&self.readers)
        .await?;
        let counted: Vec<(Lab, JobState, u64)> =
            sql_as!("SELECT lab, state, jobs FROM jobs_by_state").fetch_all(&self.readers).await?;
        let now = Timestamp::now();
        let figures = rows.into_iter().map(|row| {
            let (lab, jobs_begun, wait_seconds, cpu_seconds, result_bytes, oldest) = row;
            let longest_wait = oldest.map_or(0.0, |oldest| now.seconds_since(oldest));
            let mut jobs: HashMap<_, _> = JobState::VARIANTS.iter().map(|s| (*s, 0)).collect();
            let own = counted.iter().filter(|(whose, ..)| *whose == lab);
            jobs.extend(own.map(|(_, state, count)| (*state, *count)));
            LabFigures {
                lab,
                jobs,
                jobs_begun,
                wait_seconds,
                longest_wait,
                cpu_seconds,
                result_bytes,
            }
        });
        Ok(figures.collect())
    }

    /// True if a lab has a row: it has or had a token, a job, or limits.
    pub async fn knows_lab(&self, lab: &Lab) -> Result<bool> {
        let found = sql!("SELECT 1 FROM labs WHERE lab = ?", [lab]);
        Ok(found.fetch_optional(&self.readers).await?.is_some())
    }

    /// Sets the default limits of labs.
    pub async fn set_default_limits(&self, max_bytes: u64, max_jobs: u64) -> Result<()> {
        sql!(
            "INSERT INTO default_limits VALUES (1, ?, ?) ON CONFLICT (one) DO UPDATE
             SET max_bytes = excluded.max_bytes, max_jobs = excluded.max_jobs",
            [max_bytes, max_jobs]
        )
        .execute(self.writer()?)
        .await?;
        Ok(())
    }

    /// The limits that hold for a lab: bytes and jobs. `None` for no limit.
    pub async fn limits(&self, lab: &Lab) -> Result<(Option<u64>, Option<u64>)> {
        limits(&mut *self.readers.acquire().await?, lab).await
    }

    /// Sets what a lab is entitled to. A new lab gets a row.
    pub async fn entitle(&self, lab: &Lab, to: Entitlement) -> Result<()> {
        let mut transaction = self.write().await?;
        know(&mut transaction, lab).await?;
        let Entitlement { share, max_bytes, max_jobs } = to;
        sql!(
            "UPDATE labs SET share = coalesce(?2, share), max_bytes = iif(?3, ?4, max_bytes),
                 max_jobs = iif(?5, ?6, max_jobs) WHERE lab = ?1",
            [
                lab,
                share,
                max_bytes.is_some(),
                max_bytes.flatten(),
                max_jobs.is_some(),
                max_jobs.flatten()
            ]
        )
        .execute(&mut *transaction)
        .await?;
        Ok(transaction.commit().await?)
    }

    /// Takes a lab off the record, with its share, its limits and its totals.
    /// Errors: [`StoreError::NotFound`] if it is unknown; [`StoreError::InUse`] if it has a token or data.
    pub async fn remove_lab(&self, lab: &Lab) -> Result<()> {
        let mut transaction = self.write().await?;
        for (by, query) in BELONGINGS {
            let users: u64 = sql_as!(query, [lab]).fetch_one(&mut *transaction).await?;
            if users > 0 {
                return Err(StoreError::InUse { what: "lab", by, users });
            }
        }
        let removed =
            sql!("DELETE FROM labs WHERE lab = ?", [lab]).execute(&mut *transaction).await?;
        if removed.rows_affected() == 0 {
            return Err(StoreError::missing("lab", lab.as_str()));
        }
        for totals in [
            "DELETE FROM lab_totals WHERE lab = ?",
            "DELETE FROM jobs_by_state WHERE lab = ?",
            "DELETE FROM files_of_labs WHERE lab = ?",
            "DELETE FROM webhook_secrets WHERE lab = ?",
        ] {
            sql!(totals, [lab]).execute(&mut *transaction).await?;
        }
        Ok(transaction.commit().await?)
    }
}

/// Things that keep a lab from being removed, each with the query that counts those of one lab.
const BELONGINGS: [(&str, &str); 7] = [
    ("tokens", "SELECT count(*) FROM tokens WHERE lab = ? AND revoked_at IS NULL"),
    ("jobs", "SELECT count(*) FROM jobs WHERE lab = ?"),
    ("measurements", "SELECT count(*) FROM requests WHERE lab = ? AND what = 'measurement'"),
    ("calibrations", "SELECT count(*) FROM requests WHERE lab = ? AND what = 'calibration'"),
    ("networks", "SELECT count(*) FROM requests WHERE lab = ? AND what = 'model'"),
    ("uploads", "SELECT count(*) FROM holdings WHERE lab = ?"),
    (
        "uploads that are not complete",
        "SELECT count(*) FROM partials WHERE lab = ? AND result IS NULL",
    ),
];

/// As [`Store::limits`].
pub async fn limits(
    connection: &mut SqliteConnection,
    lab: &Lab,
) -> Result<(Option<u64>, Option<u64>)> {
    let limits = sql_as!(
        "SELECT coalesce((SELECT max_bytes FROM labs WHERE lab = ?1),
                         (SELECT max_bytes FROM default_limits WHERE (SELECT count(*) FROM labs) > 1)),
                coalesce((SELECT max_jobs FROM labs WHERE lab = ?1),
                         (SELECT max_jobs FROM default_limits WHERE (SELECT count(*) FROM labs) > 1))",
        [lab]
    );
    limits.fetch_one(connection).await
}

/// The problem of a share, if it has one.
pub fn share_error(share: f64) -> Option<&'static str> {
    let fits = (0.001..=1000.0).contains(&share);
    (!fits).then_some("a share is a number from 0.001 to 1000")
}

/// Inserts the row of a lab, if it is missing.
pub async fn know(connection: &mut SqliteConnection, lab: &Lab) -> Result<()> {
    sql!("INSERT OR IGNORE INTO labs (lab) VALUES (?)", [lab]).execute(connection).await?;
    Ok(())
}
