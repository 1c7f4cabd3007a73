//! Table `changes`: the last changes of jobs, calibrations, measurements and models. Triggers write it, so that no
//! change is missed, whichever process makes it.

use crate::Store;
use crate::columns::{from_row, sql_as};
use crate::error::Result;
use engine::job::Lab;

/// A job, calibration, measurement or model that has changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    /// `job`, `calibration`, `measurement` or `model`.
    pub what: String,
    pub lab: Lab,
    pub id: String,
    /// False if it was deleted.
    pub exists: bool,
}

from_row!(Change, row => { what, lab, id, exists });

/// The changes since a moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Changes {
    /// Each thing once. `None` if some of the changes are too old.
    pub items: Option<Vec<Change>>,
    /// Number of the last change, from which the next look starts.
    pub last: i64,
}

impl Store {
    /// Number of the last change of anything; 0 if there was none.
    pub async fn last_change(&self) -> Result<i64> {
        let last = "SELECT coalesce(max(number), 0) FROM changes";
        sql_as!(last).fetch_one(&self.readers).await
    }

    /// The changes after the one with the number `after`. The cost depends on their number alone.
    pub async fn changes(&self, after: i64) -> Result<Changes> {
        // All statements see the same state of the database.
        let mut snapshot = self.readers.begin().await?;
        let range = "SELECT coalesce(min(number), 0), coalesce(max(number), 0) FROM changes";
        let (first, last): (i64, i64) = sql_as!(range).fetch_one(&mut *snapshot).await?;
        if first > after + 1 || last < after {
            return Ok(Changes { items: None, last });
        }
        let items = sql_as!(
            "SELECT DISTINCT what, lab, id,
                 CASE what WHEN 'job' THEN EXISTS (SELECT 1 FROM jobs WHERE jobs.id = changes.id)
                     ELSE EXISTS (SELECT 1 FROM requests WHERE requests.id = changes.id) END AS \"exists\"
             FROM changes WHERE number > ?",
            [after]
        );
        Ok(Changes { items: Some(items.fetch_all(&mut *snapshot).await?), last })
    }

    /// The names of all labs.
    pub async fn lab_names(&self) -> Result<Vec<Lab>> {
        sql_as!("SELECT lab FROM labs").fetch_all(&self.readers).await
    }
}
