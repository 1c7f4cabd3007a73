//! `sci-recon watch-folder`: turns each file of a folder into a job, and puts the results beside it.
//!
//! 1. When a file stops growing, a line in the ledger gives it a permanent key.
//! 2. The file is uploaded, and a measurement and a job are created with that key. Repeated requests with the
//!    key return the same job.
//! 3. If the job succeeds, its results are downloaded; if it fails, a file has the reason.
//!
//! Each step can be repeated from its start. A kill at any moment loses nothing and creates nothing twice.

mod ledger;

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use reqwest::StatusCode;
use serde_json::json;
use uuid::Uuid;

use super::CliError;
use super::client::{Client, ClientError, Job, ServiceArguments, Wanted, place};
use super::error::Result;
use super::output::print_line;
use super::submission::{Recipe, SubmissionArguments};
use super::verdict;
use super::wait::wait;
use engine::job::{Finding, JobState};
use ledger::{Entry, Ledger, Shot, Stage};

/// Extensions of files that may hold snapshots. The service detects the format by the content.
const ENDINGS: [&str; 7] = ["npy", "tif", "tiff", "png", "mat", "h5", "hdf5"];
/// Verdict and findings, in the folder of the results.
const REPORT: &str = "REPORT.txt";
/// Pause between two looks at the folder.
const LOOK: Duration = Duration::from_millis(500);

/// Turn each file that appears in a folder into a job.
///
/// A file is submitted when it stops growing. Its results come into NAME.result beside it, with a
/// REPORT.txt; if the job fails, NAME.failed.txt has the reason. The command may be stopped and started at any
/// time. With --once it ends with 1 if a job failed, and with 3 if the checks found errors in a file.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The folder. Subfolders, links and hidden files are ignored.
    folder: PathBuf,
    #[command(flatten)]
    service: ServiceArguments,
    #[command(flatten)]
    submission: SubmissionArguments,
    /// Seconds without a change after which a file is submitted.
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0)]
    settle_seconds: f64,
    /// Files to fetch, separated by commas; may be repeated.
    #[arg(long = "file", value_name = "NAME", value_delimiter = ',', value_enum,
          default_values = ["frames.npy", "stack.tif", "manifest.json"])]
    files: Vec<Wanted>,
    /// End when all files are done.
    #[arg(long)]
    once: bool,
    /// Print a JSON object for each step of each file.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let settle = Duration::try_from_secs_f64(arguments.settle_seconds)
        .map_err(|error| CliError::Input(format!("--settle-seconds: {error}")))?;
    let folder = arguments.folder.canonicalize();
    let folder = folder.map_err(|error| CliError::file("watch", &arguments.folder, &error))?;
    wait(async {
        let client = Client::new(&arguments.service)?;
        let ledger = Ledger::open(ledger::place(&folder))?;
        let own = arguments
            .submission
            .own_files()
            .map(|file| file.canonicalize().map_err(|error| CliError::file("read", file, &error)));
        let own = own.collect::<Result<_>>()?;
        let (seen, failed, errors) = (HashMap::new(), 0, Vec::new());
        let mut watch =
            Watch { arguments, client, folder, own, settle, ledger, seen, failed, errors };
        watch.run().await?;
        if watch.failed > 0 {
            let text = format!("{} files have failed; see their .failed.txt", watch.failed);
            return Err(CliError::Failure(text));
        }
        verdict::refuse_errors([&*watch.errors])
    })
}

struct Watch<'a> {
    arguments: &'a Arguments,
    client: Client,
    folder: PathBuf,
    /// Masks and dark captures, which may be in the folder, too.
    own: Vec<PathBuf>,
    settle: Duration,
    ledger: Ledger,
    /// Files that may still grow, with the time of their last observed change.
    seen: HashMap<Shot, Instant>,
    /// Files that have failed since the start.
    failed: usize,
    /// Findings of the jobs that have ended since the start.
    errors: Vec<Finding>,
}

