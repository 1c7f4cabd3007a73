//! What all handlers share.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::FromRef;
use axum::http::header;
use quick_cache::sync::Cache;
use serde::Serialize;
use tokio::sync::{Mutex, OwnedMutexGuard, watch};
use tokio_util::sync::CancellationToken;

use super::admission::Admission;
use super::conditional;
use super::context::{RequestContext, Wait};
use super::error::Result;
use super::events::Events;
use super::metrics::Metrics;
use super::rate::Rates;
use super::rendering::Pictures;
use super::revocation::Revocations;
use super::shares::{Changes, Turns};
use crate::audit::AuditLog;
use crate::config::{DeviceState, ServeArguments};
use engine::job::{Lab, Timestamp, TokenId, without_paths};
use engine::pipeline::networks::NetworkSource;
use engine::pipeline::quality::Quality;
use formats::Limits;
use store::Store;

/// Labs for which a file is read at the same time, so that a slow one keeps no other lab waiting.
const READS_AT_ONCE: usize = 4;
/// Sessions that a token may begin in a minute. Each one writes to the database.
const SESSIONS_PER_MINUTE: u32 = 20;
/// Requests of a lab that may wait for a file to be read.
const READS: usize = 32;

/// Number of comparisons that are kept.
const KEPT_QUALITIES: usize = 1000;

/// What all handlers share; cheap to clone.
#[derive(Debug, Clone)]
pub struct App(Arc<Services>);

/// The content of [`App`].
#[derive(Debug)]
pub struct Services {
    pub(super) store: Store,
    pub(super) settings: ServeArguments,
    pub(super) audit: AuditLog,
    pub(super) started_at: Timestamp,
    pub(super) limits: Limits,
    pub(super) admission: Admission,
    /// Each read takes a core and a frame of memory; a lab has one at a time.
    pub(super) intake: Turns,
    pub(super) changes: Changes,
    /// Ends what has no end of its own.
    pub(super) closing: CancellationToken,
    /// When it was last tried whether files can be written, and what came of it.
    pub(super) disk_tried: Mutex<Option<(Instant, std::result::Result<(), String>)>>,
    pub(super) metrics: Metrics,
    pub(super) events: Events,
    pub(super) revocations: Revocations,
    /// The rate at which each token begins sessions.
    pub(super) session_rates: Rates<TokenId>,
    pub(super) pictures: Pictures,
    /// Comparisons by frames, truth and its reading, because a list of jobs asks for the same ones again and again.
    pub(super) qualities: Cache<String, Quality>,
    pub(super) machine: Machine,
}

/// The state of the cluster, the confinement and the device of the workers.
#[derive(Debug)]
pub struct Machine {
    /// Why no tile can leave this machine; `None` if none should.
    pub cluster: Option<watch::Receiver<Option<String>>>,
    /// Why networks of users can read files of labs, if they can.
    pub confinement: std::result::Result<(), String>,
    /// The networks of the service.
    pub networks: NetworkSource,
    /// State of the device that runs networks.
    pub device: watch::Receiver<DeviceState>,
}

impl App {
    /// The app on a store, with these settings. Endless answers end with `closing`. Needs a runtime of tokio.
    pub fn new(
        store: Store,
        (settings, audit): (&ServeArguments, AuditLog),
        metrics: Metrics,
        machine: Machine,
        closing: CancellationToken,
    ) -> Self {
        Self(Arc::new(Services {
            events: Events::start(store.clone(), closing.clone()),
            revocations: Revocations::start(store.clone()),
            session_rates: Rates::new(SESSIONS_PER_MINUTE),
            pictures: Pictures::new(),
            qualities: Cache::new(KEPT_QUALITIES),
            started_at: Timestamp::now(),
            limits: Limits { max_file_bytes: settings.max_upload_bytes, ..Limits::default() },
            admission: Admission::new(store.clone(), settings),
            intake: Turns::new(READS_AT_ONCE, READS),
            changes: Changes::default(),
            closing,
            disk_tried: Mutex::default(),
            metrics,
            machine,
            settings: settings.clone(),
            audit,
            store,
        }))
    }
}

