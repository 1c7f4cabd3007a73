//! Messages between hub and workers, as JSON.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::transport::TileTask;
use engine::job::{JobId, ModelRecord, Sha256, TaskId, TaskProgress, WorkerId};
use engine::pipeline::networks::NetworkSource;
use reconstruction::priors::Network;

/// A tile to be computed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TaskMessage {
    pub task: TaskId,
    /// The attempt that the message was published for.
    pub attempt: u32,
    /// The job, for logs.
    pub job: JobId,
    /// Planned processor time in seconds.
    pub cost: f64,
    pub tile: TileTask,
    /// The windows of masks and snapshots, as prepared arrays.
    pub masks: Input,
    pub snapshots: Input,
    /// The file of an end-to-end network.
    pub model: Option<Input>,
}

impl TaskMessage {
    /// All files that the tile needs.
    pub fn inputs(&self) -> impl Iterator<Item = Input> {
        [Some(self.masks), Some(self.snapshots), self.model].into_iter().flatten()
    }
}

/// A file that a tile needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    /// Hash of the bytes.
    pub sha256: Sha256,
    /// Number of bytes.
    pub bytes: u64,
}

/// A worker's report on the end of an attempt.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Event {
    pub task: TaskId,
    pub attempt: u32,
    pub worker: WorkerId,
    /// The message that the worker has, and its delivery. They serve a hub that was down when the worker began.
    #[serde(default)]
    pub seq: i64,
    #[serde(default)]
    pub delivery: u32,
    pub end: End,
}

/// The outcome of an attempt.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    Done {
        frames: Input,
        progress: TaskProgress,
        record: Value,
        /// The complete history of the solver.
        history: Option<String>,
    },
    Failed {
        reason: String,
        retry: bool,
    },
    /// The worker was stopped, or the job was cancelled.
    GivenBack,
    /// The worker's process died. `fault` is true if the tile may be the cause, false if something killed it.
    Died {
        how: String,
        fault: bool,
    },
}

/// Asks whether to begin with the tile of a message.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Begin {
    pub task: TaskId,
    /// The attempt that the message names.
    pub attempt: u32,
    /// Sequence number of the message in its stream.
    pub seq: i64,
    pub delivery: u32,
    pub worker: WorkerId,
}

/// The answer to [`Begin`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BeginAnswer {
    /// Begin, as this attempt.
    Go(u32),
    /// The tile needs no work. The message can be acknowledged.
    Over,
    /// Another worker has the message.
    Lost,
    /// This worker has computed the tile already. Another worker must verify it.
    Another,
}

/// A worker's sign of life.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Beat {
    pub worker: WorkerId,
    /// The worker's tile, with its progress.
    pub tile: Option<TileBeat>,
    /// True if the worker leaves.
    pub leaves: bool,
}

/// Progress of a tile.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TileBeat {
    pub task: TaskId,
    pub attempt: u32,
    pub progress: TaskProgress,
    /// The solver's history, if it has grown since the last beat.
    pub history: Option<String>,
}

/// Asks for an input that the worker can't fetch.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct InputRequest {
    pub task: TaskId,
    pub sha256: Sha256,
}

/// A notice of the hub to a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Notice {
    /// The job was cancelled.
    Cancel { task: TaskId, attempt: u32 },
    /// Another attempt has replaced this one.
    Lost { task: TaskId, attempt: u32 },
    /// The server has restarted and does not know the worker.
    Introduce,
}

/// Introduces a worker.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Hello {
    pub worker: WorkerId,
    pub host: String,
    pub pid: u32,
    pub device: String,
    pub program: Program,
}

impl Hello {
    /// Introduces a worker in this process.
    pub fn new(worker: WorkerId, device: String, program: Program) -> Self {
        let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
        Self { worker, host, pid: std::process::id(), device, program }
    }
}

/// The answer to [`Hello`].
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HelloAnswer {
    /// The worker is accepted. A message is redelivered after `ack_wait_ms` milliseconds without a sign of work. `now_ms` is
    /// the time of the server in milliseconds since 1970.
    Welcome { ack_wait_ms: u64, now_ms: u64 },
    /// The reason why the worker is refused.
    Refused(String),
}

/// Identifies a build. Equal builds compute equal results on processors of one kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Program {
    pub version: String,
    /// The networks that it runs.
    pub models: Vec<ModelRecord>,
}

impl Program {
    /// This program with networks from `source`; `version` includes the commit.
    pub fn of(version: &str, source: &NetworkSource) -> Self {
        let models = Network::ALL.map(|network| source.record(network)).to_vec();
        Self { version: version.into(), models }
    }

    /// The reason why a worker with the build `other` can't work for this one, if there is one.
    pub fn refusal(&self, other: &Self) -> Option<String> {
        if self.version != other.version {
            return Some(format!(
                "the worker is version {}, the server {}: install the server's version",
                other.version, self.version
            ));
        }
        let hash = |program: &Self, name: &str| {
            let model = program.models.iter().find(|model| model.name == name);
            model.map_or("none", |model| &model.sha256).to_owned()
        };
        let names = self.models.iter().chain(&other.models).map(|model| &model.name);
        let differs = names.into_iter().find(|name| hash(self, name) != hash(other, name))?;
        Some(format!(
            "both are version {}, but the worker's network {differs} has the hash {}, the \
             server's {}: install the same build, and start both with the same --models",
            self.version,
            hash(other, differs),
            hash(self, differs)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::Program;
    use engine::pipeline::networks::NetworkSource;
    use reconstruction::priors::onnx::Device;

    #[test]
    fn a_refusal_names_both_versions_or_both_networks() {
        let this = Program::of("0.1.0 (c51e2c3)", &NetworkSource::new(None, Device::Cpu));
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
