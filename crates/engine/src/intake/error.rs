//! Why a file is not taken in.

use formats::FormatError;

pub type Result<T, E = IntakeError> = std::result::Result<T, E>;

/// Why a file, or what is in it, is refused. Each names the file by its `place`: a JSON pointer into
/// the request, or a name and path, as the caller has called it; empty where there is but one.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    #[error("{}{source}", prefix(.place))]
    Format { place: String, source: FormatError },
    #[error("{}{detail}", prefix(.place))]
    Size { place: String, detail: String },
    #[error("{}{detail}", prefix(.place))]
    Content { place: String, detail: String },
    #[error("stopped")]
    Stopped,
}

fn prefix(place: &str) -> String {
    if place.is_empty() { String::new() } else { format!("{place}: ") }
}

impl IntakeError {
    /// Whether another attempt may succeed: the machine failed, not the data.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Format { source, .. } => !source.is_callers_fault(),
            Self::Size { .. } | Self::Content { .. } => false,
            Self::Stopped => true,
        }
    }

    /// For `map_err` on what goes wrong with the file called `place`.
    pub(super) fn format(place: impl Into<String>) -> impl FnOnce(FormatError) -> Self {
        move |source| Self::Format { place: place.into(), source }
    }

    pub(super) fn content(place: impl Into<String>, problem: &dyn std::fmt::Display) -> Self {
        Self::Content { place: place.into(), detail: problem.to_string() }
    }
}

/// For results and files of ours, which have no name.
impl From<FormatError> for IntakeError {
    fn from(source: FormatError) -> Self {
        Self::Format { place: String::new(), source }
    }
}
