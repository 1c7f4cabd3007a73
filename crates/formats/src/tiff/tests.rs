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
        if !matches!($compression, Compression::Uncompressed | Compression::Packbits) {
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
    let float = with(grey(2, 2, 24, 12), 339, Value::Short(3));
    assert_names(&refusal(&page(false, &float, &[0; 12])), &["24-bit float", "page 0"]);
    assert_names(&refusal(&page(false, &grey(2, 2, 24, 12), &[0; 12])), &["unsigned 24-bit"]);
    let signed = with(grey(2, 2, 12, 6), 339, Value::Short(2));
    assert_names(&refusal(&page(false, &signed, &[0; 6])), &["signed 12-bit"]);
    let undefined = with(grey(2, 2, 8, 4), 339, Value::Short(4));
    assert_names(&refusal(&page(false, &undefined, &[0; 4])), &["sample format 4"]);
    for (tag, value, words) in [
        (262, 3, &["palette", "display only"][..]),
        (262, 0, &["WhiteIsZero", "BlackIsZero"]),
        (262, 5, &["CMYK"]),
        (277, 2, &["2 samples per pixel"]),
        (259, 7, &["compression number 7", "LZW"]),
        (274, 6, &["orientation 6", "as they are stored"]),
        (317, 2, &["predictor 2", "compression number 1"]),
    ] {
        let tags = with(grey(2, 2, 8, 8), tag, Value::Short(value));
        assert_names(&refusal(&page(false, &tags, &[0; 8])), words);
    }
    let reversed = with(grey(2, 2, 32, 16), 266, Value::Short(2));
    assert_names(&refusal(&page(false, &reversed, &[0; 16])), &["FillOrder 2"]);
    let metamorph = with(grey(2, 2, 8, 4), 33629, Value::Long(9));
    let mut planes = page(false, &metamorph, &[0; 32]);
    let entry = planes.windows(2).position(|tag| tag == 33629u16.to_le_bytes()).unwrap();
    planes[entry + 4] = 3;
    planes[entry + 8] = 8;
    assert_names(&refusal(&planes), &["MetaMorph stack of 3 planes"]);
    let mut rgb = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut rgb).unwrap();
    encoder.write_image::<colortype::RGB8>(2, 2, &[0; 12]).unwrap();
    assert_names(&refusal(rgb.get_ref()), &["RGB colours", "page 0"]);
}

#[test]
fn integers_and_half_floats_are_read() {
    let read = |bits, format, bytes: &[u8]| {
        let tags = with(grey(2, 1, bits, bytes.len() as u32), 339, Value::Short(format));
        let (info, frames) = read(&page(true, &tags, bytes)).unwrap();
        (info.sample, frames.into_raw_vec_and_offset().0)
    };
    assert_eq!(read(8, 2, &[255, 3]), (SampleType::I8, vec![-1.0, 3.0]));
    assert_eq!(read(16, 2, &[255, 254, 1, 0]), (SampleType::I16, vec![-2.0, 256.0]));
    assert_eq!(
        read(32, 2, &[255, 255, 255, 255, 0, 0, 1, 0]),
        (SampleType::I32, vec![-1.0, 256.0])
    );
    assert_eq!(read(32, 1, &[0, 1, 0, 0, 0, 0, 0, 7]), (SampleType::U32, vec![65536.0, 7.0]));
    assert_eq!(read(16, 3, &[0x3c, 0, 0xc0, 0]), (SampleType::F16, vec![1.0, -2.0]));
}

#[test]
fn samples_of_any_bit_depth_are_unpacked() {
    for (bits, bytes, values) in [
        (2, &[0b00_01_10_11, 0b11_00_00_00][..], [0.0, 1.0, 2.0, 3.0, 3.0]),
        (4, &[0x12, 0x3f, 0xe0], [1.0, 2.0, 3.0, 15.0, 14.0]),
        (10, &[0xff, 0xc0, 0x10, 0x08, 0x03, 0x00, 0x40], [1023.0, 1.0, 2.0, 3.0, 1.0]),
        (12, &[0x12, 0x3f, 0xff, 0x00, 0x10, 0x02, 0x80, 0x00], [291.0, 4095.0, 1.0, 2.0, 2048.0]),
    ] {
        let (info, frames) =
            read(&page(false, &grey(5, 1, bits, bytes.len() as u32), bytes)).unwrap();
        assert_eq!(frames.into_raw_vec_and_offset().0, values, "{bits}");
        let largest = f32::from((1u16 << bits) - 1);
        assert_eq!(
            (info.default_full_scale.unwrap().value(), info.largest),
            (largest, Some(largest))
        );
    }
}

