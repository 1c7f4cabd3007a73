//! What a job is: identifiers, the validated request, states and their legal transitions. No I/O.

mod access;
mod algorithm;
mod captures;
mod disk;
mod finding;
mod ids;
mod memory;
mod model;
mod reason;
mod report;
mod request;
mod state;
mod task;
mod text;

pub use crate::recon::schedule::Schedule;
pub use access::{Lab, Role, Secret};
pub use algorithm::Algorithm;
pub use captures::Captures;
pub use finding::{Finding, Grade, Severity};
pub use ids::{
    CalibrationId, InvalidId, JobId, MeasurementId, ModelId, PartialId, TaskId, TokenId, WorkerId,
};
pub use model::{JobModel, ModelFacts, ModelTensor, ModelTrial, ModelVerdict};
pub use reason::without_paths;
pub use report::{CalibrationReport, CaptureReport, MaskReport, PatternReport};
pub use request::{
    InvalidField, JobRequest, JobSpec, MAX_TASKS, SceneShape, SnapshotRange, SnapshotSelection,
    TileSpec,
};
pub use state::{IllegalTransition, JobState};
pub use task::{TaskKind, TaskProgress, TaskStage, TaskState};
pub use text::{InvalidText, Label, Sha256, Timestamp};
