//! Tables `jobs_by_state`, `tasks_by_state`, `files_of_labs` and `stored_files`: running totals, which triggers keep.
//! Figures read them, so that the number of jobs does not slow them.

use crate::Store;
use crate::columns::{sql, sql_as};
use crate::error::Result;

/// Names of the tables with running totals, each with a statement that counts the totals that differ from a new sum.
const DIFFERENCES: [(&str, &str); 4] = [
    (
        "jobs_by_state",
        "WITH summed AS (
             SELECT lab, state, count(*), sum(disk_bytes), sum(result_bytes) FROM jobs GROUP BY lab, state),
         kept AS (
             SELECT * FROM jobs_by_state WHERE jobs <> 0 OR disk_bytes <> 0 OR result_bytes <> 0)
         SELECT (SELECT count(*) FROM (SELECT * FROM summed EXCEPT SELECT * FROM kept))
              + (SELECT count(*) FROM (SELECT * FROM kept EXCEPT SELECT * FROM summed))",
    ),
    (
        "tasks_by_state",
        "WITH summed AS (SELECT kind, state, count(*) FROM tasks GROUP BY kind, state),
         kept AS (SELECT * FROM tasks_by_state WHERE tasks <> 0)
         SELECT (SELECT count(*) FROM (SELECT * FROM summed EXCEPT SELECT * FROM kept))
              + (SELECT count(*) FROM (SELECT * FROM kept EXCEPT SELECT * FROM summed))",
    ),
    (
        "files_of_labs",
        "WITH files AS (
             SELECT lab, 'upload' AS kind, sha256 FROM holdings
             UNION ALL
             SELECT lab, 'movie', result FROM tasks WHERE thing IS NOT NULL AND result IS NOT NULL
             UNION ALL
             SELECT lab, 'prepared', prepared
             FROM (SELECT lab, prepared FROM calibrations UNION SELECT lab, prepared FROM measurements)),
         summed AS (
             SELECT lab, kind, count(*), sum(size) FROM files JOIN blobs USING (sha256) GROUP BY lab, kind),
         kept AS (SELECT * FROM files_of_labs WHERE files <> 0 OR bytes <> 0)
         SELECT (SELECT count(*) FROM (SELECT * FROM summed EXCEPT SELECT * FROM kept))
              + (SELECT count(*) FROM (SELECT * FROM kept EXCEPT SELECT * FROM summed))",
    ),
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
    "INSERT INTO jobs_by_state
     SELECT lab, state, count(*), sum(disk_bytes), sum(result_bytes) FROM jobs GROUP BY lab, state",
    "DELETE FROM tasks_by_state",
    "INSERT INTO tasks_by_state SELECT kind, state, count(*) FROM tasks GROUP BY kind, state",
    "DELETE FROM files_of_labs",
    "INSERT INTO files_of_labs
     SELECT lab, kind, count(*), sum(size)
     FROM (SELECT lab, 'upload' AS kind, sha256 FROM holdings
           UNION ALL
           SELECT lab, 'movie', result FROM tasks WHERE thing IS NOT NULL AND result IS NOT NULL
           UNION ALL
           SELECT lab, 'prepared', prepared
           FROM (SELECT lab, prepared FROM calibrations UNION SELECT lab, prepared FROM measurements))
     JOIN blobs USING (sha256) GROUP BY lab, kind",
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
