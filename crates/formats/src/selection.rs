//! Selects a window of pixels and a range of frames of a stack, and unpacks packed pixels.

use std::io::Read;
use std::str::FromStr;

use ndarray::s;
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use super::{Format, FormatError, Frames, Limits, Reader, SampleType, StackInfo, samples};
use crate::error::Result;

/// A window of pixels, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Crop {
    /// First row.
    #[schemars(range(max = 8191))]
    pub row: usize,
    /// First column.
    #[schemars(range(max = 8191))]
    pub column: usize,
    /// Number of rows.
    #[schemars(range(min = 1, max = 8192))]
    pub height: usize,
    /// Number of columns.
    #[schemars(range(min = 1, max = 8192))]
    pub width: usize,
}

impl FromStr for Crop {
    type Err = String;

    /// Parses `ROW,COLUMN,HEIGHT,WIDTH`.
    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Option<Vec<usize>> =
            text.split(',').map(|number| number.trim().parse().ok()).collect();
        match numbers.as_deref() {
            Some(&[row, column, height, width]) => Ok(Self { row, column, height, width }),
            _ => Err(format!("{text:?}; state four numbers, ROW,COLUMN,HEIGHT,WIDTH")),
        }
    }
}

/// The part of a stack that is read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Selection {
    /// The window of each frame; `None` for whole frames.
    pub crop: Option<Crop>,
    /// First and last frame, both included, counted from 0; `None` for all frames.
    pub frames: Option<[usize; 2]>,
}

/// An order of bits in which 12-bit cameras pack two pixels into three bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Packing {
    /// `Mono12p` of GenICam: the low bits first.
    Mono12p,
    /// `Mono12Packed` of GigE Vision: the high bits of both pixels around a byte with their low bits.
    Mono12packed,
}

/// Number of bytes of two pixels.
const PAIR_BYTES: usize = 3;
/// Largest value of 12 bits.
const LARGEST: f32 = 4095.0;

impl Selection {
    /// Limits a stack to this part.
    ///
    /// Errors: [`FormatError::Part`] for a part outside the stack.
    pub(super) fn of(&self, mut reader: Reader) -> Result<Reader> {
        if *self == Self::default() {
            return Ok(reader);
        }
        let all = *reader.info();
        let whole = Crop { row: 0, column: 0, height: all.height, width: all.width };
        let crop = self.crop.unwrap_or(whole);
        let inside = |first: usize, length: usize, end: usize| {
            length > 0 && first.checked_add(length).is_some_and(|last| last <= end)
        };
        let order = all.axes.map_or_else(String::new, |axes| {
            format!(". Its axes were read as {axes}: state `axes` if they have another order")
        });
        if !inside(crop.row, crop.height, all.height) || !inside(crop.column, crop.width, all.width)
        {
            let detail = format!(
                "the window of {}x{} pixels from row {} and column {} on is not inside the pictures of {}x{} (rows x \
                 columns, counted from 0){order}",
                crop.height, crop.width, crop.row, crop.column, all.height, all.width
            );
            return Err(FormatError::Part { field: "crop", detail });
        }
        let [first, last] = self.frames.unwrap_or([0, all.frames - 1]);
        if first > last || last >= all.frames {
            let detail = format!(
                "frames {first} to {last} are not in the file, which has {} frames, counted from 0{order}",
                all.frames
            );
            return Err(FormatError::Part { field: "frames", detail });
        }
        let info =
            StackInfo { frames: last - first + 1, height: crop.height, width: crop.width, ..all };
        let (mut skip, mut remaining) = (first, info.frames);
        let Crop { row, column, height, width } = crop;
        let window = s![row..row + height, column..column + width];
        Ok(Box::new(Frames::new(info, move || {
            if remaining == 0 {
                return Ok(None);
            }
            for _ in 0..std::mem::take(&mut skip) {
                reader.next_frame()?;
            }
            remaining -= 1;
            Ok(reader.next_frame()?.map(|frame| frame.slice(window).to_owned()))
        })))
    }
}

impl Packing {
    /// Number of bytes of some pixels.
    fn bytes(self, pixels: usize) -> usize {
        (pixels * PAIR_BYTES).div_ceil(2)
    }

    /// Number of stored columns of rows of this width.
    pub(super) fn stored_width(self, width: usize) -> usize {
        self.bytes(width)
    }

