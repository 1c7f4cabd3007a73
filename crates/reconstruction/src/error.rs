//! Errors of the reconstruction core.

use std::borrow::Cow;

use thiserror::Error;

/// Result of a fallible function of this crate.
pub type Result<T, E = ReconError> = std::result::Result<T, E>;

/// An error of the reconstruction core. Each message says what is wrong and what to do.
#[derive(Debug, Error)]
pub enum ReconError {
    /// Arrays that must agree in size do not.
    #[error("{what} is {found}, but {expected} is needed")]
    Shape {
        /// The array that does not fit.
        what: &'static str,
        /// Its size.
        found: String,
        /// The size that would fit.
        expected: String,
    },
    /// A parameter is outside its range.
    #[error("{name} is {value}; it must be {range}")]
    Parameter {
        /// The parameter's name.
        name: Cow<'static, str>,
        /// Its value.
        value: String,
        /// The allowed values.
        range: Cow<'static, str>,
    },
    /// The masks carry no light at all.
    #[error("every mask value is 0 in all {frames} frames: nothing can be reconstructed")]
    DarkMasks {
        /// Number of mask frames.
        frames: usize,
    },
    /// The schedule has a learned prior, but no denoiser was given.
    #[error("the schedule has stages with a learned denoiser, but none is loaded")]
    NoDenoiser,
    /// ONNX Runtime is missing, refused the device, or failed.
    #[error("{0}")]
    Runtime(String),
    /// The driver of the device stopped or was reset. Only a new process can use the device again.
    #[error("{0}")]
    DeviceLost(String),
    /// The memory of the device is full. Other work may free some.
    #[error("{0}")]
    DeviceFull(String),
    /// The frames are no longer finite.
    #[error("the reconstruction diverged at iteration {iteration} of {planned}")]
    Diverged {
        /// One-based number of the iteration.
        iteration: usize,
        /// Planned number of iterations.
        planned: usize,
    },
    /// The observer asked to stop.
    #[error("cancelled")]
    Cancelled,
}

/// Refuses a parameter unless its value `fits` the range.
///
/// # Errors
/// [`ReconError::Parameter`].
pub fn check_parameter(
    fits: bool,
    name: &'static str,
    value: impl ToString,
    range: &'static str,
) -> Result<()> {
    let (name, value, range) = (name.into(), value.to_string(), range.into());
    if fits { Ok(()) } else { Err(ReconError::Parameter { name, value, range }) }
}

/// Refuses an array unless its size `fits`.
///
/// # Errors
/// [`ReconError::Shape`].
pub fn check_shape(
    fits: bool,
    what: &'static str,
    found: impl Into<String>,
    expected: impl Into<String>,
) -> Result<()> {
    let (found, expected) = (found.into(), expected.into());
    if fits { Ok(()) } else { Err(ReconError::Shape { what, found, expected }) }
}

/// `1x2x3` from `[1, 2, 3]`, for messages.
pub(crate) fn shape_text(shape: &[usize]) -> String {
    let sides: Vec<String> = shape.iter().map(usize::to_string).collect();
    sides.join("x")
}
