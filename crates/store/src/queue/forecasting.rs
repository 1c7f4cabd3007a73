//! Making forecasts of the queue from the tables.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use super::forecast::{Forecast, Unfinished};
use crate::Store;
use crate::columns::{Columns, sql, sql_as};
use crate::error::Result;
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
            "SELECT id, lab, priority, state, tiles_left + others_left AS left
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
                left: row.read("left")?,
            });
        }
        let workers = self.live_tile_workers(WORKER_AGE).await?;
        Ok(Forecast::new(&unfinished, labs, workers, self.rates().await?))
    }

    /// Seconds that a planned CPU-second of tiles and of other tasks takes on this machine: the mean over the last tasks of
    /// a kind, weighted by their planned cost. Each kind starts with some seconds as planned, because the first tasks may be
    /// so small that they measure the start of a process.
    async fn rates(&self) -> Result<(f64, f64)> {
        const AS_PLANNED: (f64, f64) = (10.0, 1.0);
        let row = sql!(
            "SELECT coalesce(sum(recent_seconds) FILTER (WHERE kind = 'tile'), 0.0) AS tile_seconds,
                 coalesce(sum(recent_cost) FILTER (WHERE kind = 'tile'), 0.0) AS tile_cost,
                 coalesce(sum(recent_seconds)
                     FILTER (WHERE kind IN ('prepare', 'preview', 'assemble')), 0.0) AS other_seconds,
                 coalesce(sum(recent_cost)
                     FILTER (WHERE kind IN ('prepare', 'preview', 'assemble')), 0.0) AS other_cost
             FROM totals",
        )
        .fetch_one(&self.readers)
        .await?;
        let rate = |seconds: &'static str, cost: &'static str, start: f64| -> Result<f64> {
            Ok((row.read::<f64>(seconds)? + start) / (row.read::<f64>(cost)? + start))
        };
        let (tiles, others) = AS_PLANNED;
        Ok((
            rate("tile_seconds", "tile_cost", tiles)?,
            rate("other_seconds", "other_cost", others)?,
        ))
    }

    /// Planned CPU-seconds left of the unfinished jobs of each lab that has any.
    pub async fn cost_left_by_lab(&self) -> Result<HashMap<Lab, f64>> {
        Ok(self.forecast().await?.left_by_lab.clone())
    }
}
