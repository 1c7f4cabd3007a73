//! Tables `jobs_by_state`, `tasks_by_state`, `files_of_labs` and `stored_files`: running totals, which triggers keep.
//! Figures read them, so that the number of jobs does not slow them.

use crate::Store;
use crate::columns::{sql, sql_as};
use crate::error::Result;

macro_rules! jobs {
    () => {
        "SELECT lab, state, count(*), sum(disk_bytes), sum(result_bytes) FROM jobs GROUP BY lab, state"
    };
}

macro_rules! tasks {
    () => {
        "SELECT kind, state, count(*) FROM tasks GROUP BY kind, state"
    };
}

macro_rules! files {
    () => {
        "SELECT lab, kind, count(*), sum(size)
         FROM (SELECT lab, 'upload' AS kind, sha256 FROM holdings
               UNION ALL
               SELECT lab, 'movie', result FROM tasks WHERE thing IS NOT NULL AND result IS NOT NULL
               UNION ALL
               SELECT DISTINCT lab, 'prepared', prepared FROM requests
               WHERE prepared IS NOT NULL AND what <> 'model')
         JOIN blobs USING (sha256) GROUP BY lab, kind"
    };
}

/// The number of rows in which new sums and the kept ones differ.
macro_rules! difference {
    ($sums:expr, $kept:expr) => {
        concat!(
            "WITH summed AS (",
            $sums,
            "), kept AS (SELECT * FROM ",
            $kept,
            ")
             SELECT (SELECT count(*) FROM (SELECT * FROM summed EXCEPT SELECT * FROM kept))
                  + (SELECT count(*) FROM (SELECT * FROM kept EXCEPT SELECT * FROM summed))"
        )
    };
}

/// Names of the tables with running totals, each with a statement that counts the totals that differ from a new sum.
const DIFFERENCES: [(&str, &str); 4] = [
    (
        "jobs_by_state",
        difference!(
            jobs!(),
            "jobs_by_state WHERE jobs <> 0 OR disk_bytes <> 0 OR result_bytes <> 0"
        ),
    ),
    ("tasks_by_state", difference!(tasks!(), "tasks_by_state WHERE tasks <> 0")),
    ("files_of_labs", difference!(files!(), "files_of_labs WHERE files <> 0 OR bytes <> 0")),
    (
        "stored_files",
        "SELECT (SELECT count(*) FROM blobs) <> (SELECT coalesce(sum(files), 0) FROM stored_files)
             OR (SELECT coalesce(sum(size), 0) FROM blobs)
                <> (SELECT coalesce(sum(bytes), 0) FROM stored_files)",
    ),
];

/// Statements that replace all running totals by new sums.
const RECOUNTS: [&str; 8] = [
    "DELETE FROM jobs_by_state",
    concat!("INSERT INTO jobs_by_state ", jobs!()),
    "DELETE FROM tasks_by_state",
    concat!("INSERT INTO tasks_by_state ", tasks!()),
    "DELETE FROM files_of_labs",
    concat!("INSERT INTO files_of_labs ", files!()),
    "DELETE FROM stored_files",
    "INSERT INTO stored_files SELECT 1, count(*), coalesce(sum(size), 0) FROM blobs",
];

impl Store {
    /// Replaces all running totals by new sums. Takes seconds for 100,000 jobs.
    pub(crate) async fn recount_totals(&self) -> Result<()> {
        let mut transaction = self.write().await?;
        for text in RECOUNTS {
            sql!(text).execute(&mut *transaction).await?;
        }
        Ok(transaction.commit().await?)
    }

    /// Names of the tables with running totals that differ from a new sum.
    pub(crate) async fn wrong_totals(&self) -> Result<Vec<&'static str>> {
        let mut wrong = Vec::new();
        for (table, differences) in DIFFERENCES {
            let differences: u64 = sql_as!(differences).fetch_one(&self.readers).await?;
            if differences > 0 {
                wrong.push(table);
            }
        }
        Ok(wrong)
    }
}
