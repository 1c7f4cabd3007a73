//! Checks a tile that a worker reports as done, before the store accepts it. The worker is not trusted: shape,
//! values and record must be possible for the tile, and the server recomputes the residual.

use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;

use super::core::Core;
use super::error::HubError;
use super::replays::{First, Verdict};
use crate::local::tile_task;
use crate::nats::blobs::BlobError;
use crate::nats::message::Input;
use crate::transport::TileTask;
use engine::job::{RunSpec, Sha256, TaskKind, TaskProgress, Timestamp};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::Arrays;
use engine::pipeline::progress::is_history;
use engine::pipeline::records::TileTaskRecord;
use engine::pipeline::tile::TileInput;
use engine::pipeline::verify::verify;
use formats::planar::{self, Reader};
use formats::{FormatError, Limits};
use reconstruction::quality::Model;
use reconstruction::schedule::MAX_ITERATIONS;
use store::{Completion, RemoteTask, StagedBlob, Work};

/// Largest relative difference between the residual that a worker states and the one that the server computes.
/// Both sum in f64 in one order ([`engine::pipeline::residual`]), so an honest worker states the same bits.
const RESIDUAL_TOLERANCE: f32 = 0.01;
/// Number of hardware threads that no machine exceeds.
const MAX_THREADS: f64 = 1024.0;
/// Seconds by which the clock may have been set back since the attempt began.
const CLOCK_TOLERANCE: f64 = 60.0;
/// Limit of a process's memory in bytes: 64 TiB, the address space of x86-64.
const MAX_MEMORY: u64 = 1 << 46;
/// Longest name of an execution provider or of a version, in characters.
const MAX_NAME: usize = 64;

/// A worker's report of a finished tile; nothing in it is checked yet.
pub struct Report {
    pub frames: Input,
    pub progress: TaskProgress,
    pub record: Value,
    pub history: Option<String>,
}

/// The decision on a report.
pub enum Accepted {
    /// The tile is done. The text is the solver's history.
    Completion(Box<Completion>, Option<String>),
    /// Another worker must compute the tile too.
    Again,
    /// The result is impossible for the tile, for this reason.
    Refused(String),
    /// The frames are missing or damaged.
    Lost(BlobError),
}

/// A tile as the server knows it.
#[derive(Debug, Clone)]
struct Known {
    task: TileTask,
    arrays: Arrays,
    /// Frames, rows and columns.
    shape: [usize; 3],
    /// Bytes of these frames as a prepared array.
    bytes: u64,
}

impl Core {
    /// Checks a report, and fetches the frames if the rest of the report is possible.
    pub async fn accept(
        &self,
        remote: &RemoteTask,
        prefix: &str,
        report: Report,
    ) -> Result<Accepted, HubError> {
        let known = self.known(remote).await?;
        let Report { frames, progress, record, history } = report;
        let record = match known.check(remote, frames, &progress, record, history.as_deref()) {
            Ok(record) => record,
            Err(reason) => return Ok(Accepted::Refused(reason)),
        };
        let staged = match self.fetch(prefix, frames).await? {
            Ok(staged) => staged,
            Err(error) => return Ok(Accepted::Lost(error)),
        };
        let white = known.task.white;
        let record = match self.verified(known, &staged, record).await? {
            Ok(record) => record,
            Err(reason) => return Ok(Accepted::Refused(reason)),
        };
        let result = First::new(remote.worker, staged, progress, record, history);
        let result = match self.compare(remote, result, white).await? {
            Verdict::Accepted(result) => result,
            Verdict::Again => {
                self.store.give_back(&remote.lease()).await?;
                return Ok(Accepted::Again);
            }
            Verdict::Differs(reason) => return Ok(Accepted::Refused(reason)),
        };
        let (completion, history) = result.into_completion()?;
        Ok(Accepted::Completion(Box::new(completion), history))
    }

    /// Looks up the task, the arrays and the shape of a tile that is out.
    async fn known(&self, remote: &RemoteTask) -> Result<Known, HubError> {
        let claimed = self.store.remote_work(remote).await?;
        let wrong = || PipelineError::Record { what: "task", problem: "it is not a tile".into() };
        let (Work::Job(job), TaskKind::Tile { snapshot, tile, .. }) = (&claimed.work, claimed.kind)
        else {
            return Err(wrong().into());
        };
        let task = tile_task(job, snapshot, tile)?;
        let path = |sha256: Sha256| (self.store.dir().blob(&sha256), sha256);
        let arrays = Arrays {
            masks: path(task.masks),
            snapshots: path(task.measurement),
            correction: task.correction,
        };
        let known = tokio::task::spawn_blocking(move || {
            let masks = Reader::open(&arrays.masks.0, &Limits::default())?;
            let mut info = *masks.info();
            info.frames *= task.snapshots.len();
            (info.height, info.width) = (task.tile.height, task.tile.width);
            let shape = [info.frames, info.height, info.width];
            Ok(Known { task, arrays, shape, bytes: planar::bytes(&info) })
        });
        Ok(known.await?.map_err(|error: FormatError| PipelineError::from(error))?)
    }

