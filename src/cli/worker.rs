//! `sci-recon worker`: does the tasks of a data folder.

use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use super::{CliError, logging};
use crate::cli::error::Result;
use crate::config::WorkerArguments;
use crate::job::WorkerId;
use crate::pipeline::NetworkSource;
use crate::recon::prior::onnx::Device;
use crate::store::{Purpose, Store};
use crate::worker::{Local, Worker, WorkerError};

/// Works until SIGTERM, Ctrl-C or, if supervised, the end of the standard input.
pub fn run(settings: &WorkerArguments) -> Result<()> {
    logging::start(settings.log_format);
    stand_back(settings.engine.nice)?;
    let library = settings.engine.onnxruntime.clone().filter(|path| !path.as_os_str().is_empty());
    let network = NetworkSource::new(library, Device::parse(&settings.engine.device)?);
    let failed = |error: &dyn std::fmt::Display| CliError::Failure(error.to_string());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(|error| failed(&error))?;
    let ended = runtime.block_on(async {
        let store = Store::open(&settings.data, Purpose::Use).await?;
        let stop = CancellationToken::new();
        tokio::spawn(listen(settings.supervised, stop.clone()));
        let id = settings.id.unwrap_or_else(WorkerId::new);
        let stall = Duration::from_secs(settings.engine.stall_seconds);
        let worker = Worker::new(Local::new(store.clone(), id), network, stall, stop);
        let ended = worker.run().await;
        store.close().await;
        match ended {
            Err(error @ WorkerError::Unfinished) => {
                tracing::info!("{error}");
                Ok(())
            }
            ended => ended.map_err(|error| failed(&error)),
        }
    });
    // The computing thread may still be at it, or hang: not waited for.
    runtime.shutdown_background();
    ended
}

/// Lowers the priority of this process, and so of all its threads.
fn stand_back(nice: i32) -> Result<()> {
    rustix::process::setpriority_process(None, nice)
        .map_err(|error| CliError::Failure(format!("the priority can't be lowered: {error}")))
}

/// Waits for a reason to stop, and tells it on.
async fn listen(supervised: bool, stop: CancellationToken) {
    tokio::select! {
        () = terminated() => {}
        () = abandoned(), if supervised => {}
    }
    stop.cancel();
}

async fn terminated() {
    let terminate = async {
        match signal(SignalKind::terminate()) {
            Ok(mut signal) => {
                signal.recv().await;
            }
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        () = terminate => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

/// Waits for the end of the standard input: the server that held its other end is gone.
async fn abandoned() {
    let mut sink = [0; 64];
    let mut stdin = tokio::io::stdin();
    while !matches!(stdin.read(&mut sink).await, Ok(0) | Err(_)) {}
}
