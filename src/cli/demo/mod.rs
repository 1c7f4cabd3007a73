//! `sci-recon demo`: sends a simulated snapshot of a real clip through the service.

mod page;
mod report;
mod service;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use ndarray::{Array3, Axis, concatenate};
use serde_json::{Value, json};
use uuid::Uuid;

use super::CliError;
use super::client::{Client, Job, Wanted};
use super::exec::ExecArguments;
use super::watch::until_ended;
use crate::cli::error::Result;
use crate::cli::output::print_line;
use engine::intake::sample;
use engine::job::Algorithm;
use formats::{Limits, exr};
use page::Reconstruction;
use report::{PAGE, Quality, Report};
use service::Service;

/// The file that identifies the folder of a demo.
const REPORT: &str = "demo.json";
/// Names of the files and folders that the demo creates.
const PARTS: [&str; 6] = ["input", "service", "frames", "service.log", page::PICTURES, PAGE];
const COMPARED: [Algorithm; 2] = [Algorithm::GapTv, Algorithm::PnpTvFastdvdnet];

/// Run the service on a simulated snapshot, and compare the results.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder for all files; an earlier demo there is replaced.
    #[arg(long, value_name = "FOLDER", default_value = "demo-output")]
    out: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let failed = |error: std::io::Error| CliError::Failure(format!("the runtime: {error}"));
    let out = fresh_folder(&arguments.out)?;
    tokio::runtime::Runtime::new().map_err(failed)?.block_on(demo(arguments, &out))
}

async fn demo(arguments: &Arguments, out: &Path) -> Result<()> {
    let started = Instant::now();
    let print = |text: String| if arguments.json { Ok(()) } else { print_line(text) };
    // 1. Write the files that a lab would have: masks and one snapshot.
    let truth = sample(&out.join("input"))?.frames;
    let (frames, height, width) = truth.dim();
    print(format!("made masks and a snapshot of {frames} frames of {height}x{width}"))?;
    // 2. Start the service.
    let service = Service::start(out).await?;
    print(format!("the service is at {}", service.url()))?;
    // 3. Use it over HTTP, like a lab machine.
    let client = Client::at(service.url(), None)?;
    let results = through_http(&client, out, &truth).await;
    service.stop().await?;
    let ([gap_tv, pnp_tv_fastdvdnet], reconstructions) = results?;
    // 4. Compare the results.
    let report = Report {
        gap_tv,
        pnp_tv_fastdvdnet,
        frames,
        seconds: started.elapsed().as_secs_f64(),
        output_dir: out.to_owned(),
    };
    fs::write(out.join(REPORT), report.to_json()?)
        .map_err(|error| CliError::file("write", &out.join(REPORT), &error))?;
    page::write(out, &truth, &reconstructions, &report)?;
    report.print(arguments.json)
}

/// Uploads the files, requests both algorithms, waits, and compares the frames with the truth.
async fn through_http(
    client: &Client,
    out: &Path,
    truth: &Array3<f32>,
) -> Result<([Quality; 2], Vec<Reconstruction>)> {
    let input = out.join("input");
    let masks = client.upload_with_bar(&input.join("masks.npy")).await?;
    let measurement = client.upload_with_bar(&input.join("measurement.npy")).await?;
    let calibration = create(client, "/v1/calibrations", &json!({"masks": masks})).await?;
    let body = json!({"calibration": calibration, "data": measurement});
    let measurement = create(client, "/v1/measurements", &body).await?;
    let mut jobs = Vec::new();
    for name in COMPARED.map(|algorithm| algorithm.into_str()) {
        let body = json!({"measurement": measurement, "algorithm": name, "label": "demo"});
        jobs.push((name, create(client, "/v1/jobs", &body).await?));
    }
    let named: Vec<_> = jobs.iter().map(|(name, id)| (*name, id.as_str())).collect();
    let ended = until_ended(client, &named, &ExecArguments::default()).await?;
    if let Some(reason) = ended.iter().find_map(Job::failure) {
        return Err(CliError::Failure(reason));
    }
    let (mut qualities, mut results) = (Vec::new(), Vec::new());
    for (name, job) in &jobs {
        let folder = out.join("frames").join(name);
        let (frames, movie) = results_of(client, job, &folder).await?;
        qualities.push(report::compare(&frames, truth, cpu_seconds(client, job).await?)?);
        let movie = movie.strip_prefix(out).unwrap_or(&movie).display().to_string();
        results.push(Reconstruction { name, frames, movie });
    }
    Ok(([qualities[0], qualities[1]], results))
}

