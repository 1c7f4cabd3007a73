//! `sci-recon fetch`: downloads the results of a job.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::CliError;
use super::client::{Client, ServiceArguments, Wanted};
use super::error::Result;
use super::manifest::ManifestArguments;
use super::output::print_line;
use super::verdict;
use super::wait::wait;
use engine::job::{JobId, JobState};

/// Download the results of a job.
///
/// Interrupted downloads are resumed. No file is overwritten. Verdict and findings go to standard error; ends
/// with 3 if the checks found errors.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The job.
    job: JobId,
    #[command(flatten)]
    service: ServiceArguments,
    /// Folder for the files, with a subfolder for each snapshot, snapshot_0000 and so on [default: the identifier
    /// of the job].
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Files to fetch, separated by commas; may be repeated.
    #[arg(long = "file", value_name = "NAME", value_delimiter = ',', value_enum,
          default_values = ["frames.npy", "stack.exr", "manifest.json"])]
    files: Vec<Wanted>,
    #[command(flatten)]
    compared: ManifestArguments,
    /// Print a JSON object with the names of the files.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        let manifest = arguments.compared.read()?;
        let job = client.job(&arguments.job.to_string(), 0).await?;
        if job.state != JobState::Succeeded {
            let text = format!("job {} is {}, and has no results", job.id, job.state);
            return Err(CliError::Failure(job.failure().unwrap_or(text)));
        }
        let folder = arguments.out.clone().unwrap_or_else(|| job.id.clone().into());
        let findings = job.findings();
        if !arguments.json {
            eprintln!("{}", job.summary());
        }
        let files = client.fetch(&job, &arguments.files, &folder).await?;
        let comparison = match &manifest {
            Some(manifest) => Some(manifest.compare(&client, &job.id).await?),
            None => None,
        };
        match arguments.json {
            true => print_line(json!({
                "job": job.id, "files": files,
                "verdict": job.verdict, "assessment": job.assessment, "findings": findings, "comparison": comparison,
            }))?,
            false => {
                comparison.iter().for_each(|comparison| eprintln!("{}", comparison.indented()));
                files.iter().try_for_each(|file| print_line(file.display()))?;
            }
        }
        if let Some(difference) = comparison.and_then(|comparison| comparison.failure(&job.id)) {
            return Err(CliError::Failure(difference));
        }
        verdict::refuse_bad([(&*findings, job.verdict)])
    })
}
