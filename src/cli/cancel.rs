//! `sci-recon cancel`: stops jobs.

use clap::Args;
use serde_json::json;

use super::CliError;
use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::output::print_line;
use super::wait::wait;
use engine::job::JobId;

/// Stop jobs.
///
/// Each stops within an iteration.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The jobs.
    #[arg(required = true, value_name = "JOB")]
    jobs: Vec<JobId>,
    #[command(flatten)]
    service: ServiceArguments,
    /// Print a JSON object for each job.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        for id in &arguments.jobs {
            let answer = client.post(&format!("/v1/jobs/{id}/cancel"), &json!({})).await?;
            match arguments.json {
                true => print_line(answer)?,
                false => {
                    let job = Job::new(answer)?;
                    print_line(format!("{} {}", job.id, job.state))?;
                }
            }
        }
        Ok::<_, CliError>(())
    })
}
