//! The hub from its start to its end.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;

use super::core::Core;
use crate::nats::connection::{Access, ClusterError, Connection};
use crate::nats::message::Program;
use store::Store;

/// The shortest and the longest pause before the message server is tried again.
const PAUSES: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(10));
/// Time between looks at the connection.
const LOOK: Duration = Duration::from_secs(1);

/// How the hub treats workers.
#[derive(Debug, Clone)]
pub struct HubSettings {
    /// The program that workers must be.
    pub program: Program,
    /// A message is delivered again when its worker was silent for so long.
    pub ack_wait: Duration,
    /// Share of the tiles that a second worker computes, too, on \[0,1\].
    pub verify_fraction: f64,
}

/// The hub, which runs until this is dropped. Tiles that are out stay out, and are known to the next
/// server by the store.
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
        let (tell, trouble) = watch::channel(Some("there is no connection to NATS yet".to_owned()));
        running.spawn(run(store, access, settings, tell));
        Self { _running: running, trouble }
    }

    /// Why no tiles can be handed out at the moment; none if they can.
    #[must_use]
    pub fn trouble(&self) -> watch::Receiver<Option<String>> {
        self.trouble.clone()
    }
}

async fn run(
    store: Store,
    access: Access,
    settings: HubSettings,
    tell: watch::Sender<Option<String>>,
) {
    let connection = persist(&tell, || access.connect()).await;
    let HubSettings { program, ack_wait, verify_fraction } = settings;
    let core = Core::new(store, connection.clone(), (program, ack_wait), verify_fraction);
    let core = Arc::new(core);
    persist(&tell, || core.find_streams()).await;
    let mut parts = persist(&tell, || parts(&core)).await;
    tracing::info!("handing tiles out to other machines");
    parts.spawn(watch_over(connection, tell));
    while let Some(ended) = parts.join_next().await {
        if let Err(error) = ended
            && error.is_panic()
        {
            tracing::error!(%error, "a part of the hub has died");
        }
    }
}

/// Does something again and again until it succeeds, and tells why it does not.
async fn persist<T, F>(tell: &watch::Sender<Option<String>>, what: impl Fn() -> F) -> T
where
    F: Future<Output = Result<T, ClusterError>>,
{
    let mut pause = PAUSES.0;
    loop {
        match what().await {
            Ok(done) => return done,
            Err(error) => {
                tracing::error!(
                    %error,
                    "no tile leaves this machine: the cluster can't begin to work, and is tried again"
                );
                tell.send_replace(Some(error.to_string()));
            }
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(PAUSES.1);
    }
}

/// Tells whether the connection is there.
async fn watch_over(connection: Connection, tell: watch::Sender<Option<String>>) {
    loop {
        let lost = (!connection.is_up()).then(|| "the connection to NATS is lost".to_owned());
        tell.send_if_modified(|told| {
            *told != lost && {
                *told = lost;
                true
            }
        });
        tokio::time::sleep(LOOK).await;
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
    parts.spawn(core.clone().hear_beats(beats));
    parts.spawn(core.clone().record_beats());
    parts.spawn(core.clone().dispatch());
    parts.spawn(core.clone().take_events());
    parts.spawn(core.clone().sweep());
    Ok(parts)
}
