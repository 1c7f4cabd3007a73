use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::ZlibEncoder;
use ndarray::Array3;
use proptest::prelude::{any, proptest};

use super::SceneArray;
use crate::test_support::{assert_names, every_order, file, ramp, read_as, refusal};
use crate::{Axes, FormatError, Limits, SampleType, collect, open_array, read_stack};

/// The level 5 class and storage type of an array, and its samples as bytes.
struct Numbers {
    class: u32,
    storage: u32,
    bytes: Vec<u8>,
}

fn word(value: u32, big: bool) -> [u8; 4] {
    if big { value.to_be_bytes() } else { value.to_le_bytes() }
}

fn part(kind: u32, bytes: &[u8], big: bool) -> Vec<u8> {
    let mut part = word(kind, big).to_vec();
    part.extend(word(bytes.len() as u32, big));
    part.extend(bytes);
    part.resize(part.len().next_multiple_of(8), 0);
    part
}

/// An array as an element of a file.
fn matrix(name: &str, dimensions: &[i32], numbers: &Numbers, big: bool) -> Vec<u8> {
    let mut flags = word(numbers.class, big).to_vec();
    flags.extend([0; 4]);
    let mut content = part(6, &flags, big);
    let axes: Vec<u8> = dimensions.iter().flat_map(|&d| word(d as u32, big)).collect();
    content.extend(part(5, &axes, big));
    content.extend(part(1, name.as_bytes(), big));
    content.extend(part(numbers.storage, &numbers.bytes, big));
    part(14, &content, big)
}

fn compressed(element: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(element).unwrap();
    let bytes = encoder.finish().unwrap();
    let mut element = 15u32.to_le_bytes().to_vec();
    element.extend((bytes.len() as u32).to_le_bytes());
    element.extend(bytes);
    element
}

fn mat(elements: &[Vec<u8>], big: bool) -> Vec<u8> {
    let mut bytes = b"MATLAB 5.0 MAT-file, of a test".to_vec();
    bytes.resize(124, b' ');
    bytes.extend(if big { *b"\x01\x00MI" } else { *b"\x00\x01IM" });
    bytes.extend(elements.concat());
    bytes
}

/// The samples of a stack in MATLAB's order: rows vary fastest, then columns, then frames.
fn matlab_order(stack: &Array3<f32>) -> Vec<f32> {
    stack.view().permuted_axes([0, 2, 1]).iter().copied().collect()
}

fn doubles(stack: &Array3<f32>) -> Numbers {
    let bytes = matlab_order(stack).iter().flat_map(|&v| f64::from(v).to_le_bytes()).collect();
    Numbers { class: 6, storage: 9, bytes }
}

fn dimensions(stack: &Array3<f32>) -> [i32; 3] {
    let (frames, height, width) = stack.dim();
    [height as i32, width as i32, frames as i32]
}

fn element(name: &str, stack: &Array3<f32>) -> Vec<u8> {
    matrix(name, &dimensions(stack), &doubles(stack), false)
}

fn read(bytes: &[u8], array: SceneArray) -> Result<Array3<f32>, FormatError> {
    let path = file(bytes);
    Ok(collect(&mut *open_array(path.path(), array, &Limits::default())?)?.1)
}

fn refused(bytes: &[u8]) -> String {
    let error = read(bytes, SceneArray::Masks).expect_err("this file must be refused");
    assert!(error.is_callers_fault(), "{error:?}");
    error.to_string()
}

#[test]
fn plain_and_compressed_scenes_match_matfile() {
    let masks = ramp((3, 4, 5), 2);
    let measurements = ramp((2, 4, 5), 1000);
    let truth = ramp((6, 4, 5), 256);
    let plain = [element("meas", &measurements), element("mask", &masks), element("orig", &truth)];
    let packed: Vec<_> = plain.iter().map(|e| compressed(e)).collect();
    for elements in [&plain[..], &packed] {
        let bytes = mat(elements, false);
        assert_eq!(read(&bytes, SceneArray::Masks).unwrap(), masks);
        assert_eq!(read(&bytes, SceneArray::Measurements).unwrap(), measurements);
        assert_eq!(read(&bytes, SceneArray::Truth).unwrap(), truth);
        let theirs = matfile::MatFile::parse(Cursor::new(&bytes)).unwrap();
        let array = theirs.find_by_name("orig").unwrap();
        assert_eq!(array.size(), &[4, 5, 6]);
        let matfile::NumericData::Double { real, .. } = array.data() else { panic!("doubles") };
        let ours: Vec<f64> = matlab_order(&truth).iter().map(|&v| v.into()).collect();
        assert_eq!(real, &ours);
    }
    let without = read(&mat(&plain[..2], false), SceneArray::Truth).unwrap_err();
    assert!(matches!(without, FormatError::MissingArray { .. }), "{without}");
}

