//! Errors of TIFF files.

use crate::{Format, FormatError};

pub(super) fn refused(found: String, accepted: &'static str) -> FormatError {
    FormatError::Unsupported { format: Format::Tiff, found, accepted }
}

pub(super) fn malformed(problem: String) -> FormatError {
    FormatError::malformed(Format::Tiff, problem)
}
