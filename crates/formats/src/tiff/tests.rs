use std::io::Cursor;

use ::tiff::encoder::{Compression, DeflateLevel, Predictor, TiffEncoder, colortype};
use ndarray::{Array3, Axis};
use proptest::prelude::{any, proptest};

use crate::test_support::{assert_names, file, open, ramp, read, refusal, sample, survive};
use crate::{FormatError, Limits, SampleType, open_stack, read_stack};

/// The pages of a stack as a TIFF of type `C`.
macro_rules! pages {
    ($constructor:ident, $color:ty, $inner:ty, $stack:expr, $compression:expr) => {{
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder =
            TiffEncoder::$constructor(&mut bytes).unwrap().with_compression($compression);
        if !matches!($compression, Compression::Uncompressed) {
            encoder = encoder.with_predictor(Predictor::Horizontal);
        }
        for frame in $stack.axis_iter(Axis(0)) {
            let values: Vec<$inner> = frame.iter().map(|v| *v as $inner).collect();
            let (height, width) = (frame.nrows() as u32, frame.ncols() as u32);
            encoder.write_image::<$color>(width, height, &values).unwrap();
        }
        bytes.into_inner()
    }};
}

const COMPRESSIONS: [Compression; 4] = [
    Compression::Uncompressed,
    Compression::Lzw,
    Compression::Deflate(DeflateLevel::Balanced),
    Compression::Packbits,
];

fn stack16() -> Array3<f32> {
    ramp((3, 5, 7), 60_000) * 500.0
}

fn uncompressed() -> Vec<u8> {
    pages!(new, colortype::Gray16, u16, stack16(), Compression::Uncompressed)
}

/// Type and value of an entry of a page header.
#[derive(Clone, Copy)]
enum Value {
    Short(u16),
    Long(u32),
}

/// A TIFF of one page with just these tags, and `data` at byte 8.
fn page(big_endian: bool, tags: &[(u16, Value)], data: &[u8]) -> Vec<u8> {
    let u16s = |v: u16| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
    let u32s = |v: u32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
    let mut bytes = if big_endian { b"MM\0\x2a".to_vec() } else { b"II\x2a\0".to_vec() };
    bytes.extend(u32s(8 + data.len() as u32));
    bytes.extend(data);
    bytes.extend(u16s(tags.len() as u16));
    for (tag, value) in tags {
        bytes.extend(u16s(*tag));
        match value {
            Value::Short(v) => {
                bytes.extend(u16s(3));
                bytes.extend(u32s(1));
                bytes.extend(u16s(*v));
                bytes.extend([0, 0]);
            }
            Value::Long(v) => {
                bytes.extend(u16s(4));
                bytes.extend(u32s(1));
                bytes.extend(u32s(*v));
            }
        }
    }
    bytes.extend([0; 4]);
    bytes
}

/// The tags of a grey page in one strip at byte 8.
fn grey(width: u32, height: u32, bits: u16, strip_bytes: u32) -> Vec<(u16, Value)> {
    vec![
        (256, Value::Long(width)),
        (257, Value::Long(height)),
        (258, Value::Short(bits)),
        (259, Value::Short(1)),
        (262, Value::Short(1)),
        (273, Value::Long(8)),
        (277, Value::Short(1)),
        (278, Value::Long(height)),
        (279, Value::Long(strip_bytes)),
    ]
}

fn with(mut tags: Vec<(u16, Value)>, tag: u16, value: Value) -> Vec<(u16, Value)> {
    tags.retain(|(t, _)| *t != tag);
    tags.push((tag, value));
    tags.sort_by_key(|(t, _)| *t);
    tags
}

#[test]
fn all_types_and_compressions_are_read() {
    for compression in COMPRESSIONS {
        let stack = stack16();
        let (info, read16) =
            read(&pages!(new, colortype::Gray16, u16, stack, compression)).unwrap();
        assert_eq!((info.frames, info.height, info.width), (3, 5, 7));
        assert_eq!(
            (info.sample, info.default_full_scale.unwrap().value()),
            (SampleType::U16, 65535.0)
        );
        assert_eq!(read16, stack);
        let (_, big) = read(&pages!(new_big, colortype::Gray16, u16, stack, compression)).unwrap();
        assert_eq!(big, stack);
        let eight = ramp((2, 4, 6), 256);
        let (info, read8) = read(&pages!(new, colortype::Gray8, u8, eight, compression)).unwrap();
        assert_eq!((info.sample, read8), (SampleType::U8, eight));
    }
    let float = ramp((2, 40, 30), 1 << 20) / 3.0;
    let bytes = pages!(new, colortype::Gray32Float, f32, float, Compression::Uncompressed);
    let (info, read32) = read(&bytes).unwrap();
    assert_eq!((info.sample, read32), (SampleType::F32, float));
}

#[test]
fn readers_return_frames_and_then_none() {
    let mut reader = open(&uncompressed()).unwrap();
    for expected in stack16().outer_iter() {
        assert_eq!(reader.next_frame().unwrap().unwrap(), expected);
    }
    assert!(reader.next_frame().unwrap().is_none());
}

