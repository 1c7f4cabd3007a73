//! Starts and ends the hub.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;

use super::core::Core;
use crate::nats::connection::{Access, ClusterError, Connection};
use crate::nats::message::Program;
use store::Store;

/// Shortest pause before the message server is tried again.
const MIN_PAUSE: Duration = Duration::from_secs(1);
/// Longest pause before the message server is tried again.
const MAX_PAUSE: Duration = Duration::from_secs(10);
/// Time between polls of the connection's state.
const POLL: Duration = Duration::from_secs(1);

/// Settings of the hub.
#[derive(Debug, Clone)]
pub struct HubSettings {
    /// The build that workers must have.
    pub program: Program,
    /// Silence of a worker after which its message is delivered again.
    pub ack_wait: Duration,
    /// Share of the tiles that a second worker computes too, on \[0,1\].
    pub verify_fraction: f64,
}

/// The running hub. Dropping it ends the hub. Tiles that are out stay out; the next server learns of them from the
/// store.
#[derive(Debug)]
pub struct Hub {
    _running: JoinSet<()>,
    trouble: watch::Receiver<Option<String>>,
}

impl Hub {
    /// Starts to hand tiles out to workers, as soon as the message server answers.
    #[must_use]
    pub fn start(store: Store, access: Access, settings: HubSettings) -> Self {
        let mut running = JoinSet::new();
        let (report, trouble) =
            watch::channel(Some("there is no connection to NATS yet".to_owned()));
        running.spawn(run(store, access, settings, report));
        Self { _running: running, trouble }
    }

    /// The reason why no tiles can be handed out at the moment, if there is one.
    #[must_use]
    pub fn trouble(&self) -> watch::Receiver<Option<String>> {
        self.trouble.clone()
    }
}

async fn run(
    store: Store,
    access: Access,
    settings: HubSettings,
    report: watch::Sender<Option<String>>,
) {
    let connection = persist(&report, || access.connect()).await;
    let HubSettings { program, ack_wait, verify_fraction } = settings;
    let core = Core::new(store, connection.clone(), (program, ack_wait), verify_fraction);
    let core = Arc::new(core);
    persist(&report, || core.find_streams()).await;
    let mut parts = persist(&report, || parts(&core)).await;
    tracing::info!("handing tiles out to other machines");
    parts.spawn(watch_over(connection, report));
    while let Some(ended) = parts.join_next().await {
        if let Err(error) = ended
            && error.is_panic()
        {
            tracing::error!(%error, "a part of the hub has panicked");
        }
    }
}

/// Repeats an action until it succeeds, and reports its errors.
async fn persist<T, F>(report: &watch::Sender<Option<String>>, action: impl Fn() -> F) -> T
where
    F: Future<Output = Result<T, ClusterError>>,
{
    let mut pause = MIN_PAUSE;
    loop {
        match action().await {
            Ok(done) => return done,
            Err(error) => {
                tracing::error!(
                    %error,
                    "no tile leaves this machine: the cluster can't start, the server tries again"
                );
                report.send_replace(Some(error.to_string()));
            }
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(MAX_PAUSE);
    }
}

/// Reports when the connection is lost or restored.
async fn watch_over(connection: Connection, report: watch::Sender<Option<String>>) {
    loop {
        let lost = (!connection.is_up()).then(|| "the connection to NATS is lost".to_owned());
        report.send_if_modified(|reported| {
            *reported != lost && {
                *reported = lost;
                true
            }
        });
        tokio::time::sleep(POLL).await;
    }
}

async fn parts(core: &Arc<Core>) -> Result<JoinSet<()>, ClusterError> {
    let hellos = core.listen("hello").await?;
    let begins = core.listen("begin").await?;
    let wants = core.listen("want").await?;
    let beats = core.listen("beat").await?;
    let mut parts = JoinSet::new();
    parts.spawn(core.clone().answer_hellos(hellos));
    parts.spawn(core.clone().answer_begins(begins));
    parts.spawn(core.clone().answer_wants(wants));
    parts.spawn(core.clone().receive_beats(beats));
    parts.spawn(core.clone().record_beats());
    parts.spawn(core.clone().dispatch());
    parts.spawn(core.clone().take_events());
    parts.spawn(core.clone().sweep());
    Ok(parts)
}
