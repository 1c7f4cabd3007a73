//! `sci-recon serve`: runs the API and its workers until a signal stops it.

use std::io::Write;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::confine::confinement;
use super::logging;
use super::maintenance::maintain;
use super::stop::{stop_signal, stopped};
use super::supervisor::Supervisor;
use crate::audit::AuditLog;
use crate::config::{
    ClusterArguments, DeviceState, EngineArguments, RemoteArguments, ServeArguments, Takes,
    VERSION, WorkerArguments,
};
use crate::http::{App, Machine, Metrics, listen, router};
use engine::pipeline::networks::{NetworkError, NetworkSource};
use store::{Purpose, Store, StoreError};
use workers::nats::{
    Access, ClusterError, Credential, Hub, HubSettings, Program, describe_metrics,
};

/// Time that open requests have to end at a shutdown.
const DRAIN: Duration = Duration::from_secs(20);
/// The file in the data folder with the address of the service.
const ADDRESS_FILE: &str = "server.json";

/// The address of a running service, and the file of its audit log.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Announcement {
    pub(super) address: SocketAddr,
    pub(super) url: String,
    pid: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) audit_log: Option<PathBuf>,
}

impl Announcement {
    /// Reads the announcement in a data folder.
    /// Errors: none can be read, as while no service runs.
    pub(super) fn read(data: &Path) -> std::io::Result<Self> {
        Ok(serde_json::from_slice(&std::fs::read(data.join(ADDRESS_FILE))?)?)
    }
}

