//! What a lab machine says to the service.

use std::fs;
use std::path::Path;

use ndarray::{Array3, Axis, concatenate};
use reqwest::{RequestBuilder, Response};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio_util::io::ReaderStream;

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::formats::{Limits, exr};
use crate::job::{JobState, Sha256};

pub(super) struct Client {
    url: String,
    http: reqwest::Client,
}

pub(super) enum JobView {
    /// It waits or runs; the share on \[0,1\] that is done.
    Going(f64),
    /// Its results are there.
    Succeeded,
    /// It came to another end, as words that follow "the job".
    Ended(String),
}

#[derive(Deserialize)]
struct Created {
    id: String,
}

#[derive(Deserialize)]
struct Uploaded {
    sha256: String,
}

#[derive(Deserialize)]
struct Job {
    state: JobState,
    error: Option<String>,
    progress: Progress,
}

#[derive(Deserialize)]
struct Progress {
    percent: f64,
}

#[derive(Deserialize)]
struct Snapshot {
    files: Vec<RemoteFile>,
}

#[derive(Deserialize)]
struct RemoteFile {
    name: String,
    sha256: Sha256,
    href: Option<String>,
}

impl Client {
    pub(super) fn new(url: &str) -> Self {
        Self { url: url.to_owned(), http: reqwest::Client::new() }
    }

    /// Sends a file, of which memory holds a piece at a time; gives its hash.
    pub(super) async fn upload(&self, path: &Path) -> Result<String> {
        let unreadable = |error: std::io::Error| CliError::file("read", path, &error);
        let file = tokio::fs::File::open(path).await.map_err(unreadable)?;
        let body = reqwest::Body::wrap_stream(ReaderStream::new(file));
        let request = self.http.post(format!("{}/v1/blobs", self.url)).body(body);
        Ok(json::<Uploaded>(request).await?.sha256)
    }

    /// Makes a calibration, a measurement or a job; gives its identifier.
    pub(super) async fn create(&self, path: &str, body: &Value) -> Result<String> {
        let request = self.http.post(format!("{}{path}", self.url)).json(body);
        Ok(json::<Created>(request).await?.id)
    }

    pub(super) async fn job(&self, job: &str) -> Result<JobView> {
        let job: Job = json(self.get(&format!("/v1/jobs/{job}"))).await?;
        Ok(match (job.state, job.error) {
            (JobState::Succeeded, _) => JobView::Succeeded,
            (JobState::Queued | JobState::Running, _) => {
                JobView::Going(job.progress.percent / 100.0)
            }
            (state, Some(error)) => JobView::Ended(format!("is {state}: {error}")),
            (state, None) => JobView::Ended(format!("is {state}")),
        })
    }

    /// Processor seconds that the job's computing took, from its manifest.
    pub(super) async fn cpu_seconds(&self, job: &str) -> Result<f64> {
        let manifest: Value = json(self.get(&format!("/v1/jobs/{job}/manifest.json"))).await?;
        let seconds = manifest["run"]["cpu_seconds"].as_f64();
        seconds.ok_or_else(|| CliError::Failure("the manifest tells no cpu_seconds".into()))
    }

    /// Downloads the EXR frames of snapshot 0 into `folder`, and reads them: \[B,H,W\].
    pub(super) async fn download_frames(&self, job: &str, folder: &Path) -> Result<Array3<f32>> {
        let unwritable = |error| CliError::file("write", folder, &error);
        fs::create_dir_all(folder).map_err(unwritable)?;
        let snapshot: Snapshot = json(self.get(&format!("/v1/jobs/{job}/snapshots/0"))).await?;
        let mut frames = Vec::new();
        for file in &snapshot.files {
            let name = file.name.strip_prefix("frames/").filter(|name| !name.contains('/'));
            let (Some(name), Some(href)) = (name, &file.href) else { continue };
            let bytes = answered(self.get(href)).await?.bytes().await.map_err(broken)?;
            if Sha256::of(&bytes) != file.sha256 {
                return Err(CliError::Failure(format!("{href} was damaged on its way")));
            }
            let path = folder.join(name);
            fs::write(&path, &bytes).map_err(unwritable)?;
            frames.push(exr::read_stack(&path, &Limits::default())?.1);
        }
        let views: Vec<_> = frames.iter().map(|frame| frame.view()).collect();
        concatenate(Axis(0), &views)
            .map_err(|error| CliError::Failure(format!("the frames of job {job}: {error}")))
    }

    fn get(&self, path: &str) -> RequestBuilder {
        self.http.get(format!("{}{path}", self.url))
    }
}

/// Sends a request and reads the JSON of a good answer.
async fn json<T: DeserializeOwned>(request: RequestBuilder) -> Result<T> {
    answered(request).await?.json().await.map_err(broken)
}

/// Sends a request; a bad answer is an error with the service's own words.
async fn answered(request: RequestBuilder) -> Result<Response> {
    let response = request.send().await.map_err(broken)?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let problem: Value = response.json().await.unwrap_or_default();
    let detail = problem["detail"].as_str().unwrap_or("without a reason");
    Err(CliError::Failure(format!("the service answered {status}: {detail}")))
}

fn broken(error: reqwest::Error) -> CliError {
    CliError::Failure(format!("the service can't be reached: {error}"))
}
