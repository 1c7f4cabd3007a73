use ndarray::{Array3, ArrayView2, Axis, array, s};

use super::{Attributes, Stack, open_windows, read_stack};
use crate::test_support::{assert_names, bits, file, ramp};
use crate::{Channels, FormatError, Limits};

/// The file of a stack of frames.
pub(super) fn stored(
    frames: &Array3<f32>,
    channels: Channels,
    parts: &[Attributes],
) -> Result<Vec<u8>, FormatError> {
    let (_, height, samples) = frames.dim();
    let stack = Stack::new((height, samples / channels.count()), channels, parts)?;
    let mut bytes = stack.head();
    for (k, frame) in frames.outer_iter().enumerate() {
        stack.lines().encode((k, 0), frame, &mut bytes);
    }
    Ok(bytes)
}

/// The file of frame `k`, derived from the file of a stack.
fn frame_of(bytes: &[u8], k: usize, shape: (usize, usize, usize), channels: Channels) -> Vec<u8> {
    let stack = Stack::read(bytes, shape, channels).unwrap();
    let mut derived = stack.frame_head(k);
    let line_bytes = stack.lines().stored_bytes();
    let lines = bytes[stack.head().len()..].chunks_exact(line_bytes);
    for line in lines.skip(k * shape.1).take(shape.1) {
        stack.lines().frame_line(line, &mut derived);
    }
    derived
}

fn read(bytes: &[u8]) -> (Vec<super::Part>, Array3<f32>) {
    read_stack(file(bytes).path(), &Limits::default()).unwrap()
}

/// A stack with NaN, infinities, negative zero and subnormal values.
fn special_values() -> Array3<f32> {
    let mut stack = ramp((3, 37, 21), 1 << 20).mapv(|v| (v * 0.37).sin() / 3.0);
    let special = [f32::NAN, -0.0, f32::INFINITY, f32::NEG_INFINITY, 1e-42, f32::MAX, f32::MIN];
    for (value, special) in stack.iter_mut().zip(special) {
        *value = special;
    }
    stack[[2, 36, 20]] = f32::from_bits(0x7fc0_1234);
    stack
}

fn attributes(k: usize) -> Attributes {
    Attributes {
        texts: vec![
            ("sciReconJob".to_owned(), format!("job {k} µ")),
            ("sciReconManifest".to_owned(), "{\"a\": 1}".repeat(200)),
        ],
        frame_time_s: Some(0.1 * k as f64),
        frames_per_second: Some(1000.0 / 3.0),
        exposure_s: Some(0.01),
        wavelength_nm: None,
    }
}

#[test]
fn a_single_frame_keeps_its_values_and_attributes() {
    let stack = special_values();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    let bytes = stored(&stack, Channels::Grey, &parts).unwrap();
    for k in 0..3 {
        let (read_parts, back) = read(&frame_of(&bytes, k, (3, 37, 21), Channels::Grey));
        assert_eq!(bits(&back), bits(&stack)[k..=k]);
        let [part] = &*read_parts else { panic!("one part") };
        assert_eq!(part.texts["sciReconJob"], format!("job {k} µ"));
        assert_eq!(part.texts["sciReconManifest"].len(), 1600);
        assert_eq!(part.frame_time_s, Some(0.1 * k as f64));
        assert_eq!(part.frames_per_second, Some((333_333, 1000)));
        assert_eq!(part.name, "");
    }
    // A stack of one frame.
    let one = stack.slice(s![1..2, .., ..]).to_owned();
    let bytes = stored(&one, Channels::Grey, &parts[1..2]).unwrap();
    assert_eq!(read(&bytes).0[0].name, "frame_0001");
    let (parts, back) = read(&frame_of(&bytes, 0, (1, 37, 21), Channels::Grey));
    assert_eq!((bits(&back), &*parts[0].name), (bits(&one), ""));
}

#[test]
fn channels_of_bands_have_the_names_of_their_wavelengths() {
    let stack = ramp((2, 5, 7), 1 << 20);
    let part = |wavelength| Attributes { wavelength_nm: Some(wavelength), ..attributes(0) };
    let bytes = stored(&stack, Channels::Grey, &[part(453.25), part(700.0)]).unwrap();
    for name in [&b"S0.453,25nm\0"[..], b"S0.700nm\0"] {
        assert!(bytes.windows(name.len()).any(|window| window == name));
    }
    assert_eq!(bits(&read(&bytes).1), bits(&stack));
}

