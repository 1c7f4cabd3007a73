//! Refusals of uploads, as the answers to requests report them.

use std::io::ErrorKind;

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;

use super::IntakeError;
use formats::{DiskTrouble, FormatError};

/// Codes of refusals, a subset of the codes of the HTTP interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum RefusalCode {
    InvalidRequest,
    InvalidContent,
    SizeMismatch,
    UploadDamaged,
    QuotaExceeded,
    InsufficientStorage,
    TimedOut,
    Unavailable,
    /// The service has failed; the upload may be valid.
    Internal,
}

/// The reason why an upload is refused.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    pub code: RefusalCode,
    pub detail: String,
    /// JSON pointer to the invalid field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pointer: Option<String>,
    /// Code of the defect of a file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

impl Refusal {
    pub fn new(code: RefusalCode, detail: impl Into<String>) -> Self {
        Self { code, detail: detail.into(), pointer: None, reason: None }
    }

    /// Adds the pointer to the invalid field.
    pub fn at(self, pointer: &str) -> Self {
        Self { pointer: Some(pointer.to_owned()), ..self }
    }

    /// The refusal of a file whose check ran out of time.
    pub fn too_slow() -> Self {
        let detail = "the check of the file took longer than --check-seconds allows: try again when less is going \
                      on, or send it in a format that is quicker to read, such as npy";
        Self::new(RefusalCode::TimedOut, detail)
    }

    /// The refusal of a file that can't be stored in this state of the disk.
    pub fn disk_trouble(trouble: DiskTrouble) -> Self {
        match trouble {
            DiskTrouble::Full => {
                Self::new(RefusalCode::InsufficientStorage, "the disk of the service is full")
            }
            DiskTrouble::ReadOnly => Self::new(
                RefusalCode::Unavailable,
                "the disk of the service is read-only; try again later",
            ),
        }
    }
}

/// Errors: the error itself, if the machine or this program is to blame.
impl TryFrom<FormatError> for Refusal {
    type Error = FormatError;

    fn try_from(error: FormatError) -> Result<Self, FormatError> {
        if let Some(trouble) = error.disk_trouble() {
            return Ok(Self::disk_trouble(trouble));
        }
        if matches!(&error, FormatError::Io { source, .. } if source.kind() == ErrorKind::TimedOut)
        {
            return Ok(Self::too_slow());
        }
        if !error.is_callers_fault() {
            return Err(error);
        }
        let pointer = match &error {
            FormatError::FullScale(_) | FormatError::Overflow { .. } => Some("/full_scale"),
            FormatError::AxesAmbiguous { .. } | FormatError::NoAxes(_) => Some("/axes"),
            FormatError::NoNames | FormatError::MissingArray { .. } => Some("/array"),
            FormatError::Part { field: "crop", .. } => Some("/crop"),
            FormatError::Part { field: "frames", .. } => Some("/frames"),
            FormatError::Part { .. } => Some("/packing"),
            _ => None,
        };
        Ok(Self {
            code: RefusalCode::InvalidContent,
            detail: error.to_string(),
            pointer: pointer.map(str::to_owned),
            reason: Some(error.code().to_owned()),
        })
    }
}

/// Errors: the error itself, if the machine or this program is to blame, or the check was stopped.
impl TryFrom<IntakeError> for Refusal {
    type Error = IntakeError;

    fn try_from(error: IntakeError) -> Result<Self, IntakeError> {
        let (place, refusal) = match error {
            IntakeError::Format { place, source } => match source.try_into() {
                Ok(refusal) => (place, refusal),
                Err(source) => return Err(IntakeError::Format { place, source }),
            },
            IntakeError::Size { place, detail } => {
                (place, Self::new(RefusalCode::SizeMismatch, detail))
            }
            IntakeError::Content { place, detail } => {
                (place, Self::new(RefusalCode::InvalidContent, detail))
            }
            IntakeError::Stopped => return Err(IntakeError::Stopped),
        };
        Ok(if place.is_empty() { refusal } else { refusal.at(&place) })
    }
}
