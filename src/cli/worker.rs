//! `sci-recon worker`: performs tasks of a data folder, or tiles of a server on another machine.

use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::future::try_join_all;
use tokio::io::AsyncReadExt;
use tokio_util::sync::CancellationToken;

use super::confine::{confine_worker, folders_of, limit_memory};
use super::guard::guard;
use super::output::print_line;
use super::stop::stop_signal;
use super::supervisor::device_line;
use super::{CliError, logging};
use crate::cli::error::Result;
use crate::config::{VERSION, WorkerArguments};
use engine::job::WorkerId;
use engine::pipeline::networks::NetworkSource;
use reconstruction::priors::onnx::Device;
use store::{Claimant, Purpose, Store, StoreError};
use workers::nats::{ClusterError, Program, Remote, RemoteSettings};
use workers::{Local, ModelCommand, Worker, WorkerError};

/// Works until SIGTERM or Ctrl-C. A supervised worker also ends when its standard input closes.
pub fn run(settings: &WorkerArguments) -> Result<()> {
    logging::start(settings.log_format);
    lower_priority(settings.engine.nice)?;
    // If the memory of the machine or group ends, the kernel should end a worker, not the service. Its task is tried again.
    if let Err(error) = std::fs::write("/proc/self/oom_score_adj", "500") {
        tracing::debug!(%error, "the kernel does not prefer this worker when memory ends");
    }
    // A confined worker can't read the limits of its control group.
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    if let Some(bytes) = settings.memory_limit() {
        limit_memory(bytes).map_err(CliError::Failure)?;
    }
    let failed = |error: &dyn std::fmt::Display| CliError::Failure(error.to_string());
    // A confined worker can't read the folder of networks.
    let network = settings.engine.source().map_err(|error| CliError::Input(error.to_string()))?;
    // The driver of a GPU needs files that can't be listed.
    let is_confined = !settings.engine.unconfined && settings.engine.device == "cpu";
    if let Some(data) = settings.data_folder().filter(|_| is_confined) {
        let library = folders_of(settings.engine.onnxruntime.as_deref());
        let readable: Vec<&Path> = library.iter().map(PathBuf::as_path).collect();
        if let Err(reason) = confine_worker(&readable, &[data]) {
            tracing::warn!(reason, "the worker is not confined");
        }
    }
    reconstruction::cores::start_threads(cores);
    let program = std::env::current_exe().map_err(|error| failed(&error))?;
    let model = model_command(settings, program);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(|error| failed(&error))?;
    if settings.remote.nats.is_wanted() && !settings.supervised {
        return runtime.block_on(guard(&settings.remote.cache_folder(), terminated()));
    }
    try_device(&network, settings)?;
    let ended = runtime.block_on(async {
        let stop = CancellationToken::new();
        tokio::spawn(listen(settings.supervised, stop.clone()));
        match work(settings, (network, model, cores), stop).await {
            Err(WorkEnd::Worker(error @ WorkerError::Unfinished)) => {
                tracing::info!("{error}");
                Ok(())
            }
            Err(WorkEnd::Cluster(error)) => Err(error.into()),
            Err(WorkEnd::Store(error)) => Err(error.into()),
            Err(WorkEnd::Worker(WorkerError::DeviceLost(reason))) => {
                Err(CliError::DeviceLost(reason))
            }
            ended => ended.map_err(|error| failed(&error)),
        }
    });
    // The computing thread may still run or hang, so it is not awaited.
    runtime.shutdown_background();
    ended
}

/// Refuses to start with a device that can't run a network. A supervised worker reports the outcome to its server.
fn try_device(network: &NetworkSource, settings: &WorkerArguments) -> Result<()> {
    let tried = network.try_device().map_err(|error| error.to_string());
    if settings.supervised && settings.data_folder().is_some() {
        print_line(device_line(tried.as_ref().copied().map_err(String::as_str)))?;
    }
    // Wrong settings: a restart does not help.
    tried.map_err(CliError::Input)
}