impl Watch<'_> {
    async fn run(&mut self) -> Result<()> {
        let recipe = loop {
            match self.arguments.submission.recipe(&self.client).await {
                Ok(recipe) => break recipe,
                Err(ClientError::Passing(reason)) => self.waiting(&reason).await,
                Err(error) => return Err(error.into()),
            }
        };
        loop {
            let settled = self.look()?;
            let quiet = settled.is_empty() && self.seen.is_empty();
            for shot in settled {
                self.take(shot, &recipe)?;
            }
            for entry in self.ledger.open_entries() {
                self.advance(entry).await?;
            }
            if self.arguments.once && quiet && self.ledger.open_entries().is_empty() {
                return Ok(());
            }
            tokio::time::sleep(LOOK.min(self.settle.max(Duration::from_millis(50)))).await;
        }
    }

    /// New files that have stopped growing, by modification time.
    fn look(&mut self) -> Result<Vec<Shot>> {
        let unreadable = |error: std::io::Error| CliError::file("read", &self.folder, &error);
        let (now, mut seen, mut settled) = (Instant::now(), HashMap::new(), Vec::new());
        for found in fs::read_dir(&self.folder).map_err(unreadable)? {
            let path = found.map_err(unreadable)?.path();
            let Some(shot) = shot(&path) else { continue };
            if self.ledger.has(&shot) || self.own.contains(&path) {
                continue;
            }
            let since = self.seen.get(&shot).copied().unwrap_or(now);
            if now - since >= self.settle && shot.size > 0 {
                settled.push(shot);
            } else if shot.size > 0 {
                seen.insert(shot, since);
            }
        }
        self.seen = seen;
        settled.sort_by(|a, b| (a.time, &a.name).cmp(&(b.time, &b.name)));
        Ok(settled)
    }

    fn take(&mut self, shot: Shot, recipe: &Recipe) -> Result<()> {
        let results = (1..)
            .map(|number| match number {
                1 => shot.name.clone(),
                again => format!("{}.{again}", shot.name),
            })
            .find(|name| self.is_free(name));
        let results = results.unwrap_or_else(|| shot.name.clone());
        let key = Uuid::now_v7().to_string();
        self.note(Entry { shot, key, recipe: recipe.clone(), results, stage: Stage::Taken })
    }

    /// True if no file and no entry uses the names of these results.
    fn is_free(&self, name: &str) -> bool {
        let taken = [result_folder(name), failure_file(name)];
        let exists = |name: &String| self.folder.join(name).symlink_metadata().is_ok();
        !self.ledger.has_results(name) && !taken.iter().any(exists)
    }

    /// Takes the next step for a file.
    async fn advance(&mut self, entry: Entry) -> Result<()> {
        let step = match &entry.stage {
            Stage::Taken => self.submit(&entry).await,
            Stage::Submitted { job } => self.fetch(&entry, job).await,
            Stage::Done { .. } | Stage::Failed { .. } => return Ok(()),
        };
        let stage = match step {
            Ok(None) => return Ok(()),
            Ok(Some(stage)) => stage,
            Err(ClientError::Passing(reason)) => {
                self.waiting(&reason).await;
                return Ok(());
            }
            // A wrong address or certificate, or a missing permission, is no fault of the file.
            Err(error @ ClientError::Unreachable(_)) => return Err(error.into()),
            Err(ClientError::Refused { status, code, detail })
                if [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN].contains(&status) =>
            {
                return Err(ClientError::Refused { status, code, detail }.into());
            }
            // Neither is a full disk here: the next start fetches the results.
            Err(ClientError::Here(error @ CliError::Failure(_)))
                if matches!(entry.stage, Stage::Submitted { .. }) =>
            {
                return Err(error);
            }
            Err(error @ ClientError::Refused { .. }) => Stage::Failed { reason: error.to_string() },
            Err(ClientError::Here(error)) => Stage::Failed { reason: error.to_string() },
        };
        if let Stage::Failed { reason } = &stage {
            self.failed += 1;
            self.explain(&entry, reason)?;
        }
        self.note(Entry { stage, ..entry })
    }

    async fn submit(&self, entry: &Entry) -> Result<Option<Stage>, ClientError> {
        let path = self.folder.join(&entry.shot.name);
        let changed = || {
            Stage::Failed {
            reason:
                "the file was changed or removed while it was submitted; a changed file is submitted \
                     as a new one"
                    .into(),
        }
        };
        if shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        let data = self.client.sent(&path).await?;
        if shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        self.arguments.submission.send_dark(&self.client).await?;
        let label: String = entry.shot.name.chars().take(200).collect();
        let job = entry.recipe.submit(&self.client, data, Some(&label), &entry.key).await?;
        Ok(Some(Stage::Submitted { job: Job::new(job)?.id }))
    }

    async fn fetch(&mut self, entry: &Entry, job: &str) -> Result<Option<Stage>, ClientError> {
        let job = self.client.job(job, 0).await?;
        if let Some(reason) = job.failure() {
            let findings = verdict::lines(&job.findings());
            let reason = [vec![reason], findings].concat().join("\n");
            return Ok(Some(Stage::Failed { reason }));
        }
        if job.state != JobState::Succeeded {
            return Ok(None);
        }
        let folder = self.folder.join(result_folder(&entry.results));
        self.client.fetch(&job, &self.arguments.files, &folder).await?;
        self.write_report(entry, &job, &folder)?;
        Ok(Some(Stage::Done { job: job.id }))
    }

    /// Prints verdict and findings, and writes them to the folder of the results.
    fn write_report(&mut self, entry: &Entry, job: &Job, folder: &Path) -> Result<()> {
        let findings = job.findings();
        if self.arguments.json {
            print_line(json!({
                "file": entry.shot.name, "job": job.id,
                "assessment": job.assessment, "findings": findings,
            }))?;
        } else {
            print_line(format!("{} {}", entry.shot.name, job.summary()))?;
        }
        let end = job.finished_at.map(|time| time.to_string()).unwrap_or_default();
        let (first, count) = (job.snapshots.first, job.snapshots.count);
        let text = format!(
            "{}: {}\n\n{}\njob        {}\nalgorithm  {}\nsnapshots  {count}, from {first} on\nsubmitted  {}\n\
             finished   {end}\n",
            entry.shot.name,
            job.verdict().unwrap_or_default(),
            verdict::lines(&findings).iter().map(|line| format!("{line}\n")).collect::<String>(),
            job.id,
            job.algorithm,
            job.created_at,
        );
        self.errors.extend(findings);
        fs::create_dir_all(folder).map_err(|error| CliError::file("make", folder, &error))?;
        write_new(&folder.join(REPORT), &text)
    }

    /// Writes the reason of a failure beside the file.
    fn explain(&self, entry: &Entry, reason: &str) -> Result<()> {
        let path = self.folder.join(failure_file(&entry.results));
        let text =
            format!("{}: {reason}\n\nTo try again: touch {:?}\n", entry.shot.name, entry.shot.name);
        write_new(&path, &text)
    }

    fn note(&mut self, entry: Entry) -> Result<()> {
        if self.arguments.json {
            let state = &entry.stage;
            print_line(json!({"file": entry.shot.name, "size": entry.shot.size, "step": state}))?;
        } else {
            let told = match &entry.stage {
                Stage::Taken => "is sent".to_owned(),
                Stage::Submitted { job } => format!("is job {job}"),
                Stage::Done { .. } => format!("is in {}", result_folder(&entry.results)),
                Stage::Failed { reason } => format!("has failed: {reason}"),
            };
            print_line(format!("{} {told}", entry.shot.name))?;
        }
        self.ledger.note(entry)
    }

    /// Prints why the service is not available, and waits.
    async fn waiting(&self, reason: &str) {
        eprintln!("sci-recon: {reason}; trying again");
        tokio::time::sleep(Duration::from_secs(2)).await;
    }
}

