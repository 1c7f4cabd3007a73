//! What all handlers share.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::admission::Promises;
use super::events::Events;
use super::metrics::Metrics;
use super::model_check::Checker;
use super::pictures::Pictures;
use crate::config::ServeArguments;
use crate::formats::Limits;
use crate::job::Timestamp;
use crate::recon::prior::onnx::Device;
use crate::store::Store;

/// What all handlers share; cheap to clone.
#[derive(Debug, Clone)]
pub struct App(Arc<Shared>);

/// The content of [`App`].
#[derive(Debug)]
pub struct Shared {
    pub(super) store: Store,
    pub(super) limits: Limits,
    pub(super) max_upload_bytes: u64,
    pub(super) min_free_bytes: u64,
    pub(super) worker_memory_bytes: u64,
    pub(super) upload_idle: Duration,
    pub(super) request_time: Duration,
    pub(super) upload_age: Duration,
    pub(super) max_jobs: u64,
    pub(super) uploads: Arc<Semaphore>,
    pub(super) promises: Promises,
    /// One file is checked at a time: each takes a core and a frame of memory.
    pub(super) intake: Arc<Semaphore>,
    pub(super) checker: Checker,
    pub(super) metrics: Metrics,
    pub(super) events: Events,
    pub(super) pictures: Pictures,
    pub(super) about: About,
}

/// What `/v1/system` tells of the settings.
#[derive(Debug)]
pub(super) struct About {
    pub(super) started_at: Timestamp,
    pub(super) device: String,
    pub(super) provider: &'static str,
    pub(super) workers: usize,
    pub(super) uploads: usize,
}

impl About {
    fn new(settings: &ServeArguments) -> Self {
        let device = settings.engine.device.clone();
        // Workers refuse a device that can't be read, with the reason.
        let provider = Device::parse(&device).map_or("unknown", Device::provider);
        let (workers, uploads) = (settings.worker_count(), settings.max_uploads);
        Self { started_at: Timestamp::now(), device, provider, workers, uploads }
    }
}

impl App {
    /// The app on a store, with these settings. Answers that have no end of their own end with
    /// `closing`. Needs a runtime of tokio.
    #[must_use]
    pub fn new(
        store: Store,
        settings: &ServeArguments,
        metrics: Metrics,
        closing: CancellationToken,
    ) -> Self {
        let limits = Limits { max_file_bytes: settings.max_upload_bytes, ..Limits::default() };
        Self(Arc::new(Shared {
            events: Events::start(store.clone(), closing),
            pictures: Pictures::new(),
            about: About::new(settings),
            store,
            limits,
            max_upload_bytes: settings.max_upload_bytes,
            min_free_bytes: settings.min_free_bytes,
            worker_memory_bytes: settings.worker_memory_bytes,
            upload_idle: settings.upload_idle(),
            request_time: settings.request_time(),
            upload_age: settings.upload_age(),
            max_jobs: settings.max_jobs,
            uploads: Arc::new(Semaphore::new(settings.max_uploads)),
            promises: Promises::default(),
            intake: Arc::new(Semaphore::new(1)),
            checker: Checker::new(settings),
            metrics,
        }))
    }
}

impl std::ops::Deref for App {
    type Target = Shared;

    fn deref(&self) -> &Shared {
        &self.0
    }
}