    /// Recomputes the residual and puts it into the record. The inner error is the reason why the frames are rejected.
    async fn verified(
        &self,
        known: Known,
        staged: &StagedBlob,
        mut record: TileTaskRecord,
    ) -> Result<Result<TileTaskRecord, String>, HubError> {
        let path = staged.path().to_owned();
        // Bounds the memory: each check holds the masks of its tile.
        let Ok(_turn) = self.verifying.acquire().await else {
            return Ok(Err("the server is stopping".into()));
        };
        let verified = tokio::task::spawn_blocking(move || {
            let Known { task, arrays, .. } = known;
            let input = arrays.window(task.snapshots.clone(), &task.tile.window(), task.white)?;
            let input = match task.model {
                Some(_) => input.snapshot_by_snapshot(),
                None => TileInput { pieces: task.pieces, ..input },
            };
            Ok::<_, PipelineError>(verify(&path, &input))
        });
        let computed = match verified.await?? {
            Ok(computed) => computed,
            Err(error) if error.is_of_frames() => return Ok(Err(error.to_string())),
            Err(error) => {
                let problem = error.to_string();
                return Err(PipelineError::Record { what: "tile", problem }.into());
            }
        };
        let stated = std::mem::replace(&mut record.tile.residual, computed);
        let differs = (stated - computed).abs() > RESIDUAL_TOLERANCE * computed;
        Ok(if differs {
            Err(format!("it states a residual of {stated:.4e}, but its frames have {computed:.4e}"))
        } else {
            Ok(record)
        })
    }
}

impl Known {
    /// Checks everything except the values of the frames, and returns the record. The error is the reason of a refusal.
    fn check(
        &self,
        remote: &RemoteTask,
        frames: Input,
        progress: &TaskProgress,
        record: Value,
        history: Option<&str>,
    ) -> Result<TileTaskRecord, String> {
        if frames.bytes != self.bytes {
            let [count, height, width] = self.shape;
            return Err(format!(
                "it has {} bytes, but {count} frames of {height}x{width} pixels have {}",
                frames.bytes, self.bytes
            ));
        }
        let record = TileTaskRecord::deserialize(&record)
            .map_err(|error| format!("its record can't be read: {error}"))?;
        let elapsed = Timestamp::now().0.saturating_sub(remote.started_at.0);
        let elapsed = Duration::from_millis(u64::try_from(elapsed).unwrap_or(0));
        if let Some(field) = self.impossible_field(&record, progress, elapsed) {
            return Err(format!("{field} of its record is impossible for the tile"));
        }
        if history.is_some_and(|text| !is_history(text, MAX_ITERATIONS)) {
            return Err("its history can't be read".into());
        }
        Ok(record)
    }

    /// Name of the first field with a value that is impossible for this tile.
    fn impossible_field(
        &self,
        record: &TileTaskRecord,
        progress: &TaskProgress,
        elapsed: Duration,
    ) -> Option<&'static str> {
        let TileTask { pieces, schedule, model, .. } = &self.task;
        let TileTaskRecord { tile, solved, assessment, cost } = record;
        // An end-to-end network needs one pass.
        let max_iterations = if model.is_some() { 1 } else { schedule.planned_iterations() };
        let [frames, height, width] = self.shape;
        let assessed = model.is_none() && Model::of(schedule).is_some();
        let is_name = |name: &Option<String>| {
            let plain = |c: char| c.is_ascii_graphic() || c == ' ';
            name.as_ref().is_none_or(|name| name.len() <= MAX_NAME && name.chars().all(plain))
        };
        let seconds = MAX_THREADS * (elapsed.as_secs_f64() + CLOCK_TOLERANCE);
        let fields = [
            ("progress", is_possible(progress) && progress.iterations as usize <= max_iterations),
            ("passes", progress.passes as usize <= max_iterations * pieces.len().max(1)),
            ("iterations", tile.iterations <= max_iterations),
            ("tv_iterations", tile.tv_iterations <= max_iterations),
            ("denoiser_passes", tile.denoiser_passes <= max_iterations),
            ("residual", tile.residual.is_finite() && tile.residual >= 0.0),
            ("stop_reason", ["converged", "max-iterations"].contains(&tile.stop_reason.as_str())),
            ("solved", solved.iter().copied().eq(pieces.iter().flat_map(Clone::clone))),
            ("assessment", assessment.is_some() == assessed),
            ("assessment", assessment.iter().all(|values| values.fits(frames, (height, width)))),
            ("provider", is_name(&cost.provider)),
            ("onnxruntime", is_name(&cost.onnxruntime)),
            ("gpu", is_name(&cost.gpu)),
            ("cpu_seconds", (0.0..=seconds).contains(&cost.cpu_seconds)),
            ("peak_rss_bytes", cost.peak_rss_bytes <= MAX_MEMORY),
        ];
        fields.into_iter().find(|(_, is_possible)| !is_possible).map(|(name, _)| name)
    }
}

/// True if the progress is possible for some tile.
pub fn is_possible(progress: &TaskProgress) -> bool {
    let max_passes = MAX_ITERATIONS * RunSpec::LONGEST as usize;
    progress.iterations as usize <= MAX_ITERATIONS
        && progress.passes as usize <= max_passes
        && (0.0..=1.0).contains(&progress.fraction)
}