/// Writes a text file, completely or not at all. A file with the same text may be there.
fn write_new(path: &Path, text: &str) -> Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let made = path.with_file_name(format!(".{name}.part"));
    let write = || -> std::io::Result<()> {
        let mut file = File::create(&made)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|error| CliError::file("write", &made, &error))?;
    match place(&made, path) {
        // It was written before the ledger could say so.
        Err(_) if fs::read_to_string(path).is_ok_and(|there| there == text) => {
            fs::remove_file(&made).map_err(|error| CliError::file("remove", &made, &error))
        }
        placed => placed,
    }
}

fn result_folder(name: &str) -> String {
    format!("{name}.result")
}

fn failure_file(name: &str) -> String {
    format!("{name}.failed.txt")
}

/// The state of a file; none unless it is a regular file that may hold snapshots.
fn shot(path: &Path) -> Option<Shot> {
    let name = path.file_name()?.to_str().filter(|name| !name.starts_with('.'))?;
    let ending = path.extension()?.to_str()?.to_ascii_lowercase();
    let meta = path.symlink_metadata().ok().filter(|meta| meta.is_file())?;
    let time = (meta.mtime(), meta.mtime_nsec());
    let shot = Shot { name: name.to_owned(), size: meta.len(), time };
    ENDINGS.contains(&&*ending).then_some(shot)
}
