//! Maintenance during service: folds metrics, and cleans up.

use std::time::{Duration, Instant};

use crate::audit::{Actor, AuditLog, Entry, Outcome};
use crate::config::ServeArguments;
use engine::job::Timestamp;
use formats::DiskTrouble;
use store::{Expired, Store, StoreError};

/// Time between two foldings of metrics.
const TICK: Duration = Duration::from_secs(5);
/// Ticks between two cleanings.
const TICKS_PER_CLEANING: u64 = 120;
/// Age below which files are kept even if the disk is full.
const MIN_AGE: Duration = Duration::from_secs(3600);
const DAY: Duration = Duration::from_secs(86_400);

/// Folds metrics every few seconds, and cleans up at the start and every ten minutes.
pub(super) async fn maintain(
    store: Store,
    fold_metrics: impl Fn(),
    settings: ServeArguments,
    audit: AuditLog,
) {
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
        let mut cleaned = clean(&store, &settings, &audit).await;
        if is_full(&cleaned) && matches!(store.give_up_reserve().await, Ok(true)) {
            cleaned = clean(&store, &settings, &audit).await;
        }
        if let Err(error) = cleaned {
            tracing::error!(%error, "cleaning up has failed");
        }
    }
}

fn is_full(cleaned: &Result<(), StoreError>) -> bool {
    cleaned.as_ref().is_err_and(|error| error.disk_trouble() == Some(DiskTrouble::Full))
}

/// Records deletions of one kind, and counts them.
struct Deletions<'a> {
    audit: &'a AuditLog,
    action: &'static str,
    count: usize,
}

impl<'a> Deletions<'a> {
    fn new(audit: &'a AuditLog, action: &'static str) -> Self {
        Self { audit, action, count: 0 }
    }

    fn record<Id: ToString>(&mut self, expired: Expired<Id>) {
        self.count += 1;
        self.audit.record(&Entry {
            lab: Some(expired.lab),
            object: Some(expired.id.to_string()),
            ..Entry::new(Actor::Service, self.action, Outcome::Done)
        });
    }
}

async fn clean(
    store: &Store,
    settings: &ServeArguments,
    audit: &AuditLog,
) -> Result<(), StoreError> {
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
    let mut uploads = Deletions::new(audit, "delete unused upload");
    let mut unfinished = Deletions::new(audit, "delete unfinished upload");
    let mut jobs = Deletions::new(audit, "delete ended job");
    store.expire_partials(settings.upload_age(), |upload| unfinished.record(upload)).await?;
    let old = store.ago(settings.upload_age()).await?;
    store.collect(old).await?.into_iter().for_each(|upload| uploads.record(upload));
    if let Some(days) = settings.job_days {
        let old = store.ago(DAY * days).await?;
        store.remove_jobs(old, u64::MAX, |job| jobs.record(job)).await?;
    }
    // 3. If the disk is nearly full, remove unused files, then the oldest jobs.
    if store.dir().disk()?.0 < settings.low_water_bytes {
        let old = store.ago(MIN_AGE).await?;
        store.collect(old).await?.into_iter().for_each(|upload| uploads.record(upload));
        store.remove_jobs(old, settings.low_water_bytes, |job| jobs.record(job)).await?;
    }
    let (uploads, unfinished, jobs) = (uploads.count, unfinished.count, jobs.count);
    // 4. Keep a reserve, so that the service can start and delete on a full disk.
    if let Err(error) = store.dir().keep_reserve(settings.min_free_bytes) {
        tracing::warn!(%error, "there is no reserve for a full disk");
    }
    if orphans + uploads + unfinished + jobs > 0 {
        tracing::info!(orphans, uploads, unfinished, jobs, "cleaned up");
    }
    Ok(())
}
