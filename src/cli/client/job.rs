//! Jobs as the service shows them, and their files.

use std::path::{Component, Path, PathBuf};

use clap::ValueEnum;
use indicatif::ProgressBar;
use reqwest::StatusCode;
use serde::Deserialize;
use serde_json::Value;

use super::{Client, Result, refused};
use crate::cli::CliError;
use crate::cli::progress;
use engine::job::{Assessment, Finding, Grade, JobState, Sha256, SnapshotRange, Timestamp};

#[derive(Debug, Clone, Deserialize)]
pub(in crate::cli) struct Job {
    pub(in crate::cli) id: String,
    pub(in crate::cli) state: JobState,
    pub(in crate::cli) label: Option<String>,
    pub(in crate::cli) algorithm: String,
    pub(in crate::cli) error: Option<String>,
    pub(in crate::cli) created_at: Timestamp,
    pub(in crate::cli) finished_at: Option<Timestamp>,
    /// Findings of the checks.
    pub(in crate::cli) warnings: Vec<Finding>,
    /// The verdict on the frames. `None` if nothing was found and no quality can be predicted.
    pub(in crate::cli) verdict: Option<Grade>,
    /// The verdict in a line; `None` until the job has succeeded.
    pub(in crate::cli) verdict_text: Option<String>,
    /// `None` until the job has succeeded, and if the quality can't be predicted.
    pub(in crate::cli) assessment: Option<Assessment>,
    pub(in crate::cli) snapshots: SnapshotRange,
    pub(in crate::cli) progress: Progress,
}

#[derive(Debug, Clone, Deserialize)]
pub(in crate::cli) struct Progress {
    pub(in crate::cli) percent: f64,
}

/// Files of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum Wanted {
    /// The frames of each snapshot, float32.
    #[value(name = "frames.npy")]
    Array,
    /// The frames of each snapshot as a multi-part EXR.
    #[value(name = "stack.exr")]
    Stack,
    /// The multi-part EXR with the expected error in an additional layer `sigma`.
    #[value(name = "stack-sigma.exr")]
    StackWithError,
    /// The frames of each snapshot as an OME-TIFF for ImageJ, Fiji and napari.
    #[value(name = "stack.tif")]
    Tiff,
    /// A movie of each snapshot.
    #[value(name = "movie.mp4")]
    Movie,
    /// A movie of each snapshot for presentation programs. Grey levels are exact.
    #[value(name = "movie.gif")]
    Gif,
    /// The frames of a colour sensor before demosaicking, float32.
    #[value(name = "mosaic.npy")]
    Mosaic,
    /// The expected error of blocks of the frames, float32.
    #[value(name = "error.npy")]
    Error,
    /// Each frame as an EXR.
    #[value(name = "frames")]
    Frames,
    /// Each frame as a PNG.
    #[value(name = "png")]
    Pictures,
    /// Inputs, schedule, versions and quality of the results.
    #[value(name = "manifest.json")]
    Manifest,
    /// The frames of all snapshots, one after the other.
    #[value(name = "sequence.npy")]
    SequenceArray,
    /// The frames of all snapshots as an OME-TIFF.
    #[value(name = "sequence.tif")]
    SequenceTiff,
    /// A movie of all snapshots.
    #[value(name = "sequence.mp4")]
    SequenceMovie,
    /// A movie of all snapshots for presentation programs.
    #[value(name = "sequence.gif")]
    SequenceGif,
    /// All files as one archive.
    #[value(name = "results.zip")]
    Archive,
}

#[derive(Debug, Deserialize)]
struct Listed {
    name: String,
    sha256: Sha256,
    href: Option<String>,
}

impl Wanted {
    /// The local name of the file, or of the folder.
    fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    /// For a file that is made from a snapshot on request, its path below the exports of the snapshot.
    fn snapshot_export(self) -> Option<&'static str> {
        match self {
            Self::StackWithError => Some("exr?layers=sigma"),
            Self::Tiff => Some("tiff"),
            Self::Movie => Some("mp4"),
            Self::Gif => Some("gif"),
            _ => None,
        }
    }

    /// For a file of the whole job, its path below the exports of the job.
    fn job_export(self) -> Option<&'static str> {
        match self {
            Self::Manifest => Some("manifest"),
            Self::SequenceArray => Some("npy"),
            Self::SequenceTiff => Some("tiff"),
            Self::SequenceMovie => Some("mp4"),
            Self::SequenceGif => Some("gif"),
            Self::Archive => Some("zip"),
            _ => None,
        }
    }

    /// True if this selects the file `name` in the list of a snapshot. Each snapshot has a manifest, too.
    fn includes(self, name: &str) -> bool {
        let is_listed = self == Self::Manifest
            || (self.snapshot_export().is_none() && self.job_export().is_none());
        is_listed && name.split('/').next() == Some(&self.name())
    }
}

fn parsed<T: for<'de> Deserialize<'de>>(value: Value) -> Result<T> {
    let unreadable =
        |error| CliError::Failure(format!("the service's answer can't be read: {error}"));
    Ok(serde_json::from_value(value).map_err(unreadable)?)
}

