//! What is said, as JSON.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::transport::TileTask;
use engine::job::{JobId, Sha256, TaskId, TaskProgress, WorkerId};
use engine::pipeline::networks::ModelRecord;
use reconstruction::priors::Network;

/// A tile to be computed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TaskMessage {
    /// The task.
    pub task: TaskId,
    /// The attempt that it was published for.
    pub attempt: u32,
    /// Its job, for logs.
    pub job: JobId,
    /// Its planned processor time in seconds.
    pub cost: f64,
    /// What is to be done.
    pub tile: TileTask,
    /// The windows of masks and snapshots, as prepared arrays.
    pub masks: Input,
    pub snapshots: Input,
    /// The file of an end-to-end network.
    pub model: Option<Input>,
}

impl TaskMessage {
    /// All that the tile needs.
    pub fn inputs(&self) -> impl Iterator<Item = Input> {
        [Some(self.masks), Some(self.snapshots), self.model].into_iter().flatten()
    }
}

/// A file that a tile needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    /// The hash of its bytes.
    pub sha256: Sha256,
    /// How many there are.
    pub bytes: u64,
}

/// How a tile ended.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Event {
    pub task: TaskId,
    pub attempt: u32,
    pub worker: WorkerId,
    /// The message that the worker has, and its delivery, for a hub that did not hear the worker begin.
    #[serde(default)]
    pub seq: i64,
    #[serde(default)]
    pub delivery: u32,
    pub end: End,
}

/// How a tile ended: by its frames, by an error, or because the worker was told to stop.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    Done {
        frames: Input,
        progress: TaskProgress,
        record: Value,
        /// How the solver went, to its end.
        history: Option<String>,
    },
    Failed {
        reason: String,
        retry: bool,
    },
    /// The worker was to end, or the job was cancelled.
    GivenBack,
    /// Its process died, of itself (a fault, which the tile may have caused) or from outside.
    Died {
        how: String,
        fault: bool,
    },
}

/// A worker that has a message asks whether to begin.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Begin {
    pub task: TaskId,
    /// The attempt that the message names.
    pub attempt: u32,
    /// The message's place in its stream.
    pub seq: i64,
    pub delivery: u32,
    pub worker: WorkerId,
}

/// The answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BeginAnswer {
    /// Begin, as this attempt.
    Go(u32),
    /// The message is of no use any more.
    Over,
    /// Another worker has the message.
    Lost,
    /// The tile is computed a second time, by another worker than the first time.
    Another,
}

/// A worker's sign of life.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Beat {
    pub worker: WorkerId,
    /// What it has in hand, and how far that is.
    pub tile: Option<TileBeat>,
    /// True for the last sign.
    pub leaves: bool,
}

/// How far a tile is.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TileBeat {
    pub task: TaskId,
    pub attempt: u32,
    pub progress: TaskProgress,
    /// How the solver went, if there is news.
    pub history: Option<String>,
}

/// An input is not to be had: it should be put again.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Want {
    pub task: TaskId,
    pub sha256: Sha256,
}

/// What the hub tells a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Tell {
    /// The attempt is not wanted any more.
    Cancel { task: TaskId, attempt: u32 },
    /// The attempt is over: another one has taken its place.
    Lost { task: TaskId, attempt: u32 },
    /// The server has started anew, and does not know the worker.
    Introduce,
}

/// A worker introduces itself.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Hello {
    pub worker: WorkerId,
    pub host: String,
    pub pid: u32,
    pub device: String,
    pub program: Program,
}

/// The answer.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HelloAnswer {
    /// Welcome; a message is delivered again after so many milliseconds without a sign.
    Welcome { ack_wait_ms: u64 },
    /// Why the worker is of no use here.
    Refused(String),
}

/// What computes: the results of two that are equal are the same on processors of a kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Program {
    pub version: String,
    /// The networks that the program carries.
    pub models: Vec<ModelRecord>,
}

impl Program {
    /// This program, of the version that it says of itself, with its commit.
    pub fn of(version: &str) -> Self {
        let models = Network::ALL.map(ModelRecord::carried).to_vec();
        Self { version: version.into(), models }
    }

    /// Why a worker with `other` can't work for this one; none if it can.
    pub fn refusal(&self, other: &Self) -> Option<String> {
        if self.version != other.version {
            return Some(format!(
                "the worker is version {}, the server {}: install the server's version",
                other.version, self.version
            ));
        }
        let of = |program: &Self, name: &str| {
            let found = program.models.iter().find(|model| model.name == name);
            found.map_or("none", |model| &model.sha256).to_owned()
        };
        let names = self.models.iter().chain(&other.models).map(|model| &model.name);
        let differs = names.into_iter().find(|name| of(self, name) != of(other, name))?;
        Some(format!(
            "both are version {}, but the worker's network {differs} has the hash {}, the \
             server's {}: install the same build",
            self.version,
            of(other, differs),
            of(self, differs)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::Program;

    #[test]
    fn another_version_or_another_network_is_refused_with_both() {
        let this = Program::of("0.1.0 (c51e2c3)");
        assert_eq!(this.refusal(&this), None);
        for version in ["0.0.9", "0.1.0 (e45ec33)", "0.1.0"] {
            let other = Program { version: version.into(), ..this.clone() };
            let refusal = this.refusal(&other).unwrap();
            assert!(refusal.contains(version) && refusal.contains(&this.version), "{refusal}");
        }
        let mut other = this.clone();
        other.models[0].sha256 = "ab".repeat(32);
        let refusal = this.refusal(&other).unwrap();
        assert!(refusal.contains(&other.models[0].sha256), "{refusal}");
        assert!(refusal.contains(&this.models[0].sha256), "{refusal}");
        other.models.remove(0);
        assert!(this.refusal(&other).unwrap().contains("none"));
    }
}
