//! `sci-recon watch-folder`: what camera software drops into a folder is reconstructed, and comes back beside it.
//!
//! 1. A file that has stopped growing is taken up: a line in the ledger gives it a key for ever.
//! 2. It is sent, and a measurement and a job are made with that key. Whoever repeats this gets the same job.
//! 3. When the job has succeeded its results are fetched; when it has failed a file has the reason.
//!
//! Each step can be repeated from its begin, so that a kill at any moment costs nothing and makes nothing twice.

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
use super::submission::{Recipe, SubmissionArguments};
use super::wait::wait;
use engine::job::JobState;
use ledger::{Entry, Ledger, Shot, Stage};

/// Names of files that may hold snapshots; what they are, their first bytes tell.
const ENDINGS: [&str; 7] = ["npy", "tif", "tiff", "png", "mat", "h5", "hdf5"];
/// Pause between two looks at the folder.
const LOOK: Duration = Duration::from_millis(500);

/// Reconstruct what is dropped into a folder. Each file that has stopped growing becomes a job; its results come
/// into NAME.result beside it, or the reason why there are none into NAME.failed.txt. May be stopped and started
/// at any time.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The folder. Files in it are looked at, not those in folders below; links are not followed.
    folder: PathBuf,
    #[command(flatten)]
    service: ServiceArguments,
    #[command(flatten)]
    submission: SubmissionArguments,
    /// Seconds for which a file must stay as it is before it is taken up.
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0)]
    settle_seconds: f64,
    /// What to fetch; may be given several times.
    #[arg(long = "file", value_name = "NAME", value_delimiter = ',', value_enum,
          default_values = ["frames.npy", "stack.tif", "manifest.json"])]
    files: Vec<Wanted>,
    /// End when all files that are there are done.
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
        let masks = arguments.submission.masks().map(|masks| {
            masks.canonicalize().map_err(|error| CliError::file("read", masks, &error))
        });
        let masks = masks.transpose()?;
        let mut watch =
            Watch { arguments, client, folder, masks, settle, ledger, seen: HashMap::new() };
        watch.run().await
    })
}

