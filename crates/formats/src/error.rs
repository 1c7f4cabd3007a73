//! Errors of files and of the values in them.

use std::io;

use super::Format;

/// The result type of this crate.
pub type Result<T, E = FormatError> = std::result::Result<T, E>;

/// The reason why a file could not be read, written or accepted.
///
/// [`FormatError::Io`] and [`FormatError::Internal`] are failures of the machine or of this program. All other variants
/// describe a problem of the file; see [`FormatError::is_callers_fault`]. Messages contain no paths, because a server
/// must not reveal its folders. Frames, rows and columns are counted from 0.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages describe the fields
pub enum FormatError {
    /// The operating system refused a read or a write.
    #[error("can't {action}: {source}")]
    Io { action: &'static str, source: io::Error },
    /// An incorrect call, such as a window outside the stack, or a frame of the wrong size.
    #[error("internal error: {0}")]
    Internal(String),
    /// The file is in none of the supported formats.
    #[error("the file format is not supported: {found}; supported formats are {accepted}")]
    UnknownFormat { found: String, accepted: &'static str },
    /// The format is supported, but not this kind of content.
    #[error("this content of the {format} file is not supported: {found}; supported: {accepted}")]
    Unsupported { format: Format, found: String, accepted: &'static str },
    /// The file is shorter than its header states.
    #[error(
        "the {format} file is cut short: its header promises {promised}, but the file contains {present}"
    )]
    Truncated { format: Format, promised: String, present: String },
    /// The content violates the rules of the format, or is inconsistent.
    #[error("the {format} file is malformed: {problem}")]
    Malformed { format: Format, problem: String },
    /// The content exceeds the [`super::Limits`].
    #[error("the {format} file is too large: {what} is {value}, but the limit is {limit}")]
    OverLimit { format: Format, what: &'static str, value: u64, limit: u64 },
    /// The file does not have the requested array.
    #[error(
        "the {format} file has no array named '{name}'; it contains {present}{}",
        if present.starts_with('\'') { ": name one of them as `array`" } else { "" }
    )]
    MissingArray { format: Format, name: String, present: String },
    /// A picture of an archive is not a valid frame.
    #[error("{name}: {source}")]
    Member { name: String, source: Box<FormatError> },
    /// An array name was stated for a file with one array without a name.
    #[error("the file contains one array, which has no name: omit `array`")]
    NoNames,
    /// Several orders of the axes are possible.
    #[error(
        "the order of the axes is ambiguous: the array [{}, {}, {}] of the {format} file may be {fits}: state the \
         correct one as `axes`{}",
        shape[0], shape[1], shape[2], conversion_hint(*format)
    )]
    AxesAmbiguous { format: Format, shape: [u64; 3], fits: String },
    /// An order of axes was stated for pictures, whose order is fixed.
    #[error("a {0} file contains pictures, which always have rows and columns: omit `axes`")]
    NoAxes(Format),
    /// A stated part or packing does not fit the file.
    #[error("{field}: {detail}")]
    Part { field: &'static str, detail: String },
    /// The data type has no default full scale, and none was stated.
    #[error(
        "the samples are {0}, which has no default full scale: state `full_scale`, the stored value that means 1"
    )]
    FullScaleNeeded(String),
    /// The full scale is not a positive number that 32-bit floats have.
    #[error(
        "full_scale is {0:?} as a 32-bit float; it must be a finite number of at least 1.2e-38"
    )]
    FullScale(f32),
    /// A value is NaN or infinite.
    #[error(
        "{subject}: the value at frame {frame}, row {row}, column {column} (counted from 0) is {value}; all values \
         must be finite, and at most 3.4e38"
    )]
    NotFinite { subject: &'static str, value: f32, frame: usize, row: usize, column: usize },
    /// A mask value exceeds the full scale.
    #[error(
        "masks: the largest value is {largest} (frame {frame}, row {row}, column {column}, counted from 0), above the \
         full scale {full_scale}: state as `full_scale` the stored value that means fully open"
    )]
    AboveFullScale { largest: f32, frame: usize, row: usize, column: usize, full_scale: f32 },
    /// The masks have positive and negative levels.
    #[error(
        "masks: {percent} % of the values other than 0 are negative, {low} on average, and the others are {high} on \
         average; a mask transmits light or blocks it, so its values lie between 0 and the full scale. If the pattern \
         (1+C)/2 was shown for a mask C, send (1+C)/2. If the measurement is the difference of two exposures, behind \
         (1+C)/2 and behind (1-C)/2, send each exposure as a measurement with the masks it was taken with"
    )]
    BipolarMasks { percent: f64, low: f32, high: f32 },
    /// All masks are closed everywhere.
    #[error(
        "masks: the largest value of all {frames} frames is {largest:?}, less than a millionth of the full scale \
         {full_scale:?}; masks need open pixels: state as `full_scale` the stored value of an open pixel, and check the NaN \
         of the masks and the map of bad pixels, which are not measured"
    )]
    AllMasksZero { frames: usize, largest: f32, full_scale: f32 },
    /// One mask is closed everywhere.
    #[error(
        "masks: frame {frame} of {frames} (counted from 0) has no value above a millionth of the full scale \
         {full_scale:?}; every mask needs open pixels"
    )]
    MaskFrameZero { frame: usize, frames: usize, full_scale: f32 },
    /// A value is implausibly far above the full scale.
    #[error(
        "measurement: the value at frame {frame}, row {row}, column {column} (counted from 0) is {value:?}, which is more \
         than 1e15 times the full scale {full_scale:?}: state as `full_scale` the stored value that means 1"
    )]
    Overflow { value: f32, frame: usize, row: usize, column: usize, full_scale: f32 },
    /// No snapshot has light.
    #[error(
        "measurement: snapshot {snapshot} of {snapshots} (counted from 0) {state}: there is nothing to reconstruct"
    )]
    NoLight { snapshot: usize, snapshots: usize, state: Lightless },
}