#[test]
fn big_endian_pages_are_read() {
    let data = [0, 1, 1, 0, 255, 255, 0, 0];
    let bytes = page(true, &grey(2, 2, 16, 8), &data);
    assert_eq!(read(&bytes).unwrap().1, ndarray::array![[[1.0, 256.0], [65535.0, 0.0]]]);
}

#[test]
fn unsupported_samples_are_refused_by_name() {
    let signed = with(grey(2, 2, 16, 8), 339, Value::Short(2));
    assert_names(&refusal(&page(false, &signed, &[0; 8])), &["signed 16-bit", "page 0"]);
    let half = with(grey(2, 2, 16, 8), 339, Value::Short(3));
    assert_names(&refusal(&page(false, &half, &[0; 8])), &["16-bit float"]);
    assert_names(&refusal(&page(false, &grey(2, 2, 32, 16), &[0; 16])), &["unsigned 32-bit"]);
    assert_names(&refusal(&page(false, &grey(8, 2, 4, 8), &[0; 8])), &["unsigned 4-bit"]);
    let palette = with(grey(2, 2, 8, 4), 262, Value::Short(3));
    assert_names(&refusal(&page(false, &palette, &[0; 4])), &["RGBPalette"]);
    let inverted = with(grey(2, 2, 8, 4), 262, Value::Short(0));
    assert_names(&refusal(&page(false, &inverted, &[0; 4])), &["WhiteIsZero", "BlackIsZero"]);
    let two_samples = with(grey(2, 2, 8, 8), 277, Value::Short(2));
    assert_names(&refusal(&page(false, &two_samples, &[0; 8])), &["Multiband"]);
    let jpeg = with(grey(2, 2, 8, 4), 259, Value::Short(7));
    assert_names(&refusal(&page(false, &jpeg, &[0; 4])), &["compression number 7", "LZW"]);
    let mut rgb = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut rgb).unwrap();
    encoder.write_image::<colortype::RGB8>(2, 2, &[0; 12]).unwrap();
    assert_names(&refusal(rgb.get_ref()), &["RGB colours", "page 0"]);
}

#[test]
fn pages_of_different_sizes_are_refused_with_both() {
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<colortype::Gray8>(4, 3, &[1; 12]).unwrap();
    encoder.write_image::<colortype::Gray8>(3, 4, &[1; 12]).unwrap();
    assert_names(&refusal(bytes.get_ref()), &["page 1 is 4x3", "page 0 is 3x4"]);
}

#[test]
fn large_claims_in_small_files_are_refused_before_allocation() {
    let whole = page(false, &grey(2, 2, 8, 4), &[0; 812]);
    let length = format!("{} bytes in all", whole.len());
    let outside = page(false, &grey(8192, 8192, 16, u32::MAX), &[0; 812]);
    assert_names(&refusal(&outside), &["page 0", "8 to 4294967303", &length]);
    let float = with(grey(8192, 8192, 32, 2_147_483_648), 339, Value::Short(3));
    assert_names(&refusal(&page(false, &float, &[0; 800])), &["2147483656", "934 bytes in all"]);
    let honest = page(false, &grey(8192, 8192, 16, 100), &[0; 800]);
    assert_names(&refusal(&honest), &["8192x8192 uint16", "134217728 bytes", "100 stored bytes"]);
    // 800 bytes of Deflate expand to less than a megabyte.
    let deflated = with(grey(8192, 8192, 16, 800), 259, Value::Short(8));
    assert_names(&refusal(&page(false, &deflated, &[0; 800])), &["134217728 bytes", "800 stored"]);
    assert_names(&refusal(&page(false, &grey(70_000, 2, 8, 4), &[0; 8])), &["width", "70000"]);
    // The number of strip offsets exceeds first the file, then the limit.
    let entry = 8 + 812 + 2 + 5 * 12;
    let mut many = whole.clone();
    many[entry + 4..entry + 8].copy_from_slice(&2_000_000u32.to_le_bytes());
    assert_names(&refusal(&many), &["2000000 values for tag 273", "8000000 bytes", &length]);
    many.resize(10_000_000, 0);
    assert_names(&refusal(&many), &["number of values of a tag", "2000000", "262144"]);
    let tiles = with(grey(2, 2, 8, 4), 322, Value::Long(1 << 31));
    let tiles = with(with(tiles, 323, Value::Long(16)), 324, Value::Long(8));
    let mut tiles = with(tiles, 325, Value::Long(4));
    tiles.retain(|(tag, _)| ![273, 278, 279].contains(tag));
    assert_names(&refusal(&page(false, &tiles, &[0; 4])), &["tiles of width 2147483648"]);
}

#[test]
fn too_many_pages_and_cycles_are_refused() {
    let path = file(&uncompressed());
    let limits = Limits { max_frames: 2, ..Limits::default() };
    let error = open_stack(path.path(), &limits).err().unwrap();
    assert!(matches!(error, FormatError::OverLimit { value: 3, limit: 2, .. }), "{error}");
    let mut cycle = page(false, &grey(2, 2, 8, 4), &[0; 4]);
    let end = cycle.len();
    cycle[end - 4..].copy_from_slice(&12u32.to_le_bytes());
    assert!(open(&cycle).err().unwrap().is_callers_fault());
}

