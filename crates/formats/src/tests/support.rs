//! Helpers for the tests of the decoders.

use std::io::Write;
use std::path::{Path, PathBuf};

use ndarray::{Array3, ArrayView3, Axis};
use tempfile::NamedTempFile;

use super::mat::SceneArray;
use super::{
    Axes, Expected, FormatError, FrameReader, Limits, StackInfo, Wanted, collect, open_array,
    open_stack, read_stack,
};

/// A file from another program. `make.py` in the same folder writes it.
pub(super) fn sample(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/formats").join(name)
}

pub(super) fn file(bytes: &[u8]) -> NamedTempFile {
    let mut file = NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    file.flush().unwrap();
    file
}

pub(super) fn read(bytes: &[u8]) -> Result<(StackInfo, Array3<f32>), FormatError> {
    read_stack(file(bytes).path(), &Limits::default())
}

pub(super) fn open(bytes: &[u8]) -> Result<Box<dyn FrameReader + Send>, FormatError> {
    open_stack(file(bytes).path(), &Limits::default())
}

/// A stack with the values 0, 1, 2, ... modulo `modulus`, in the order (frame, row, column).
pub(super) fn ramp(shape: (usize, usize, usize), modulus: usize) -> Array3<f32> {
    let count = shape.0 * shape.1 * shape.2;
    let values = (0..count).map(|v| (v % modulus) as f32).collect();
    Array3::from_shape_vec(shape, values).unwrap()
}

/// The message of the error that reading must give. The error must blame the file.
pub(super) fn refusal(bytes: &[u8]) -> String {
    let error = read(bytes).expect_err("this file must be refused");
    assert!(error.is_callers_fault(), "{error:?}");
    error.to_string()
}

/// Asserts that a message contains all parts.
#[track_caller]
pub(super) fn assert_names(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "'{part}' is not in '{message}'");
    }
}

/// Reads a damaged file. Any values are acceptable, but an error must blame the file.
pub(super) fn survive(bytes: &[u8]) {
    if let Err(error) = read(bytes) {
        assert!(error.is_callers_fault(), "{error:?}");
    }
}

/// The bits of all values per frame, so that NaN equals itself.
pub(super) fn bits(stack: &Array3<f32>) -> Vec<Vec<u32>> {
    stack.axis_iter(Axis(0)).map(|f| f.iter().map(|v| v.to_bits()).collect()).collect()
}

/// A stack (frame, row, column) as arrays with each order of axes.
pub(super) fn every_order(stack: &Array3<f32>) -> [(Axes, ArrayView3<'_, f32>); 4] {
    [
        (Axes::FrameRowColumn, stack.view()),
        (Axes::RowColumnFrame, stack.view().permuted_axes([1, 2, 0])),
        (Axes::ColumnRowFrame, stack.view().permuted_axes([2, 1, 0])),
        (Axes::FrameColumnRow, stack.view().permuted_axes([0, 2, 1])),
    ]
}

/// Reads the array `mask` of a file, or its only array, with stated axes. Returns the axes that were used.
pub(super) fn read_as(path: &Path, axes: Axes) -> Result<(Option<Axes>, Array3<f32>), FormatError> {
    let expected = Expected { axes: Some(axes), ..Expected::default() };
    let wanted = Wanted { expected, ..SceneArray::Masks.into() };
    let (info, stack) = collect(&mut *open_array(path, wanted, &Limits::default())?)?;
    Ok((info.axes, stack))
}
