//! The tables: one file for each kind of row.

pub(super) mod blobs;
mod changes;
pub(super) mod jobs;
pub(super) mod keys;
pub(super) mod labs;
mod notifications;
pub(super) mod partials;
pub(super) mod quota;
pub(super) mod reports;
pub(super) mod requests;
pub(super) mod reservations;
pub(super) mod resources;
pub(super) mod results;
pub(super) mod sums;
pub(super) mod tasks;
mod tokens;
mod totals;
pub(super) mod workers;

pub use blobs::{Blob, BlobRow, Origin};
pub use changes::{Change, Changes};
pub use jobs::{Job, JobChanges, JobFilter};
pub use keys::{Inserted, RequestKey, ResourceKind};
pub use labs::{Entitlement, LabFigures, LabRow, LabUse, share_error};
pub use notifications::{Delivery, Notification};
pub use partials::{FIRST_RESERVE, FoundPartial, NewPartial, Partial, PartialFile};
pub use requests::Request;
pub use reservations::Reservations;
pub use resources::{
    Calibration, FoundResource, Measurement, Model, NewCalibration, NewMeasurement, NewModel,
    ReadyResource, Resource,
};
pub use tasks::{
    FailedTask, FailureCause, TaskCounts, TaskRecord, TaskTotals, TileHistory, TileResult,
    TileState,
};
pub use tokens::Token;
pub use workers::{Claimant, WorkerPlace, WorkerRow, WorkerTask};
