//! A command of the user that runs when a job has ended.

use std::path::Path;

use clap::Args;
use tokio::process::Command;

use super::CliError;
use super::client::Job;
use super::error::Result;

/// The option of `watch` and `watch-folder`.
#[derive(Debug, Args)]
pub struct ExecArguments {
    /// Shell command that runs each time a job has ended. JOB_ID, JOB_STATE, JOB_LABEL, JOB_ERROR and JOB_VERDICT describe
    /// the job; watch-folder also sets JOB_FILE and JOB_RESULTS [default: none].
    #[arg(long, value_name = "COMMAND")]
    exec: Option<String>,
}

impl ExecArguments {
    /// Runs the command for a job that has ended. `files` are the submitted file and the folder or file of its results.
    ///
    /// Errors: the command does not end with 0.
    pub(super) async fn run(&self, job: &Job, files: Option<(&Path, &Path)>) -> Result<()> {
        let Some(line) = &self.exec else { return Ok(()) };
        let mut command = Command::new("sh");
        command.arg("-c").arg(line).kill_on_drop(true).env("JOB_ID", &job.id);
        command.env("JOB_STATE", job.state.to_string());
        command.env("JOB_LABEL", job.label.as_deref().unwrap_or_default());
        command.env("JOB_ERROR", job.error.as_deref().unwrap_or_default());
        command.env("JOB_VERDICT", job.verdict().unwrap_or_default());
        if let Some((file, results)) = files {
            command.env("JOB_FILE", file).env("JOB_RESULTS", results);
        }
        let failed =
            |reason: String| CliError::Failure(format!("--exec for job {}: {reason}", job.id));
        let status = command.status().await.map_err(|error| failed(error.to_string()))?;
        if status.success() {
            Ok(())
        } else {
            Err(failed(format!("the command ended with {status}")))
        }
    }
}