struct Watch<'a> {
    arguments: &'a Arguments,
    client: Client,
    folder: PathBuf,
    /// Masks that may lie in the folder, too.
    masks: Option<PathBuf>,
    settle: Duration,
    ledger: Ledger,
    /// Files that may still grow, since when they are as they are.
    seen: HashMap<Shot, Instant>,
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

    /// The files that have stopped growing and were not taken up yet, in the order of their times.
    fn look(&mut self) -> Result<Vec<Shot>> {
        let unreadable = |error: std::io::Error| CliError::file("read", &self.folder, &error);
        let (now, mut seen, mut settled) = (Instant::now(), HashMap::new(), Vec::new());
        for found in fs::read_dir(&self.folder).map_err(unreadable)? {
            let path = found.map_err(unreadable)?.path();
            let Some(shot) = shot(&path) else { continue };
            if self.ledger.has(&shot) || self.masks.as_ref() == Some(&path) {
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

    /// Whether nothing has the names of results yet.
    fn is_free(&self, name: &str) -> bool {
        let taken = [result_folder(name), failure_file(name)];
        let exists = |name: &String| self.folder.join(name).symlink_metadata().is_ok();
        !self.ledger.has_results(name) && !taken.iter().any(exists)
    }

    /// Goes as far with a file as can be gone now.
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
            // Neither is a wrong address or certificate a fault of the file, ...
            Err(error @ ClientError::Unreachable(_)) => return Err(error.into()),
            // ... nor that whoever watches is not let in.
            Err(ClientError::Refused { status, code, detail })
                if [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN].contains(&status) =>
            {
                return Err(ClientError::Refused { status, code, detail }.into());
            }
            // Results that can't be written here wait for the next start.
            Err(ClientError::Here(error @ CliError::Failure(_)))
                if matches!(entry.stage, Stage::Submitted { .. }) =>
            {
                return Err(error);
            }
            Err(error @ ClientError::Refused { .. }) => Stage::Failed { reason: error.to_string() },
            Err(ClientError::Here(error)) => Stage::Failed { reason: error.to_string() },
        };
        if let Stage::Failed { reason } = &stage {
            self.explain(&entry, reason)?;
        }
        self.note(Entry { stage, ..entry })
    }

    async fn submit(&self, entry: &Entry) -> Result<Option<Stage>, ClientError> {
        let path = self.folder.join(&entry.shot.name);
        let changed = || Stage::Failed {
            reason:
                "the file has changed or gone after it had stopped growing; as it is now, it is \
                     another one"
                    .into(),
        };
        if shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        let data = self.client.sent(&path).await?;
        if shot(&path).as_ref() != Some(&entry.shot) {
            return Ok(Some(changed()));
        }
        let label: String = entry.shot.name.chars().take(200).collect();
        let job = entry.recipe.submit(&self.client, data, Some(&label), &entry.key).await?;
        Ok(Some(Stage::Submitted { job: Job::new(job)?.id }))
    }

    async fn fetch(&self, entry: &Entry, job: &str) -> Result<Option<Stage>, ClientError> {
        let job = self.client.job(job, 0).await?;
        if let Some(reason) = job.failure() {
            return Ok(Some(Stage::Failed { reason }));
        }
        if job.state != JobState::Succeeded {
            return Ok(None);
        }
        let folder = self.folder.join(result_folder(&entry.results));
        self.client.fetch(&job, &self.arguments.files, &folder).await?;
        Ok(Some(Stage::Done { job: job.id }))
    }

    /// Writes the reason of a failure beside the file.
    fn explain(&self, entry: &Entry, reason: &str) -> Result<()> {
        let path = self.folder.join(failure_file(&entry.results));
        let text = format!(
            "{}: {reason}\n\nTo try it again, give the file another time: touch {:?}\n",
            entry.shot.name, entry.shot.name
        );
        let made = self.folder.join(format!(".{}.part", failure_file(&entry.results)));
        let write = || -> std::io::Result<()> {
            let mut file = File::create(&made)?;
            file.write_all(text.as_bytes())?;
            file.sync_all()
        };
        write().map_err(|error| CliError::file("write", &made, &error))?;
        match place(&made, &path) {
            // It was written before the ledger could say so.
            Err(_) if fs::read_to_string(&path).is_ok_and(|there| there == text) => {
                fs::remove_file(&made).map_err(|error| CliError::file("remove", &made, &error))
            }
            placed => placed,
        }
    }

    fn note(&mut self, entry: Entry) -> Result<()> {
        if self.arguments.json {
            let state = &entry.stage;
            println!(
                "{}",
                json!({"file": entry.shot.name, "size": entry.shot.size, "step": state})
            );
        } else {
            let told = match &entry.stage {
                Stage::Taken => "is sent".to_owned(),
                Stage::Submitted { job } => format!("is job {job}"),
                Stage::Done { .. } => format!("is in {}", result_folder(&entry.results)),
                Stage::Failed { reason } => format!("has failed: {reason}"),
            };
            println!("{} {told}", entry.shot.name);
        }
        self.ledger.note(entry)
    }

    /// Says that the service can't do it now, and waits.
    async fn waiting(&self, reason: &str) {
        eprintln!("sci-recon: {reason}; it goes on when that is over");
        tokio::time::sleep(Duration::from_secs(2)).await;
    }
}

fn result_folder(name: &str) -> String {
    format!("{name}.result")
}

fn failure_file(name: &str) -> String {
    format!("{name}.failed.txt")
}

/// The file as it is; none unless it is a regular one that may hold snapshots.
fn shot(path: &Path) -> Option<Shot> {
    let name = path.file_name()?.to_str().filter(|name| !name.starts_with('.'))?;
    let ending = path.extension()?.to_str()?.to_ascii_lowercase();
    // Of the link itself, if it is one.
    let meta = path.symlink_metadata().ok().filter(|meta| meta.is_file())?;
    let time = (meta.mtime(), meta.mtime_nsec());
    let shot = Shot { name: name.to_owned(), size: meta.len(), time };
    ENDINGS.contains(&&*ending).then_some(shot)
}
