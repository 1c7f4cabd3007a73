//! The last task of a job: its own manifest, over all its snapshots.

use std::fs;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::assemble::SnapshotRecord;
use super::prepare::{Prepared, to_record};
use super::task::TaskError;
use crate::job::{
    Algorithm, Finding, SceneShape, Schedule, TaskKind, TaskProgress, TaskStage, Timestamp,
};
use crate::pipeline::ResultFile;
use crate::pipeline::manifest::{
    Inputs, ModelRecord, RunRecord, ScaleRecord, Summary, TilePlanRecord,
};
use crate::pipeline::pilot::PilotRecord;
use crate::store::{Completion, JobTask, Product, Store, TaskRecord};

/// Name and version of this form of record.
const SCHEMA: &str = "sci-recon/job/1";

/// `manifest.json` of a job. As in a snapshot's manifest, `content` is the same whenever the
/// same work is done.
#[derive(Debug, Serialize, Deserialize)]
struct JobManifest {
    schema: String,
    content: JobContent,
    run: JobRun,
}

#[derive(Debug, Serialize, Deserialize)]
struct JobContent {
    program_version: String,
    algorithm: Algorithm,
    schedule: Schedule,
    /// How an adaptive schedule became this one.
    #[serde(default)]
    pilot: Option<PilotRecord>,
    shape: SceneShape,
    inputs: Inputs,
    models: Vec<ModelRecord>,
    scale: ScaleRecord,
    tile_plan: TilePlanRecord,
    /// What the check of the measurement against its calibration found.
    #[serde(default)]
    warnings: Vec<Finding>,
    snapshots: Vec<SnapshotEntry>,
}

#[derive(Debug, Serialize, Deserialize)]
struct SnapshotEntry {
    snapshot: u32,
    summary: Summary,
    /// Without the snapshot's own manifest, whose times differ from run to run.
    files: Vec<ResultFile>,
}

#[derive(Debug, Serialize, Deserialize)]
struct JobRun {
    #[serde(flatten)]
    run: RunRecord,
    label: Option<String>,
    calibration: String,
    measurement: String,
    /// Tasks of the job, and how often workers took one up.
    tasks: usize,
    attempts: u64,
    /// Seconds that each kind of task took, over all tasks.
    seconds_by_task: std::collections::BTreeMap<String, f64>,
}

/// Writes the job's manifest, at the task's attempt of this number.
pub(super) fn run(
    store: &Store,
    task: &JobTask,
    attempt: u32,
    records: &[TaskRecord],
) -> Result<Completion, TaskError> {
    let snapshots = records.iter().filter_map(snapshot).collect::<Result<Vec<_>, _>>()?;
    let manifest = JobManifest {
        schema: SCHEMA.into(),
        run: job_run(task, attempt, records, &snapshots),
        content: content(task, snapshots)?,
    };
    let staged = store.staged_dir()?;
    let text = serde_json::to_string_pretty(&manifest)
        .map_err(|error| TaskError::Record { what: "job", problem: error.to_string() })?;
    let path = staged.path().join("manifest.json");
    fs::write(&path, text + "\n").map_err(|source| crate::pipeline::ResultError::File {
        name: "manifest.json".into(),
        source,
    })?;
    let progress = TaskProgress { stage: TaskStage::Writing, fraction: 1.0, ..TaskProgress::START };
    Ok(Completion { progress, record: to_record(&Value::Null)?, product: Product::Files(staged) })
}

/// The index and record of a snapshot, if this task assembled one.
fn snapshot(task: &TaskRecord) -> Option<Result<(u32, SnapshotRecord), TaskError>> {
    let TaskKind::Assemble { snapshot } = task.kind else { return None };
    let record = serde_json::from_value(task.record.clone())
        .map_err(|error| TaskError::Record { what: "snapshot", problem: error.to_string() });
    Some(record.map(|record| (snapshot, record)))
}

fn content(task: &JobTask, snapshots: Vec<(u32, SnapshotRecord)>) -> Result<JobContent, TaskError> {
    let (spec, calibration, measurement) =
        (&task.spec, &task.calibration.facts, &task.measurement.facts);
    let entry = |(snapshot, record): (u32, SnapshotRecord)| {
        let files = record.files.into_iter().filter(|file| file.name != "manifest.json");
        SnapshotEntry { snapshot, summary: record.summary, files: files.collect() }
    };
    let prepared = Prepared::of(task)?;
    Ok(JobContent {
        program_version: env!("CARGO_PKG_VERSION").into(),
        algorithm: spec.algorithm,
        schedule: prepared.schedule(spec),
        pilot: prepared.pilot,
        shape: spec.shape,
        inputs: Inputs {
            masks_sha256: calibration.masks.to_string(),
            measurement_sha256: measurement.data.to_string(),
        },
        models: ModelRecord::of_job(spec),
        scale: ScaleRecord {
            masks_full_scale: calibration.full_scale,
            measurement_full_scale: measurement.full_scale,
            white: prepared.white,
        },
        tile_plan: (&spec.tile_plan()?).into(),
        warnings: spec.warnings.clone(),
        snapshots: snapshots.into_iter().map(entry).collect(),
    })
}

fn job_run(
    task: &JobTask,
    attempt: u32,
    records: &[TaskRecord],
    snapshots: &[(u32, SnapshotRecord)],
) -> JobRun {
    let mut seconds_by_task = std::collections::BTreeMap::new();
    for record in records {
        *seconds_by_task.entry(record.kind.name().to_owned()).or_insert(0.0) += record.seconds;
    }
    let runs = || snapshots.iter().map(|(_, record)| &record.run);
    JobRun {
        run: RunRecord {
            job: Some(task.job.to_string()),
            provider: runs().find_map(|run| run.provider.clone()),
            onnxruntime: runs().find_map(|run| run.onnxruntime.clone()),
            seconds: None,
            cpu_seconds: runs().map(|run| run.cpu_seconds).sum(),
            peak_rss_bytes: runs().map(|run| run.peak_rss_bytes).max().unwrap_or(0),
            finished_at: Timestamp::now().to_string(),
        },
        label: task.spec.label.as_ref().map(|label| label.as_str().to_owned()),
        calibration: task.spec.calibration.to_string(),
        measurement: task.spec.measurement.to_string(),
        tasks: records.len() + 1,
        attempts: records.iter().map(|record| u64::from(record.attempt)).sum::<u64>()
            + u64::from(attempt),
        seconds_by_task,
    }
}
