//! Runs the service as a separate process.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, Command};

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::cli::serve::Announcement;

/// Time that the service has to start, and to stop.
const PATIENCE: Duration = Duration::from_secs(30);

/// A running service. It is killed if this is dropped.
pub(super) struct Service {
    process: Child,
    url: String,
}

impl Service {
    /// Starts `sci-recon serve` on a free port, with its data in `out/service` and its log in
    /// `out/service.log`.
    pub(super) async fn start(out: &Path) -> Result<Self> {
        let failed = |what: &str| {
            let log = out.join("service.log");
            CliError::Failure(format!("the service {what}; see {}", log.display()))
        };
        let program = std::env::current_exe().map_err(|error| {
            CliError::Failure(format!("the program can't find its path: {error}"))
        })?;
        let log = File::create(out.join("service.log"))
            .map_err(|error| CliError::file("write", &out.join("service.log"), &error))?;
        let mut process = Command::new(program)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(out.join("service"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log)
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| failed(&format!("can't be started: {error}")))?;
        let stdout = process.stdout.take().ok_or_else(|| failed("has no output"))?;
        let mut lines = BufReader::new(stdout).lines();
        let line = tokio::time::timeout(PATIENCE, lines.next_line()).await;
        let line = line.ok().and_then(Result::ok).flatten();
        let line = line.ok_or_else(|| failed("did not start"))?;
        let announced: Announcement = serde_json::from_str(&line)
            .map_err(|error| failed(&format!("printed an invalid address ({error})")))?;
        Ok(Self { process, url: announced.url })
    }

    pub(super) fn url(&self) -> &str {
        &self.url
    }

    /// Stops the service and waits for its end.
    pub(super) async fn stop(mut self) -> Result<()> {
        let failed =
            |text: String| CliError::Failure(format!("the service can't be stopped: {text}"));
        let id = self.process.id().and_then(|id| i32::try_from(id).ok());
        if let Some(pid) = id.and_then(rustix::process::Pid::from_raw) {
            rustix::process::kill_process(pid, rustix::process::Signal::TERM)
                .map_err(|error| failed(error.to_string()))?;
        }
        match tokio::time::timeout(PATIENCE, self.process.wait()).await {
            Ok(status) => status.map(drop).map_err(|error| failed(error.to_string())),
            // Dropping the process kills it.
            Err(_) => Ok(()),
        }
    }
}
