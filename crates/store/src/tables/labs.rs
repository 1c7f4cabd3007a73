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
    /// Its share of the machine, beside the shares of the others that want it.
    pub share: f64,
    /// Bytes that it may keep here; none: no limit.
    pub max_bytes: Option<u64>,
    /// Jobs that it may have waiting and running; none: no limit of its own.
    pub max_jobs: Option<u64>,
    /// Jobs that wait and run.
    pub jobs: u64,
    /// Planned CPU-seconds that are left of them.
    pub cost_left: f64,
}

from_row!(LabRow, row => { lab, share, max_bytes, max_jobs, jobs, cost_left });

/// Usage of a lab.
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

/// What a lab is to be entitled to; what is none stays as it is.
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
                 (SELECT count(*) FROM holdings WHERE lab = ?1) AS uploads,
                 (SELECT coalesce(sum(size), 0) FROM holdings JOIN blobs USING (sha256)
                  WHERE lab = ?1) AS upload_bytes,
                 (SELECT coalesce(sum(result_bytes), 0) FROM jobs WHERE lab = ?1)
                 + (SELECT coalesce(sum(size), 0) FROM tasks JOIN blobs ON sha256 = result
                    WHERE lab = ?1 AND thing IS NOT NULL AND result IS NOT NULL) AS result_bytes,
                 (SELECT count(*) FROM jobs WHERE lab = ?1 AND finished_at IS NULL) AS jobs",
            [lab]
        );
        found.fetch_one(&self.readers).await
    }

    /// All labs, by name.
    pub async fn labs(&self) -> Result<Vec<LabRow>> {
        self.find_labs(None).await
    }

    /// The lab of this name.
    /// Errors: [`StoreError::NotFound`] if none is on record.
    pub async fn lab(&self, name: &str) -> Result<LabRow> {
        let found = self.find_labs(Some(name)).await?.pop();
        found.ok_or_else(|| StoreError::missing("lab", name))
    }

    async fn find_labs(&self, name: Option<&str>) -> Result<Vec<LabRow>> {
        let rows = sql_as!(
            "SELECT labs.lab, share, max_bytes, max_jobs, count(jobs.id) AS jobs,
                 coalesce(sum(tiles_left + others_left), 0.0) AS cost_left
             FROM labs
             LEFT JOIN jobs ON jobs.lab = labs.lab AND finished_at IS NULL
             LEFT JOIN job_sums ON job = jobs.id
             WHERE ?1 IS NULL OR labs.lab = ?1
             GROUP BY labs.lab ORDER BY labs.lab",
            [name]
        );
        rows.fetch_all(&self.readers).await
    }

    /// Figures of all labs, by name.
    pub async fn lab_figures(&self) -> Result<Vec<LabFigures>> {
        let rows: Vec<(Lab, u64, f64, f64, u64, Option<Timestamp>)> = sql_as!(
            "SELECT labs.lab, coalesce(jobs_begun, 0), coalesce(wait_seconds, 0.0),
                 coalesce(cpu_seconds, 0.0),
                 (SELECT coalesce(sum(result_bytes), 0) FROM jobs WHERE jobs.lab = labs.lab)
                 + (SELECT coalesce(sum(size), 0) FROM tasks JOIN blobs ON sha256 = result
                    WHERE tasks.lab = labs.lab AND thing IS NOT NULL AND result IS NOT NULL),
                 (SELECT min(created_at) FROM jobs
                  WHERE jobs.lab = labs.lab AND finished_at IS NULL AND started_at IS NULL)
             FROM labs LEFT JOIN lab_totals USING (lab) ORDER BY labs.lab",
        )
        .fetch_all(&self.readers)
        .await?;
        let counted: Vec<(Lab, JobState, u64)> =
            sql_as!("SELECT lab, state, count(*) FROM jobs GROUP BY lab, state")
                .fetch_all(&self.readers)
                .await?;
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

    /// Whether a lab is on record: it has a token, something in the queue, or limits.
    pub async fn knows_lab(&self, lab: &Lab) -> Result<bool> {
        let found = sql!("SELECT 1 FROM labs WHERE lab = ?", [lab]);
        Ok(found.fetch_optional(&self.readers).await?.is_some())
    }

    /// What a lab is entitled to.
    pub async fn entitlement(&self, lab: &Lab) -> Result<Entitlement> {
        let found = sql_as!("SELECT share, max_bytes, max_jobs FROM labs WHERE lab = ?", [lab]);
        let found: Option<(f64, Option<u64>, Option<u64>)> =
            found.fetch_optional(&self.readers).await?;
        let (share, max_bytes, max_jobs) = found.unwrap_or((1.0, None, None));
        let (max_bytes, max_jobs) = (Some(max_bytes), Some(max_jobs));
        Ok(Entitlement { share: Some(share), max_bytes, max_jobs })
    }

    /// Sets what a lab is entitled to. A lab that is not on record yet is put there.
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
    /// Errors: [`StoreError::NotFound`] if it is not on record; [`StoreError::InUse`] if it has a token or data.
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
        sql!("DELETE FROM lab_totals WHERE lab = ?", [lab]).execute(&mut *transaction).await?;
        Ok(transaction.commit().await?)
    }
}

/// Things that keep a lab on record, each with the query that counts those of one lab.
const BELONGINGS: [(&str, &str); 8] = [
    ("tokens", "SELECT count(*) FROM tokens WHERE lab = ? AND revoked_at IS NULL"),
    ("jobs", "SELECT count(*) FROM jobs WHERE lab = ?"),
    ("measurements", "SELECT count(*) FROM measurements WHERE lab = ?"),
    ("calibrations", "SELECT count(*) FROM calibrations WHERE lab = ?"),
    ("networks", "SELECT count(*) FROM models WHERE lab = ?"),
    ("checks of files", "SELECT count(*) FROM requests WHERE lab = ?"),
    ("uploads", "SELECT count(*) FROM holdings WHERE lab = ?"),
    (
        "uploads that are not complete",
        "SELECT count(*) FROM partials WHERE lab = ? AND result IS NULL",
    ),
];

/// What is wrong with a share, if something is.
pub fn share_error(share: f64) -> Option<&'static str> {
    let fits = (0.001..=1000.0).contains(&share);
    (!fits).then_some("a share is a number from 0.001 to 1000")
}

/// Puts a lab on record, if it is not there.
pub async fn know(connection: &mut SqliteConnection, lab: &Lab) -> Result<()> {
    sql!("INSERT OR IGNORE INTO labs (lab) VALUES (?)", [lab]).execute(connection).await?;
    Ok(())
}
