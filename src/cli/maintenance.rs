//! Maintenance during service: folds metrics, and cleans up.

use std::time::{Duration, Instant};

use crate::config::ServeArguments;
use engine::job::Timestamp;
use store::{Store, StoreError};

/// Time between two foldings of metrics.
const TICK: Duration = Duration::from_secs(5);
/// Ticks between two cleanings.
const TICKS_PER_CLEANING: u64 = 120;
/// Age below which files are kept even if the disk is full.
const MIN_AGE: Duration = Duration::from_secs(3600);
const DAY: Duration = Duration::from_secs(86_400);

/// Folds metrics every few seconds, and cleans up at the start and every ten minutes.
pub(super) async fn maintain(store: Store, fold_metrics: impl Fn(), settings: ServeArguments) {
    let mut tick = tokio::time::interval(TICK);
    let mut noted = Instant::now();
    for count in 0u64.. {
        tick.tick().await;
        fold_metrics();
        if count % TICKS_PER_CLEANING != 0 {
            continue;
        }
        match store.note_time(noted.elapsed()).await {
            Ok(()) => noted = Instant::now(),
            Err(error) => tracing::error!(%error, "the time can't be recorded"),
        }
        if let Err(error) = store.look_at_database().await {
            tracing::error!(%error, "the database can't be checked");
        }
        if let Err(error) = clean(&store, &settings).await {
            tracing::error!(%error, "cleaning up has failed");
        }
    }
}

async fn clean(store: &Store, settings: &ServeArguments) -> Result<(), StoreError> {
    // 1. Remove the remains of crashes.
    store.advance_generation().await?;
    store.dir().sweep_tmp()?;
    store.finish_removals().await?;
    let orphans = store.quarantine_orphans(false).await?;
    store.empty_quarantine(store.ago(DAY * settings.quarantine_days).await?).await?;
    let full = store.dir().disk()?.0 < settings.low_water_bytes.max(settings.min_free_bytes);
    let updated = match settings.rollback_days {
        days if days > 0 && !full => store.ago(DAY * days).await?,
        _ => Timestamp::now(),
    };
    if store.release_kept(updated).await? {
        tracing::info!("files from before the last update are no longer kept");
    }
    // 2. Remove expired uploads and jobs.
    let old = store.ago(settings.upload_age()).await?;
    let uploads = store.expire_partials(settings.upload_age()).await? + store.collect(old).await?;
    let mut jobs = match settings.job_days {
        Some(days) => store.remove_jobs(store.ago(DAY * days).await?, u64::MAX).await?,
        None => 0,
    };
    // 3. If the disk is nearly full, remove unused files, then the oldest jobs.
    let mut unused = 0;
    if store.dir().disk()?.0 < settings.low_water_bytes {
        let old = store.ago(MIN_AGE).await?;
        unused = store.collect(old).await?;
        jobs += store.remove_jobs(old, settings.low_water_bytes).await?;
    }
    // 4. Keep a reserve, so that the service can start on a full disk.
    if let Err(error) = store.dir().keep_reserve(settings.min_free_bytes) {
        tracing::warn!(%error, "there is no reserve for a start on a full disk");
    }
    if orphans + uploads + jobs + unused > 0 {
        tracing::info!(orphans, uploads, jobs, unused, "cleaned up");
    }
    Ok(())
}