#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The service would be open to everyone.
    #[error(
        "{0} can be reached from other machines, and everyone could do everything: create a token \
        (sci-recon token create), listen on 127.0.0.1, or set --allow-remote if the network is \
        trusted"
    )]
    Exposed(SocketAddr),
    /// The device can't be read, or the folder of networks is not one.
    #[error(transparent)]
    Networks(#[from] NetworkError),
    /// The store can't be opened.
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("can't listen at {address}: {source}")]
    Listen { address: SocketAddr, source: std::io::Error },
    #[error("can't {action}: {source}")]
    Io { action: &'static str, source: std::io::Error },
    #[error("can't write the audit log {file}: {source}; correct --audit-log, or its permissions")]
    Audit { file: String, source: std::io::Error },
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    #[error("can't collect metrics: {0}")]
    Metrics(#[from] metrics_exporter_prometheus::BuildError),
}

fn io(action: &'static str) -> impl FnOnce(std::io::Error) -> ServeError {
    move |source| ServeError::Io { action, source }
}

/// Serves until SIGTERM or Ctrl-C.
pub fn run(settings: &ServeArguments) -> Result<(), ServeError> {
    logging::start(settings.log_format);
    let runtime = tokio::runtime::Runtime::new().map_err(io("start the runtime"))?;
    let served = runtime.block_on(serve(settings));
    #[cfg(feature = "otel")]
    crate::traces::finish();
    served
}

async fn serve(settings: &ServeArguments) -> Result<(), ServeError> {
    // 1. Open the audit log, and the store exclusively.
    let file = settings.audit.audit_log.as_deref();
    let audit = AuditLog::open(file).map_err(|source| {
        let file = file.map_or(String::new(), |file| file.display().to_string());
        ServeError::Audit { file, source }
    })?;
    let accept_database = settings.accept_database;
    let store = Store::open(&settings.data, Purpose::Serve { accept_database }).await?;
    if settings.is_exposed(store.is_open().await?) {
        return Err(ServeError::Exposed(settings.listen));
    }
    let networks = settings.engine.source()?;
    // 2. Clean up after an earlier server.
    let swept = store.dir().sweep_tmp()?;
    store.finish_removals().await?;
    store.quarantine_orphans(accept_database).await?;
    store.forget_workers(Duration::from_secs(60)).await?;
    let half = store.dir().disk()?.1 / 2;
    let lab_jobs = settings.lab_jobs.unwrap_or(settings.max_jobs);
    store.set_default_limits(settings.lab_bytes.unwrap_or(half), lab_jobs).await?;
    // 3. Announce the address. The reader may send a signal at once, so signals are handled first.
    let signal = stop_signal().map_err(io("listen for signals"))?;
    let listener = TcpListener::bind(settings.listen)
        .await
        .map_err(|source| ServeError::Listen { address: settings.listen, source })?;
    let address = listener.local_addr().map_err(io("learn the address"))?;
    if let Err(missing) = settings.engine.check_library() {
        tracing::error!(
            "{missing}. Until then, jobs with networks are refused; /readyz reports it too"
        );
    }
    let confinement = confinement(&settings.engine);
    if let Err(reason) = &confinement {
        tracing::warn!("{reason}");
    }
    tracing::info!(%address, data = %store.dir().root().display(), swept, "listening");
    announce(store.dir().root(), address, settings)?;
    // 4. Run workers and maintenance until the signal.
    let (stopper, stop) = watch::channel(false);
    let metrics = Metrics::install()?;
    let program = std::env::current_exe().map_err(io("find this program"))?;
    let workers = worker_arguments(settings, store.dir().root());
    let hub = cluster(settings, &networks, &store).await?;
    let trouble = hub.as_ref().map(Hub::trouble);
    let mut lines = vec![workers.clone(); settings.worker_count()];
    let on_cpu = EngineArguments { device: "cpu".into(), ..workers.engine.clone() };
    let host = WorkerArguments { takes: Takes::Host, engine: on_cpu.clone(), ..workers.clone() };
    lines.extend(vec![host; settings.host_worker_count()]);
    // Clients wait for the checks of their uploads, so these must not wait for tiles. Short tasks need no GPU, and checks of
    // users' networks run where these networks will.
    let engine = if on_cpu.unconfined { workers.engine.clone() } else { on_cpu };
    let engine = EngineArguments { nice: 0, ..engine };
    lines.push(WorkerArguments { takes: Takes::Light, engine, ..workers });
    let (device, device_state) = watch::channel(DeviceState::Untried);
    let supervisor = Supervisor::start(&store, &program, lines, &device, &stop);
    let closing = CancellationToken::new();
    let folded = metrics.clone();
    let maintenance =
        maintain(store.clone(), move || folded.upkeep(), settings.clone(), audit.clone());
    tokio::spawn(closing.clone().run_until_cancelled_owned(maintenance));
    let webhooks = crate::webhooks::send(store.clone(), settings.webhook_hosts.clone());
    tokio::spawn(closing.clone().run_until_cancelled_owned(webhooks));
    if settings.scrub_bytes > 0 {
        let (store, rate) = (store.clone(), settings.scrub_bytes);
        let scrub = async move { store.scrub(rate).await };
        tokio::spawn(closing.clone().run_until_cancelled_owned(scrub));
    }
    let closer = closing.clone();
    tokio::spawn(async move {
        signal.await;
        closer.cancel();
        // Fails only if all receivers have ended.
        let _ = stopper.send(true);
    });
    // 5. Serve the API.
    let machine = Machine { cluster: trouble, confinement, networks, device: device_state };
    let app = App::new(store.clone(), (settings, audit), metrics, machine, closing);
    let service = router(app);
    tokio::select! {
        () = listen(listener, service, settings, stopped(stop.clone())) => {}
        () = drain_time_over(stop) => tracing::warn!("requests were interrupted by the shutdown"),
    }
    // 6. Shut down. Workers of this machine return their tasks; workers on others continue.
    drop(hub);
    supervisor.ended().await;
    store.advance_generation().await?;
    // The file is only information. A failure to remove it is harmless.
    let _ = std::fs::remove_file(store.dir().root().join(ADDRESS_FILE));
    store.close().await;
    tracing::info!("stopped");
    Ok(())
}

/// Announces the address of the service, and the file of its audit log, as one JSON line on standard output and in a
/// file.
fn announce(root: &Path, address: SocketAddr, settings: &ServeArguments) -> Result<(), ServeError> {
    let audit_log = settings.audit.audit_log.as_ref().map(std::path::absolute).transpose();
    let audit_log = audit_log.map_err(io("find the audit log"))?;
    let announcement = Announcement {
        address,
        url: format!("http://{address}"),
        pid: std::process::id(),
        audit_log: audit_log.map(|file| file.to_string_lossy().into_owned().into()),
    };
    let text = serde_json::json!(announcement).to_string();
    let (path, draft) = (root.join(ADDRESS_FILE), root.join("server.json.new"));
    std::fs::write(&draft, &text).map_err(io("write server.json"))?;
    std::fs::rename(draft, path).map_err(io("write server.json"))?;
    let mut stdout = std::io::stdout();
    writeln!(stdout, "{text}").and_then(|()| stdout.flush()).map_err(io("print the address"))
}

/// Limit of a worker's data (`RLIMIT_DATA`) in bytes, for the largest planned resident memory.
fn allowance(planned: u64) -> u64 {
    planned.saturating_add(planned / 4).saturating_add(256 << 20)
}

fn worker_arguments(settings: &ServeArguments, root: &Path) -> WorkerArguments {
    WorkerArguments {
        data: Some(root.to_owned()),
        remote: RemoteArguments::default(),
        takes: match settings.host_worker_count() {
            _ if settings.without_tiles() => Takes::WithoutTiles,
            0 => Takes::All,
            _ => Takes::Gpu,
        },
        memory_bytes: Some(allowance(settings.worker_memory_bytes)),
        engine: settings.engine.clone(),
        log_format: settings.log_format,
        id: None,
        supervised: true,
    }
}

/// Starts to hand out tiles to other machines, if a NATS server is configured.
async fn cluster(
    settings: &ServeArguments,
    networks: &NetworkSource,
    store: &Store,
) -> Result<Option<Hub>, ServeError> {
    let ClusterArguments { nats, ack_wait, verify_fraction } = &settings.cluster;
    if !nats.is_wanted() {
        store.disown_remote().await?;
        return Ok(None);
    }
    describe_metrics();
    let credential = nats.nats_creds.as_deref().map(Credential::read).transpose()?;
    let access =
        Access::new(nats.nats.as_deref(), &credential.unwrap_or_default(), "sci-recon hub")?;
    let settings = HubSettings {
        program: Program::of(VERSION, networks),
        ack_wait: Duration::from_secs(*ack_wait),
        verify_fraction: *verify_fraction,
    };
    Ok(Some(Hub::start(store.clone(), access, settings)))
}

async fn drain_time_over(stop: watch::Receiver<bool>) {
    stopped(stop).await;
    tokio::time::sleep(DRAIN).await;
}