#[test]
fn stacks_are_stored_bit_for_bit() {
    let stack = special_values();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    let (parts, back) = read(&stored(&stack, Channels::Grey, &parts).unwrap());
    assert_eq!(bits(&back), bits(&stack));
    let names: Vec<_> = parts.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["frame_0001", "frame_0002", "frame_0003"]);
    assert_eq!(parts[2].texts["sciReconJob"], "job 2 µ");
}

#[test]
fn colours_are_stored_bit_for_bit() {
    let stack = special_values();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    let bytes = stored(&stack, Channels::Rgb, &parts).unwrap();
    assert_eq!(bits(&read(&bytes).1), bits(&stack));
    let frame = frame_of(&bytes, 2, (3, 37, 7), Channels::Rgb);
    assert_eq!(bits(&read(&frame).1), bits(&stack)[2..]);
}

#[test]
fn windows_of_a_stack_are_read_alone() {
    let frames = special_values();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    for channels in [Channels::Grey, Channels::Rgb] {
        let shape = (3, 37, 21 / channels.count());
        let stack = file(&stored(&frames, channels, &parts).unwrap());
        let reader = open_windows(stack.path(), shape, channels).unwrap();
        for (k, rows, columns) in
            [(0..3, 0..37, 0..21), (1..3, 5..9, 3..9), (2..3, 36..37, 20..21), (0..1, 4..4, 7..8)]
        {
            let window = reader.read_window(k.clone(), rows.clone(), columns.clone()).unwrap();
            let expected = frames.slice(s![k, rows, columns]).to_owned();
            assert_eq!(bits(&window), bits(&expected));
        }
        let lattice = reader.read_lattice(1..2, (1..37, 2..21), 4).unwrap();
        assert_eq!(bits(&lattice), bits(&frames.slice(s![1..2, 1..37;4, 2..21;4]).to_owned()));
        let long = open_windows(stack.path(), (9, shape.1, shape.2), channels);
        assert!(matches!(long, Err(FormatError::Truncated { .. })), "{long:?}");
    }
}

#[test]
fn transposed_views_are_written_in_logical_order() {
    let frame = array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
    let stack = Stack::new((3, 2), Channels::Grey, &[Attributes::default()]).unwrap();
    let mut bytes = stack.head();
    let frame: ArrayView2<'_, f32> = frame.t();
    stack.lines().encode((0, 0), frame, &mut bytes);
    assert_eq!(read(&bytes).1.index_axis(Axis(0), 0), frame);
}

#[test]
fn invalid_attributes_are_refused() {
    let frame = Array3::zeros((1, 2, 2));
    let long = "x".repeat(256);
    for names in [vec![""], vec!["twice", "twice"], vec!["channels"], vec!["expTime"], vec![&long]]
    {
        let texts = names.iter().map(|n| ((*n).to_owned(), "value".to_owned())).collect();
        let attributes = Attributes { texts, ..Attributes::default() };
        let result = stored(&frame, Channels::Grey, &[attributes]);
        assert!(matches!(result, Err(FormatError::Internal(_))), "{names:?}: {result:?}");
    }
    let empty = Array3::zeros((1, 0, 2));
    assert!(stored(&empty, Channels::Grey, &[Attributes::default()]).is_err());
}

#[test]
fn truncated_files_are_refused() {
    let bytes = stored(&special_values(), Channels::Grey, &vec![Attributes::default(); 3]).unwrap();
    for length in (0..bytes.len() - 1).step_by(7) {
        let error = read_stack(file(&bytes[..length]).path(), &Limits::default()).unwrap_err();
        assert!(error.is_callers_fault(), "{length}: {error:?}");
    }
    let limits = Limits { max_frames: 2, ..Limits::default() };
    let error = read_stack(file(&bytes).path(), &limits).unwrap_err();
    assert_names(&error.to_string(), &["frames", "3", "2"]);
}

#[test]
fn equal_frames_give_equal_files() {
    let frames = special_values();
    let attributes: Vec<Attributes> = (0..frames.dim().0).map(attributes).collect();
    // The order of a hash map differs between instances, so a few files suffice to detect it.
    let files = (0..4).map(|_| stored(&frames, Channels::Grey, &attributes).unwrap());
    let files: Vec<_> = files.collect();
    assert!(files.iter().all(|file| *file == files[0]));
}
