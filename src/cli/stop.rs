//! Signals that end the service and its workers.

use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;

/// Starts to listen for SIGTERM and Ctrl-C. The future completes at the first one.
pub(super) fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    Ok(async move {
        tokio::select! {
            _ = terminate.recv() => tracing::info!("stopping on SIGTERM"),
            _ = interrupt.recv() => tracing::info!("stopping on Ctrl-C"),
        }
    })
}

/// Waits for a stop.
pub(super) async fn stopped(mut stop: watch::Receiver<bool>) {
    // An error means that the sender was dropped, which is a stop as well.
    let _ = stop.wait_for(|stop| *stop).await;
}
