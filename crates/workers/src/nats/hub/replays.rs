//! Tiles that two workers compute before the result is accepted. There is no other way to detect a worker that
//! returns plausible but wrong frames.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

use engine::job::{TaskId, TaskProgress, WorkerId};
use engine::pipeline::PipelineError;
use engine::pipeline::records::TileTaskRecord;
use engine::pipeline::verify::relative_difference;
use store::{Completion, Product, StagedBlob};

/// Largest root mean square of the difference between the frames of two workers, relative to the white level.
///
/// Workers of one version on processors of one kind return the same bits. Others round differently, which changes
/// frames by some 1e-5. 0.01 is a PSNR of 40 dB, above which assessments distinguish nothing either.
const MAX_DIFFERENCE: f64 = 0.01;
/// Time after which an uncompared result is dropped. The tile was abandoned, or a worker of the server computed it.
const MAX_AGE: Duration = Duration::from_secs(3600);

/// The first result of a tile. It has passed all checks and may wait for a second one.
#[derive(Debug)]
pub struct First {
    worker: WorkerId,
    since: Instant,
    frames: StagedBlob,
    progress: TaskProgress,
    record: TileTaskRecord,
    history: Option<String>,
}

/// The decision on a result.
#[derive(Debug)]
pub enum Verdict {
    Accepted(Box<First>),
    /// The result is kept until another worker has computed the tile.
    Again,
    /// Two workers disagree.
    Differs(String),
}

/// Results that wait for a second one.
#[derive(Debug)]
pub struct Replays {
    /// Share of the tiles that are computed twice, on \[0,1\].
    fraction: f64,
    firsts: HashMap<TaskId, First>,
    /// Tiles about which workers disagreed: the next result is compared in any case.
    disputed: HashSet<TaskId>,
}

impl Replays {
    pub fn new(fraction: f64) -> Self {
        Self { fraction, firsts: HashMap::new(), disputed: HashSet::new() }
    }

    /// The worker that has computed a tile which waits for a second worker.
    pub fn first_worker(&self, task: TaskId) -> Option<WorkerId> {
        self.firsts.get(&task).map(|first| first.worker)
    }

    /// Drops results that no second worker will confirm.
    pub fn drop_old(&mut self) {
        self.firsts.retain(|_, first| first.since.elapsed() < MAX_AGE);
    }

    /// Keeps a result until another worker has computed the tile.
    pub fn keep(&mut self, task: TaskId, first: First) {
        self.firsts.insert(task, first);
    }

    /// Takes the result that waits for a second one.
    pub fn take(&mut self, task: TaskId) -> Option<First> {
        self.firsts.remove(&task)
    }

    /// Records whether two workers agree on a tile.
    pub fn judge(&mut self, task: TaskId, agree: bool) {
        if agree {
            self.disputed.remove(&task);
        } else {
            self.disputed.insert(task);
        }
    }

    /// True if a second worker should compute the tile.
    pub fn is_wanted(&self, task: TaskId) -> bool {
        self.disputed.contains(&task) || rand::random::<f64>() < self.fraction
    }
}

impl First {
    pub fn new(
        worker: WorkerId,
        frames: StagedBlob,
        progress: TaskProgress,
        record: TileTaskRecord,
        history: Option<String>,
    ) -> Self {
        Self { worker, since: Instant::now(), frames, progress, record, history }
    }

    /// The worker that computed the result.
    pub fn worker(&self) -> WorkerId {
        self.worker
    }

    /// Returns the completion for the store, and the history of the solver.
    pub fn into_completion(self) -> Result<(Completion, Option<String>), PipelineError> {
        let record = serde_json::to_value(&self.record).map_err(PipelineError::record("tile"))?;
        let product = Product::File(self.frames);
        Ok((Completion { progress: self.progress, record, product }, self.history))
    }

    /// Describes the difference of two results. Returns `None` if they agree.
    pub fn difference(&self, other: &Self, white: f32) -> Result<Option<String>, PipelineError> {
        if self.frames.sha256() == other.frames.sha256() {
            let agree = match (&self.record.assessment, &other.record.assessment) {
                (Some(first), Some(second)) => first.agrees_with(second),
                (first, second) => first.is_none() && second.is_none(),
            };
            return Ok((!agree).then(|| "the assessments of equal frames differ".into()));
        }
        let difference = relative_difference(self.frames.path(), other.frames.path(), white)?;
        let differs = !difference.is_finite() || difference > MAX_DIFFERENCE;
        Ok(differs.then(|| format!("frames differ by {difference:.2e} of the white level")))
    }
}
