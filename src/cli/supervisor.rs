//! Keeps worker processes running: starts them, watches their end, starts others.
//!
//! A worker's standard input is a pipe from here that nothing is written to. When it closes, be it
//! because the server wants the worker to end or because the server was killed, the worker gives its
//! task back and ends: no worker outlives its server.

use std::ffi::OsStr;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use tokio::process::{Child, Command};
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::config::WorkerArguments;
use engine::job::WorkerId;
use engine::pipeline::usage::{kills_for_memory, peak_rss_of};
use store::{Store, WorkerEnd};

/// How long a worker may take to give its task back.
pub(super) const GRACE: Duration = Duration::from_secs(8);
/// The shortest and the longest pause before a worker is started again.
pub(super) const PAUSES: (Duration, Duration) =
    (Duration::from_millis(100), Duration::from_secs(15));
/// Time between looks at a worker's memory.
const MEMORY_LOOK: Duration = Duration::from_millis(500);
/// Time between looks at a worker's signs of life.
const LOOK: Duration = Duration::from_secs(5);
/// A worker that gives no sign of life for so long hangs as a whole; its lease has run out.
const SILENCE: Duration = Duration::from_secs(30);
/// A worker that lived for so long did not die of its start.
pub(super) const HEALTHY: Duration = Duration::from_secs(20);

pub(super) struct Supervisor {
    slots: JoinSet<()>,
}

impl Supervisor {
    /// Starts a worker with each of these arguments, to end when `stop` becomes true.
    pub(super) fn start(
        store: &Store,
        program: &Path,
        workers: Vec<WorkerArguments>,
        stop: &watch::Receiver<bool>,
    ) -> Self {
        let mut slots = JoinSet::new();
        for arguments in workers {
            let slot = Slot {
                store: store.clone(),
                program: program.to_owned(),
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
                () = stopped(&mut self.stop) => {}
            }
        }
    }

    fn spawn(&self, id: WorkerId) -> std::io::Result<Child> {
        let arguments =
            WorkerArguments { id: Some(id), supervised: true, ..self.arguments.clone() };
        let mut command = Command::new(&self.program);
        // The command line states every setting. A variable of the server, such as its NATS credential, would
        // be taken for the worker's.
        for (name, _) in std::env::vars_os().filter(|(name, _)| is_setting(name)) {
            command.env_remove(name);
        }
        command
            .args(arguments.command_line())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            // Away from the terminal: Ctrl-C is for the server, which then tells the workers.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
    }

    async fn watch(&mut self, id: WorkerId, mut child: Child) {
        let stdin = child.stdin.take();
        let store = self.store.clone();
        let mut memory = Memory::of(child.id());
        let ended = tokio::select! {
            status = child.wait() => Some(status),
            () = stopped(&mut self.stop) => None,
            () = silent(&store, id) => {
                tracing::warn!(worker = %id, "a worker gives no sign of life and is killed");
                Some(child.kill().await.and(child.wait().await))
            }
            never = memory.watch() => match never {},
        };
        let end = match ended {
            Some(Ok(status)) => memory.explain(judge(status), self.arguments.memory_bytes),
            Some(Err(error)) => WorkerEnd::Crashed(error.to_string()),
            None => {
                drop(stdin);
                end(id, child).await;
                // However it ended, it was told to: nothing is held against its task.
                WorkerEnd::Left
            }
        };
        self.report(id, &end).await;
    }

    async fn report(&self, id: WorkerId, end: &WorkerEnd) {
        let reason = match end {
            WorkerEnd::Left => "left",
            WorkerEnd::Killed => "killed",
            WorkerEnd::Starved(_) => "starved",
            WorkerEnd::Crashed(_) => "crashed",
        };
        metrics::counter!("sci_recon_worker_exits_total", "reason" => reason).increment(1);
        match end {
            WorkerEnd::Left => tracing::info!(worker = %id, "a worker has ended"),
            WorkerEnd::Killed => tracing::warn!(worker = %id, "a worker was killed"),
            WorkerEnd::Starved(how) => tracing::error!(worker = %id, how, "a worker had no memory"),
            WorkerEnd::Crashed(how) => tracing::error!(worker = %id, how, "a worker has died"),
        }
        if let Err(error) = self.store.worker_ended(id, end).await {
            // Its lease runs out instead.
            tracing::error!(worker = %id, %error, "the task of a worker can't be freed");
        }
    }
}

/// True if an environment variable is a setting of this program.
fn is_setting(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b"SCI_RECON_")
}

/// The memory of a worker, as far as it shows from outside.
struct Memory {
    process: Option<u32>,
    /// The most that it was seen to have, in bytes.
    peak: u64,
    /// Kills by the kernel for want of memory, among the processes of this service, before it began.
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
            tokio::time::sleep(MEMORY_LOOK).await;
        }
    }

    /// The same end, with what memory had to do with it.
    fn explain(&self, end: WorkerEnd, limit: Option<u64>) -> WorkerEnd {
        let peak = format!("its memory was seen at {} MiB", self.peak >> 20);
        match end {
            WorkerEnd::Killed if kills_for_memory() > self.kills => {
                WorkerEnd::Starved(format!("the machine had no memory left for it; {peak}"))
            }
            WorkerEnd::Crashed(how) => WorkerEnd::Crashed(match limit {
                Some(limit) => format!("{how}; {peak} of the {} MiB it may take", limit >> 20),
                None => format!("{how}; {peak}"),
            }),
            end => end,
        }
    }
}

async fn stopped(stop: &mut watch::Receiver<bool>) {
    // An error means that the sender is gone, which is a stop as well.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// Waits until a worker has given no sign of life for too long, by the clock that does not jump.
async fn silent(store: &Store, id: WorkerId) {
    let (mut last, mut since) = (None, Instant::now());
    while since.elapsed() < SILENCE {
        tokio::time::sleep(LOOK).await;
        match store.last_sign(id).await {
            Ok(sign) if sign == last => {}
            Ok(sign) => (last, since) = (sign, Instant::now()),
            // Nobody can give a sign then.
            Err(_) => since = Instant::now(),
        }
    }
}

/// Waits for a worker that was told to end, and kills it if it does not.
async fn end(id: WorkerId, mut child: Child) {
    if tokio::time::timeout(GRACE, child.wait()).await.is_err() {
        tracing::warn!(worker = %id, "a worker did not end in time and is killed");
        if let Err(error) = child.kill().await {
            tracing::error!(worker = %id, %error, "a worker can't be killed");
        }
    }
}

/// Why a worker ended: by itself, from outside, or of a fault that its task may have caused.
pub(super) fn judge(status: ExitStatus) -> WorkerEnd {
    const SIGINT: i32 = 2;
    const SIGKILL: i32 = 9;
    const SIGTERM: i32 = 15;
    match (status.code(), status.signal()) {
        (Some(0), _) => WorkerEnd::Left,
        (_, Some(SIGINT | SIGKILL | SIGTERM)) => WorkerEnd::Killed,
        _ => WorkerEnd::Crashed(status.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::{ExitStatus, ExitStatusExt, WorkerEnd, judge};

    #[test]
    fn a_kill_is_not_held_against_the_task_and_a_fault_is() {
        assert!(matches!(judge(ExitStatus::from_raw(0)), WorkerEnd::Left));
        assert!(matches!(judge(ExitStatus::from_raw(9)), WorkerEnd::Killed));
        for fault in [11, 6, 4, 101 << 8] {
            let end = judge(ExitStatus::from_raw(fault));
            assert!(matches!(end, WorkerEnd::Crashed(_)), "{fault}: {end:?}");
        }
    }
}