/// Error that ended the work.
#[derive(Debug, thiserror::Error)]
enum WorkEnd {
    #[error(transparent)]
    Worker(#[from] WorkerError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(transparent)]
    Cluster(#[from] ClusterError),
}

async fn work(
    settings: &WorkerArguments,
    (network, model, cores): (NetworkSource, ModelCommand, usize),
    stop: CancellationToken,
) -> Result<(), WorkEnd> {
    let id = settings.id.unwrap_or_else(WorkerId::new);
    let stall = Duration::from_secs(settings.engine.stall_seconds);
    if settings.remote.nats.is_wanted() {
        let remote = remote_settings(settings, &network);
        let Some(remote) = Remote::open(remote, id, stop.clone()).await? else { return Ok(()) };
        let ended = Worker::new(remote.clone(), network, model, cores, stall, stop).run().await;
        if let Some(refusal) = remote.refusal() {
            return Err(refusal.into());
        }
        remote.leave().await;
        return Ok(ended?);
    }
    let store = Store::open(settings.data_folder().unwrap_or(Path::new("")), Purpose::Use).await?;
    let run = |claimant: &Claimant<'static>| {
        let local = Local::new(store.clone(), id, *claimant, settings.engine.device.clone());
        Worker::new(local, network.clone(), model.clone(), cores, stall, stop.clone()).run()
    };
    let ended = try_join_all(settings.takes.claimants().iter().map(run)).await;
    store.close().await;
    ended?;
    Ok(())
}

fn remote_settings(settings: &WorkerArguments, network: &NetworkSource) -> RemoteSettings {
    let remote = &settings.remote;
    RemoteSettings {
        program: Program::of(VERSION, network),
        urls: remote.nats.nats.clone(),
        credential: remote.nats.nats_creds.clone(),
        pool: remote.pool.clone(),
        cache: (remote.cache_folder(), remote.cache_bytes),
        hand: remote.hand.clone(),
        died: remote.died.clone(),
        device: settings.engine.device.clone(),
        patience: Duration::from_secs(settings.engine.stall_seconds) / 2,
        idle: remote.exit_when_idle.map(Duration::from_secs),
    }
}

/// The command lines for processes of users' networks, with the limits of this worker.
fn model_command(settings: &WorkerArguments, program: PathBuf) -> ModelCommand {
    let WorkerArguments { memory_bytes, engine, .. } = settings;
    // A driver needs files that can't be listed, so networks of users run on the CPU unless they may be unconfined.
    let device = if engine.unconfined { engine.device.as_str() } else { "cpu" };
    let mut options = vec!["--device".into(), device.into()];
    if let Some(library) = &engine.onnxruntime {
        options.extend(["--onnxruntime".into(), library.into()]);
    }
    if let Some(bytes) = memory_bytes {
        options.extend(["--memory-bytes".into(), bytes.to_string().into()]);
    }
    if engine.unconfined {
        options.push("--unconfined".into());
    }
    let line = |command: &str| [&[command.into()], &options[..]].concat();
    let (run, check) = (line("run-model"), line("check-model"));
    let provider = Device::parse(device).map_or("unknown", Device::provider);
    ModelCommand { program, run, check, memory_bytes: *memory_bytes, provider }
}

/// Lowers the priority of this process and its threads. A priority that is already lower remains, because only root may
/// raise it.
fn lower_priority(nice: i32) -> Result<()> {
    let failed = |error: rustix::io::Errno| {
        CliError::Failure(format!("the priority can't be lowered: {error}"))
    };
    if rustix::process::getpriority_process(None).map_err(failed)? >= nice {
        return Ok(());
    }
    rustix::process::setpriority_process(None, nice).map_err(failed)
}

/// Cancels `stop` at a signal, or when the server ends.
async fn listen(supervised: bool, stop: CancellationToken) {
    tokio::select! {
        () = terminated() => {}
        () = abandoned(), if supervised => {}
    }
    stop.cancel();
}

async fn terminated() {
    match stop_signal() {
        Ok(signal) => signal.await,
        Err(_) => std::future::pending().await,
    }
}

/// Waits until standard input ends, which means that the server has ended.
async fn abandoned() {
    let mut sink = [0; 64];
    let mut stdin = tokio::io::stdin();
    while !matches!(stdin.read(&mut sink).await, Ok(0) | Err(_)) {}
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::{Device, PathBuf, WorkerArguments, model_command};

    #[derive(Debug, Parser)]
    struct Command {
        #[command(flatten)]
        worker: WorkerArguments,
    }

    #[test]
    fn networks_of_users_run_on_the_gpu_only_without_confinement() {
        let command = |options: &[&str]| {
            let line = [&["test", "--data", "data", "--device", "gpu"], options].concat();
            let settings = Command::try_parse_from(line).unwrap().worker;
            model_command(&settings, PathBuf::from("program"))
        };
        for (options, device) in [(&[][..], "cpu"), (&["--unconfined"][..], "gpu")] {
            let model = command(options);
            assert_eq!(model.provider, Device::parse(device).unwrap().provider());
            for line in [model.run, model.check] {
                assert_eq!(line[1..3], ["--device", device]);
                assert_eq!(line.iter().any(|word| word == "--unconfined"), !options.is_empty());
            }
        }
    }
}
