//! `sci-recon ls`: lists the jobs of a lab.

use clap::Args;
use serde_json::{Value, json};

use super::CliError;
use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::output::print_line;
use super::verdict;
use super::wait::wait;
use engine::job::JobState;

/// List jobs with their verdicts, newest first.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    service: ServiceArguments,
    /// Only jobs in these states, separated by commas; may be repeated.
    #[arg(long, value_name = "STATE", value_delimiter = ',')]
    state: Vec<JobState>,
    /// Largest number of jobs.
    #[arg(long, value_name = "N", default_value_t = 50)]
    limit: usize,
    /// Print a JSON array of jobs, as the service shows them.
    #[arg(long)]
    json: bool,
}

/// Jobs per request.
const PAGE: usize = 100;

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        let jobs = list(&client, &arguments.state, arguments.limit).await?;
        if arguments.json {
            print_line(json!(jobs))?;
            return Ok(());
        }
        for job in jobs {
            let job = Job::new(job)?;
            let Job { id, created_at, algorithm, .. } = &job;
            let state = verdict::state_word(job.state);
            let percent = job.progress.percent;
            let verdict = job.verdict_text.as_deref().unwrap_or_default();
            let label = job.label.as_deref().unwrap_or_default();
            let line = format!("{id}  {state:9}  {percent:3.0} %  {created_at}  {algorithm:18}");
            print_line(format!("{line}  {label:20}  {verdict}").trim_end())?;
            for finding in verdict::lines(&job.findings()) {
                print_line(format!("    {finding}"))?;
            }
        }
        Ok::<_, CliError>(())
    })
}

async fn list(client: &Client, states: &[JobState], limit: usize) -> Result<Vec<Value>> {
    let states: Vec<&str> = states.iter().map(|state| state.into_str()).collect();
    let mut cursor = String::new();
    let mut jobs = Vec::new();
    while jobs.len() < limit {
        let count = PAGE.min(limit - jobs.len());
        let mut path = format!("/v1/jobs?limit={count}{cursor}");
        if !states.is_empty() {
            path += &format!("&state={}", states.join(","));
        }
        let mut page = client.get(&path).await?;
        jobs.extend(page["items"].take().as_array().cloned().unwrap_or_default());
        match page["next_cursor"].as_str() {
            Some(next) => cursor = format!("&cursor={next}"),
            None => break,
        }
    }
    Ok(jobs)
}
