//! What can be wrong with a file or with the values in it.

use std::io;

use super::Format;

/// What the functions of this folder give.
pub type Result<T, E = FormatError> = std::result::Result<T, E>;

/// Why a file could not be read, written or accepted.
///
/// Only [`FormatError::Io`] and [`FormatError::Internal`] are ours; everything else says what is
/// wrong with the file that somebody gave us (see [`FormatError::is_callers_fault`]). Messages name
/// no path: the caller knows which file it meant, and a server must not show its own layout.
/// Frames, rows and columns count from 0.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say what the fields are
pub enum FormatError {
    /// The operating system refused a read or a write.
    #[error("cannot {action}: {source}")]
    Io { action: &'static str, source: io::Error },
    /// A call that breaks the rules of this module (a window outside the stack, a frame of the wrong size).
    #[error("internal error in the use of a file format: {0}")]
    Internal(String),
    /// The first bytes belong to none of the formats that can be read.
    #[error("the file is in no format that is read here: {found}; accepted are {accepted}")]
    UnknownFormat { found: String, accepted: &'static str },
    /// The format is known but not this kind of content.
    #[error("{format} file: found {found}; accepted: {accepted}")]
    Unsupported { format: Format, found: String, accepted: &'static str },
    /// The file is shorter than its header says.
    #[error(
        "{format} file is cut short: its header promises {promised}, but the file holds {present}"
    )]
    Truncated { format: Format, promised: String, present: String },
    /// The bytes contradict the format's rules or themselves.
    #[error("{format} file is malformed: {problem}")]
    Malformed { format: Format, problem: String },
    /// The content is larger than this installation accepts ([`super::Limits`]).
    #[error("{format} file is too large: {what} is {value}, the limit is {limit}")]
    OverLimit { format: Format, what: &'static str, value: u64, limit: u64 },
    /// A file of several arrays without the one that was asked for.
    #[error("{format} file has no array named '{name}'; it holds {present}")]
    MissingArray { format: Format, name: String, present: String },
    /// A picture of an archive that is no frame.
    #[error("{name}: {source}")]
    Member { name: String, source: Box<FormatError> },
    /// An array was named, in a file that holds one without a name.
    #[error("the file holds one array without a name: leave array out")]
    NoNames,
    /// An array whose frames may lie along several of its axes.
    #[error(
        "{format} file: the array [{}, {}, {}] may be {fits}: state axes, the one that is right{}",
        shape[0], shape[1], shape[2], turning(*format)
    )]
    AxesAmbiguous { format: Format, shape: [u64; 3], fits: String },
    /// The axes of pictures were stated as something else than they are.
    #[error("{0} has pictures of rows and columns, one for each frame: leave axes out")]
    NoAxes(Format),
    /// Integers of a type that has no scale of its own, and none was stated.
    #[error(
        "the samples are {0}, which has no full scale of its own: state full_scale, the stored number that means 1"
    )]
    FullScaleNeeded(String),
    /// A full scale that is no finite positive number.
    #[error("full_scale must be a finite number above 0, not {0}")]
    FullScale(f32),
    /// NaN or an infinity.
    #[error(
        "{subject}: {value} at frame {frame}, row {row}, column {column} (counted from 0); every value must be finite"
    )]
    NotFinite { subject: &'static str, value: f32, frame: usize, row: usize, column: usize },
    /// A mask value above the full scale.
    #[error(
        "masks: the largest value is {largest} (frame {frame}, row {row}, column {column}, counted from 0), above the full scale {full_scale}; \
         masks must lie in [0, full_scale]: state the full_scale that means fully open"
    )]
    AboveFullScale { largest: f32, frame: usize, row: usize, column: usize, full_scale: f32 },
    /// No mask lets any light through.
    #[error(
        "masks: no value is above 0 in any of the {frames} frames; a calibration needs open pixels"
    )]
    AllMasksZero { frames: usize },
    /// One mask lets no light through.
    #[error(
        "masks: frame {frame} of {frames} (counted from 0) has no value above 0; every mask needs open pixels"
    )]
    MaskFrameZero { frame: usize, frames: usize },
    /// A snapshot without any signal.
    #[error(
        "measurement: snapshot {snapshot} of {snapshots} (counted from 0) is zero everywhere; there is nothing to reconstruct"
    )]
    SnapshotZero { snapshot: usize, snapshots: usize },
}

impl FormatError {
    /// A short stable name of the kind of error, for machines.
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
            Self::FullScale(_) | Self::FullScaleNeeded(_) => "invalid_full_scale",
            Self::NotFinite { .. } => "not_finite",
            Self::AboveFullScale { .. } => "above_full_scale",
            Self::AllMasksZero { .. } => "all_masks_zero",
            Self::MaskFrameZero { .. } => "mask_frame_zero",
            Self::SnapshotZero { .. } => "snapshot_zero",
        }
    }

    /// True when the file (or the stated scale) is to blame, false when the machine or this program is.
    pub fn is_callers_fault(&self) -> bool {
        !matches!(self, Self::Io { .. } | Self::Internal(_))
    }

    /// True if the disk is full or a quota is used up.
    pub fn is_disk_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        matches!(self, Self::Io { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded))
    }

    pub(super) fn malformed(format: Format, problem: impl Into<String>) -> Self {
        Self::Malformed { format, problem: problem.into() }
    }

    /// For `map_err` on I/O: `.map_err(FormatError::io("read the frame"))`.
    pub fn io(action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { action, source }
    }
}

/// How an array is saved in another order.
fn turning(format: Format) -> &'static str {
    match format {
        Format::Npy => {
            ", or save [row, column, frame] as [frame, row, column]: python -c \"import numpy; \
             numpy.save('out.npy', numpy.moveaxis(numpy.load('in.npy'), -1, 0))\""
        }
        _ => "",
    }
}
