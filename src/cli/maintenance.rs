//! Maintenance beside serving: figures, and cleaning up.

use std::time::Duration;

use crate::config::ServeArguments;
use crate::job::Timestamp;
use crate::store::{Store, StoreError};

/// Time between two foldings of figures.
const TICK: Duration = Duration::from_secs(5);
/// Ticks between two cleanings.
const TICKS_PER_CLEANING: u64 = 120;
/// What is younger stays, however full the disk is.
const HOUR: Duration = Duration::from_secs(3600);
const DAY: Duration = Duration::from_secs(86_400);

/// Every few seconds: figures; at the start and every ten minutes: cleaning.
pub(super) async fn maintain(store: Store, fold_figures: impl Fn(), settings: ServeArguments) {
    let mut tick = tokio::time::interval(TICK);
    for count in 0u64.. {
        tick.tick().await;
        fold_figures();
        if count % TICKS_PER_CLEANING != 0 {
            continue;
        }
        if let Err(error) = clean(&store, &settings).await {
            tracing::error!(%error, "cleaning up has failed");
        }
    }
}

async fn clean(store: &Store, settings: &ServeArguments) -> Result<(), StoreError> {
    // 1. What crashes have left.
    store.advance_generation().await?;
    store.dir().sweep_tmp()?;
    let orphans = store.quarantine_orphans(false).await?;
    store.empty_quarantine(ago(DAY * settings.quarantine_days)).await?;
    // 2. What is older than it may get.
    let uploads =
        store.expire_partials().await? + store.collect(ago(settings.upload_age())).await?;
    let mut jobs = match settings.job_days {
        Some(days) => store.remove_jobs(ago(DAY * days), u64::MAX).await?,
        None => 0,
    };
    // 3. If the disk is nearly full: what nobody uses, then the oldest jobs.
    let mut unused = 0;
    if store.dir().disk()?.0 < settings.low_water_bytes {
        unused = store.collect(ago(HOUR)).await?;
        jobs += store.remove_jobs(ago(HOUR), settings.low_water_bytes).await?;
    }
    if orphans + uploads + jobs + unused > 0 {
        tracing::info!(orphans, uploads, jobs, unused, "cleaned up");
    }
    Ok(())
}

fn ago(age: Duration) -> Timestamp {
    let age = i64::try_from(age.as_millis()).unwrap_or(i64::MAX);
    Timestamp(Timestamp::now().0.saturating_sub(age))
}
