//! The data model of jobs: identifiers, validated requests, states and their transitions. No I/O.

mod access;
mod algorithm;
mod assessment;
mod captures;
mod ids;
mod inputs;
mod memory;
mod model;
mod pool;
mod reading;
mod registration;
mod repetition;
mod report;
mod request;
mod shape;
mod state;
mod submission;
mod task;
mod text;
mod webhook;

pub use access::{Lab, Role, Secret};
pub use algorithm::Algorithm;
pub use assessment::{Assessment, MaskOrder};
pub use captures::{Captures, MAX_CALIBRATION_SECONDS, MAX_MASKS, planned_seconds};
pub use ids::{
    CalibrationId, InvalidId, JobId, MeasurementId, ModelId, PartialId, ResourceId, TaskId,
    TokenId, WorkerId,
};
pub use inputs::{CorrectedMasks, Inputs, MaskInputs, MeasurementInputs, fields};
pub use model::{
    JobModel, ModelFacts, ModelRecord, ModelTensor, ModelTrial, ModelVerdict, shortened_reason,
};
pub use optics::{Dispersion, DispersionAxis, MARGIN, MaskExtent, Mosaic};
pub use pool::Pool;
pub use reading::{Reading, ScaleBasis, keeps_mosaic};
pub use reconstruction::schedule::Schedule;
pub use registration::{Registered, RegistrationRequest};
pub use repetition::repetition;
pub use report::{
    CalibrationReport, CaptureReport, Finding, FindingCode, Grade, MaskReport, Severity,
    withholds_quality,
};
pub use request::{JobRequest, JobSpec, MAX_TASKS, SnapshotSelection, priority_error};
pub use shape::{Cut, CutRequest, RunSpec, SceneShape, Sequence, SnapshotRange, TileSpec};
pub use state::{IllegalTransition, JobState};
pub use submission::{
    CalibrationRequest, CheckLimits, MeasurementRequest, ModelRequest, Submission,
};
pub use task::{
    MIN_MOVIE_SIDE, MOVIE_SIDE, MovieFormat, ResultFile, TaskKind, TaskProgress, TaskStage,
    TaskState, WrittenFile, movie_step,
};
pub use text::{
    HashingWriter, InvalidField, InvalidText, Label, Sha256, Timestamp, with_causes, without_paths,
};
pub use webhook::Webhook;