#[test]
fn all_classes_and_storage_types_are_read_with_their_full_scale() {
    let stack = ramp((2, 3, 4), 24);
    let values = matlab_order(&stack);
    let as_u8: Vec<u8> = values.iter().map(|&v| v as u8).collect();
    let as_u16: Vec<u8> = values.iter().flat_map(|&v| (v as u16).to_le_bytes()).collect();
    let as_f32: Vec<u8> = values.iter().flat_map(|&v| v.to_le_bytes()).collect();
    let as_i32: Vec<u8> = values.iter().flat_map(|&v| (v as i32).to_le_bytes()).collect();
    for (class, storage, bytes, sample) in [
        (6, 2, &as_u8, SampleType::F64),
        (6, 4, &as_u16, SampleType::F64),
        (6, 5, &as_i32, SampleType::F64),
        (7, 7, &as_f32, SampleType::F32),
        (9, 2, &as_u8, SampleType::U8),
        (9 | 0x200, 2, &as_u8, SampleType::Bool),
        (10, 4, &as_u16, SampleType::I16),
        (11, 4, &as_u16, SampleType::U16),
        (12, 5, &as_i32, SampleType::I32),
    ] {
        let numbers = Numbers { class, storage, bytes: bytes.clone() };
        let path = file(&mat(&[matrix("orig", &[3, 4, 2], &numbers, false)], false));
        let mut reader = open_array(path.path(), SceneArray::Truth, &Limits::default()).unwrap();
        let (info, read) = collect(&mut *reader).unwrap();
        assert_eq!((info.sample, info.default_full_scale.unwrap().value()), (sample, 255.0));
        assert_eq!(read, stack);
    }
    let as_be: Vec<u8> = values.iter().flat_map(|&v| (v as u16).to_be_bytes()).collect();
    let numbers = Numbers { class: 6, storage: 4, bytes: as_be };
    let big = mat(&[matrix("mask", &[3, 4, 2], &numbers, true)], true);
    assert_eq!(read(&big, SceneArray::Masks).unwrap(), stack);
    let flat = Numbers { class: 9, storage: 2, bytes: as_u8[..12].to_vec() };
    let two = mat(&[matrix("mask", &[3, 4], &flat, false)], false);
    assert_eq!(read(&two, SceneArray::Masks).unwrap().dim(), (1, 3, 4));
}

#[test]
fn unsupported_arrays_are_refused_by_name() {
    let numbers = |class, storage| Numbers { class, storage, bytes: vec![0; 32] };
    for (class, storage, name) in [(2, 2, "a struct"), (4, 4, "text"), (6 | 0x800, 9, "complex")] {
        let message =
            refused(&mat(&[matrix("mask", &[2, 2], &numbers(class, storage), false)], false));
        assert_names(&message, &[name, "'mask'", "double"]);
    }
    let others = [element("meas", &ramp((1, 2, 2), 9)), element("other", &ramp((1, 2, 2), 9))];
    let message = refused(&mat(&others, false));
    assert_names(&message, &["no array named 'mask'", "'meas' (2x2x1), 'other' (2x2x1)"]);
    assert_names(&refused(&mat(&[], false)), &["no array named 'mask'", "no arrays"]);
    let four = matrix("mask", &[1, 2, 2, 1], &numbers(6, 9), false);
    assert_names(&refused(&mat(&[four], false)), &["4 dimensions", "(row, column, frame)"]);
    assert_names(&refusal(&mat(&others, false)), &["'meas', 'other'", "save the array alone"]);
}

#[test]
fn the_only_array_is_read_whatever_its_name() {
    for name in ["dark", "orig", "mask"] {
        let frames = ramp((3, 4, 5), 256);
        let path = file(&mat(&[element(name, &frames)], false));
        let (info, values) = read_stack(path.path(), &Limits::default()).unwrap();
        let scale = info.default_full_scale.map(|scale| scale.value());
        assert_eq!((scale, values), (Some(1.0), frames.clone()), "{name}");
    }
    let shots = ramp((3, 4, 5), 256);
    let text = Numbers { class: 4, storage: 4, bytes: vec![0; 8] };
    let note = matrix("note", &[2, 2], &text, false);
    let bytes = mat(&[note, element("shots", &shots)], false);
    for array in [SceneArray::Masks, SceneArray::Measurements, SceneArray::Truth] {
        assert_eq!(read(&bytes, array).unwrap(), shots);
    }
    // The usual name of another role is not taken.
    let bytes = mat(&[element("meas", &shots)], false);
    assert_names(&refused(&bytes), &["no array named 'mask'", "'meas'"]);
}