/// Creates a calibration, a measurement or a job, and returns its identifier.
async fn create(client: &Client, path: &str, body: &Value) -> Result<String> {
    Ok(client.create_checked(path, body, &Uuid::now_v7().to_string()).await?)
}

/// Downloads the EXR frames of snapshot 0 and its movie to `folder`. Returns the frames \[B,H,W\] and the movie's path.
async fn results_of(client: &Client, job: &str, folder: &Path) -> Result<(Array3<f32>, PathBuf)> {
    let job = &client.job(job, 0).await?;
    let files = client.fetch(job, &[Wanted::Frames, Wanted::Movie], folder).await?;
    let (movies, files): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| file.extension().is_some_and(|kind| kind == "mp4"));
    let frames = files.iter().map(|file| exr::read_stack(file, &Limits::default()));
    let frames = frames.collect::<std::result::Result<Vec<_>, _>>()?;
    let views: Vec<_> = frames.iter().map(|(_, frame)| frame.view()).collect();
    let failed = |error: &dyn std::fmt::Display| {
        CliError::Failure(format!("the results of job {}: {error}", job.id))
    };
    let frames = concatenate(Axis(0), &views).map_err(|error| failed(&error))?;
    let movie = movies.into_iter().next().ok_or_else(|| failed(&"there is no movie"))?;
    Ok((frames, movie))
}

/// Reads the processor seconds of a job from its manifest.
async fn cpu_seconds(client: &Client, job: &str) -> Result<f64> {
    let manifest = client.get(&format!("/v1/jobs/{job}/exports/manifest")).await?;
    let seconds = manifest["run"]["cpu_seconds"].as_f64();
    seconds.ok_or_else(|| CliError::Failure("the manifest has no cpu_seconds".into()))
}

/// Creates an empty folder, or clears the folder of an earlier demo. Returns the absolute path.
fn fresh_folder(out: &Path) -> Result<PathBuf> {
    let unwritable = |error: std::io::Error| CliError::file("write", out, &error);
    fs::create_dir_all(out).map_err(unwritable)?;
    let mut entries = fs::read_dir(out).map_err(unwritable)?;
    if entries.next().is_some() && !out.join(REPORT).is_file() {
        return Err(CliError::Input(format!(
            "{} is not empty and not the folder of an earlier demo: choose a new one with --out",
            out.display()
        )));
    }
    // Written first, so that an interrupted demo can be repeated.
    fs::write(out.join(REPORT), "{}\n").map_err(unwritable)?;
    for part in PARTS.map(|part| out.join(part)) {
        let removed = if part.is_dir() { fs::remove_dir_all(part) } else { fs::remove_file(part) };
        removed.or_else(|error| match error.kind() {
            std::io::ErrorKind::NotFound => Ok(()),
            _ => Err(unwritable(error)),
        })?;
    }
    out.canonicalize().map_err(unwritable)
}

#[cfg(test)]
mod tests {
    use super::{REPORT, fresh_folder};
    use std::fs;

    #[test]
    fn only_the_folder_of_a_demo_is_cleared() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("demo");
        fresh_folder(&out).unwrap();
        fs::create_dir(out.join("frames")).unwrap();
        fs::write(out.join("notes.txt"), "mine").unwrap();
        fresh_folder(&out).unwrap();
        assert!(!out.join("frames").exists() && out.join("notes.txt").exists());
        fs::remove_file(out.join(REPORT)).unwrap();
        let error = fresh_folder(&out).unwrap_err().to_string();
        assert!(error.contains("not the folder of an earlier demo"), "{error}");
        assert!(out.join("notes.txt").exists());
    }
}