/// A file with ImageJ's layout above 4 GB: a big-endian page of 2x3 pixels that start at `start`, and an image count.
fn imagej(images: &str, bits: u16, start: u32) -> Vec<u8> {
    let text = format!("ImageJ=1.53\nimages={images}\nslices={images}\n\0");
    let mut data = vec![0; 4];
    data.extend(text.as_bytes());
    let tags = grey(3, 2, bits, 6 * u32::from(bits) / 8);
    let tags = with(with(tags, 270, Value::Long(12)), 273, Value::Long(start));
    let tags = if bits == 32 { with(tags, 339, Value::Short(3)) } else { tags };
    let mut bytes = page(true, &tags, &data);
    // The description: type ASCII, length and offset.
    let entry = 8 + data.len() + 2 + 5 * 12;
    bytes[entry + 3] = 2;
    bytes[entry + 4..entry + 8].copy_from_slice(&(text.len() as u32).to_be_bytes());
    bytes
}

#[test]
fn imagej_images_after_one_header_are_read() {
    let stack = ramp((30, 2, 3), 200);
    let whole = |bits: u16, pixels: &dyn Fn(f32) -> Vec<u8>| {
        let mut bytes = imagej("30", bits, 400);
        bytes.resize(400, 0);
        bytes.extend(stack.iter().flat_map(|value| pixels(*value)));
        bytes
    };
    let eight = whole(8, &|value| vec![value as u8]);
    let float = whole(32, &|value| value.to_be_bytes().into());
    let sixteen = whole(16, &|value| (value as u16).to_be_bytes().into());
    for bytes in [&eight, &float, &sixteen] {
        assert_eq!(read(bytes).unwrap().1, stack);
        assert_names(&refusal(&bytes[..bytes.len() - 1]), &["30 images of 2x3", "cut short"]);
    }
    for (images, words) in [
        ("9999999999999", ["number of frames", "limit"]),
        ("4096", ["4096 images of 2x3 uint16", "cut short"]),
    ] {
        let mut bytes = imagej(images, 16, 400);
        bytes.resize(800, 0);
        assert_names(&refusal(&bytes), &words);
    }
    let mut packed = eight.clone();
    let entry = packed.windows(2).position(|tag| tag == [1, 3]).unwrap();
    packed[entry + 8..entry + 10].copy_from_slice(&8u16.to_be_bytes());
    assert_names(&refusal(&packed), &["ImageJ stack of 30 images", "not compressed"]);
}

#[test]
fn imagej_images_beyond_4_gb_are_read() {
    use std::io::{Seek, SeekFrom, Write};
    let stack = ramp((30, 2, 3), 200);
    let start = u32::MAX - 50;
    let mut path = file(&imagej("30", 16, start));
    path.seek(SeekFrom::Start(start.into())).unwrap();
    let pixels: Vec<u8> = stack.iter().flat_map(|value| (*value as u16).to_be_bytes()).collect();
    path.write_all(&pixels).unwrap();
    let (info, frames) = read_stack(path.path(), &Limits::default()).unwrap();
    assert_eq!((info.frames, frames), (30, stack));
    assert!(path.as_file().metadata().unwrap().len() > 1 << 32);
}

#[test]
fn truncated_files_are_refused() {
    for compression in COMPRESSIONS {
        let whole = pages!(new, colortype::Gray16, u16, stack16(), compression);
        for length in 0..whole.len() - 1 {
            let error = read(&whole[..length]).expect_err("cut");
            assert!(error.is_callers_fault(), "{length}: {error:?}");
        }
    }
    let cut_in_pixels = page(false, &grey(2, 2, 8, 400), &[0; 4]);
    assert_names(&refusal(&cut_in_pixels), &["cut short", "bytes 8 to 408"]);
}

proptest! {
    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..10_000, value in any::<u8>(), which in 0usize..4) {
        let mut bytes = pages!(new, colortype::Gray16, u16, stack16(), COMPRESSIONS[which]);
        let position = position % bytes.len();
        bytes[position] = value;
        survive(&bytes);
    }
}

#[test]
fn bits_and_doubles_from_other_programs_are_read() {
    let read = |name: &str| read_stack(&sample(name), &Limits::default()).unwrap();
    let masks = Array3::from_shape_fn((3, 4, 5), |(k, i, j)| ((k + 2 * i + 3 * j) % 2) as f32);
    let (info, values) = read("masks-bool.tif");
    assert_eq!((info.sample, values), (SampleType::Bool, masks.clone()));
    let (info, values) = read("mask-1-bit.tif");
    assert_eq!(info.sample, SampleType::Bool);
    assert_eq!(values.index_axis(Axis(0), 0), masks.index_axis(Axis(0), 0));
    let (info, values) = read("snapshots-float64.tif");
    assert_eq!(info.sample, SampleType::F64);
    let snapshots = Array3::from_shape_fn((2, 4, 5), |(k, i, j)| (100 * k + 10 * i + j) as f32);
    assert_eq!(values, snapshots);
}
