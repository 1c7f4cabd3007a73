//! Making forecasts of the queue from the tables.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use super::forecast::{Crew, Forecast, Unfinished};
use crate::Store;
use crate::columns::{Columns, sql, sql_as};
use crate::error::Result;
use crate::tables::workers::since;
use engine::job::{JobState, Lab};

/// Workers that were silent for longer do not count.
const WORKER_AGE: Duration = Duration::from_secs(15);

impl Store {
    /// The load ahead of every unfinished job. While the forecast of a long queue is renewed, callers get the last one,
    /// so that no request takes longer in a longer queue.
    pub(super) async fn forecast(&self) -> Result<Arc<Forecast>> {
        match self.forecasts.last() {
            Some(last) if last.is_good() => return Ok(last),
            Some(last) if last.is_long() && !last.is_outdated() => {
                if let Ok(making) = self.forecasts.making.clone().try_lock_owned() {
                    let store = self.clone();
                    tokio::spawn(async move {
                        let _making = making;
                        if let Err(error) = store.renew_forecast().await {
                            tracing::warn!(%error, "the forecast of the queue can't be renewed");
                        }
                    });
                }
                return Ok(last);
            }
            _ => {}
        }
        let _making = self.forecasts.making.lock().await;
        match self.forecasts.last() {
            Some(last) if last.is_good() => Ok(last),
            _ => self.renew_forecast().await,
        }
    }

    async fn renew_forecast(&self) -> Result<Arc<Forecast>> {
        let made = self.new_forecast().await?;
        Ok(self.forecasts.keep(made))
    }

    async fn new_forecast(&self) -> Result<Forecast> {
        let rows = sql!(
            "SELECT id, lab, priority, state, tiles_left, others_left
             FROM jobs INDEXED BY jobs_unfinished JOIN job_sums ON job = id
             WHERE finished_at IS NULL ORDER BY id",
        )
        .fetch_all(&self.readers)
        .await?;
        let found: Vec<(Lab, f64)> =
            sql_as!("SELECT lab, share FROM labs").fetch_all(&self.readers).await?;
        let shares: HashMap<Lab, f64> = found.into_iter().collect();
        let mut labs: Vec<(Lab, f64)> = Vec::new();
        let (mut places, mut unfinished) = (HashMap::new(), Vec::with_capacity(rows.len()));
        for row in &rows {
            let lab: Lab = row.read("lab")?;
            let place = *places.entry(lab).or_insert_with_key(|lab| {
                labs.push((lab.clone(), shares.get(lab).copied().unwrap_or(1.0)));
                labs.len() - 1
            });
            unfinished.push(Unfinished {
                id: row.read("id")?,
                lab: place,
                priority: row.read("priority")?,
                waits: row.read::<JobState>("state")? == JobState::Queued,
                tiles: row.read("tiles_left")?,
                others: row.read("others_left")?,
            });
        }
        let (tiles, others) = (self.crew(true).await?, self.crew(false).await?);
        Ok(Forecast::new(&unfinished, labs, tiles, others))
    }

    /// The live workers of tiles, or those of other tasks. The speed of each is the mean over the last tasks on its device,
    /// weighted by their planned cost. It starts with some seconds as planned, because the first tasks may be so small that
    /// they measure the start of a process.
    async fn crew(&self, of_tiles: bool) -> Result<Crew> {
        let as_planned = if of_tiles { 10.0 } else { 1.0 };
        sql_as!(
            "SELECT count(*) AS workers,
                 total((coalesce(cost, 0.0) + ?3) / (coalesce(seconds, 0.0) + ?3)) AS speed
             FROM workers LEFT JOIN (
                 SELECT device AS class, sum(seconds) AS seconds, sum(cost) AS cost FROM rates
                 WHERE kind IN ('tile', 'prepare', 'preview', 'assemble') AND (kind = 'tile') = ?2
                 GROUP BY device)
             ON class = coalesce(device, 'cpu')
             WHERE seen_at >= ?1 AND light = 0 AND iif(?2, tiles, others)",
            [since(WORKER_AGE), of_tiles, as_planned]
        )
        .fetch_one(&self.readers)
        .await
    }

    /// Planned CPU-seconds left of the unfinished jobs of each lab that has any.
    pub async fn cost_left_by_lab(&self) -> Result<HashMap<Lab, f64>> {
        Ok(self.forecast().await?.left_by_lab.clone())
    }
}