impl App {
    /// Checks `If-Match` of a request that changes or deletes something; `current` gives its representation. No
    /// other request changes anything of the lab until the guard is dropped.
    pub(super) async fn precondition<T: Serialize>(
        &self,
        request: &RequestContext,
        lab: &Lab,
        current: impl Future<Output = Result<T>>,
    ) -> Result<OwnedMutexGuard<()>> {
        let guard = self.changes.lock(lab).await;
        if request.headers.contains_key(header::IF_MATCH) {
            conditional::check_match(&request.headers, &conditional::etag_of(&current.await?)?)?;
        }
        Ok(guard)
    }

    /// How long a GET waits that prefers to; none for not at all. A proxy, or the limit on the time of answers, must not
    /// come first.
    pub(super) fn wait(&self, wait: Wait) -> Option<Duration> {
        let time = wait.time(Duration::ZERO).min(self.settings.request_time() / 2);
        (!time.is_zero()).then_some(time)
    }

    /// Whether jobs with networks can be done; if not, why, and what to do. Looked up each time: the library
    /// may be put in its place while the service runs.
    pub(super) fn networks(&self) -> Result<(), String> {
        let elsewhere = self.settings.without_tiles() || self.settings.workers == Some(0);
        // Workers that others start bring their own.
        let found = if elsewhere { Ok(()) } else { self.settings.engine.check_library() };
        found.map_err(|error| without_paths(&error.to_string()))?;
        match &*self.machine.device.borrow() {
            DeviceState::Refused(reason) => Err(without_paths(reason)),
            DeviceState::Untried | DeviceState::Ready => Ok(()),
        }
    }
}

/// Workers that were silent for longer are not counted.
pub(super) const WORKER_AGE: Duration = Duration::from_secs(15);

impl App {
    /// True if a live worker, or those of this service, use a GPU.
    pub(super) async fn has_gpu(&self) -> Result<bool> {
        let workers = self.store.live_workers(WORKER_AGE).await?;
        let devices = workers.iter().filter_map(|worker| worker.place.device.as_deref());
        let mut devices = devices.chain([&*self.settings.engine.device]);
        Ok(devices.any(|device| device != "cpu"))
    }

    /// The problem in words if no worker takes tiles. A service that has just started has time to start its workers.
    pub(super) async fn tiles(&self) -> Result<std::result::Result<(), String>> {
        if self.store.live_tile_workers(WORKER_AGE).await? > 0 {
            return Ok(Ok(()));
        }
        let last = self
            .store
            .last_tile_worker()
            .await?
            .map_or(self.started_at, |last| last.max(self.started_at));
        let seconds = Timestamp::now().seconds_since(last);
        if seconds < WORKER_AGE.as_secs_f64() {
            return Ok(Ok(()));
        }
        // Coarse: an ETag should not change every second.
        let time = match seconds {
            ..60.0 => format!("{:.0} s", (seconds / 15.0).floor() * 15.0),
            60.0..3600.0 => format!("{:.0} min", (seconds / 60.0).floor()),
            _ => format!("{:.0} h", (seconds / 3600.0).floor()),
        };
        Ok(Err(format!("no worker has taken tiles for {time}")))
    }

    /// What keeps the service from doing some jobs: networks, the cluster, workers for tiles.
    pub(super) async fn troubles(&self) -> Result<Vec<String>> {
        let cluster = self.machine.cluster.as_ref().and_then(|trouble| trouble.borrow().clone());
        let troubles = [self.networks().err(), cluster, self.tiles().await?.err()];
        Ok(troubles.into_iter().flatten().collect())
    }
}

impl std::ops::Deref for App {
    type Target = Services;

    fn deref(&self) -> &Services {
        &self.0
    }
}

impl FromRef<App> for Events {
    fn from_ref(app: &App) -> Self {
        app.events.clone()
    }
}
