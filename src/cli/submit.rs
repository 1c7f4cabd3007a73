//! `sci-recon submit`: uploads files and submits a job.

use std::path::PathBuf;

use clap::Args;
use uuid::Uuid;

use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::output::print_line;
use super::submission::SubmissionArguments;
use super::verdict;
use super::wait::wait;

/// Upload masks and snapshots and submit a job.
///
/// Prints the identifier of the job. Findings of the checks go to standard error; ends with 3 if there are
/// errors among them.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Snapshots [row, column] or [snapshot, row, column].
    measurement: PathBuf,
    #[command(flatten)]
    service: ServiceArguments,
    #[command(flatten)]
    submission: SubmissionArguments,
    /// Requests with the same key create one job, however often they are sent [default: a new key].
    #[arg(long, value_name = "TEXT")]
    key: Option<String>,
    /// Print the job as a JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        let recipe = arguments.submission.recipe(&client).await?;
        let data = client.upload_with_bar(&arguments.measurement).await?;
        let key = arguments.key.clone().unwrap_or_else(|| Uuid::now_v7().to_string());
        let job = recipe.submit(&client, (&arguments.measurement, data), None, &key).await?;
        if arguments.json {
            print_line(&job)?;
        }
        let job = Job::new(job)?;
        if !arguments.json {
            print_line(&job.id)?;
            verdict::lines(&job.warnings).iter().for_each(|line| eprintln!("{line}"));
        }
        verdict::refuse_bad([(&*job.warnings, None)])
    })
}
