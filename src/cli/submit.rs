//! `sci-recon submit`: files to a service, and a job of them.

use std::path::PathBuf;

use clap::Args;
use uuid::Uuid;

use super::CliError;
use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::submission::SubmissionArguments;
use super::wait::wait;

/// Send masks and snapshots to a service and ask for a job; prints its identifier.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Snapshots [row, column] or [snapshot, row, column].
    measurement: PathBuf,
    #[command(flatten)]
    service: ServiceArguments,
    #[command(flatten)]
    submission: SubmissionArguments,
    /// What the job is called.
    #[arg(long, value_name = "TEXT")]
    label: Option<String>,
    /// With the same key, the same request makes one job however often it is sent [default: a new one].
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
        let data = client.sent(&arguments.measurement).await?;
        let key = arguments.key.clone().unwrap_or_else(|| Uuid::now_v7().to_string());
        let job = recipe.submit(&client, data, arguments.label.as_deref(), &key).await?;
        match arguments.json {
            true => println!("{job}"),
            false => println!("{}", Job::new(job)?.id),
        }
        Ok::<_, CliError>(())
    })
}
