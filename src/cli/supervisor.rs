//! Keeps worker processes running: starts them, watches them, and replaces those that end.
//!
//! The server holds a pipe to each worker's standard input and writes nothing to it. The pipe closes when the server stops
//! the worker or is killed. The worker then returns its task and ends, so no worker outlives its server.

use std::ffi::OsStr;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::watch;
use tokio::task::JoinSet;

use super::stop::stopped;
use crate::config::{DEVICE_LOST, DeviceState, Takes, WorkerArguments};
use engine::job::WorkerId;
use engine::pipeline::usage::{kills_for_memory, peak_rss_of};
use store::{Store, WorkerEnd};

/// Time that a worker has to return its task.
pub(super) const GRACE: Duration = Duration::from_secs(8);
/// The shortest and the longest pause before a worker is restarted.
pub(super) const PAUSES: (Duration, Duration) =
    (Duration::from_millis(100), Duration::from_secs(15));
/// Time between readings of a worker's memory.
const MEMORY_POLL: Duration = Duration::from_millis(500);
/// Time between readings of a worker's last sign of life.
const SIGN_POLL: Duration = Duration::from_secs(5);
/// A worker without a sign of life for this long hangs; the lease of its task has expired.
const MAX_SILENCE: Duration = Duration::from_secs(30);
/// Line that a worker prints once its device has passed the test.
const DEVICE_READY: &str = "device ready";
/// Start of the line with which a worker refuses its device. The reason follows.
const DEVICE_REFUSED: &str = "device refused: ";
/// A worker that has lived this long has started correctly.
pub(super) const HEALTHY: Duration = Duration::from_secs(20);

pub(super) struct Supervisor {
    slots: JoinSet<()>,
}

impl Supervisor {
    /// Starts one worker for each element of `workers`. They end when `stop` becomes true. `device` receives the state
    /// of the device of workers that are not on the CPU by design.
    pub(super) fn start(
        store: &Store,
        program: &Path,
        workers: Vec<WorkerArguments>,
        device: &watch::Sender<DeviceState>,
        stop: &watch::Receiver<bool>,
    ) -> Self {
        let mut slots = JoinSet::new();
        for arguments in workers {
            let slot = Slot {
                store: store.clone(),
                program: program.to_owned(),
                device: (!matches!(arguments.takes, Takes::Host | Takes::Light))
                    .then(|| device.clone()),
                arguments,
                stop: stop.clone(),
            };
            slots.spawn(slot.keep_running());
        }
        Self { slots }
    }

    /// Waits until all workers have ended.
    pub(super) async fn ended(mut self) {
        while self.slots.join_next().await.is_some() {}
    }
}

struct Slot {
    store: Store,
    program: PathBuf,
    arguments: WorkerArguments,
    device: Option<watch::Sender<DeviceState>>,
    stop: watch::Receiver<bool>,
}

impl Slot {
    async fn keep_running(mut self) {
        let mut pause = PAUSES.0;
        while !*self.stop.borrow() {
            let id = WorkerId::new();
            let start = Instant::now();
            match self.spawn(id) {
                Ok(child) => self.watch(id, child).await,
                Err(error) => tracing::error!(%error, "a worker can't be started"),
            }
            pause = if start.elapsed() > HEALTHY { PAUSES.0 } else { (pause * 2).min(PAUSES.1) };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                () = stopped(self.stop.clone()) => {}
            }
        }
    }

    fn spawn(&self, id: WorkerId) -> std::io::Result<Child> {
        let arguments =
            WorkerArguments { id: Some(id), supervised: true, ..self.arguments.clone() };
        let mut command = Command::new(&self.program);
        // The command line states every setting. The worker must not read variables that are for the server, such as
        // its NATS credential.
        for (name, _) in std::env::vars_os().filter(|(name, _)| is_setting(name)) {
            command.env_remove(name);
        }
        command
            .args(arguments.command_line())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C in the terminal must reach only the server, which then stops the workers.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
    }

    async fn watch(&mut self, id: WorkerId, mut child: Child) {
        let stdin = child.stdin.take();
        if let Some(output) = child.stdout.take() {
            tokio::spawn(read_state(output, self.device.clone()));
        }
        let store = self.store.clone();
        let mut memory = Memory::of(child.id());
        let ended = tokio::select! {
            status = child.wait() => Some(status),
            () = stopped(self.stop.clone()) => None,
            () = silent(&store, id) => {
                tracing::warn!(worker = %id, "a worker gives no sign of life and is killed");
                Some(child.kill().await.and(child.wait().await))
            }
            never = memory.watch() => match never {},
        };
        let end = match ended {
            Some(Ok(status)) => memory.explain(judge(status), self.arguments.memory_limit()),
            Some(Err(error)) => WorkerEnd::Crashed(error.to_string()),
            None => {
                drop(stdin);
                end(id, child).await;
                // The server asked the worker to stop, so its end does not count against its task.
                WorkerEnd::Left
            }
        };
        self.report(id, &end).await;
    }

    async fn report(&self, id: WorkerId, end: &WorkerEnd) {
        let reason = match end {
            WorkerEnd::Left => "left",
            WorkerEnd::Killed => "killed",
            WorkerEnd::DeviceLost => "device_lost",
            WorkerEnd::Starved(_) => "starved",
            WorkerEnd::Crashed(_) => "crashed",
        };
        metrics::counter!("sci_recon_worker_exits_total", "reason" => reason).increment(1);
        match end {
            WorkerEnd::Left => tracing::info!(worker = %id, "a worker has ended"),
            WorkerEnd::Killed => tracing::warn!(worker = %id, "a worker was killed"),
            WorkerEnd::DeviceLost => tracing::error!(worker = %id, "a worker has lost its GPU"),
            WorkerEnd::Starved(how) => tracing::error!(worker = %id, how, "a worker had no memory"),
            WorkerEnd::Crashed(how) => tracing::error!(worker = %id, how, "a worker has died"),
        }
        if let Err(error) = self.store.worker_ended(id, end).await {
            // The task is freed when its lease expires.
            tracing::error!(worker = %id, %error, "the task of a worker can't be freed");
        }
    }
}