    /// Unpacks `count` pixels.
    fn unpack(self, bytes: &[u8], count: usize) -> Vec<f32> {
        let pair = |pair: &[u8]| {
            let byte = |place: usize| u16::from(pair.get(place).copied().unwrap_or(0));
            let (first, middle, last) = (byte(0), byte(1), byte(2));
            match self {
                Self::Mono12p => [first | (middle & 15) << 8, middle >> 4 | last << 4],
                Self::Mono12packed => [first << 4 | middle & 15, last << 4 | middle >> 4],
            }
        };
        let pixels = bytes.chunks(PAIR_BYTES).flat_map(pair);
        pixels.take(count).map(f32::from).collect()
    }

    /// Unpacks the rows of a stack of bytes.
    ///
    /// Errors: [`FormatError::Part`] for stacks of other samples, or rows of other than whole pairs of pixels.
    pub(super) fn rows_of(self, mut reader: Reader) -> Result<Reader> {
        let stored = *reader.info();
        if stored.sample != SampleType::U8 || !stored.width.is_multiple_of(PAIR_BYTES) {
            let detail = format!(
                "{self} packs 2 pixels into 3 bytes, so the file must contain uint8 rows of a multiple of 3 bytes, but its \
                 rows have {} values of the type {}",
                stored.width, stored.sample
            );
            return Err(FormatError::Part { field: "packing", detail });
        }
        let (sample, width) = (SampleType::U16, stored.width / PAIR_BYTES * 2);
        let info = StackInfo { sample, width, ..stored }.with_largest(LARGEST)?;
        Ok(Box::new(Frames::new(info, move || {
            let Some(frame) = reader.next_frame()? else { return Ok(None) };
            // Rows are whole pairs, so pairs do not cross rows.
            let bytes: Vec<u8> = frame.iter().map(|value| *value as u8).collect();
            let pixels = self.unpack(&bytes, info.height * info.width);
            samples::frame(info.height, info.width, pixels).map(Some)
        })))
    }

