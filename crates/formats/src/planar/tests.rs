use std::ops::Range;
use std::path::Path;

use ndarray::{Array3, s};
use proptest::prelude::proptest;

use super::{Reader, writer};
use crate::test_support::{assert_names, file, ramp};
use crate::{FormatError, Limits};

fn planar(stack: &Array3<f32>) -> Vec<u8> {
    let (frames, height, width) = stack.dim();
    let mut writer = writer(Vec::new(), frames, height, width).unwrap();
    for frame in stack.outer_iter() {
        writer.write_frame(frame).unwrap();
    }
    writer.finish().unwrap()
}

fn read_window(
    path: &Path,
    frames: Range<usize>,
    rows: Range<usize>,
    columns: Range<usize>,
    limits: &Limits,
) -> Result<Array3<f32>, FormatError> {
    Reader::open(path, limits)?.read_window(frames, rows, columns)
}

fn refusal(bytes: &[u8]) -> String {
    Reader::open(file(bytes).path(), &Limits::default()).unwrap_err().to_string()
}

#[test]
fn inconsistent_headers_are_refused_with_both_sizes() {
    let good = planar(&ramp((2, 3, 4), 100));
    assert_eq!(good.len(), 32 + 96);
    assert_names(&refusal(&good[..100]), &["2 frames of 3x4", "128 bytes", "100 bytes"]);
    assert_names(&refusal(&good[..20]), &["20 bytes"]);
    let mut long = good.clone();
    long.push(0);
    assert_names(&refusal(&long), &["1 bytes follow", "2 frames of 3x4"]);
    let change = |at: usize, value: u32| {
        let mut bytes = good.clone();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        refusal(&bytes)
    };
    assert_names(&change(0, 0), &["signature"]);
    assert_names(&change(8, 2), &["version 2"]);
    assert_names(&change(12, u32::MAX), &["frames", "4294967295", "4096"]);
    assert_names(&change(16, 8192), &["2 frames of 8192x4", "128 bytes"]);
    assert_names(&change(20, 0), &["empty"]);
}

#[test]
fn windows_outside_the_stack_are_internal_errors() {
    let path = file(&planar(&ramp((2, 3, 4), 100)));
    let limits = Limits::default();
    for (frames, rows, columns) in [(0..3, 0..3, 0..4), (0..2, 0..4, 0..4), (0..2, 0..3, 2..5)] {
        let error = read_window(path.path(), frames, rows, columns, &limits).unwrap_err();
        assert!(matches!(error, FormatError::Internal(_)), "{error}");
    }
    let empty = read_window(path.path(), 1..1, 0..0, 0..4, &limits).unwrap();
    assert_eq!(empty.dim(), (0, 0, 4));
}

proptest! {
    #[test]
    fn windows_equal_slices_of_the_whole(
        (frames, height, width) in (1usize..4, 1usize..9, 1usize..9),
        a in 0usize..1000, b in 0usize..1000, c in 0usize..1000,
    ) {
        let stack = ramp((frames, height, width), 1 << 20);
        let path = file(&planar(&stack));
        let range = |seed: usize, axis: usize| {
            let start = seed % axis;
            start..start + 1 + (seed / axis) % (axis - start)
        };
        let (f, r, c) = (range(a, frames), range(b, height), range(c, width));
        let window = read_window(path.path(), f.clone(), r.clone(), c.clone(), &Limits::default());
        assert_eq!(window.unwrap(), stack.slice(s![f, r, c]));
        let reader = Reader::open(path.path(), &Limits::default()).unwrap();
        assert_eq!(reader.read_window(0..frames, 0..height, 0..width).unwrap(), stack);
    }
}
