//! Keeps the process of a worker on another machine running. If a task crashes the process, the next process reports the
//! crash and continues.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Instant;

use tokio::process::{Child, Command};

use super::CliError;
use super::supervisor::{GRACE, HEALTHY, PAUSES, judge};
use store::WorkerEnd;

/// Exit code of a process with invalid settings, or that a server refuses. A restart would not help.
const PERMANENT_ERROR: i32 = 2;

/// Runs this program again with the same arguments and `--supervised`, until it ends normally or `stop` completes. The
/// process records its current tile in the folder `cache`.
pub(super) async fn guard(cache: &Path, stop: impl Future<Output = ()>) -> Result<(), CliError> {
    let failed = |error: std::io::Error| CliError::Failure(format!("no worker process: {error}"));
    let program = std::env::current_exe().map_err(failed)?;
    let hand = cache.join(format!("hand-{}.json", std::process::id()));
    let (mut died, mut pause) = (None, PAUSES.0);
    tokio::pin!(stop);
    loop {
        let start = Instant::now();
        let mut child = spawn(&program, &hand, died.take()).map_err(failed)?;
        let stdin = child.stdin.take();
        let status = tokio::select! {
            status = child.wait() => status.map_err(failed)?,
            () = &mut stop => {
                drop(stdin);
                return end(child, &hand).await.map_err(failed);
            }
        };
        if status.code() == Some(PERMANENT_ERROR) {
            // The process has printed the reason.
            std::process::exit(PERMANENT_ERROR);
        }
        died = match judge(status) {
            WorkerEnd::Left => return Ok(()),
            WorkerEnd::Killed => Some("killed".to_owned()),
            WorkerEnd::DeviceLost => Some("its GPU was lost".to_owned()),
            WorkerEnd::Starved(how) | WorkerEnd::Crashed(how) => Some(how),
        };
        tracing::error!(how = died, "the worker process has died and is restarted");
        pause = if start.elapsed() > HEALTHY { PAUSES.0 } else { (pause * 2).min(PAUSES.1) };
        tokio::select! {
            () = tokio::time::sleep(pause) => {}
            () = &mut stop => return Ok(()),
        }
    }
}

fn spawn(program: &Path, hand: &PathBuf, died: Option<String>) -> std::io::Result<Child> {
    let mut command = Command::new(program);
    command.args(std::env::args_os().skip(1)).arg("--supervised").arg("--hand").arg(hand);
    if let Some(how) = died {
        command.arg("--died").arg(how);
    }
    command.stdin(Stdio::piped()).process_group(0).kill_on_drop(true).spawn()
}

/// Waits for a process that was asked to stop, and kills it after [`GRACE`].
async fn end(mut child: Child, hand: &Path) -> std::io::Result<()> {
    if tokio::time::timeout(GRACE, child.wait()).await.is_err() {
        child.kill().await?;
    }
    match std::fs::remove_file(hand) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
