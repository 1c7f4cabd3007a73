//! `sci-recon watch-folder`: submits each file of a folder as a job, and puts the results next to the file.
//!
//! 1. When a file stops growing, a line in the ledger gives it a permanent key.
//! 2. The file is uploaded, and a measurement and a job are created with that key. Repeated requests with the
//!    key return the same job.
//! 3. If the job succeeds, its results are downloaded. If it fails, the reason is written to a file.
//!
//! Each step can be repeated from its start. A kill at any moment loses nothing and creates nothing twice.

mod ledger;

use std::collections::HashMap;
use std::ffi::{OsStr, OsString};
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
use super::client::{Client, ClientError, Job, ServiceArguments, Wanted, rename_new};
use super::error::Result;
use super::exec::{End, ExecArguments};
use super::output::print_line;
use super::submission::{Recipe, SubmissionArguments};
use super::verdict;
use super::wait::wait;
use engine::job::JobState;
use ledger::{Entry, FileState, Ledger, Shot};

/// Extensions of files that may hold snapshots. The service detects the format by the content.
const ENDINGS: [&str; 10] = ["npy", "npz", "tif", "tiff", "png", "zip", "tar", "mat", "h5", "hdf5"];
/// Further extensions of packed pixels without a header.
const PACKED_ENDINGS: [&str; 2] = ["raw", "bin"];
/// File with verdict and findings, in the folder of the results.
const REPORT: &str = "REPORT.txt";
/// Longest name of a file in bytes. File systems allow 255, and names of results are longer than that of the file.
const MAX_NAME: usize = 230;
/// Time between two scans of the folder.
const POLL: Duration = Duration::from_millis(500);

/// Submit each file that appears in a folder as a job.
///
/// A file is submitted when it stops growing. The results are written to NAME.result in the same folder, with a
/// REPORT.txt; if the job fails, NAME.failed.txt has the reason. The command may be stopped and started at any
/// time. With --once it ends with 1 if a job failed or a file was skipped, and with 3 if the verdict on a file is bad.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The folder. Subfolders and hidden files are ignored. Links, empty files, and names that are not UTF-8, have control
    /// characters or more than 230 bytes are skipped and reported.
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
    #[command(flatten)]
    exec: ExecArguments,
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
        let ledger = Ledger::open(ledger::path_in(&folder))?;
        let excluded = arguments
            .submission
            .own_files()
            .map(|file| file.canonicalize().map_err(|error| CliError::unreadable(file, &error)));
        let mut watch = Watch {
            arguments,
            client,
            folder,
            excluded: excluded.collect::<Result<_>>()?,
            settle,
            ledger,
            growing: HashMap::new(),
            failed: 0,
            skipped: HashMap::new(),
            results: Vec::new(),
        };
        watch.run().await?;
        if watch.failed > 0 {
            let text = format!("{} files have failed; see their .failed.txt", watch.failed);
            return Err(CliError::Failure(text));
        }
        if !watch.skipped.is_empty() {
            let text =
                format!("{} files were skipped; the output has the reasons", watch.skipped.len());
            return Err(CliError::Failure(text));
        }
        verdict::refuse_bad(watch.results.iter().map(|job| (&*job.warnings, job.verdict)))
    })
}

struct Watch<'a> {
    arguments: &'a Arguments,
    client: Client,
    folder: PathBuf,
    /// Masks and dark captures, which may be in the same folder.
    excluded: Vec<PathBuf>,
    settle: Duration,
    ledger: Ledger,
    /// Files that may still grow, with the time of their last observed change.
    growing: HashMap<Shot, Instant>,
    /// Files that have failed since the start.
    failed: usize,
    /// Names of files that are not submitted, with the reasons.
    skipped: HashMap<OsString, &'static str>,
    /// Jobs that have succeeded since the start.
    results: Vec<Job>,
}