/// The state of a snapshot without light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::Display)]
pub enum Lightless {
    /// All stored values are 0.
    #[strum(to_string = "is zero everywhere")]
    Zero,
    /// All values are NaN.
    #[strum(to_string = "has no finite value: all pixels are NaN, or left out for their masks")]
    NotMeasured,
    /// All values are tiny.
    #[strum(to_string = "has no value above a 1e15th of the full scale, which is too large")]
    Underflow,
}

/// A state of the disk that ends without anybody changing the data: work waits for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiskTrouble {
    /// The disk is full, or a quota is exhausted.
    Full,
    /// The file system is read-only.
    ReadOnly,
}

impl DiskTrouble {
    /// The state of the disk that an error reports, if it does.
    pub fn of(error: &io::Error) -> Option<Self> {
        use io::ErrorKind::{QuotaExceeded, ReadOnlyFilesystem, StorageFull};
        match error.kind() {
            StorageFull | QuotaExceeded => Some(Self::Full),
            ReadOnlyFilesystem => Some(Self::ReadOnly),
            _ => None,
        }
    }
}

impl FormatError {
    /// A stable identifier of the error, for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Io { .. } => "io",
            Self::Internal(_) => "internal",
            Self::UnknownFormat { .. } => "unknown_format",
            Self::Unsupported { .. } => "unsupported_content",
            Self::Truncated { .. } => "truncated",
            Self::Malformed { .. } => "malformed",
            Self::OverLimit { .. } => "over_limit",
            Self::MissingArray { .. } | Self::NoNames => "missing_array",
            Self::Member { source, .. } => source.code(),
            Self::AxesAmbiguous { .. } => "axes_ambiguous",
            Self::NoAxes(_) => "no_axes",
            Self::Part { .. } => "invalid_part",
            Self::FullScale(_) | Self::FullScaleNeeded(_) => "invalid_full_scale",
            Self::NotFinite { .. } | Self::Overflow { .. } => "not_finite",
            Self::AboveFullScale { .. } => "above_full_scale",
            Self::BipolarMasks { .. } => "bipolar_masks",
            Self::AllMasksZero { .. } => "all_masks_zero",
            Self::MaskFrameZero { .. } => "mask_frame_zero",
            Self::NoLight { .. } => "snapshot_zero",
        }
    }

    /// True for problems of the file or of the stated options; false for failures of the machine or of this program.
    pub fn is_callers_fault(&self) -> bool {
        !matches!(self, Self::Io { .. } | Self::Internal(_))
    }

    /// The state of the disk that is the cause, if it is.
    pub fn disk_trouble(&self) -> Option<DiskTrouble> {
        match self {
            Self::Io { source, .. } => DiskTrouble::of(source),
            _ => None,
        }
    }

    pub(super) fn malformed(format: Format, problem: impl Into<String>) -> Self {
        Self::Malformed { format, problem: problem.into() }
    }

    /// Converts an I/O error, for use with `map_err`: `.map_err(FormatError::io("read the frame"))`.
    pub fn io(action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { action, source }
    }
}

/// How to convert the array to another order.
fn conversion_hint(format: Format) -> &'static str {
    match format {
        Format::Npy => {
            ", or convert [row, column, frame] to [frame, row, column]: python -c \"import numpy; \
             numpy.save('out.npy', numpy.moveaxis(numpy.load('in.npy'), -1, 0))\""
        }
        _ => "",
    }
}
