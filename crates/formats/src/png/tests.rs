use ::png::{BitDepth, ColorType, Encoder};
use ndarray::{array, s};
use proptest::prelude::{any, proptest};

use crate::display::{Encoding, Picture};
use crate::test_support::{assert_names, open, ramp, read, refusal, survive};
use crate::{Channels, SampleType};

fn png(color: ColorType, depth: BitDepth, width: u32, height: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == ColorType::Indexed {
        encoder.set_palette(vec![0; 12]);
    }
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    bytes
}

fn sixteen(height: usize, width: usize) -> Vec<u8> {
    let frame = ramp((1, height, width), 65536);
    let frame = frame.slice(s![0, .., ..]);
    let picture = Picture::with_16_bits(frame, Channels::Grey, (0.0, 65535.0)).unwrap();
    picture.encode(Encoding::Png).unwrap()
}

/// Length and checksum of a chunk.
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut bytes = (data.len() as u32).to_be_bytes().to_vec();
    bytes.extend(kind);
    bytes.extend(data);
    let mut crc = flate2::Crc::new();
    crc.update(&bytes[4..]);
    bytes.extend(crc.sum().to_be_bytes());
    bytes
}

#[test]
fn grey_8_and_16_bit_values_are_read_as_stored() {
    let eight = png(ColorType::Grayscale, BitDepth::Eight, 3, 2, &[0, 1, 2, 253, 254, 255]);
    let (info, stack) = read(&eight).unwrap();
    assert_eq!((info.frames, info.height, info.width, info.sample), (1, 2, 3, SampleType::U8));
    assert_eq!(stack, array![[[0.0, 1.0, 2.0], [253.0, 254.0, 255.0]]]);
    let (info, stack) = read(&sixteen(300, 301)).unwrap();
    assert_eq!(info.sample, SampleType::U16);
    assert_eq!(stack, ramp((1, 300, 301), 65536));
}

#[test]
fn unsupported_kinds_are_refused_by_name() {
    for (color, depth, bytes, name) in [
        (ColorType::Rgb, BitDepth::Eight, 12, "Rgb"),
        (ColorType::Rgba, BitDepth::Sixteen, 32, "Rgba"),
        (ColorType::GrayscaleAlpha, BitDepth::Eight, 8, "GrayscaleAlpha"),
        (ColorType::Indexed, BitDepth::Eight, 4, "Indexed"),
        (ColorType::Grayscale, BitDepth::Two, 2, "Two bit"),
        (ColorType::Grayscale, BitDepth::Four, 2, "Four bit"),
    ] {
        let message = refusal(&png(color, depth, 2, 2, &vec![0; bytes]));
        assert_names(&message, &[name, "PNG", "Grayscale", "Sixteen"]);
    }
}

#[test]
fn truncated_files_are_refused() {
    let whole = sixteen(9, 9);
    let data_ends = whole.len() - 12 - 4;
    for length in 0..data_ends {
        let error = read(&whole[..length]).expect_err("cut");
        assert!(error.is_callers_fault(), "{length}: {error:?}");
    }
    assert_names(&refusal(&whole[..data_ends - 40]), &["cut short"]);
}

#[test]
fn large_claims_in_small_files_are_refused_before_allocation() {
    let claim = |width: u32, height: u32| {
        let mut header = width.to_be_bytes().to_vec();
        header.extend(height.to_be_bytes());
        header.extend([16, 0, 0, 0, 0]);
        let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
        bytes.extend(chunk(b"IHDR", &header));
        bytes.extend(chunk(b"IDAT", &[0x78, 0x9c, 3, 0, 0, 0, 0, 1]));
        bytes.extend(chunk(b"IEND", &[]));
        bytes
    };
    let huge = claim(8192, 8192);
    let length = format!("{} bytes", huge.len());
    assert_names(&refusal(&huge), &["8192x8192 uint16", "134217728 bytes", &length]);
    assert_names(&refusal(&claim(70_000, 2)), &["width", "70000", "8192"]);
    assert!(open(&claim(0, 2)).is_err());
    let mut chunk_claim = b"\x89PNG\r\n\x1a\n".to_vec();
    chunk_claim.extend(u32::MAX.to_be_bytes());
    chunk_claim.extend(b"IHDR");
    assert!(open(&chunk_claim).is_err());
}

proptest! {
    #[test]
    fn damaged_files_are_read_or_refused(position in 0usize..10_000, value in any::<u8>()) {
        let mut bytes = sixteen(7, 5);
        let position = position % bytes.len();
        bytes[position] = value;
        survive(&bytes);
    }
}
