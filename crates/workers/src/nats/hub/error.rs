//! Errors of the hub.

use crate::nats::connection::ClusterError;
use engine::pipeline::PipelineError;
use formats::FormatError;
use store::StoreError;

/// Reason for which an event or a tile is postponed, or a sweep ends early.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("the frames can't be written: {0}")]
    Write(#[from] std::io::Error),
    #[error("a thread ended unexpectedly")]
    Thread(#[from] tokio::task::JoinError),
    #[error("the frames can't be fetched: {0}")]
    Fetch(String),
    #[error("the tile's arrays can't be read: {0}")]
    Tile(#[from] PipelineError),
}

impl From<FormatError> for HubError {
    fn from(error: FormatError) -> Self {
        Self::Tile(error.into())
    }
}

impl HubError {
    /// True if the event may be the cause. False if a disk or a message server has failed.
    pub fn is_of_event(&self) -> bool {
        match self {
            Self::Store(error) => error.disk_trouble().is_none(),
            Self::Thread(_) | Self::Tile(_) => true,
            Self::Cluster(_) | Self::Write(_) | Self::Fetch(_) => false,
        }
    }
}
