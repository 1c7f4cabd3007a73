//! Stacks of frames, independent of the file format.

use ndarray::Array2;

use super::{Axes, Format, FormatError};
use crate::error::Result;
use strum::Display;

/// The data type of stored samples. `Display` gives the name in NumPy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display)]
pub enum SampleType {
    /// Boolean in one byte, 0 or 1.
    #[strum(serialize = "bool")]
    Bool,
    /// Unsigned 8 bit.
    #[strum(serialize = "uint8")]
    U8,
    /// Unsigned 16 bit.
    #[strum(serialize = "uint16")]
    U16,
    /// Unsigned 32 bit. Integers of 32 and 64 bits are rounded to 24 bits when read.
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
    /// 64-bit float, rounded to 32 bits when read.
    #[strum(serialize = "float64")]
    F64,
}

impl SampleType {
    /// Number of bytes per sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 | Self::F16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// The full scale if none is stated: the largest value of unsigned integers of 8 and 16 bits, which cameras and
    /// pictures use, and 1 for floats and booleans. Other integers have no common scale.
    pub fn default_full_scale(self) -> Option<FullScale> {
        match self {
            Self::Bool | Self::F16 | Self::F32 | Self::F64 => Some(FullScale::ONE),
            other => other.largest().map(FullScale),
        }
    }

    /// The largest value of unsigned integers of 8 and 16 bits, at which the pixels of cameras are full.
    fn largest(self) -> Option<f32> {
        match self {
            Self::U8 => Some(255.0),
            Self::U16 => Some(65535.0),
            _ => None,
        }
    }
}

/// The stored value that means 1.0. It is finite and above 0.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct FullScale(f32);

impl FullScale {
    /// The full scale of values on `[0,1]`.
    pub const ONE: Self = Self(1.0);
    /// The full scale of 8-bit grey values, as in the public .mat scenes.
    pub const EIGHT_BIT: Self = Self(255.0);

    /// Errors: [`FormatError::FullScale`] for NaN, infinities, zero, negative and subnormal values.
    pub fn new(value: f32) -> Result<Self> {
        // Division by a subnormal scale would give infinities.
        if value.is_normal() && value > 0.0 {
            Ok(Self(value))
        } else {
            Err(FormatError::FullScale(value))
        }
    }

    /// The value as a float.
    pub fn value(self) -> f32 {
        self.0
    }
}

/// The description of a stack. A two-dimensional array has one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StackInfo {
    /// Number of frames (masks, snapshots), at least 1.
    pub frames: usize,
    /// Rows of a frame.
    pub height: usize,
    /// Columns of a frame.
    pub width: usize,
    /// Data type of the samples.
    pub sample: SampleType,
    /// File format.
    pub format: Format,
    /// Order of the axes; `None` for pictures and two-dimensional arrays, where it is clear.
    pub axes: Option<Axes>,
    /// The full scale if none is stated: [`SampleType::default_full_scale`], except for .mat scenes, where it is
    /// [`SceneArray::default_full_scale`](super::mat::SceneArray::default_full_scale).
    pub default_full_scale: Option<FullScale>,
    /// The largest value that a camera can have stored, for unsigned integers of up to 16 bits.
    pub largest: Option<f32>,
}

impl StackInfo {
    /// A description with the default full scale of the data type, and without axes.
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
            largest: sample.largest(),
        }
    }

    /// The description of samples that use only a part of the bits of their type, with this largest value.
    pub(super) fn with_largest(self, largest: f32) -> Result<Self> {
        let default_full_scale = Some(FullScale::new(largest)?);
        Ok(Self { default_full_scale, largest: Some(largest), ..self })
    }

    /// Number of voxels: frames x height x width.
    pub fn voxels(&self) -> u64 {
        (self.frames as u64).saturating_mul(self.height as u64).saturating_mul(self.width as u64)
    }
}

/// A stack that is read one frame at a time.
pub trait FrameReader {
    /// The description of the stack, which is known before the first frame is read.
    fn info(&self) -> &StackInfo;

    /// Returns the next frame (row, column) as stored, without scaling; `None` after the last one.
    ///
    /// Errors: an invalid frame. The reader can't be used after an error.
    fn next_frame(&mut self) -> Result<Option<Array2<f32>>>;
}

/// A reader of any format.
pub type Reader = Box<dyn FrameReader + Send>;

/// A stack of frames that a function returns one at a time.
pub struct Frames<F> {
    info: StackInfo,
    next: F,
}

impl<F: FnMut() -> Result<Option<Array2<f32>>>> Frames<F> {
    /// A stack of this description. `next` returns the next frame, and `None` after the last one.
    pub fn new(info: StackInfo, next: F) -> Self {
        Self { info, next }
    }
}

/// A stack of one frame, which `decode` returns.
pub(super) fn one_frame(
    info: StackInfo,
    decode: impl FnOnce() -> Result<Array2<f32>> + Send + 'static,
) -> Reader {
    let mut decode = Some(decode);
    Box::new(Frames::new(info, move || decode.take().map(|decode| decode()).transpose()))
}

impl<F: FnMut() -> Result<Option<Array2<f32>>>> FrameReader for Frames<F> {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        (self.next)()
    }
}

impl<R: FrameReader + ?Sized> FrameReader for Box<R> {
    fn info(&self) -> &StackInfo {
        (**self).info()
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        (**self).next_frame()
    }
}
