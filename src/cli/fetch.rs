//! `sci-recon fetch`: the results of a job.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::CliError;
use super::client::{Client, ServiceArguments, Wanted};
use super::error::Result;
use super::wait::wait;
use engine::job::{JobId, JobState};

/// Fetch results of a job that has succeeded. What was cut goes on where it was; nothing is overwritten.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The job.
    job: JobId,
    #[command(flatten)]
    service: ServiceArguments,
    /// Folder for the files: those of each snapshot come into snapshot_0000 and so on [default: one with the
    /// identifier of the job].
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// What to fetch; may be given several times.
    #[arg(long = "file", value_name = "NAME", value_delimiter = ',', value_enum,
          default_values = ["frames.npy", "stack.exr", "manifest.json"])]
    files: Vec<Wanted>,
    /// Print a JSON object with the names of the files.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        let job = client.job(&arguments.job.to_string(), 0).await?;
        if job.state != JobState::Succeeded {
            let text = format!("job {} is {}, and has no results", job.id, job.state);
            return Err(CliError::Failure(job.failure().unwrap_or(text)));
        }
        let folder = arguments.out.clone().unwrap_or_else(|| job.id.clone().into());
        let files = client.fetch(&job, &arguments.files, &folder).await?;
        match arguments.json {
            true => println!("{}", json!({"job": job.id, "files": files})),
            false => files.iter().for_each(|file| println!("{}", file.display())),
        }
        Ok(())
    })
}
