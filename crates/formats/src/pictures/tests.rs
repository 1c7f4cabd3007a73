use ::zip::write::SimpleFileOptions;
use ndarray::Array3;
use proptest::prelude::{any, proptest};

use super::Parts;
use crate::display::{Encoding, Picture};
use crate::npz::tests::archive;
use crate::test_support::{assert_names, file, ramp, read, read_as, refusal, sample, survive};
use crate::{Axes, Channels, Format, Limits, SampleType, open_stack};

/// The frames as 8-bit PNG pictures.
fn pictures(stack: &Array3<f32>) -> Vec<Vec<u8>> {
    stack
        .outer_iter()
        .map(|frame| {
            let picture = Picture::new(frame, Channels::Grey, (0.0, 255.0)).unwrap();
            picture.encode(Encoding::Png).unwrap()
        })
        .collect()
}

fn zipped(members: &[(&str, Vec<u8>)]) -> Vec<u8> {
    archive(members, SimpleFileOptions::default())
}

/// A tar header with its content.
fn tar_member(name: &str, kind: u8, content: &[u8]) -> Vec<u8> {
    let mut head = vec![0; 512];
    head[..name.len()].copy_from_slice(name.as_bytes());
    head[124..136].copy_from_slice(format!("{:011o}\0", content.len()).as_bytes());
    head[148..156].fill(b' ');
    head[156] = kind;
    head[257..265].copy_from_slice(b"ustar\x0000");
    let sum: u64 = head.iter().map(|byte| u64::from(*byte)).sum();
    head[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    head.extend(content);
    head.resize(head.len().next_multiple_of(512), 0);
    head
}

fn tar(members: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let members = members.iter().map(|(name, content)| tar_member(name, b'0', content));
    members.chain([vec![0; 1024]]).flatten().collect()
}

#[test]
fn pictures_are_read_in_numeric_order() {
    let stack = ramp((3, 4, 5), 200);
    let pngs = pictures(&stack);
    let members = |names: [&'static str; 3]| -> Vec<(&str, Vec<u8>)> {
        [1, 2, 0].map(|k| (names[k], pngs[k].clone())).into()
    };
    for names in [
        ["shot_9.png", "shot_10.png", "shot_11.png"],
        ["run 2/0001.png", "run 2/0002.png", "run 2/0003.png"],
        ["7", "8", "9"],
    ] {
        for (bytes, format) in
            [(zipped(&members(names)), Format::Zip), (tar(&members(names)), Format::Tar)]
        {
            let (info, frames) = read(&bytes).unwrap();
            assert_eq!((info.format, info.sample, info.axes), (format, SampleType::U8, None));
            assert_eq!(frames, stack, "{names:?}");
            assert!(read_as(file(&bytes).path(), Axes::FrameRowColumn).is_ok());
            let other = read_as(file(&bytes).path(), Axes::RowColumnFrame).unwrap_err();
            assert_names(&other.to_string(), &["omit `axes`"]);
        }
    }
    let tiff = std::fs::read(sample("mask-1-bit.tif")).unwrap();
    let (info, _) = read(&zipped(&[("m1.tif", tiff.clone()), ("m2.tif", tiff)])).unwrap();
    assert_eq!((info.frames, info.sample), (2, SampleType::Bool));
}

#[test]
fn hidden_files_are_skipped_and_other_files_refused() {
    let png = pictures(&ramp((1, 4, 5), 200)).remove(0);
    let several = |names: &[&'static str]| -> Vec<(&str, Vec<u8>)> {
        names.iter().map(|name| (*name, png.clone())).collect()
    };
    let mut members = several(&["a1.png", "a2.png"]);
    members.push(("__MACOSX/._a1.png", b"no picture".to_vec()));
    for name in [".DS_Store", "README.txt", "ReadMe", "Thumbs.db", "scan/desktop.ini", "camera.xml"]
    {
        members.push((name, b"no picture".to_vec()));
    }
    assert_eq!(read(&zipped(&members)).unwrap().0.frames, 2);
    for (names, words) in [
        (
            &["a1.png", "a2.png", "a4.png"][..],
            &["'a4.png' after 'a2.png'", "missing", "zipfile"][..],
        ),
        (&["a1.png", "a01.png"], &["same number"]),
        (&["a1.png", "b2.png"], &["'b2.png' among 'aN.png'"]),
        (&["a1.png", "a2.PNG"], &["'a2.PNG'"]),
        (&["a1.png", "overview.png"], &["'overview.png'", "has no number"]),
        (&["a1/mask.png"], &["has no number"]),
        (&["a9999999999999999999999999999999999999999.png"], &["has no number"]),
        (&["a1_b2.png", "a2_b1.png"], &["'a1_b2.png'", "one number in the names rises"]),
        (&["a1_b1.png", "a2_b1.png", "a1_b2.png", "a2_b2.png"], &["same number"]),
        (&["a1.png", "a2.png", "a4_1.png"], &["'a4_1.png' among 'aN.png'"]),
        (&["a10_1.png", "a20_3.png"], &["'a20_3.png' after 'a10_1.png'", "missing"]),
    ] {
        let message = refusal(&zipped(&several(names)));
        assert_names(&message, words);
        assert_names(&refusal(&tar(&several(names))), &words[..1]);
    }
    assert_names(&refusal(&zipped(&[])), &["no pictures"]);
    assert_names(
        &refusal(&zipped(&[("a1.jpg", b"text".to_vec())])),
        &["'a1.jpg'", "neither PNG nor TIFF"],
    );
    let pages = std::fs::read(sample("masks-bool.tif")).unwrap();
    assert_names(&refusal(&zipped(&[("a1.tif", pages)])), &["3 pages"]);
    let other = pictures(&ramp((1, 5, 4), 200)).remove(0);
    let mixed = [("a1.png", png.clone()), ("a2.png", other)];
    assert_names(&refusal(&zipped(&mixed)), &["'a2.png' is 5x4 uint8, but 'a1.png' is 4x5"]);
    let damaged = [("a1.png", png[..40].to_vec())];
    assert_names(&refusal(&zipped(&damaged)), &["'a1.png': the PNG"]);
    let path = file(&zipped(&several(&["a1.png", "a2.png", "a3.png"])));
    let limits = Limits { max_frames: 2, ..Limits::default() };
    let message = open_stack(path.path(), &limits).err().unwrap().to_string();
    assert_names(&message, &["number of frames is 3"]);
}

#[test]
fn tar_lengths_and_checksums_are_verified() {
    let png = pictures(&ramp((1, 4, 5), 200)).remove(0);
    let whole = tar(&[("a1.png", png.clone()), ("a2.png", png.clone())]);
    assert!(read(&whole).is_ok());
    let mut wrong = whole.clone();
    wrong[0] = b'b';
    assert_names(&refusal(&wrong), &["header at byte 0 is damaged"]);
    // Cut in a member, before one, in its header, and before the end.
    let second = whole.len() - 1024 - (512 + png.len().next_multiple_of(512));
    for length in [530, second, second + 100, second + 511, whole.len() - 1024, whole.len() - 1000]
    {
        let refused = refusal(&whole[..length]);
        assert_names(&refused, &["cut short"]);
    }
    // Long names are stored in separate members; folders are skipped.
    let long = format!("{}/a7.png", "folder".repeat(40));
    let pax = format!("{} path={long}\n", long.len() + 10);
    for (kind, name) in [(b'L', format!("{long}\0")), (b'x', pax)] {
        let bytes: Vec<u8> = [
            tar_member("folder", b'5', b""),
            tar_member("name", kind, name.as_bytes()),
            tar_member("cut", b'0', &png),
            vec![0; 1024],
        ]
        .concat();
        assert_eq!(read(&bytes).unwrap().0.frames, 1);
    }
    let endless = tar_member("name", b'L', &vec![b'a'; 1 << 17]);
    assert_names(&refusal(&endless), &["a name of 131072 bytes"]);
    let sparse = tar_member("sparse", b'S', b"");
    assert_names(&refusal(&sparse), &["kind 'S'", "regular files"]);
    // A member without content may be a frame that is missing.
    for (kind, text) in [(b'1', "--hard-dereference"), (b'2', "a link"), (b'6', "a pipe")] {
        let member = tar_member("a3.png", kind, b"");
        assert_names(
            &refusal(&[whole[..whole.len() - 1024].to_vec(), member].concat()),
            &["a3.png", text],
        );
    }
}

#[test]
fn names_are_split_at_the_numbers_of_the_file() {
    let parts = |name: &'static str| Parts::of(name).map(|parts| (parts.texts, parts.numbers));
    assert_eq!(parts("a7/b2_003.tif"), Some((vec!["a7/b", "_", ".tif"], vec![2, 3])));
    assert_eq!(parts("17"), Some((vec!["", ""], vec![17])));
    assert_eq!(parts("mp4.png"), Some((vec!["mp", ".png"], vec![4])));
    assert_eq!(parts("ä1.png"), Some((vec!["ä", ".png"], vec![1])));
    for name in ["", "a.png", "a.7", "1/a.png", "a9999999999999999999999999999999999999999.png"] {
        assert_eq!(parts(name), None, "{name}");
    }
}

#[test]
fn a_second_counter_may_rise_with_the_first() {
    let stack = ramp((3, 4, 5), 200);
    let pngs = pictures(&stack);
    for names in [
        ["f1_t0.png", "f2_t250.png", "f3_t1000.png"],
        ["t090_1.png", "t100_2.png", "t110_3.png"],
        [
            "cam1_20260131_235959.9_1.png",
            "cam1_20260201_000000.1_2.png",
            "cam1_20260201_000000.3_3.png",
        ],
    ] {
        let members: Vec<_> = [2, 0, 1].map(|k| (names[k], pngs[k].clone())).into();
        assert_eq!(read(&zipped(&members)).unwrap().1, stack, "{names:?}");
    }
}

proptest! {
    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..10_000, value in any::<u8>(), zip in any::<bool>()) {
        let pngs = pictures(&ramp((2, 4, 5), 200));
        let members = [("a1.png", pngs[0].clone()), ("a2.png", pngs[1].clone())];
        let mut bytes = if zip { zipped(&members) } else { tar(&members) };
        let position = position % bytes.len();
        bytes[position] = value;
        survive(&bytes);
        survive(&bytes[..position]);
    }

    #[test]
    fn splitting_never_panics(name in ".{0,20}") {
        if let Some(Parts { texts, numbers }) = Parts::of(&name) {
            assert_eq!(texts.len(), numbers.len() + 1);
            assert!(name.starts_with(texts[0]) && name.ends_with(texts[numbers.len()]));
        }
    }
}
