//! `sci-recon watch`: waits for jobs.

use clap::Args;
use indicatif::MultiProgress;
use serde_json::json;

use super::CliError;
use super::client::{Client, Job, ServiceArguments};
use super::error::Result;
use super::exec::{End, ExecArguments};
use super::manifest::{Manifest, ManifestArguments};
use super::output::print_line;
use super::progress;
use super::verdict;
use super::wait::wait;
use engine::job::{JobId, JobState};

/// Wait for jobs, and print verdicts and findings.
///
/// Ends with 1 unless all have succeeded and equal the manifest, if one is given, else with 3 if the checks found errors.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The jobs.
    #[arg(required = true, value_name = "JOB")]
    jobs: Vec<JobId>,
    #[command(flatten)]
    service: ServiceArguments,
    #[command(flatten)]
    compared: ManifestArguments,
    #[command(flatten)]
    exec: ExecArguments,
    /// Print a JSON object for each job.
    #[arg(long)]
    json: bool,
}

/// Seconds that a request waits for the end of a job while a bar is shown.
const WAIT_WITH_BAR: u32 = 1;
/// Seconds that a request waits for the end of a job otherwise.
const WAIT: u32 = 20;

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let client = Client::new(&arguments.service)?;
        let manifest = arguments.compared.read()?;
        let jobs: Vec<_> = arguments.jobs.iter().map(ToString::to_string).collect();
        let jobs: Vec<_> = jobs.iter().map(|id| (&**id, &**id)).collect();
        let jobs = until_ended(&client, &jobs, &arguments.exec).await?;
        report(&client, &jobs, manifest.as_ref(), arguments.json).await
    })
}

/// Waits for the end of all jobs, each with its name and its identifier, and shows their progress.
/// Errors: those of the service; the command of `exec` fails.
pub(super) async fn until_ended(
    client: &Client,
    jobs: &[(&str, &str)],
    exec: &ExecArguments,
) -> Result<Vec<Job>> {
    let screen = MultiProgress::with_draw_target(progress::target());
    let wait = if screen.is_hidden() { WAIT } else { WAIT_WITH_BAR };
    let bars = jobs.iter().map(|&(name, id)| (id, screen.add(progress::bar(name.to_owned()))));
    // Waits for all jobs concurrently.
    let ends = bars.map(|(id, bar)| async move {
        loop {
            let requested = std::time::Instant::now();
            let job = client.job(id, wait).await?;
            progress::show(&bar, job.progress.percent / 100.0);
            if job.state.is_final() {
                exec.run(&End::of(&job), None).await?;
                return Ok::<Job, CliError>(job);
            }
            // The service answers at once if too many requests of the lab wait.
            let pause = std::time::Duration::from_secs(1).saturating_sub(requested.elapsed());
            tokio::time::sleep(pause).await;
        }
    });
    let jobs = futures_util::future::try_join_all(ends).await;
    // The result does not depend on the bars. A failure to clear them is ignored.
    let _ = screen.clear();
    jobs
}

async fn report(
    client: &Client,
    jobs: &[Job],
    manifest: Option<&Manifest>,
    as_json: bool,
) -> Result<()> {
    let mut failures: Vec<String> = jobs.iter().filter_map(Job::failure).collect();
    for job in jobs {
        let comparison = match manifest.filter(|_| job.state == JobState::Succeeded) {
            Some(manifest) => Some(manifest.compare(client, &job.id).await?),
            None => None,
        };
        match as_json {
            true => print_line(json!({
                "id": job.id, "state": job.state, "error": job.error,
                "verdict": job.verdict, "assessment": job.assessment, "findings": job.findings(), "comparison": comparison,
            }))?,
            false => {
                print_line(job.summary())?;
                comparison.iter().try_for_each(|comparison| print_line(comparison.indented()))?;
            }
        }
        failures.extend(comparison.and_then(|comparison| comparison.failure(&job.id)));
    }
    if !failures.is_empty() {
        return Err(CliError::Failure(failures.join("; ")));
    }
    let findings: Vec<_> = jobs.iter().map(Job::findings).collect();
    let verdicts = jobs.iter().map(|job| job.verdict);
    verdict::refuse_bad(findings.iter().map(Vec::as_slice).zip(verdicts))
}
