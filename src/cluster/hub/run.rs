//! The hub from its start to its end.

use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinSet;

use super::core::Core;
use crate::cluster::connection::{ClusterError, Connection};
use crate::store::Store;

/// Pause before the streams are tried to be made again.
const TROUBLE: Duration = Duration::from_secs(2);

/// The hub, which runs until this is dropped. Tiles that are out stay out, and are known to the next
/// server by the store.
#[derive(Debug)]
pub struct Hub {
    _running: JoinSet<()>,
}

impl Hub {
    /// Starts to hand tiles out. A message is delivered again when its worker was silent for `ack_wait`.
    #[must_use]
    pub fn start(store: Store, connection: Connection, ack_wait: Duration) -> Self {
        let mut running = JoinSet::new();
        running.spawn(run(Arc::new(Core::new(store, connection, ack_wait))));
        Self { _running: running }
    }
}

async fn run(core: Arc<Core>) {
    while let Err(error) = core.find_streams().await {
        tracing::error!(%error, "the cluster can't begin to work");
        tokio::time::sleep(TROUBLE).await;
    }
    let mut parts = loop {
        match parts(&core).await {
            Ok(parts) => break parts,
            Err(error) => tracing::error!(%error, "the cluster can't begin to work"),
        }
        tokio::time::sleep(TROUBLE).await;
    };
    tracing::info!("handing tiles out to other machines");
    while let Some(ended) = parts.join_next().await {
        if let Err(error) = ended
            && error.is_panic()
        {
            tracing::error!(%error, "a part of the hub has died");
        }
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
