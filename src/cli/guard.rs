//! Keeps the process of a worker for a server elsewhere running: if its task takes it down, the next
//! process tells so, and goes on.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Instant;

use tokio::process::{Child, Command};

use super::CliError;
use super::supervisor::{GRACE, HEALTHY, PAUSES, judge};
use store::WorkerEnd;

/// The exit code of a process whose settings can't be, or that a server refuses: another one would fare
/// no better.
const HOPELESS: i32 = 2;

/// Runs this program again, with the same arguments and `--supervised`, until it ends by itself or
/// `stop` comes. `cache` is the folder in which it notes what it has in hand.
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
        if status.code() == Some(HOPELESS) {
            // It has said why.
            std::process::exit(HOPELESS);
        }
        died = match judge(status) {
            WorkerEnd::Left => return Ok(()),
            WorkerEnd::Killed => Some("killed".to_owned()),
            WorkerEnd::Starved(how) | WorkerEnd::Crashed(how) => Some(how),
        };
        tracing::error!(how = died, "the worker process has died, and another one takes its place");
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

/// Waits for a process that was told to end, and kills it if it does not.
async fn end(mut child: Child, hand: &Path) -> std::io::Result<()> {
    if tokio::time::timeout(GRACE, child.wait()).await.is_err() {
        child.kill().await?;
    }
    match std::fs::remove_file(hand) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
