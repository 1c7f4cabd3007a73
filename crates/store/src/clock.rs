//! Ages of stored things. Wall clocks jump. A file that was stored while the clock was a year behind is not a year old
//! once the clock is right. So age also counts the time for which the service has run.

use std::time::Duration;

use super::Store;
use super::error::Result;
use crate::columns::{sql, sql_as};
use engine::job::Timestamp;

/// No age that anybody asks for is longer (a year, in milliseconds).
const LONGEST: i64 = 366 * 86_400_000;

impl Store {
    /// Notes what time it is, and that the service has run for so long since the last note.
    pub async fn note_time(&self, since: Duration) -> Result<()> {
        let since = i64::try_from(since.as_millis()).unwrap_or(LONGEST);
        let mut transaction = self.write().await?;
        // The earlier of two notes without time between them counts.
        sql!(
            "INSERT INTO clock (run, wall)
             VALUES ((SELECT coalesce(max(run), 0) FROM clock) + ?, ?)
             ON CONFLICT (run) DO UPDATE SET wall = min(wall, excluded.wall)",
            [since, Timestamp::now()]
        )
        .execute(&mut *transaction)
        .await?;
        sql!("DELETE FROM clock WHERE run < (SELECT max(run) FROM clock) - ?", [LONGEST])
            .execute(&mut *transaction)
            .await?;
        Ok(transaction.commit().await?)
    }

    /// Time stamp below which a thing is older than `age`, by the clock and by the running time of the service. It is
    /// not after any time that was noted within the last `age` of running.
    pub async fn ago(&self, age: Duration) -> Result<Timestamp> {
        let age = i64::try_from(age.as_millis()).unwrap_or(LONGEST);
        let seen: Option<i64> = sql_as!(
            "SELECT min(wall) FROM clock WHERE run >= (SELECT max(run) FROM clock) - ?",
            [age]
        )
        .fetch_one(&self.readers)
        .await?;
        let by_the_clock = Timestamp::now().0.saturating_sub(age);
        Ok(Timestamp(seen.map_or(by_the_clock, |seen| seen.min(by_the_clock))))
    }
}
