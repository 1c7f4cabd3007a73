use ndarray::{Array2, Array3, array};
use proptest::prelude::{any, prop, proptest};

use super::header::Header;
use super::write_f32;
use crate::test_support::{
    assert_names, every_order, file, open, ramp, read, read_as, refusal, sample, survive,
};
use crate::{Axes, Channels, FormatError, Limits, SampleType, open_stack, read_stack};

/// An npy file of version 1.0 with this dictionary.
fn npy(dictionary: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((dictionary.len() as u16).to_le_bytes());
    bytes.extend(dictionary.as_bytes());
    bytes.extend(data);
    bytes
}

fn array_file(descr: &str, fortran: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    npy(&format!("{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n"), data)
}

#[test]
fn all_data_types_are_read_in_both_byte_orders() {
    let expected = array![[[1.0f32, 2.0], [3.0, 250.0]]];
    let values = [1u8, 2, 3, 250];
    let cases: Vec<(&str, SampleType, Vec<u8>)> = vec![
        ("'|u1'", SampleType::U8, values.to_vec()),
        (
            "'<u2'",
            SampleType::U16,
            values.iter().flat_map(|&v| u16::from(v).to_le_bytes()).collect(),
        ),
        (
            "'>u2'",
            SampleType::U16,
            values.iter().flat_map(|&v| u16::from(v).to_be_bytes()).collect(),
        ),
        (
            "'<f4'",
            SampleType::F32,
            values.iter().flat_map(|&v| f32::from(v).to_le_bytes()).collect(),
        ),
        (
            "'>f4'",
            SampleType::F32,
            values.iter().flat_map(|&v| f32::from(v).to_be_bytes()).collect(),
        ),
        (
            "'<f8'",
            SampleType::F64,
            values.iter().flat_map(|&v| f64::from(v).to_le_bytes()).collect(),
        ),
        (
            "\">f8\"",
            SampleType::F64,
            values.iter().flat_map(|&v| f64::from(v).to_be_bytes()).collect(),
        ),
    ];
    for (descr, sample, data) in cases {
        for shape in ["(1, 2, 2)", "(2, 2)", "(2L, 2L)"] {
            let (info, stack) = read(&array_file(descr, "False", shape, &data)).unwrap();
            assert_eq!((info.frames, info.height, info.width, info.sample), (1, 2, 2, sample));
            assert_eq!(stack, expected, "{descr}");
        }
    }
    let (info, stack) = read(&array_file("'|b1'", "False", "(1, 3)", &[0, 1, 1])).unwrap();
    assert_eq!(info.default_full_scale.unwrap().value(), 1.0);
    assert_eq!(stack, array![[[0.0, 1.0, 1.0]]]);
}

#[test]
fn readers_return_frames_and_then_none() {
    let data: Vec<u8> = (0..12).collect();
    let mut reader = open(&array_file("'|u1'", "False", "(3, 2, 2)", &data)).unwrap();
    for k in 0..3u8 {
        let expected =
            Array2::from_shape_fn((2, 2), |(r, c)| f32::from(4 * k) + (2 * r + c) as f32);
        assert_eq!(reader.next_frame().unwrap(), Some(expected));
    }
    assert_eq!(reader.next_frame().unwrap(), None);
    assert_eq!(reader.next_frame().unwrap(), None);
}

#[test]
fn fortran_order_is_read() {
    // numpy.asfortranarray([[1, 2, 3], [4, 5, 6]]) is stored as 1 4 2 5 3 6.
    let two = array_file("'|u1'", "True", "(2, 3)", &[1, 4, 2, 5, 3, 6]);
    assert_eq!(read(&two).unwrap().1, array![[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]]);
    let three = array_file("'|u1'", "True", "(1, 2, 3)", &[1, 4, 2, 5, 3, 6]);
    assert_eq!(read(&three).unwrap().1, array![[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]]);
    let of_numpy = read_stack(&sample("snapshots-fortran.npy"), &Limits::default()).unwrap().1;
    let expected = Array3::from_shape_fn((2, 4, 5), |(k, i, j)| (100 * k + 10 * i + j) as f32);
    assert_eq!(of_numpy, expected);
}

