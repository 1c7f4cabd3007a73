//! Errors of the pipeline.

use std::io;

use super::networks::NetworkError;
use crate::job::Sha256;
use formats::{DiskTrouble, FormatError};
use reconstruction::ReconError;

pub type Result<T, E = PipelineError> = std::result::Result<T, E>;

/// The reason why a step of the pipeline did not finish.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages describe the variants
pub enum PipelineError {
    /// The task was cancelled, or the worker is shutting down.
    #[error("the task was stopped before its end")]
    Stopped,
    /// The solver refused its input or failed.
    #[error(transparent)]
    Recon(ReconError),
    /// A network can't be loaded or run.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// An array or a frame can't be read or written.
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error("{name} of the result can't be read or written: {source}")]
    File { name: String, source: io::Error },
    /// The output folder contains files that do not belong to an earlier result.
    #[error(
        "the output folder already contains {name:?}, which is not from an earlier run of this program: use a new \
         folder"
    )]
    Foreign { name: String },
    /// Stored tiles are damaged: the first snapshot of the run, and the tile, of each.
    #[error("stored tiles are damaged: (first snapshot of the run, tile) = {0:?}")]
    Damaged(Vec<(u32, u32)>),
    /// A prepared array does not have its recorded hash.
    #[error(
        "the stored {what} (blob {sha256}) are damaged: upload the files again, and create a new calibration and a new \
         measurement"
    )]
    Corrupt { what: &'static str, sha256: Sha256 },
    /// A result file does not have its recorded hash.
    #[error("the stored {0} is damaged: retry the job to create it again")]
    Result(String),
    #[error("snapshot {snapshot}: {source}")]
    Snapshot { snapshot: u32, source: ReconError },
    #[error("the stored record of the {what} is invalid: {problem}")]
    Record { what: &'static str, problem: String },
    #[error("a worker thread panicked")]
    Thread,
}

impl PipelineError {
    /// Converts a JSON error of a stored record, for use with `map_err`.
    pub fn record(what: &'static str) -> impl Fn(serde_json::Error) -> Self {
        move |error| Self::Record { what, problem: error.to_string() }
    }

    /// The state of the disk that is the cause, if it is.
    pub fn disk_trouble(&self) -> Option<DiskTrouble> {
        match self {
            Self::Format(error) => error.disk_trouble(),
            Self::File { source, .. } => DiskTrouble::of(source),
            _ => None,
        }
    }

    /// True if another attempt may succeed, because the machine failed and not the data.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Recon(error) => {
                use ReconError::{DeviceFull, DeviceLost, Runtime};
                matches!(error, Runtime(_) | DeviceLost(_) | DeviceFull(_))
            }
            Self::Format(error) => !error.is_callers_fault(),
            Self::Snapshot { .. }
            | Self::Record { .. }
            | Self::Corrupt { .. }
            | Self::Result(_) => false,
            _ => true,
        }
    }
}

impl From<ReconError> for PipelineError {
    fn from(error: ReconError) -> Self {
        match error {
            ReconError::Cancelled => Self::Stopped,
            other => Self::Recon(other),
        }
    }
}
