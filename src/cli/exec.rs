//! A command of the user that runs when a job has ended.

use std::path::Path;

use clap::Args;
use tokio::process::Command;

use super::CliError;
use super::client::Job;
use super::error::Result;

/// The option of `watch` and `watch-folder`.
#[derive(Debug, Default, Args)]
pub struct ExecArguments {
    /// Shell command that runs each time a job has ended. JOB_ID, JOB_STATE, JOB_LABEL, JOB_ERROR and JOB_VERDICT describe
    /// the job; watch-folder also sets JOB_FILE and JOB_RESULTS, and runs it for refused files, too [default: none].
    #[arg(long, value_name = "COMMAND")]
    exec: Option<String>,
}

/// The end of a job, or of a file that was refused.
#[derive(Debug, Default)]
pub(super) struct End {
    pub(super) job: String,
    pub(super) state: String,
    pub(super) label: String,
    pub(super) error: String,
    pub(super) verdict: String,
}

impl End {
    pub(super) fn of(job: &Job) -> Self {
        Self {
            job: job.id.clone(),
            state: job.state.to_string(),
            label: job.label.clone().unwrap_or_default(),
            error: job.error.clone().unwrap_or_default(),
            verdict: job.verdict_text.clone().unwrap_or_default(),
        }
    }
}

impl ExecArguments {
    /// Runs the command. `files` are the submitted file and the folder or file of its results.
    ///
    /// Errors: the command does not end with 0.
    pub(super) async fn run(&self, end: &End, files: Option<(&Path, &Path)>) -> Result<()> {
        let Some(line) = &self.exec else { return Ok(()) };
        let mut command = Command::new("sh");
        command.arg("-c").arg(line).kill_on_drop(true);
        command.env("JOB_ID", &end.job).env("JOB_STATE", &end.state);
        command.env("JOB_LABEL", &end.label).env("JOB_ERROR", &end.error);
        command.env("JOB_VERDICT", &end.verdict);
        if let Some((file, results)) = files {
            command.env("JOB_FILE", file).env("JOB_RESULTS", results);
        }
        let failed = |reason: String| CliError::Failure(format!("--exec: {reason}"));
        let status = command.status().await.map_err(|error| failed(error.to_string()))?;
        match status.success() {
            true => Ok(()),
            false => Err(failed(format!("the command ended with {status}"))),
        }
    }
}
