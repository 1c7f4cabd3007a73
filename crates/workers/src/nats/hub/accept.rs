//! Checks a tile that a worker reports as done, before the store takes it. The worker is not trusted: shape,
//! values and record must be possible for the tile, and the server computes the residual itself.

use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;

use super::core::Core;
use super::error::EventError;
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
use reconstruction::assessment::Model;
use reconstruction::schedule::MAX_ITERATIONS;
use store::{Completion, RemoteTask, StagedBlob, Work};

/// Largest relative difference between the residual that a worker states and the one that the server computes.
/// Both sum in f64 in one order ([`engine::pipeline::residual`]), so an honest worker states the same bits.
const RESIDUAL: f32 = 0.01;
/// More hardware threads than a machine has.
const THREADS: f64 = 1024.0;
/// Seconds by which the clock may have been set back since the attempt began.
const CLOCK: f64 = 60.0;
/// Most memory in bytes that a process can have: 64 TiB, which is what x86-64 addresses.
const MEMORY: u64 = 1 << 46;
/// Longest name of an execution provider or of a version, in characters.
const NAME: usize = 64;

/// A worker's report of a finished tile; nothing in it is checked yet.
pub struct Report {
    pub frames: Input,
    pub progress: TaskProgress,
    pub record: Value,
    pub history: Option<String>,
}

/// What becomes of it.
pub enum Accepted {
    /// The tile is done; with how the solver went.
    Completion(Box<Completion>, Option<String>),
    /// Another worker is to compute it, too.
    Again,
    /// The result can't be right.
    Refused(String),
    /// The frames are missing or are not those that the worker has put.
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
    /// Checks a report, and fetches the frames only if all else is possible.
    pub async fn accept(
        &self,
        remote: &RemoteTask,
        prefix: &str,
        report: Report,
    ) -> Result<Accepted, EventError> {
        let known = self.known(remote).await?;
        let Report { frames, progress, record, history } = report;
        let record = match known.check(remote, frames, (&progress, record, history.as_deref())) {
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
    async fn known(&self, remote: &RemoteTask) -> Result<Known, EventError> {
        let claimed = self.store.remote_work(remote).await?;
        let wrong = || PipelineError::Record { what: "task", problem: "it is no tile".into() };
        let (Work::Job(job), TaskKind::Tile { snapshot, tile, .. }) = (&claimed.work, claimed.kind)
        else {
            return Err(wrong().into());
        };
        let task = tile_task(job, snapshot, tile)?;
        let path = |sha256: Sha256| (self.store.dir().blob(&sha256), sha256);
        let arrays = Arrays { masks: path(task.masks), snapshots: path(task.measurement) };
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

    /// The record with the residual that the frames have, or why they can't be used.
    async fn verified(
        &self,
        known: Known,
        staged: &StagedBlob,
        mut record: TileTaskRecord,
    ) -> Result<Result<TileTaskRecord, String>, EventError> {
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
        let differs = (stated - computed).abs() > RESIDUAL * computed;
        Ok(if differs {
            Err(format!("it states a residual of {stated:.4e}, but its frames have {computed:.4e}"))
        } else {
            Ok(record)
        })
    }
}

impl Known {
    /// Checks all but the frames themselves, and returns the record; else what is wrong.
    fn check(
        &self,
        remote: &RemoteTask,
        frames: Input,
        (progress, record, history): (&TaskProgress, Value, Option<&str>),
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
        let since = Timestamp::now().0.saturating_sub(remote.started_at.0);
        let elapsed = Duration::from_millis(u64::try_from(since).unwrap_or(0));
        let wrong = self.wrong_field(&record, progress, elapsed);
        if let Some(field) = wrong {
            return Err(format!("{field} of its record is impossible for the tile"));
        }
        if history.is_some_and(|text| !is_history(text, MAX_ITERATIONS)) {
            return Err("its history can't be read".into());
        }
        Ok(record)
    }

    /// The first field of a record that this tile can't have.
    fn wrong_field(
        &self,
        record: &TileTaskRecord,
        progress: &TaskProgress,
        elapsed: Duration,
    ) -> Option<&'static str> {
        let TileTask { pieces, schedule, model, .. } = &self.task;
        let TileTaskRecord { tile, solved, assessment, cost } = record;
        // An end-to-end network is one pass.
        let most = if model.is_some() { 1 } else { schedule.planned_iterations() };
        let [frames, height, width] = self.shape;
        let assessed = model.is_none() && Model::of(schedule).is_some();
        let is_name = |name: &Option<String>| {
            let plain = |c: char| c.is_ascii_graphic() || c == ' ';
            name.as_ref().is_none_or(|name| name.len() <= NAME && name.chars().all(plain))
        };
        let seconds = THREADS * (elapsed.as_secs_f64() + CLOCK);
        let fields = [
            ("progress", is_possible(progress) && progress.iterations as usize <= most),
            ("passes", progress.passes as usize <= most * pieces.len().max(1)),
            ("iterations", tile.iterations <= most),
            ("tv_iterations", tile.tv_iterations <= most),
            ("denoiser_passes", tile.denoiser_passes <= most),
            ("residual", tile.residual.is_finite() && tile.residual >= 0.0),
            ("stop_reason", ["converged", "max-iterations"].contains(&tile.stop_reason.as_str())),
            ("solved", solved.iter().copied().eq(pieces.iter().flat_map(Clone::clone))),
            ("assessment", assessment.is_some() == assessed),
            ("assessment", assessment.iter().all(|one| one.fits(frames, (height, width)))),
            ("provider", is_name(&cost.provider)),
            ("onnxruntime", is_name(&cost.onnxruntime)),
            ("cpu_seconds", (0.0..=seconds).contains(&cost.cpu_seconds)),
            ("peak_rss_bytes", cost.peak_rss_bytes <= MEMORY),
        ];
        fields.into_iter().find(|(_, good)| !good).map(|(name, _)| name)
    }
}

/// True if the progress is possible for some tile.
pub fn is_possible(progress: &TaskProgress) -> bool {
    let most = MAX_ITERATIONS * RunSpec::LONGEST as usize;
    progress.iterations as usize <= MAX_ITERATIONS
        && progress.passes as usize <= most
        && (0.0..=1.0).contains(&progress.fraction)
}