#[test]
fn all_orders_of_axes_are_read() {
    // The stack needs several passes and several blocks per pass.
    for shape in [(2, 3, 4), (40, 2, 3), (3, 11, 7)] {
        let stack = ramp(shape, 200);
        for (axes, permuted) in every_order(&stack) {
            let dimensions: Vec<i32> = permuted.shape().iter().map(|&axis| axis as i32).collect();
            let bytes = permuted.t().iter().map(|&value| value as u8).collect();
            let numbers = Numbers { class: 9, storage: 2, bytes };
            let plain = matrix("mask", &dimensions, &numbers, false);
            for element in [compressed(&plain), plain] {
                let path = file(&mat(&[element], false));
                let result = read_as(path.path(), axes).unwrap();
                assert_eq!(result, (Some(axes), stack.clone()), "{axes}");
            }
        }
    }
    let flat = Numbers { class: 9, storage: 2, bytes: (0..12).collect() };
    let path = file(&mat(&[matrix("mask", &[4, 3], &flat, false)], false));
    let turned = read_as(path.path(), Axes::ColumnRowFrame).unwrap().1;
    assert_eq!(turned, ramp((1, 3, 4), 12));
}

#[test]
fn large_claims_in_small_files_are_refused_before_allocation() {
    let claim = |dimensions: &[i32], bytes: u32| {
        let mut element = matrix(
            "mask",
            dimensions,
            &Numbers { class: 6, storage: 9, bytes: vec![0; 800] },
            false,
        );
        let at = element.len() - 804;
        element[at..at + 4].copy_from_slice(&bytes.to_le_bytes());
        element
    };
    let honest = claim(&[8192, 8192, 4], 2_147_483_648);
    for element in [honest.clone(), compressed(&honest)] {
        assert_names(&refused(&mat(&[element], false)), &["'mask'", "2147483648 bytes"]);
    }
    // The outer size is also wrong, so only the expansion limit of Deflate detects it.
    let mut outer = honest;
    outer[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
    assert_names(&refused(&mat(&[compressed(&outer)], false)), &["2147483648 bytes"]);
    assert_names(&refused(&mat(&[outer], false)), &["bytes in all"]);
    let message = refused(&mat(&[claim(&[10, 10, 30], 800)], false));
    assert_names(&message, &["[10, 10, 30]", "24000 bytes", "800"]);
    assert_names(&refused(&mat(&[claim(&[9000, 2, 2], 800)], false)), &["height", "9000"]);
    assert_names(&refused(&mat(&[claim(&[10, -10, 1], 800)], false)), &["negative dimension"]);
    assert_names(&refused(&mat(&[claim(&[i32::MAX; 3], 800)], false)), &["limit"]);
}

#[test]
fn compressed_bombs_are_not_expanded_beyond_their_declared_size() {
    let mut element = element("mask", &ramp((1, 4, 4), 2));
    element.resize(50_000_000, 0);
    assert_names(&refused(&mat(&[compressed(&element)], false)), &["more bytes than its size"]);
}

#[test]
fn damage_is_detected() {
    let whole = mat(&[compressed(&element("mask", &ramp((2, 8, 8), 97)))], false);
    for length in 128..whole.len() {
        assert!(read(&whole[..length], SceneArray::Masks).is_err(), "{length}");
    }
    let mut wrong_checksum = whole.clone();
    let last = wrong_checksum.len() - 1;
    wrong_checksum[last] ^= 1;
    assert_names(&refused(&wrong_checksum), &["compressed data"]);
    let many = vec![part(1, b"", false); 1001];
    assert_names(&refused(&mat(&many, false)), &["more than 1000 elements"]);
}

proptest! {
    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..10_000, value in any::<u8>(), packed in any::<bool>()) {
        let plain = element("mask", &ramp((2, 3, 4), 97));
        let mut bytes = mat(&[if packed { compressed(&plain) } else { plain }], false);
        let position = position % bytes.len();
        bytes[position] = value;
        if let Err(error) = read(&bytes, SceneArray::Masks) {
            assert!(error.is_callers_fault(), "{error:?}");
        }
    }
}

/// A file of the shared benchmark data, if it is available.
fn shared(name: &str) -> Option<PathBuf> {
    let root = match std::env::var_os("SCI_RECON_SHARED") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"),
    };
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is not there (SCI_RECON_SHARED names the folder)", path.display());
    None
}

#[test]
fn the_benchmark_scene_satisfies_the_forward_model() {
    let Some(path) = shared("scenes/traffic48_cacti.mat") else { return };
    let read =
        |array| collect(&mut *open_array(&path, array, &Limits::default()).unwrap()).unwrap().1;
    let (masks, measurements) = (read(SceneArray::Masks), read(SceneArray::Measurements));
    let truth = read(SceneArray::Truth);
    assert_eq!(masks.dim(), (8, 256, 256));
    assert_eq!(measurements.dim(), (6, 256, 256));
    assert_eq!(truth.dim(), (48, 256, 256));
    // The measurement equals the sum of the masked frames only if all axes are read correctly.
    for (snapshot, measured) in measurements.outer_iter().enumerate() {
        let frames = truth.slice(ndarray::s![8 * snapshot..8 * snapshot + 8, .., ..]);
        let sum = (&frames * &masks).sum_axis(ndarray::Axis(0));
        let worst = (&sum - &measured).iter().fold(0f32, |m, d| m.max(d.abs()));
        assert!(worst < 0.01, "snapshot {snapshot}: {worst}");
    }
}