#[test]
fn all_orders_of_axes_are_read() {
    // The stack needs the largest number of passes, and several blocks per pass.
    for shape in [(2, 3, 4), (7, 3, 5), (40, 2, 3), (3, 11, 7), (50, 10, 9)] {
        let stack = ramp(shape, 60_000);
        for (axes, array) in every_order(&stack) {
            for fortran in ["False", "True"] {
                let stored = if fortran == "True" { array.t() } else { array.view() };
                let bytes: Vec<u8> =
                    stored.iter().flat_map(|value| (*value as u16).to_le_bytes()).collect();
                let (a, b, c) = array.dim();
                let bytes = array_file("'<u2'", fortran, &format!("({a}, {b}, {c})"), &bytes);
                let result = read_as(file(&bytes).path(), axes).unwrap();
                assert_eq!(result, (Some(axes), stack.clone()), "{axes} {fortran}");
                let cut = read_as(file(&bytes[..bytes.len() - 1]).path(), axes).unwrap_err();
                assert_names(&cut.to_string(), &["cut short"]);
            }
        }
    }
    let flat = array_file("'|u1'", "False", "(2, 3)", &[1, 2, 3, 4, 5, 6]);
    let turned = read_as(file(&flat).path(), Axes::ColumnRowFrame).unwrap().1;
    assert_eq!(turned, array![[[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]]);
}

#[test]
fn unsupported_data_types_are_refused_by_name() {
    for (descr, name) in [
        ("'<c16'", "complex128"),
        ("'|O'", "a pickle"),
        ("[('a', '<f4'), ('b', '<f4')]", "structured"),
        ("'<U7'", "'<U7'"),
    ] {
        let message = refusal(&array_file(descr, "False", "(2, 2)", &[0; 64]));
        assert_names(&message, &[name, "integers and floats of 8 to 64 bits", "bool"]);
    }
}

#[test]
fn two_gigabyte_claims_in_small_files_are_refused_with_both_sizes() {
    let shape = array_file("'<f4'", "False", "(8, 8192, 8192)", &[0; 900]);
    assert_names(&refusal(&shape), &["8 frames", "8192x8192", "2147483648 bytes", "900 bytes"]);
    let mut header = b"\x93NUMPY\x02\x00\x00\x00\x00\x80".to_vec();
    header.resize(1024, b' ');
    assert_names(&refusal(&header), &["header of 2147483648 bytes", "1024 bytes"]);
}

#[test]
fn errors_of_truncated_files_count_whole_frames() {
    let message = refusal(&array_file("'<u2'", "False", "(30, 10, 10)", &[0; 200 * 12 + 7]));
    assert_names(&message, &["30 frames of 10x10 uint16", "6000 bytes", "12 whole frames", "2407"]);
    let message = refusal(&array_file("'<u2'", "False", "(1, 10)", &[0; 23]));
    assert_names(&message, &["3 bytes follow"]);
}

#[test]
fn limits_are_checked_before_the_length() {
    for (shape, what) in [
        ("(5000, 2, 2)", "frames"),
        ("(1, 9000, 2)", "height"),
        ("(1, 2, 9000)", "width"),
        ("(4000, 8000, 8000)", "frames x height x width"),
        ("(18446744073709551615, 18446744073709551615, 2)", "frames"),
        ("(0, 2, 2)", "empty"),
        ("(2, 0)", "empty"),
    ] {
        assert_names(&refusal(&array_file("'|u1'", "False", shape, &[0; 16])), &[what]);
    }
    let path = file(&array_file("'|u1'", "False", "(2, 2)", &[0; 4]));
    let limits = Limits { max_file_bytes: 10, ..Limits::default() };
    let error = open_stack(path.path(), &limits).err().unwrap();
    assert!(matches!(error, FormatError::OverLimit { limit: 10, .. }), "{error}");
}

#[test]
fn malformed_headers_are_refused() {
    for dictionary in [
        "",
        "{",
        "{}",
        "{'descr': '<f4'}",
        "{'descr': '<f4', 'fortran_order': 0, 'shape': (2, 2)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, -2)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 99999999999999999999999)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': 4}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2), 'more': 1}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2",
        "{'descr': '<f4",
        &"(".repeat(5000),
        &format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}", "(".repeat(5000)),
    ] {
        assert_names(&refusal(&npy(dictionary, &[0; 16])), &["npy", "malformed"]);
    }
    for shape in ["()", "(4,)", "(1, 1, 2, 2)"] {
        let message = refusal(&array_file("'<f4'", "False", shape, &[0; 16]));
        assert_names(&message, &["dimensions", "2 or 3"]);
    }
    assert_names(&refusal(b"\x93NUMPY\x09\x00\x10\x00"), &["version 9.0"]);
    assert_names(&refusal(b"\x93NUMPY\x01"), &["ends inside the header"]);
    assert_names(&refusal(b"\x93NUMPY\x01\x00\x05"), &["ends inside the header"]);
}

#[test]
fn written_stacks_are_read_by_ndarray_npy() {
    let stack = ramp((3, 4, 5), 1000) / 7.0;
    let path = tempfile::NamedTempFile::new().unwrap();
    write_f32(path.path(), stack.view()).unwrap();
    let read: Array3<f32> = ndarray_npy::read_npy(path.path()).unwrap();
    assert_eq!(read, stack);
    let bytes = std::fs::read(path.path()).unwrap();
    assert_eq!((bytes.len() - 3 * 4 * 5 * 4) % 64, 0);
}

#[test]
fn writers_refuse_frames_that_do_not_fit() {
    let mut writer = super::writer(Vec::new(), (1, 2, 2), Channels::Grey).unwrap();
    assert!(writer.write_frame(Array2::zeros((2, 3)).view()).is_err());
    writer.write_frame(Array2::zeros((2, 2)).view()).unwrap();
    assert!(writer.write_frame(Array2::zeros((2, 2)).view()).is_err());
    let unfinished = super::writer(Vec::new(), (1, 2, 2), Channels::Grey).unwrap();
    assert!(matches!(unfinished.finish(), Err(FormatError::Internal(_))));
}

proptest! {
    #[test]
    fn f32_stacks_survive_a_round_trip(
        (frames, height, width) in (1usize..4, 1usize..7, 1usize..7),
        seed in any::<u32>(),
    ) {
        let stack = Array3::from_shape_fn((frames, height, width), |(k, r, c)| {
            f32::from_bits(seed.wrapping_mul(1 + (k * 49 + r * 7 + c) as u32) & 0x7f7f_ffff)
        });
        let path = tempfile::NamedTempFile::new().unwrap();
        // The view is not contiguous.
        let flipped = stack.slice(ndarray::s![.., ..;-1, ..]);
        write_f32(path.path(), flipped).unwrap();
        let (info, back) = read_stack(path.path(), &Limits::default()).unwrap();
        assert_eq!(back, flipped);
        assert_eq!((info.frames, info.height, info.width), (frames, height, width));
    }

    #[test]
    fn parsing_arbitrary_headers_never_panics(text in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = Header::parse(&text);
    }

    #[test]
    fn parsing_nearly_valid_headers_never_panics(text in "[{}(),:'\"<>|ufb1248TrueFalsdcohp_ \\[\\]L-]{0,80}") {
        let _ = Header::parse(text.as_bytes());
    }

    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..144, value in any::<u8>()) {
        let mut bytes = array_file("'<u2'", "False", "(2, 4, 5)", &[7; 80]);
        let position = position % bytes.len();
        bytes[position] = value;
        survive(&bytes);
        survive(&bytes[..position]);
    }
}

#[test]
fn windows_of_written_stacks_are_read() {
    let stack = ramp((3, 5, 7), 1000);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("frames.npy");
    super::write_f32(&path, stack.view()).unwrap();
    let reader = super::open_windows(&path, &Limits::default()).unwrap();
    let window = reader.read_window(1..3, 2..4, 1..6).unwrap();
    assert_eq!(window, stack.slice(ndarray::s![1..3, 2..4, 1..6]));
    assert!(reader.read_window(0..1, 0..6, 0..1).is_err());
    // Other layouts are refused.
    let bytes = std::fs::read(&path).unwrap();
    for (from, to) in [("<f4", ">f4"), ("False", "True "), ("(3, 5, 7)", "(3, 35)  ")] {
        let text = String::from_utf8_lossy(&bytes[..128]).replace(from, to);
        let changed = [&bytes[..10], &text.as_bytes()[text.len() - 118..], &bytes[128..]].concat();
        std::fs::write(&path, changed).unwrap();
        assert!(super::open_windows(&path, &Limits::default()).is_err(), "{to}");
    }
}
