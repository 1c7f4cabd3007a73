//! `sci-recon submit`: uploads files and submits a job.

use std::path::PathBuf;

use clap::Args;
use serde_json::Value;
use uuid::Uuid;

use super::CliError;
use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::manifest::Manifest;
use super::output::print_line;
use super::submission::{SETTINGS, SubmissionArguments};
use super::verdict;
use super::wait::wait;

/// Upload masks and snapshots and submit a job.
///
/// With --manifest, repeat the job of a manifest; `watch JOB --manifest FILE` compares the frames.
///
/// Prints the identifier of the job. Findings of the checks go to standard error; ends with 3 if there are
/// errors among them.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Snapshots [row, column] or [snapshot, row, column]; with --manifest, the inputs that the service lacks.
    #[arg(value_name = "FILE", required_unless_present = "manifest")]
    files: Vec<PathBuf>,
    /// The manifest of a job, which is repeated with the same calibration, measurement and settings.
    #[arg(long, value_name = "FILE", group = "camera",
          conflicts_with_all = SETTINGS)]
    manifest: Option<PathBuf>,
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
        let key = arguments.key.clone().unwrap_or_else(|| Uuid::now_v7().to_string());
        let job = submit(&client, arguments, &key).await?;
        if arguments.json {
            print_line(&job)?;
        }
        let job = Job::new(job)?;
        if !arguments.json {
            print_line(&job.id)?;
            verdict::lines(&job.warnings).iter().for_each(|line| eprintln!("{line}"));
        }
        verdict::refuse_bad([(&*job.warnings, job.verdict)])
    })
}

async fn submit(client: &Client, arguments: &Arguments, key: &str) -> Result<Value> {
    let Arguments { files, submission, .. } = arguments;
    if let Some(manifest) = &arguments.manifest {
        return Manifest::read(manifest)?.submit(client, files, submission.plain(), key).await;
    }
    let [file] = files.as_slice() else {
        let text =
            "give one file of snapshots: several snapshots are an array or a TIFF in one file";
        return Err(CliError::Input(text.into()));
    };
    let recipe = submission.recipe(client).await?;
    let data = client.upload_with_bar(file).await?;
    Ok(recipe.submit(client, file, data, None, key).await?)
}
