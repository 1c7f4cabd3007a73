use std::io::{Cursor, Write};

use ::zip::ZipWriter;
use ::zip::write::SimpleFileOptions;
use ndarray::Array3;
use proptest::prelude::{any, proptest};

use crate::mat::SceneArray;
use crate::test_support::{assert_names, every_order, file, ramp, read_as, refusal, survive};
use crate::{Channels, Format, FormatError, Limits, Wanted, collect, npy, open_array};

/// The options of stored and of deflated members.
fn options() -> [SimpleFileOptions; 2] {
    use ::zip::CompressionMethod::{Deflated, Stored};
    [Stored, Deflated].map(|method| SimpleFileOptions::default().compression_method(method))
}

pub(crate) fn archive(members: &[(&str, Vec<u8>)], options: SimpleFileOptions) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in members {
        archive.start_file(*name, options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn array(stack: &Array3<f32>) -> Vec<u8> {
    let (frames, height, width) = stack.dim();
    let mut writer = npy::writer(Vec::new(), (frames, height, width), Channels::Grey).unwrap();
    stack.outer_iter().for_each(|frame| writer.write_frame(frame).unwrap());
    writer.finish().unwrap()
}

fn read(bytes: &[u8], array: SceneArray, name: Option<&str>) -> Result<Array3<f32>, FormatError> {
    let wanted = Wanted { name, ..array.into() };
    let path = file(bytes);
    let (info, stack) = collect(&mut *open_array(path.path(), wanted, &Limits::default())?)?;
    assert_eq!(info.format, Format::Npz);
    Ok(stack)
}

#[test]
fn arrays_are_read_by_name() {
    let (masks, snapshots) = (ramp((3, 4, 5), 2), ramp((2, 4, 5), 1000));
    for options in options() {
        let members = [("meas.npy", array(&snapshots)), ("mask.npy", array(&masks))];
        let bytes = archive(&members, options);
        assert_eq!(read(&bytes, SceneArray::Masks, None).unwrap(), masks);
        assert_eq!(read(&bytes, SceneArray::Measurements, None).unwrap(), snapshots);
        assert_eq!(read(&bytes, SceneArray::Masks, Some("meas")).unwrap(), snapshots);
        let missing = read(&bytes, SceneArray::Truth, None).unwrap_err().to_string();
        assert_names(&missing, &["npz", "'orig'", "'meas' (2x4x5), 'mask' (3x4x5)"]);
        assert_names(&refusal(&bytes), &["'meas.npy', 'mask.npy'", "save the array alone"]);
        // The only array needs no name, and a clip may be called frames.
        let only = archive(&[("arr_0.npy", array(&masks))], options);
        assert_eq!(read(&only, SceneArray::Masks, None).unwrap(), masks);
        let clip = [("frames.npy", array(&snapshots)), ("other.npy", array(&masks))];
        assert_eq!(read(&archive(&clip, options), SceneArray::Truth, None).unwrap(), snapshots);
        for (axes, permuted) in every_order(&masks) {
            let bytes = archive(&[("mask.npy", array(&permuted.to_owned()))], options);
            assert_eq!(read_as(file(&bytes).path(), axes).unwrap(), (Some(axes), masks.clone()));
        }
    }
}

#[test]
fn two_arrays_of_one_name_are_refused() {
    let [stored, _] = options();
    let (one, other) = (array(&ramp((3, 4, 5), 2)), array(&ramp((3, 4, 5), 1000)));
    // The crate does not write such archives.
    let mut bytes = archive(&[("mask.npy", one), ("musk.npy", other)], stored);
    for at in 0..bytes.len() - 8 {
        if &bytes[at..at + 8] == b"musk.npy" {
            bytes[at + 1] = b'a';
        }
    }
    for name in [None, Some("mask")] {
        let error = read(&bytes, SceneArray::Masks, name).unwrap_err();
        assert!(matches!(error, FormatError::Malformed { .. }), "{error}");
        assert_names(&error.to_string(), &["two members", "'mask.npy'"]);
    }
}

#[test]
fn damage_is_detected() {
    for options in options() {
        let bytes = archive(&[("mask.npy", array(&ramp((3, 4, 5), 251)))], options);
        for length in 1..bytes.len() {
            let error = read(&bytes[..length], SceneArray::Masks, None).expect_err("cut");
            assert!(error.is_callers_fault(), "{length}: {error:?}");
        }
        // Damage a value, and the checksum.
        let mut wrong = bytes.clone();
        let at = bytes.len() / 2;
        wrong[at] ^= 1;
        assert!(read(&wrong, SceneArray::Masks, None).is_err());
    }
}

#[test]
fn claims_beyond_the_file_are_refused_before_allocation() {
    let bytes = archive(&[("mask.npy", array(&ramp((1, 2, 2), 9)))], options()[1]);
    let entry = bytes.windows(4).position(|part| part == b"PK\x01\x02").unwrap();
    let patched = |at: usize, value: u32| {
        let mut bytes = bytes.clone();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        bytes
    };
    // More than Deflate can expand, a section outside the file, a directory of 2 GB.
    let message = |bytes: &[u8]| read(bytes, SceneArray::Masks, None).unwrap_err().to_string();
    assert_names(&message(&patched(entry + 24, 0x7fff_ffff)), &["'mask.npy' of 2147483647 bytes"]);
    assert_names(&message(&patched(entry + 20, 0x7fff_ffff)), &["bytes in all"]);
    let end = bytes.len() - 22;
    assert_names(&message(&patched(end + 12, 0x7fff_ffff)), &["directory", "2147483647"]);
    let encrypted = {
        let mut bytes = bytes.clone();
        bytes[entry + 8] |= 1;
        bytes
    };
    assert_names(&message(&encrypted), &["encrypted", "zipfile"]);
}

#[test]
fn archive_bombs_are_not_expanded_beyond_their_declared_size() {
    let mut content = array(&ramp((1, 4, 4), 2));
    let honest = content.len();
    content.resize(20_000_000, 0);
    let mut bytes = archive(&[("mask.npy", content)], options()[1]);
    let entry = bytes.windows(4).position(|part| part == b"PK\x01\x02").unwrap();
    bytes[entry + 24..entry + 28].copy_from_slice(&(honest as u32).to_le_bytes());
    let error = read(&bytes, SceneArray::Masks, None).unwrap_err().to_string();
    assert_names(&error, &["more bytes than its size"]);
}

proptest! {
    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..10_000, value in any::<u8>(), packed in any::<bool>()) {
        let members = [("mask.npy", array(&ramp((2, 3, 4), 97))), ("b.npy", array(&ramp((1, 2, 2), 9)))];
        let mut bytes = archive(&members, options()[usize::from(packed)]);
        let position = position % bytes.len();
        bytes[position] = value;
        survive(&bytes);
        if let Err(error) = read(&bytes, SceneArray::Masks, None) {
            assert!(error.is_callers_fault(), "{error:?}");
        }
    }
}
