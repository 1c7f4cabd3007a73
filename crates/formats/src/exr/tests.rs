use ndarray::{Array2, Array3, Axis, array};

use super::{Attributes, read_stack, write_frame, write_stack};
use crate::test_support::{assert_names, bits, file, ramp};
use crate::{Channels, FormatError, Limits};

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
fn frames_are_stored_bit_for_bit_with_their_attributes() {
    let stack = special_values();
    let path = tempfile::NamedTempFile::new().unwrap();
    write_frame(path.path(), stack.index_axis(ndarray::Axis(0), 0), Channels::Grey, &attributes(3))
        .unwrap();
    let (parts, back) = read_stack(path.path(), &Limits::default()).unwrap();
    assert_eq!(bits(&back), bits(&stack)[..1]);
    let [part] = &*parts else { panic!("one part") };
    assert_eq!(part.texts["sciReconJob"], "job 3 µ");
    assert_eq!(part.texts["sciReconManifest"].len(), 1600);
    assert_eq!(part.frame_time_s, Some(0.1 * 3.0));
    assert_eq!(part.frames_per_second, Some((333_333, 1000)));
    assert_eq!(part.name, "");
}

#[test]
fn channels_of_bands_have_the_names_of_their_wavelengths() {
    let stack = ramp((4, 5, 7), 1 << 20);
    let path = tempfile::NamedTempFile::new().unwrap();
    let part = |wavelength| Attributes { wavelength_nm: Some(wavelength), ..attributes(0) };
    let parts = [453.25, 700.000_000_000_000_1, 500.0, 500.000_000_1].map(part);
    write_stack(path.path(), (5, 7), Channels::Grey, &parts, |k| {
        Ok::<_, FormatError>(stack.index_axis(ndarray::Axis(0), k).to_owned())
    })
    .unwrap();
    let bytes = std::fs::read(path.path()).unwrap();
    for name in [&b"S0.453,25nm\0"[..], b"S0.700nm\0", b"S0.500nm\0", b"S0.500,0000001nm\0"] {
        assert!(bytes.windows(name.len()).any(|window| window == name));
    }
    let (_, back) = read_stack(path.path(), &Limits::default()).unwrap();
    assert_eq!(bits(&back), bits(&stack));
}

#[test]
fn stacks_are_stored_bit_for_bit_and_request_frames_in_order() {
    let stack = special_values();
    let path = tempfile::NamedTempFile::new().unwrap();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    let mut requested = Vec::new();
    write_stack(path.path(), (37, 21), Channels::Grey, &parts, |k| {
        requested.push(k);
        Ok::<_, FormatError>(stack.index_axis(ndarray::Axis(0), k).to_owned())
    })
    .unwrap();
    assert_eq!(requested, [0, 1, 2]);
    let (parts, back) = read_stack(path.path(), &Limits::default()).unwrap();
    assert_eq!(bits(&back), bits(&stack));
    let names: Vec<_> = parts.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["frame_0001", "frame_0002", "frame_0003"]);
    assert_eq!(parts[2].texts["sciReconJob"], "job 2 µ");
}

#[test]
fn colours_are_stored_bit_for_bit() {
    let stack = special_values();
    let path = tempfile::NamedTempFile::new().unwrap();
    let parts: Vec<_> = (0..3).map(attributes).collect();
    write_stack(path.path(), (37, 7), Channels::Rgb, &parts, |k| {
        Ok::<_, FormatError>(stack.index_axis(Axis(0), k).to_owned())
    })
    .unwrap();
    assert_eq!(bits(&read_stack(path.path(), &Limits::default()).unwrap().1), bits(&stack));
    write_frame(path.path(), stack.index_axis(Axis(0), 2), Channels::Rgb, &parts[2]).unwrap();
    assert_eq!(bits(&read_stack(path.path(), &Limits::default()).unwrap().1), bits(&stack)[2..]);
}