/// The line that reports whether a worker can use its device, for [`read_state`].
pub(super) fn device_line(tried: Result<(), &str>) -> String {
    match tried {
        Ok(()) => DEVICE_READY.to_owned(),
        Err(reason) => format!("{DEVICE_REFUSED}{}", reason.replace('\n', " ")),
    }
}

/// Reads what a worker prints until it ends, and passes on the state of its device.
async fn read_state(output: ChildStdout, device: Option<watch::Sender<DeviceState>>) {
    let mut lines = BufReader::new(output).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        let state = match line.strip_prefix(DEVICE_REFUSED) {
            Some(reason) => DeviceState::Refused(reason.to_owned()),
            None if line == DEVICE_READY => DeviceState::Ready,
            None => continue,
        };
        if let Some(device) = &device {
            device.send_replace(state);
        }
    }
}

/// True if an environment variable is a setting of this program.
fn is_setting(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b"SCI_RECON_")
}

/// Observes the memory of a worker from outside.
struct Memory {
    process: Option<u32>,
    /// Largest observed resident memory in bytes.
    peak: u64,
    /// The kernel's count of out-of-memory kills among the processes of this service when the worker started.
    kills: Option<u64>,
}

impl Memory {
    fn of(process: Option<u32>) -> Self {
        Self { process, peak: 0, kills: kills_for_memory() }
    }

    async fn watch(&mut self) -> std::convert::Infallible {
        loop {
            if let Some(process) = self.process {
                self.peak = self.peak.max(peak_rss_of(process));
            }
            tokio::time::sleep(MEMORY_POLL).await;
        }
    }

    /// Adds the use of memory to the cause of a worker's end.
    fn explain(&self, end: WorkerEnd, limit: Option<u64>) -> WorkerEnd {
        let peak = format!("it used {} MiB of memory", self.peak >> 20);
        match end {
            WorkerEnd::Killed if kills_for_memory() > self.kills => {
                WorkerEnd::Starved(format!("the machine had no memory left for it; {peak}"))
            }
            WorkerEnd::Crashed(how) => WorkerEnd::Crashed(match limit {
                Some(limit) => format!("{how}; {peak}, its limit is {} MiB", limit >> 20),
                None => format!("{how}; {peak}"),
            }),
            end => end,
        }
    }
}

/// Waits until a worker has given no sign of life for [`MAX_SILENCE`], by the monotonic clock.
async fn silent(store: &Store, id: WorkerId) {
    let (mut last, mut since) = (None, Instant::now());
    while since.elapsed() < MAX_SILENCE {
        tokio::time::sleep(SIGN_POLL).await;
        match store.last_sign(id).await {
            Ok(sign) if sign == last => {}
            Ok(sign) => (last, since) = (sign, Instant::now()),
            // Workers can't record signs either while the database fails.
            Err(_) => since = Instant::now(),
        }
    }
}

/// Waits for a worker that was asked to stop, and kills it after [`GRACE`].
async fn end(id: WorkerId, mut child: Child) {
    if tokio::time::timeout(GRACE, child.wait()).await.is_err() {
        tracing::warn!(worker = %id, "a worker did not end in time and is killed");
        if let Err(error) = child.kill().await {
            tracing::error!(worker = %id, %error, "a worker can't be killed");
        }
    }
}

/// Classifies the end of a worker: a normal exit, a kill from outside, or a crash that its task may have caused.
pub(super) fn judge(status: ExitStatus) -> WorkerEnd {
    const SIGINT: i32 = 2;
    const SIGKILL: i32 = 9;
    const SIGTERM: i32 = 15;
    match (status.code(), status.signal()) {
        (Some(0), _) => WorkerEnd::Left,
        (Some(code), _) if code == i32::from(DEVICE_LOST) => WorkerEnd::DeviceLost,
        (_, Some(SIGINT | SIGKILL | SIGTERM)) => WorkerEnd::Killed,
        _ => WorkerEnd::Crashed(status.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::{ExitStatus, ExitStatusExt, WorkerEnd, judge};

    #[test]
    fn a_crash_counts_against_the_task_and_a_kill_does_not() {
        assert!(matches!(judge(ExitStatus::from_raw(0)), WorkerEnd::Left));
        assert!(matches!(judge(ExitStatus::from_raw(9)), WorkerEnd::Killed));
        assert!(matches!(judge(ExitStatus::from_raw(75 << 8)), WorkerEnd::DeviceLost));
        for fault in [11, 6, 4, 101 << 8] {
            let end = judge(ExitStatus::from_raw(fault));
            assert!(matches!(end, WorkerEnd::Crashed(_)), "{fault}: {end:?}");
        }
    }
}