/// The identifier in an answer of the service.
pub(super) fn id(value: &Value) -> Result<String> {
    let id = value["id"].as_str().map(str::to_owned);
    Ok(id.ok_or_else(|| CliError::Failure("the service's answer has no identifier".into()))?)
}

impl Job {
    pub(in crate::cli) fn new(value: Value) -> Result<Self> {
        parsed(value)
    }

    /// Describes the end of a job that failed or was cancelled.
    pub(in crate::cli) fn failure(&self) -> Option<String> {
        if !self.state.is_final() || self.state == JobState::Succeeded {
            return None;
        }
        let error = self.error.as_ref().map_or(String::new(), |error| format!(": {error}"));
        Some(format!("job {} is {}{error}", self.id, self.state))
    }
}

impl Client {
    /// Requests a job. The service answers when the job has ended, at the latest after `wait` seconds.
    pub(in crate::cli) async fn job(&self, id: &str, wait: u32) -> Result<Job> {
        Job::new(self.get_ended(&format!("/v1/jobs/{id}"), wait).await?)
    }

    /// Creates a resource with an idempotency key, and waits until its files are checked. Returns its identifier.
    pub(in crate::cli) async fn create_checked(
        &self,
        path: &str,
        body: &Value,
        key: &str,
    ) -> Result<String> {
        let mut resource = self.create(path, body, key).await?;
        let id = id(&resource)?;
        while resource["state"] == "preparing" {
            resource = self.get_ended(&format!("{path}/{id}"), 20).await?;
        }
        let problem = &resource["problem"];
        match problem["status"].as_u64().and_then(|status| u16::try_from(status).ok()) {
            // A retry with the same key creates a new resource.
            Some(status) => Err(refused(StatusCode::from_u16(status).unwrap_or_default(), problem)),
            None => Ok(id),
        }
    }

    /// Downloads files of a job into a folder, those of each snapshot into `snapshot_0000` and so on. Returns the
    /// paths of all files.
    pub(in crate::cli) async fn fetch(
        &self,
        job: &Job,
        wanted: &[Wanted],
        folder: &Path,
    ) -> Result<Vec<PathBuf>> {
        let base = format!("/v1/jobs/{}", job.id);
        let all = Wanted::value_variants().iter();
        let wanted: Vec<_> = all.filter(|one| wanted.contains(one)).collect();
        let mut files = Vec::new();
        for snapshot in job.snapshots.indices() {
            let snapshot_url = format!("{base}/snapshots/{snapshot}");
            let snapshot_folder = folder.join(format!("snapshot_{snapshot:04}"));
            let listed: Vec<Listed> = parsed(self.get(&snapshot_url).await?["files"].take())?;
            for file in listed {
                let Some(href) = &file.href else { continue };
                if wanted.iter().any(|wanted| wanted.includes(&file.name)) {
                    let path = snapshot_folder.join(relative(&file.name)?);
                    // Relative to the address of the list.
                    files.push((format!("{base}/snapshots/{href}"), path, Some(file.sha256)));
                }
            }
            for wanted in &wanted {
                let Some(export) = wanted.snapshot_export() else { continue };
                self.prepare(&base, Some(snapshot), export).await?;
                let href = format!("{snapshot_url}/exports/{export}");
                files.push((href, snapshot_folder.join(wanted.name()), None));
            }
        }
        for wanted in &wanted {
            let Some(export) = wanted.job_export() else { continue };
            self.prepare(&base, None, export).await?;
            files.push((format!("{base}/exports/{export}"), folder.join(wanted.name()), None));
        }
        for (href, path, sha256) in &files {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let bar = progress::bytes(name);
            self.download(href, path, *sha256, &bar).await?;
            bar.finish_and_clear();
        }
        Ok(files.into_iter().map(|(_, path, _)| path).collect())
    }

    /// Has the service encode an export of a snapshot of a job, or of all, if it is a movie; it may exist already.
    async fn prepare(&self, job: &str, snapshot: Option<u32>, export: &str) -> Result<()> {
        if !["mp4", "gif"].contains(&export) {
            return Ok(());
        }
        let body = serde_json::json!({"format": export, "snapshot": snapshot});
        self.post(&format!("{job}/exports"), &body).await.map(|_| ())
    }

    /// Uploads a file, with a progress bar on a terminal.
    pub(in crate::cli) async fn upload_with_bar(&self, path: &Path) -> Result<Sha256> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let bar: ProgressBar = progress::bytes(name);
        let sha256 = self.upload(path, &bar).await;
        bar.finish_and_clear();
        sha256
    }
}

/// Checks that a file name does not lead out of its folder.
fn relative(name: &str) -> Result<&Path> {
    let path = Path::new(name);
    if path.components().all(|part| matches!(part, Component::Normal(_))) {
        return Ok(path);
    }
    Err(CliError::Failure(format!("the service lists a file with the unsafe name {name:?}")).into())
}
