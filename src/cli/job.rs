//! `sci-recon job`: manages the jobs of all labs, for the administrator of the machine.

use clap::{ArgGroup, Args, Subcommand};

use super::CliError;
use super::audited::{Change, FolderArguments, audited};
use super::output::print_line;
use super::wait::with_store;
use crate::audit::AuditLog;
use crate::cli::error::Result;
use engine::job::{JobId, JobState, Lab, Label, priority_error};
use store::{Job, JobChanges, JobFilter, JobProgress, Store, StoreError};

/// Jobs per query.
const PAGE: u32 = 1000;

/// Manage the jobs of all labs.
///
/// The service may be running.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    folder: FolderArguments,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List jobs, newest first.
    List {
        /// Only jobs of this lab.
        #[arg(long, value_name = "NAME")]
        lab: Option<Lab>,
        /// Only jobs in these states, separated by commas [default: all].
        #[arg(long, value_name = "STATE", value_delimiter = ',')]
        state: Vec<JobState>,
        /// Largest number of jobs.
        #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
        limit: u32,
    },
    /// Cancel a job that waits or runs.
    Cancel {
        /// The job's identifier.
        job: JobId,
    },
    /// Retry a job that has failed or was cancelled.
    Retry {
        /// The job's identifier.
        job: JobId,
    },
    /// Change the priority of a job that waits or runs.
    Priority {
        /// The job's identifier.
        job: JobId,
        /// From -100 to 100; jobs of higher priority go first.
        #[arg(value_name = "N", allow_negative_numbers = true, value_parser = priority)]
        priority: i32,
    },
    /// Delete jobs that have ended, and their results.
    #[command(group = ArgGroup::new("which").args(["jobs", "all"]).required(true))]
    Delete {
        /// The jobs' identifiers.
        #[arg(value_name = "JOB")]
        jobs: Vec<JobId>,
        /// Delete all jobs of a lab that have ended.
        #[arg(long, requires = "lab")]
        all: bool,
        /// The lab.
        #[arg(long, value_name = "NAME", requires = "all")]
        lab: Option<Lab>,
        /// Only jobs in these final states, separated by commas.
        #[arg(long, value_name = "STATE", value_delimiter = ',', requires = "all",
              default_values = ["succeeded", "failed", "cancelled"])]
        state: Vec<JobState>,
        /// Confirm the deletion of all jobs; without it, they are counted.
        #[arg(long, requires = "all")]
        yes: bool,
    },
}

fn priority(text: &str) -> Result<i32, String> {
    let priority = text.parse().map_err(|_| format!("{text:?} is not a whole number"))?;
    priority_error(priority).map_or(Ok(priority), |error| Err(error.detail))
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let log = arguments.folder.log()?;
    let act = async |store: &Store| act(store, &log, &arguments.action).await;
    print_line(with_store(&arguments.folder.data, act)?)
}

async fn act(store: &Store, log: &AuditLog, action: &Action) -> Result<String> {
    let (id, name) = match *action {
        Action::List { ref lab, ref state, limit } => {
            let states = (!state.is_empty()).then(|| state.clone());
            let filter = JobFilter { states, ..JobFilter::default() };
            let jobs = store.jobs(lab.as_ref(), &filter, limit).await?.items;
            return Ok(table(&jobs, &store.progress_of(&jobs).await?));
        }
        Action::Delete { ref jobs, ref lab, ref state, yes, .. } => {
            return match lab {
                Some(lab) => delete_all(store, log, lab, state, yes).await,
                None => delete_each(store, log, jobs).await,
            };
        }
        Action::Cancel { job } => (job, "job cancel"),
        Action::Retry { job } => (job, "job retry"),
        Action::Priority { job, .. } => (job, "job priority"),
    };
    let lab = store.job_of_any_lab(id).await?.lab;
    let change = Change { action: name, lab: Some(lab.clone()), object: id.to_string() };
    audited(store, log, change, async || alter(store, &lab, action).await).await?;
    let jobs = [store.job_of_any_lab(id).await?];
    Ok(table(&jobs, &store.progress_of(&jobs).await?))
}

/// Deletes jobs of any lab.
async fn delete_each(store: &Store, log: &AuditLog, jobs: &[JobId]) -> Result<String> {
    let mut lines = Vec::with_capacity(jobs.len());
    for &job in jobs {
        let lab = store.job_of_any_lab(job).await?.lab;
        delete(store, log, &lab, job).await?;
        lines.push(format!("deleted {job} of {lab}"));
    }
    Ok(lines.join("\n"))
}

/// Deletes the jobs of a lab in some final states.
///
/// Errors: a state that is not final; without `yes`, the number of jobs.
async fn delete_all(
    store: &Store,
    log: &AuditLog,
    lab: &Lab,
    states: &[JobState],
    yes: bool,
) -> Result<String> {
    if let Some(state) = states.iter().find(|state| !state.is_final()) {
        let text = format!("jobs that are {state} can't be deleted: cancel them first");
        return Err(CliError::Input(text));
    }
    store.lab(lab.as_str()).await?;
    let mut filter = JobFilter { states: Some(states.to_vec()), ..JobFilter::default() };
    let mut count = 0_u64;
    loop {
        let page = store.jobs(Some(lab), &filter, PAGE).await?;
        for job in &page.items {
            if yes {
                delete(store, log, lab, job.id).await?;
            }
            count += 1;
        }
        match page.items.last() {
            Some(last) if page.more => filter.after = Some(last.id),
            _ => break,
        }
    }
    let names: Vec<&str> = states.iter().map(|state| state.into_str()).collect();
    let plural = if count == 1 { "" } else { "s" };
    let jobs = format!("{count} job{plural} of {lab} ({}) with all results", names.join(", "));
    if yes || count == 0 {
        return Ok(format!("deleted {jobs}"));
    }
    Err(CliError::Input(format!("this deletes {jobs}: add --yes to confirm")))
}

async fn delete(store: &Store, log: &AuditLog, lab: &Lab, job: JobId) -> Result<()> {
    let change = Change { action: "job delete", lab: Some(lab.clone()), object: job.to_string() };
    audited(store, log, change, async || store.delete_job(lab, job).await).await
}

/// Changes a job of this lab.
async fn alter(store: &Store, lab: &Lab, action: &Action) -> Result<(), StoreError> {
    match *action {
        Action::List { .. } | Action::Delete { .. } => Ok(()),
        Action::Cancel { job } => store.cancel_job(lab, job).await.map(drop),
        Action::Retry { job } => store.retry_job(lab, job).await.map(drop),
        Action::Priority { job, priority } => {
            let changes = JobChanges { priority: Some(priority), ..JobChanges::default() };
            store.change_job(lab, job, &changes).await.map(drop)
        }
    }
}

fn table(jobs: &[Job], progress: &[JobProgress]) -> String {
    let mut lines = vec![format!(
        "{:36}  {:16}  {:10}  {:>8}  {:>5}  {:24}  {:20}  label",
        "id", "lab", "state", "priority", "done", "created", "algorithm"
    )];
    for (job, progress) in jobs.iter().zip(progress) {
        lines.push(format!(
            "{:36}  {:16}  {:10}  {:>8}  {:>4.0}%  {:24}  {:20}  {}",
            job.id.to_string(),
            job.lab.as_str(),
            job.state.into_str(),
            job.spec.priority,
            progress.percent,
            job.created_at.to_string(),
            job.spec.algorithm.into_str(),
            job.spec.label.as_ref().map_or("", Label::as_str),
        ));
    }
    lines.join("\n")
}
