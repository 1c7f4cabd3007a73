//! What a stack of frames is, whatever file it lies in.

use ndarray::Array2;

use super::{Axes, Format, FormatError};
use crate::error::Result;
use strum::Display;

/// How one sample is stored in a file, by NumPy's names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display)]
pub enum SampleType {
    /// One byte, 0 or 1.
    #[strum(serialize = "bool")]
    Bool,
    /// Unsigned 8 bit.
    #[strum(serialize = "uint8")]
    U8,
    /// Unsigned 16 bit.
    #[strum(serialize = "uint16")]
    U16,
    /// Unsigned 32 bit; this and wider integers are rounded to 24 binary digits when read.
    #[strum(serialize = "uint32")]
    U32,
    /// Unsigned 64 bit.
    #[strum(serialize = "uint64")]
    U64,
    /// Signed 8 bit.
    #[strum(serialize = "int8")]
    I8,
    /// Signed 16 bit.
    #[strum(serialize = "int16")]
    I16,
    /// Signed 32 bit.
    #[strum(serialize = "int32")]
    I32,
    /// Signed 64 bit.
    #[strum(serialize = "int64")]
    I64,
    /// 16-bit float.
    #[strum(serialize = "float16")]
    F16,
    /// 32-bit float.
    #[strum(serialize = "float32")]
    F32,
    /// 64-bit float, rounded to 32 bit when read.
    #[strum(serialize = "float64")]
    F64,
}

impl SampleType {
    /// Bytes a sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 | Self::F16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// What means 1.0 where nobody states a full scale: the type's maximum for unsigned integers of 8
    /// and 16 bits, in which cameras and pictures count, and 1 for floats and truth values. Other integers
    /// have none: what programs store in them has no common scale.
    pub fn default_full_scale(self) -> Option<FullScale> {
        match self {
            Self::U8 => Some(FullScale(255.0)),
            Self::U16 => Some(FullScale(65535.0)),
            Self::Bool | Self::F16 | Self::F32 | Self::F64 => Some(FullScale(1.0)),
            Self::U32 | Self::U64 | Self::I8 | Self::I16 | Self::I32 | Self::I64 => None,
        }
    }
}

/// The value of the stored numbers that means 1.0. Finite and above 0.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct FullScale(f32);

impl FullScale {
    /// Numbers that are on `[0,1]` already.
    pub const ONE: Self = Self(1.0);
    /// Eight-bit grey values, the community's .mat scenes.
    pub const EIGHT_BIT: Self = Self(255.0);

    /// Errors: [`FormatError::FullScale`] for NaN, infinities, zero, negative and subnormal numbers.
    pub fn new(value: f32) -> Result<Self> {
        // A subnormal scale would turn every ordinary value into an infinity.
        if value.is_normal() && value > 0.0 {
            Ok(Self(value))
        } else {
            Err(FormatError::FullScale(value))
        }
    }

    /// The number itself.
    pub fn value(self) -> f32 {
        self.0
    }
}

/// What a file says about its stack; a two-dimensional file has one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StackInfo {
    /// Frames (masks, snapshots), at least 1.
    pub frames: usize,
    /// Rows of a frame.
    pub height: usize,
    /// Columns of a frame.
    pub width: usize,
    /// How the samples are stored.
    pub sample: SampleType,
    /// The file's format.
    pub format: Format,
    /// The order of the array's axes; none for pictures and arrays of two dimensions, where there is no question.
    pub axes: Option<Axes>,
    /// What means 1.0 unless stated: [`SampleType::default_full_scale`], but 255 for the meas and
    /// orig arrays of a .mat scene, whatever their type.
    pub default_full_scale: Option<FullScale>,
}

impl StackInfo {
    /// An info with the sample type's own full scale.
    pub(super) fn new(
        format: Format,
        sample: SampleType,
        frames: usize,
        height: usize,
        width: usize,
    ) -> Self {
        Self {
            frames,
            height,
            width,
            sample,
            format,
            axes: None,
            default_full_scale: sample.default_full_scale(),
        }
    }

    /// Frames x height x width.
    pub fn voxels(&self) -> u64 {
        (self.frames as u64).saturating_mul(self.height as u64).saturating_mul(self.width as u64)
    }
}

/// A stack of frames that is read one frame at a time, so that memory holds one frame.
pub trait FrameReader {
    /// The shape and type, known before the first frame is read.
    fn info(&self) -> &StackInfo;

    /// The next frame (row, column) as stored, not scaled; `None` after the last.
    ///
    /// Errors: whatever is wrong with this frame's bytes. After an error the reader is spent.
    fn next_frame(&mut self) -> Result<Option<Array2<f32>>>;
}

impl<R: FrameReader + ?Sized> FrameReader for Box<R> {
    fn info(&self) -> &StackInfo {
        (**self).info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        (**self).next_frame()
    }
}