#[test]
fn transposed_views_are_written_in_logical_order() {
    let frame = array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
    let path = tempfile::NamedTempFile::new().unwrap();
    write_frame(path.path(), frame.t(), Channels::Grey, &Attributes::default()).unwrap();
    let (_, back) = read_stack(path.path(), &Limits::default()).unwrap();
    assert_eq!(back.index_axis(ndarray::Axis(0), 0), frame.t());
}

#[test]
fn errors_of_the_source_are_returned() {
    let path = tempfile::NamedTempFile::new().unwrap();
    let parts = vec![Attributes::default(); 2];
    let result = write_stack(path.path(), (2, 2), Channels::Grey, &parts, |k| match k {
        0 => Ok(Array2::zeros((2, 2))),
        _ => Err(FormatError::AllMasksZero { frames: 77 }),
    });
    assert!(matches!(result, Err(FormatError::AllMasksZero { frames: 77 })));
    let result =
        write_stack(path.path(), (2, 2), Channels::Grey, &parts, |_| Ok(Array2::zeros((2, 3))));
    assert!(matches!(result, Err(FormatError::Internal(_))), "{result:?}");
}

#[test]
fn invalid_attributes_are_refused() {
    let path = tempfile::NamedTempFile::new().unwrap();
    let frame = Array2::zeros((2, 2));
    let long = "x".repeat(256);
    for names in [vec![""], vec!["twice", "twice"], vec!["channels"], vec!["expTime"], vec![&long]]
    {
        let texts = names.iter().map(|n| ((*n).to_owned(), "value".to_owned())).collect();
        let attributes = Attributes { texts, ..Attributes::default() };
        let result = write_frame(path.path(), frame.view(), Channels::Grey, &attributes);
        assert!(matches!(result, Err(FormatError::Internal(_))), "{names:?}: {result:?}");
    }
    let empty = Array2::zeros((0, 2));
    assert!(
        write_frame(path.path(), empty.view(), Channels::Grey, &Attributes::default()).is_err()
    );
}

#[test]
fn truncated_files_are_refused() {
    let path = tempfile::NamedTempFile::new().unwrap();
    let stack = special_values();
    let parts = vec![Attributes::default(); 3];
    write_stack(path.path(), (37, 21), Channels::Grey, &parts, |k| {
        Ok::<_, FormatError>(stack.index_axis(ndarray::Axis(0), k).to_owned())
    })
    .unwrap();
    let bytes = std::fs::read(path.path()).unwrap();
    for length in (0..bytes.len() - 1).step_by(7) {
        let error = read_stack(file(&bytes[..length]).path(), &Limits::default()).unwrap_err();
        assert!(error.is_callers_fault(), "{length}: {error:?}");
    }
    let limits = Limits { max_frames: 2, ..Limits::default() };
    let error = read_stack(path.path(), &limits).unwrap_err();
    assert_names(&error.to_string(), &["frames", "3", "2"]);
}

#[test]
fn equal_frames_give_equal_files() {
    let folder = tempfile::tempdir().unwrap();
    let frames = special_values();
    let attributes: Vec<Attributes> = (0..frames.dim().0).map(attributes).collect();
    // The order of a hash map differs between instances, so a few files suffice to detect it.
    let files: Vec<(Vec<u8>, Vec<u8>)> = (0..4)
        .map(|_| {
            let path = folder.path().join("frame.exr");
            write_frame(&path, frames.index_axis(Axis(0), 0), Channels::Grey, &attributes[0])
                .unwrap();
            let frame = std::fs::read(&path).unwrap();
            let (_, height, width) = frames.dim();
            write_stack(&path, (height, width), Channels::Grey, &attributes, |k| {
                Ok::<_, FormatError>(frames.index_axis(Axis(0), k).to_owned())
            })
            .unwrap();
            (frame, std::fs::read(&path).unwrap())
        })
        .collect();
    assert!(files.iter().all(|pair| *pair == files[0]));
}
