//! Why a step of the pipeline did not come to its end.

use std::io;

use super::networks::NetworkError;
use crate::job::Sha256;
use formats::FormatError;
use reconstruction::ReconError;

pub type Result<T, E = PipelineError> = std::result::Result<T, E>;

/// Why a step did not come to its end.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum PipelineError {
    #[error("stopped")]
    Stopped,
    /// The solver refused or failed.
    #[error(transparent)]
    Recon(ReconError),
    /// There is no network.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// An array or a frame can't be read or written.
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error("the result's {name}: {source}")]
    File { name: String, source: io::Error },
    /// The output folder holds something that is not an earlier result.
    #[error(
        "the output folder already holds {name:?}, which no earlier run of this program left \
         there: name a new folder"
    )]
    Foreign { name: String },
    /// Of runs, given by their first snapshot, these tiles.
    #[error("the stored results of tiles are damaged (first snapshot of the run, tile): {0:?}")]
    Damaged(Vec<(u32, u32)>),
    /// A prepared array is not what was stored.
    #[error(
        "the stored {what} (blob {sha256}) are damaged: send the files again, and make the \
         calibration and the measurement anew"
    )]
    Corrupt { what: &'static str, sha256: Sha256 },
    /// A result file has other bytes than it was written with.
    #[error("the stored {0} is damaged: retry the job, and it is made again")]
    Result(String),
    #[error("snapshot {snapshot}: {source}")]
    Snapshot { snapshot: u32, source: ReconError },
    #[error("the record of the {what} can't be used: {problem}")]
    Record { what: &'static str, problem: String },
    #[error("a computing thread ended unexpectedly")]
    Thread,
}

impl PipelineError {
    /// A record that can't be read or written as JSON; for `map_err`.
    pub fn record(what: &'static str) -> impl Fn(serde_json::Error) -> Self {
        move |error| Self::Record { what, problem: error.to_string() }
    }

    /// True if the disk is full or a quota is used up.
    pub fn is_disk_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        match self {
            Self::Format(error) => error.is_disk_full(),
            Self::File { source, .. } => matches!(source.kind(), QuotaExceeded | StorageFull),
            _ => false,
        }
    }

    /// Whether another attempt may succeed: the machine failed, not the data.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Recon(error) => matches!(error, ReconError::Runtime(_)),
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