    /// Reads a file without a header as frames of a known size.
    ///
    /// Errors: [`FormatError::Part`] for an unknown size, or a length that is not a multiple of a frame.
    pub(super) fn raw<R: Read + Send + 'static>(
        self,
        mut file: R,
        length: u64,
        size: Option<(usize, usize)>,
        limits: &Limits,
    ) -> Result<Reader> {
        let refused = |detail: String| Err(FormatError::Part { field: "packing", detail });
        let Some((height, width)) = size else {
            return refused(
                "the file has no header that states its size: save the bytes as a uint8 array [frame, row, byte], for \
                 example with numpy"
                    .to_owned(),
            );
        };
        let bytes = self.bytes(height * width) as u64;
        let frames = length / bytes.max(1);
        if bytes == 0 || frames == 0 || !length.is_multiple_of(bytes) {
            return refused(format!(
                "the file has {length} bytes, which is not a multiple of the {bytes} bytes of a picture of {height}x{width} \
                 pixels in {self}"
            ));
        }
        limits.check_shape(Format::Raw, frames, height as u64, width as u64)?;
        let frames = usize::try_from(frames).unwrap_or(usize::MAX);
        let info = StackInfo::new(Format::Raw, SampleType::U16, frames, height, width);
        let (info, mut remaining) = (info.with_largest(LARGEST)?, frames);
        Ok(Box::new(Frames::new(info, move || {
            if remaining == 0 {
                return Ok(None);
            }
            remaining -= 1;
            let mut bytes = vec![0; self.bytes(height * width)];
            let read = file.read_exact(&mut bytes);
            read.map_err(|error| samples::read_error(Format::Raw, error))?;
            samples::frame(height, width, self.unpack(&bytes, height * width)).map(Some)
        })))
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, s};

    use super::{Crop, Packing, Selection};
    use crate::mat::SceneArray;
    use crate::test_support::{assert_names, file, ramp};
    use crate::{
        Expected, FormatError, FrameReader, Limits, StackInfo, Wanted, collect, npy, open_array,
    };

    fn open(bytes: &[u8], wanted: Wanted<'_>) -> Result<(StackInfo, Array3<f32>), FormatError> {
        collect(&mut *open_array(file(bytes).path(), wanted, &Limits::default())?)
    }

    fn stack() -> (Array3<f32>, Vec<u8>) {
        let stack = ramp((5, 6, 8), 1000);
        let path = tempfile::NamedTempFile::new().unwrap();
        npy::write_f32(path.path(), stack.view()).unwrap();
        let bytes = std::fs::read(path.path()).unwrap();
        (stack, bytes)
    }

    #[test]
    fn a_window_and_a_range_of_frames_are_selected() {
        let (stack, bytes) = stack();
        let crop = Crop { row: 1, column: 2, height: 4, width: 6 };
        let part = Selection { crop: Some(crop), frames: Some([1, 3]) };
        let (info, found) = open(&bytes, Wanted { part, ..SceneArray::Masks.into() }).unwrap();
        assert_eq!((info.frames, info.height, info.width), (3, 4, 6));
        assert_eq!(found, stack.slice(s![1..4, 1..5, 2..8]));
        for (part, words) in [
            (Selection { crop: Some(Crop { row: 3, ..crop }), frames: None }, ["4x6", "6x8"]),
            (Selection { crop: Some(Crop { width: 0, ..crop }), frames: None }, ["4x0", "6x8"]),
            (
                Selection { crop: Some(Crop { column: usize::MAX, ..crop }), frames: None },
                ["4x6", "6x8"],
            ),
            (Selection { crop: None, frames: Some([2, 5]) }, ["frames 2 to 5", "5 frames"]),
            (Selection { crop: None, frames: Some([2, 1]) }, ["frames 2 to 1", "5 frames"]),
        ] {
            let error = open(&bytes, Wanted { part, ..SceneArray::Masks.into() }).unwrap_err();
            assert!(matches!(error, FormatError::Part { .. }), "{error:?}");
            assert_names(&error.to_string(), &words);
        }
    }

    /// Packs pixels as the standards of cameras describe.
    fn pack(packing: Packing, values: &[u16]) -> Vec<u8> {
        let pair = |pair: &[u16]| {
            let (a, b) = (pair[0], pair.get(1).copied().unwrap_or(0));
            let bytes = match packing {
                Packing::Mono12p => [a & 255, a >> 8 | (b & 15) << 4, b >> 4],
                Packing::Mono12packed => [a >> 4, a & 15 | (b & 15) << 4, b >> 4],
            };
            bytes.map(|byte| byte as u8)[..if pair.len() == 1 { 2 } else { 3 }].to_vec()
        };
        values.chunks(2).flat_map(pair).collect()
    }

    #[test]
    fn packed_pixels_are_read_from_arrays_and_from_raw_files() {
        let values: Vec<u16> = (0..2 * 3 * 4).map(|k| k * 617 % 4096).collect();
        let expected: Vec<f32> = values.iter().map(|value| f32::from(*value)).collect();
        for packing in [Packing::Mono12p, Packing::Mono12packed] {
            let bytes = pack(packing, &values);
            let expected_size = Expected { size: Some((3, 4)), ..Expected::default() };
            let wanted = Wanted {
                packing: Some(packing),
                expected: expected_size,
                ..SceneArray::Measurements.into()
            };
            let (info, found) = open(&bytes, wanted).unwrap();
            assert_eq!(
                (info.frames, info.height, info.width, info.largest),
                (2, 3, 4, Some(4095.0))
            );
            assert_eq!(found.into_raw_vec_and_offset().0, expected);
            let mut array = b"\x93NUMPY\x01\x00\x46\x00".to_vec();
            array.extend(
                format!(
                    "{:<69}\n",
                    "{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 6), }"
                )
                .bytes(),
            );
            array.extend(&bytes);
            let (info, found) = open(&array, wanted).unwrap();
            assert_eq!((info.frames, info.height, info.width), (2, 3, 4));
            assert_eq!(found.into_raw_vec_and_offset().0, expected);
            let odd = Wanted {
                expected: Expected { size: Some((1, 3)), ..Expected::default() },
                ..wanted
            };
            let (_, found) = open(&pack(packing, &values[..3]), odd).unwrap();
            assert_eq!(found.into_raw_vec_and_offset().0, expected[..3]);
            let error = open(&bytes[1..], wanted).unwrap_err();
            assert_names(&error.to_string(), &["35 bytes", "18 bytes", "3x4"]);
            let unknown = Wanted { expected: Expected::default(), ..wanted };
            assert_names(&open(&bytes, unknown).unwrap_err().to_string(), &["no header"]);
        }
        let (_, floats) = stack();
        let wanted = Wanted { packing: Some(Packing::Mono12p), ..SceneArray::Masks.into() };
        assert_names(&open(&floats, wanted).unwrap_err().to_string(), &["uint8 rows", "float32"]);
        let mut reader =
            open_array(file(&floats).path(), SceneArray::Masks, &Limits::default()).unwrap();
        assert!(reader.next_frame().unwrap().is_some());
    }
}
