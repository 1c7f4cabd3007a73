//! Errors of commands, with their exit codes.

use std::fmt::Display;
use std::fs::{self, File};
use std::path::Path;
use std::process::ExitCode;

use serde::de::DeserializeOwned;

use super::fields::{Role, as_options};
use super::serve::ServeError;
use crate::config::DEVICE_LOST;
use engine::intake::IntakeError;
use engine::pipeline::PipelineError;
use engine::pipeline::networks::NetworkError;
use formats::FormatError;
use reconstruction::ReconError;

pub type Result<T, E = CliError> = std::result::Result<T, E>;

/// Failure of a command. The text is for the user.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    /// The input can't be used; exit code 2, as for wrong arguments.
    #[error("{0}")]
    Input(String),
    /// The machine or the program failed; exit code 1.
    #[error("{0}")]
    Failure(String),
    /// The work is done, but the checks found errors in the input; exit code 3.
    #[error("{0}")]
    ErrorsFound(String),
    /// A worker lost its GPU, and another process must replace it.
    #[error("{0}")]
    DeviceLost(String),
    /// The reader of standard output has closed it. The command then ends with success.
    #[error("standard output is closed")]
    Unread,
}

impl CliError {
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Input(_) => ExitCode::from(2),
            Self::Failure(_) => ExitCode::FAILURE,
            Self::ErrorsFound(_) => ExitCode::from(3),
            Self::DeviceLost(_) => ExitCode::from(DEVICE_LOST),
            Self::Unread => ExitCode::SUCCESS,
        }
    }

    /// The error with the options of the command line in place of the fields of the API.
    pub(super) fn about(self, role: Role) -> Self {
        match self {
            Self::Input(text) => Self::Input(as_options(&text, role)),
            other => other,
        }
    }

    pub fn file(action: &str, path: &Path, error: &dyn Display) -> Self {
        Self::Failure(format!("cannot {action} {}: {error}", path.display()))
    }

    /// The user named a file that can't be read.
    pub fn unreadable(path: &Path, error: &dyn Display) -> Self {
        Self::Input(format!("cannot read {}: {error}", path.display()))
    }
}

/// Opens a file that the user names.
pub fn open_input(path: &Path) -> Result<File> {
    formats::open_file(path).map_err(|error| match error {
        FormatError::Io { source, .. } => CliError::unreadable(path, &source),
        other => CliError::Input(format!("{}: {other}", path.display())),
    })
}

/// Reads a JSON file that the user names; `what` is its role.
/// Errors: [`CliError::Input`].
pub(super) fn read_json<T: DeserializeOwned>(what: &str, path: &Path) -> Result<T> {
    let refused =
        |error: &dyn Display| CliError::Input(format!("{what} {}: {error}", path.display()));
    let text = fs::read_to_string(path).map_err(|error| refused(&error))?;
    serde_json::from_str(&text).map_err(|error| refused(&error))
}

impl From<ReconError> for CliError {
    fn from(error: ReconError) -> Self {
        let text = error.to_string();
        match error {
            ReconError::Runtime(_)
            | ReconError::DeviceLost(_)
            | ReconError::DeviceFull(_)
            | ReconError::Diverged { .. }
            | ReconError::Cancelled => Self::Failure(text),
            _ => Self::Input(text),
        }
    }
}

impl From<ServeError> for CliError {
    fn from(error: ServeError) -> Self {
        match error {
            ServeError::Exposed(_) => Self::Input(error.to_string()),
            other => Self::Failure(other.to_string()),
        }
    }
}

impl From<NetworkError> for CliError {
    fn from(error: NetworkError) -> Self {
        Self::Failure(error.to_string())
    }
}

impl From<PipelineError> for CliError {
    fn from(error: PipelineError) -> Self {
        match error {
            PipelineError::Recon(error) => error.into(),
            PipelineError::Foreign { .. } => Self::Input(error.to_string()),
            other => Self::Failure(other.to_string()),
        }
    }
}

/// For input. A file that can't be opened is an input error too, because the user can correct it.
impl From<IntakeError> for CliError {
    fn from(error: IntakeError) -> Self {
        let text = error.to_string();
        match error {
            IntakeError::Format { source: FormatError::Internal(_), .. } => Self::Failure(text),
            _ => Self::Input(text),
        }
    }
}

/// For output.
impl From<FormatError> for CliError {
    fn from(error: FormatError) -> Self {
        Self::Failure(error.to_string())
    }
}