#[test]
fn bits_in_reverse_order_are_read() {
    let reversed = |tags| with(tags, 266, Value::Short(2));
    let one = page(false, &reversed(grey(10, 1, 1, 2)), &[0b0000_0101, 0b0000_0010]);
    assert_eq!(
        read(&one).unwrap().1.into_raw_vec_and_offset().0,
        [1., 0., 1., 0., 0., 0., 0., 0., 0., 1.]
    );
    for big_endian in [false, true] {
        let sixteen = page(big_endian, &reversed(grey(1, 1, 16, 2)), &[0b1000_0000, 0b0100_0000]);
        let expected = if big_endian { 0x0102 } else { 0x0201 };
        assert_eq!(read(&sixteen).unwrap().1[[0, 0, 0]], expected as f32);
    }
}

#[test]
fn palettes_of_greys_are_read_as_numbers() {
    let map = |step: u32| (0..768u32).flat_map(move |k| ((k % 256 * step) as u16).to_le_bytes());
    let file = |step: u32| {
        let mut data = vec![0, 3, 255, 7];
        data.extend(map(step));
        let tags = with(grey(2, 2, 8, 4), 262, Value::Short(3));
        let mut bytes = page(false, &with(tags, 320, Value::Long(12)), &data);
        let entry = bytes.windows(4).rposition(|tag| tag == [64, 1, 4, 0]).unwrap();
        bytes[entry + 2] = 3;
        bytes[entry + 4..entry + 8].copy_from_slice(&768u32.to_le_bytes());
        bytes
    };
    for step in [256, 257] {
        assert_eq!(read(&file(step)).unwrap().1, ndarray::array![[[0.0, 3.0], [255.0, 7.0]]]);
    }
    assert_names(&refusal(&file(200)), &["colours of a palette"]);
}

#[test]
fn frames_follow_the_order_of_the_ome_xml() {
    let xml = |planes: &str| {
        format!(
            "<OME xmlns=\"x\"><Image><Pixels DimensionOrder=\"XYCZT\" SizeC=\"1\" SizeZ=\"1\" \
             SizeT=\"3\">{planes}</Pixels></Image></OME>"
        )
    };
    let order = |planes: &str| super::ome::order(&xml(planes), 3);
    assert_eq!(super::ome::order("ImageJ=1.53", 3).unwrap(), None);
    assert_eq!(order("<TiffData/>").unwrap(), Some(vec![0, 1, 2]));
    assert_eq!(order("").unwrap(), Some(vec![0, 1, 2]));
    let turned =
        "<TiffData IFD=\"1\" FirstT=\"0\" PlaneCount=\"2\"/><TiffData IFD=\"0\" FirstT=\"2\"/>";
    assert_eq!(order(turned).unwrap(), Some(vec![1, 2, 0]));
    for (planes, words) in [
        ("<TiffData IFD=\"0\"/>", "3 planes"),
        ("<TiffData IFD=\"0\" PlaneCount=\"4\"/>", "does not fit"),
        ("<TiffData IFD=\"1\" PlaneCount=\"3\"/>", "does not fit"),
        ("<TiffData IFD=\"0\" PlaneCount=\"3\"/><TiffData IFD=\"0\"/>", "does not fit"),
        ("<TiffData IFD=\"99999999999\" FirstT=\"99999999999\"/>", "does not fit"),
        ("<TiffData IFD=\"x\"/>", "not a number"),
        ("<TiffData", "OME-XML of page 0"),
    ] {
        assert_names(&order(planes).unwrap_err().to_string(), &[words]);
    }
    let elsewhere = "<OME UUID=\"a\"><Image><Pixels SizeT=\"1\"><TiffData><UUID>b</UUID></TiffData></Pixels></Image></OME>";
    assert_names(&super::ome::order(elsewhere, 1).unwrap_err().to_string(), &["in other files"]);
    let binary = "<OME><BinaryOnly MetadataFile=\"a\"/></OME>";
    assert_names(&super::ome::order(binary, 1).unwrap_err().to_string(), &["in another file"]);
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
    assert_names(&refusal(&packed), &["stack of 30 images", "not compressed"]);
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
