//! The tables: one file for each kind of thing on record.

pub(super) mod blobs;
pub(super) mod calibrations;
pub(super) mod jobs;
mod measurements;
mod models;
mod partials;
mod reports;
pub(super) mod results;
mod tasks;
mod tokens;
pub(super) mod workers;

pub use blobs::{Blob, Origin};
pub use calibrations::{Calibration, NewCalibration};
pub use jobs::{Job, JobFilter};
pub use measurements::{Measurement, MeasurementFilter, NewMeasurement};
pub use models::{Model, ModelFilter, NewModel};
pub use partials::{FoundPartial, NewPartial, Partial, PartialFile};
pub use reports::Unready;
pub use results::ResultFile;
pub use tasks::{TileHistory, TileState};
pub use tokens::Token;
pub use workers::{WorkerEnd, WorkerRow, WorkerTask};