impl Watch<'_> {
    async fn run(&mut self) -> Result<()> {
        let recipe = loop {
            match self.arguments.submission.recipe(&self.client).await {
                Ok(recipe) => break recipe,
                Err(ClientError::Temporary(reason)) => self.wait_for_service(&reason).await,
                Err(error) => return Err(error.into()),
            }
        };
        loop {
            let settled = self.scan()?;
            // An empty file may still be filled, but the end does not wait for it.
            let is_skipped = |shot: &Shot| self.skipped.contains_key(OsStr::new(&shot.name));
            let is_quiet = settled.is_empty() && self.growing.keys().all(is_skipped);
            for shot in settled {
                self.take(shot, &recipe)?;
            }
            for entry in self.ledger.open_entries() {
                self.advance(entry).await?;
            }
            if self.arguments.once && is_quiet && self.ledger.open_entries().is_empty() {
                return Ok(());
            }
            tokio::time::sleep(POLL.min(self.settle.max(Duration::from_millis(50)))).await;
        }
    }

    /// Finds new files that have stopped growing. Returns them in order of modification time.
    fn scan(&mut self) -> Result<Vec<Shot>> {
        let unreadable = |error: std::io::Error| CliError::file("read", &self.folder, &error);
        let (now, mut growing, mut settled) = (Instant::now(), HashMap::new(), Vec::new());
        let mut skipped = HashMap::new();
        for entry in fs::read_dir(&self.folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            if self.excluded.contains(&path) {
                continue;
            }
            let shot = match self.look_at(&path) {
                None => continue,
                Some(Ok(shot)) if self.ledger.has(&shot) => continue,
                Some(Ok(shot)) => shot,
                Some(Err(reason)) => {
                    skipped.extend(path.file_name().map(|name| (name.to_owned(), reason)));
                    continue;
                }
            };
            let since = self.growing.get(&shot).copied().unwrap_or(now);
            if now - since < self.settle {
                growing.insert(shot, since);
            } else if shot.size > 0 {
                settled.push(shot);
            } else {
                skipped.insert(shot.name.clone().into(), EMPTY);
                growing.insert(shot, since);
            }
        }
        for (name, reason) in &skipped {
            if !self.skipped.contains_key(name) {
                self.report_skipped(&name.to_string_lossy(), reason)?;
            }
        }
        (self.growing, self.skipped) = (growing, skipped);
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
        self.record(Entry { shot, key, recipe: recipe.clone(), results, stage: FileState::Taken })
    }

    /// Prints once why a file is not submitted.
    fn report_skipped(&self, name: &str, reason: &str) -> Result<()> {
        // A terminal would obey control characters.
        let name = name.replace(char::is_control, "\u{fffd}");
        if self.arguments.json {
            let step = json!({"state": "skipped", "reason": reason});
            return print_line(json!({"file": name, "step": step}));
        }
        print_line(format!("{name} is skipped: {reason}"))
    }

    /// True if no file and no entry uses the names of these results.
    fn is_free(&self, name: &str) -> bool {
        let paths = [result_folder(name), failure_file(name)];
        let exists = |name: &String| self.folder.join(name).symlink_metadata().is_ok();
        !self.ledger.has_results(name) && !paths.iter().any(exists)
    }

    /// Takes the next step for a file.
    async fn advance(&mut self, entry: Entry) -> Result<()> {
        let step = match &entry.stage {
            FileState::Taken => self.submit(&entry).await,
            FileState::Submitted { job } => self.fetch(&entry, job).await,
            FileState::Done { .. } | FileState::Failed { .. } => return Ok(()),
        };
        let stage = match step {
            Ok(None) => return Ok(()),
            Ok(Some(stage)) => stage,
            Err(ClientError::Temporary(reason)) => {
                self.wait_for_service(&reason).await;
                return Ok(());
            }
            // The file does not cause a wrong address or certificate, or a missing permission.
            Err(error @ ClientError::Unreachable(_)) => return Err(error.into()),
            Err(ClientError::Refused { status, code, detail })
                if [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN].contains(&status) =>
            {
                return Err(ClientError::Refused { status, code, detail }.into());
            }
            // It does not cause a full disk either. The next start downloads the results.
            Err(ClientError::Local(error @ CliError::Failure(_)))
                if matches!(entry.stage, FileState::Submitted { .. }) =>
            {
                return Err(error);
            }
            Err(error @ ClientError::Refused { .. }) => {
                FileState::Failed { reason: error.to_string() }
            }
            Err(ClientError::Local(error)) => FileState::Failed { reason: error.to_string() },
        };
        if let FileState::Failed { reason } = &stage {
            self.failed += 1;
            self.write_failure(&entry, reason)?;
        }
        self.exec(&entry, &stage).await;
        self.record(Entry { stage, ..entry })
    }

    async fn submit(&self, entry: &Entry) -> Result<Option<FileState>, ClientError> {
        let path = self.folder.join(&entry.shot.name);
        let changed = || {
            FileState::Failed {
            reason:
                "the file was changed or removed during the submission; a changed file is submitted as a new \
                one"
                    .into(),
        }
        };
        if self.shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        let data = self.client.upload_with_bar(&path).await?;
        if self.shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        self.arguments.submission.send_dark(&self.client).await?;
        let label: String = entry.shot.name.chars().take(200).collect();
        let job = entry.recipe.submit(&self.client, &path, data, Some(&label), &entry.key).await?;
        Ok(Some(FileState::Submitted { job: Job::new(job)?.id }))
    }

    async fn fetch(&mut self, entry: &Entry, job: &str) -> Result<Option<FileState>, ClientError> {
        let job = self.client.job(job, 0).await?;
        if let Some(reason) = job.failure() {
            let findings = verdict::lines(&job.findings());
            let reason = [vec![reason], findings].concat().join("\n");
            return Ok(Some(FileState::Failed { reason }));
        }
        if job.state != JobState::Succeeded {
            return Ok(None);
        }
        let folder = self.folder.join(result_folder(&entry.results));
        self.client.fetch(&job, &self.arguments.files, &folder).await?;
        self.write_report(entry, &job, &folder)?;
        Ok(Some(FileState::Done { job: job.id }))
    }

    /// Prints verdict and findings, and writes them to the results' folder.
    fn write_report(&mut self, entry: &Entry, job: &Job, folder: &Path) -> Result<()> {
        let findings = job.findings();
        if self.arguments.json {
            print_line(json!({
                "file": entry.shot.name, "job": job.id,
                "verdict": job.verdict, "assessment": job.assessment, "findings": findings,
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
            job.verdict_text.as_deref().unwrap_or_default(),
            verdict::lines(&findings).iter().map(|line| format!("{line}\n")).collect::<String>(),
            job.id,
            job.algorithm,
            job.created_at,
        );
        self.results.push(job.clone());
        fs::create_dir_all(folder).map_err(|error| CliError::file("make", folder, &error))?;
        write_new(&folder.join(REPORT), &text)
    }

    /// Writes the reason of a failure to a file next to the submitted one.
    fn write_failure(&self, entry: &Entry, reason: &str) -> Result<()> {
        let path = self.folder.join(failure_file(&entry.results));
        let text =
            format!("{}: {reason}\n\nTo try again: touch {:?}\n", entry.shot.name, entry.shot.name);
        write_new(&path, &text)
    }

    fn record(&mut self, entry: Entry) -> Result<()> {
        if self.arguments.json {
            let state = &entry.stage;
            print_line(json!({"file": entry.shot.name, "size": entry.shot.size, "step": state}))?;
        } else {
            let step = match &entry.stage {
                FileState::Taken => "is being uploaded".to_owned(),
                FileState::Submitted { job } => format!("is job {job}"),
                FileState::Done { .. } => format!("is in {}", result_folder(&entry.results)),
                FileState::Failed { reason } => format!("has failed: {reason}"),
            };
            print_line(format!("{} {step}", entry.shot.name))?;
        }
        self.ledger.record(entry)
    }

    /// Runs the command of the user for a file that has ended. The ledger does not name the end yet, so that a kill can't
    /// leave the command out.
    async fn exec(&self, entry: &Entry, stage: &FileState) {
        let job = match &entry.stage {
            FileState::Submitted { job } => job.clone(),
            _ => String::new(),
        };
        let end = End { job, label: entry.shot.name.clone(), ..End::default() };
        let (end, results) = match stage {
            FileState::Taken | FileState::Submitted { .. } => return,
            FileState::Failed { reason } => {
                let (state, error) = ("failed".to_owned(), reason.clone());
                (End { state, error, ..end }, failure_file(&entry.results))
            }
            FileState::Done { .. } => {
                let verdict = self.results.last().and_then(|job| job.verdict_text.clone());
                let (state, verdict) = ("succeeded".to_owned(), verdict.unwrap_or_default());
                (End { state, verdict, ..end }, result_folder(&entry.results))
            }
        };
        let (file, results) = (self.folder.join(&entry.shot.name), self.folder.join(results));
        if let Err(error) = self.arguments.exec.run(&end, Some((&file, &results))).await {
            eprintln!("sci-recon: {error}");
        }
    }

    /// The state of a file that may contain snapshots, or the reason why it is never submitted. `None` for folders, hidden files
    /// and files with other endings.
    fn look_at(&self, path: &Path) -> Option<Result<Shot, &'static str>> {
        let name = path.file_name()?;
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        let is_packed = self.arguments.submission.is_packed();
        let is_taken =
            ENDINGS.contains(&&*ending) || (is_packed && PACKED_ENDINGS.contains(&&*ending));
        if name.as_encoded_bytes().starts_with(b".") || !is_taken {
            return None;
        }
        let meta = path.symlink_metadata().ok()?;
        if meta.is_dir() {
            return None;
        }
        if meta.is_symlink() {
            return Some(Err(
                "it is a symbolic link; put the file in the folder, or a hard link to it",
            ));
        }
        if !meta.is_file() {
            return Some(Err("it is no regular file"));
        }
        let Some(name) = name.to_str() else {
            return Some(Err("the name is not UTF-8; rename the file"));
        };
        if name.chars().any(char::is_control) {
            return Some(Err("the name has control characters; rename the file"));
        }
        if name.len() > MAX_NAME {
            return Some(Err(
                "the name has more than 230 bytes, so that results can't be named after it; rename the file",
            ));
        }
        let time = (meta.mtime(), meta.mtime_nsec());
        Some(Ok(Shot { name: name.to_owned(), size: meta.len(), time }))
    }

    /// The state of a regular file that may contain snapshots. `None` for all other paths.
    fn shot(&self, path: &Path) -> Option<Shot> {
        self.look_at(path)?.ok()
    }

    /// Prints why the service is unavailable, and waits.
    async fn wait_for_service(&self, reason: &str) {
        eprintln!("sci-recon: {reason}; trying again");
        tokio::time::sleep(Duration::from_secs(2)).await;
    }
}

/// Writes a text file, completely or not at all. A file with the same text may exist.
fn write_new(path: &Path, text: &str) -> Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let draft = path.with_file_name(format!(".{name}.part"));
    let write = || -> std::io::Result<()> {
        let mut file = File::create(&draft)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|error| CliError::file("write", &draft, &error))?;
    match rename_new(&draft, path) {
        // An earlier process wrote it, and was killed before it updated the ledger.
        Err(_) if fs::read_to_string(path).is_ok_and(|existing| existing == text) => {
            fs::remove_file(&draft).map_err(|error| CliError::file("remove", &draft, &error))
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

const EMPTY: &str = "the file is empty; it is submitted once it has content";
