//! Errors of reading and checking the files of a lab.

use formats::FormatError;

pub type Result<T, E = IntakeError> = std::result::Result<T, E>;

/// The reason why a file or its content is refused. `place` names the file: a JSON pointer into the request, or a name
/// with a path. It is empty if there is only one file.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    /// The file can't be read, or its content is invalid.
    #[error("{}{source}", prefix(.place))]
    Format { place: String, source: FormatError },
    /// The size or the number of frames does not fit.
    #[error("{}{detail}", prefix(.place))]
    Size { place: String, detail: String },
    /// The content is unusable.
    #[error("{}{detail}", prefix(.place))]
    Content { place: String, detail: String },
    /// The caller stopped the work.
    #[error("the task was stopped before its end")]
    Stopped,
}

fn prefix(place: &str) -> String {
    if place.is_empty() { String::new() } else { format!("{place}: ") }
}

impl IntakeError {
    /// True if another attempt may succeed, because the machine failed and not the data.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Format { source, .. } => !source.is_callers_fault(),
            Self::Size { .. } | Self::Content { .. } => false,
            Self::Stopped => true,
        }
    }

    /// Adds the place of a file to an error, for use with `map_err`.
    pub(super) fn format(place: impl Into<String>) -> impl FnOnce(FormatError) -> Self {
        move |source| Self::Format { place: place.into(), source }
    }

    pub(super) fn content(place: impl Into<String>, problem: &dyn std::fmt::Display) -> Self {
        Self::Content { place: place.into(), detail: problem.to_string() }
    }
}

/// For output and scratch files, which have no place.
impl From<FormatError> for IntakeError {
    fn from(source: FormatError) -> Self {
        Self::Format { place: String::new(), source }
    }
}
