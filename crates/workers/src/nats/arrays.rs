//! Converts arrays between memory and the format of prepared arrays, in which they travel.

use std::path::Path;

use ndarray::{Array3, ArrayView3};

use formats::planar::{self, Reader};
use formats::{FormatError, Limits};

/// Serializes an array \[B,h,w\].
pub fn to_bytes(array: ArrayView3<'_, f32>) -> Result<Vec<u8>, FormatError> {
    let (count, height, width) = array.dim();
    let mut writer = planar::writer(Vec::new(), count, height, width)?;
    array.outer_iter().try_for_each(|frame| writer.write_frame(frame))?;
    writer.finish()
}

/// Reads the array in a file.
pub fn read(path: &Path) -> Result<Array3<f32>, FormatError> {
    let reader = Reader::open(path, &Limits::default())?;
    let info = reader.info();
    reader.read_window(0..info.frames, 0..info.height, 0..info.width)
}
