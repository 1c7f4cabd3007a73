//! Reads JPEG, BMP and PNM with 8 bits as a stack of one frame, by the `image` crate. They are accepted as true frames and
//! shown to people. As masks or measurements they are refused: JPEG has altered the values, 8 bits are coarse.

use std::io::{Cursor, ErrorKind, Read};

use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader};

use super::limits::check;
use super::samples::{frame, read_error};
use super::stack::one_frame;
use super::{Channels, Format, FormatError, Limits, Reader, SampleType, StackInfo};
use crate::error::Result;

/// Largest length of a picture in bytes, which is read into memory as a whole: a frame of the largest sides in 16 bits,
/// with a margin.
pub(super) const MAX_PICTURE_BYTES: u64 = 160 << 20;

/// The bytes after the last row of a JPEG.
const END_OF_JPEG: [u8; 2] = [0xff, 0xd9];

/// Opens a grey picture. One in colours counts as grey if its channels are equal, as in a BMP with a grey palette.
pub(super) fn open(bytes: &[u8], format: Format, limits: &Limits) -> Result<Reader> {
    match decode(bytes, format, limits)? {
        (Channels::Grey, reader) => Ok(reader),
        (Channels::Rgb, _) => Err(unsupported(format, "colours".to_owned())),
    }
}

/// Opens a picture in colours; `None` for a grey one.
pub(super) fn open_colours(
    bytes: &[u8],
    format: Format,
    limits: &Limits,
) -> Result<Option<Reader>> {
    let (channels, reader) = decode(bytes, format, limits)?;
    Ok((channels == Channels::Rgb).then_some(reader))
}

fn decode(bytes: &[u8], format: Format, limits: &Limits) -> Result<(Channels, Reader)> {
    let kind = match format {
        Format::Jpeg => ImageFormat::Jpeg,
        Format::Bmp => ImageFormat::Bmp,
        Format::Pnm => ImageFormat::Pnm,
        other => return Err(FormatError::Internal(format!("{other} is not such a picture"))),
    };
    // The decoder would fill the missing rows of a JPEG.
    let content = bytes.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    if format == Format::Jpeg && !bytes[..content].ends_with(&END_OF_JPEG) {
        return Err(cut(format));
    }
    let mut decoder = ImageReader::with_format(Cursor::new(bytes), kind)
        .into_decoder()
        .map_err(|error| decoding_error(format, error))?;
    let (width, height) = decoder.dimensions();
    limits.check_shape(format, 1, height.into(), width.into())?;
    let turned = decoder.orientation().map_err(|error| decoding_error(format, error))?;
    if turned != Orientation::NoTransforms {
        return Err(unsupported(format, "a picture that is turned for display".to_owned()));
    }
    let color = decoder.color_type();
    if !matches!(color, ColorType::L8 | ColorType::Rgb8) {
        return Err(unsupported(format, format!("{color:?} pixels")));
    }
    let picture =
        DynamicImage::from_decoder(decoder).map_err(|error| decoding_error(format, error))?;
    let levels = picture.into_bytes();
    let is_grey = |pixel: &[u8]| pixel[0] == pixel[1] && pixel[1] == pixel[2];
    let (channels, levels) = match color {
        ColorType::Rgb8 if levels.chunks_exact(3).all(is_grey) => {
            (Channels::Grey, levels.into_iter().step_by(3).collect())
        }
        ColorType::Rgb8 => (Channels::Rgb, levels),
        _ => (Channels::Grey, levels),
    };
    let (height, samples) = (height as usize, width as usize * channels.count());
    let info = StackInfo::new(format, SampleType::U8, 1, height, samples);
    let values = levels.into_iter().map(f32::from).collect();
    let frame = frame(height, samples, values)?;
    Ok((channels, one_frame(info, || Ok(frame))))
}

/// Reads a picture of `length` bytes into memory. Errors: above [`MAX_PICTURE_BYTES`].
pub(super) fn read_picture(
    mut picture: impl Read,
    (format, length): (Format, u64),
) -> Result<Vec<u8>> {
    check(format, "the length of a picture in bytes", length, MAX_PICTURE_BYTES)?;
    let mut bytes = Vec::new();
    picture.read_to_end(&mut bytes).map_err(|error| read_error(format, error))?;
    Ok(bytes)
}

fn unsupported(format: Format, found: String) -> FormatError {
    FormatError::Unsupported {
        format,
        found,
        accepted: "one picture with 8 bits, upright, grey, or in colours as the truth of a colour sensor (to convert it \
                   to grey: python -c \"from PIL import Image; Image.open('in').convert('L').save('out.png')\")",
    }
}

fn cut(format: Format) -> FormatError {
    FormatError::Truncated {
        format,
        promised: "a whole picture".to_owned(),
        present: "only its beginning, or other data behind its end".to_owned(),
    }
}

fn decoding_error(format: Format, error: ImageError) -> FormatError {
    match error {
        ImageError::IoError(source) if source.kind() == ErrorKind::UnexpectedEof => cut(format),
        ImageError::Unsupported(error) => unsupported(format, error.to_string()),
        other => FormatError::malformed(format, other.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use image::{DynamicImage, ImageFormat};
    use ndarray::{Array2, Axis};
    use proptest::prelude::{any, proptest};

    use crate::mat::SceneArray;
    use crate::test_support::{assert_names, file, refusal};
    use crate::{Format, FormatError, Limits, collect, open_array, open_colours, open_shown};

    const KINDS: [(Format, ImageFormat); 3] = [
        (Format::Jpeg, ImageFormat::Jpeg),
        (Format::Bmp, ImageFormat::Bmp),
        (Format::Pnm, ImageFormat::Pnm),
    ];

    fn encoded(picture: &DynamicImage, kind: ImageFormat) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut bytes, kind).unwrap();
        bytes.into_inner()
    }

    /// A smooth picture of 24x40 pixels (rows x columns).
    fn smooth() -> DynamicImage {
        image::GrayImage::from_fn(40, 24, |x, y| image::Luma([(3 * x + 5 * y) as u8])).into()
    }

    fn read_truth(bytes: &[u8]) -> Result<Array2<f32>, FormatError> {
        let file = file(bytes);
        let mut reader = open_array(file.path(), SceneArray::Truth, &Limits::default())?;
        Ok(collect(&mut *reader)?.1.index_axis_move(Axis(0), 0))
    }

    #[test]
    fn true_frames_are_read_and_other_arrays_refused() {
        for (format, kind) in KINDS {
            let bytes = encoded(&smooth(), kind);
            let frame = read_truth(&bytes).unwrap();
            let worst = frame.indexed_iter().map(|((i, j), v)| (v - (3 * j + 5 * i) as f32).abs());
            let tolerance = if format == Format::Jpeg { 12.0 } else { 0.0 };
            assert!(worst.fold(0.0, f32::max) <= tolerance, "{format}");
            let shown = file(&bytes);
            let shown = open_shown(shown.path(), &Limits::default()).unwrap();
            assert_eq!((shown.info().format, shown.info().width), (format, 40));
            for array in [SceneArray::Masks, SceneArray::Measurements] {
                let refused = file(&bytes);
                let refused = open_array(refused.path(), array, &Limits::default()).err().unwrap();
                assert_eq!(refused.code(), "unknown_format");
                assert_names(&refused.to_string(), &[&format.to_string(), "npy"]);
            }
            assert_names(&refusal(&bytes), &[&format.to_string()]);
        }
    }

    #[test]
    fn colours_are_for_colour_sensors() {
        let colours = image::RgbImage::from_fn(8, 6, |x, y| image::Rgb([x as u8, y as u8, 200]));
        for (format, kind) in KINDS {
            let open = |picture: &DynamicImage| {
                open_colours(file(&encoded(picture, kind)).path(), &Limits::default()).unwrap()
            };
            let reader = open(&colours.clone().into()).unwrap();
            assert_eq!((reader.info().height, reader.info().width), (6, 24), "{format}");
            assert!(open(&smooth()).is_none(), "{format}");
            let refused = read_truth(&encoded(&colours.clone().into(), kind)).unwrap_err();
            assert_names(&refused.to_string(), &["colours", "convert('L')"]);
        }
    }

    #[test]
    fn cut_and_large_pictures_are_refused() {
        for (format, kind) in KINDS {
            let bytes = encoded(&smooth(), kind);
            for length in [bytes.len() / 4, bytes.len() / 2, bytes.len() - 1] {
                let refused = read_truth(&bytes[..length]).unwrap_err();
                assert!(refused.is_callers_fault(), "{format} {length}: {refused}");
            }
            let small = Limits { max_side: 39, ..Limits::default() };
            let refused = open_array(file(&bytes).path(), SceneArray::Truth, &small).err().unwrap();
            assert_eq!(refused.code(), "over_limit", "{refused}");
        }
        let wide = b"P5\n70000 2\n255\n";
        assert_eq!(read_truth(wide).unwrap_err().code(), "over_limit");
        let deep = read_truth(b"P5\n1 1\n65535\nab").unwrap_err();
        assert_names(&deep.to_string(), &["L16", "8 bits"]);
    }

    proptest! {
        #[test]
        fn damaged_pictures_are_read_or_refused(position in 0usize..10_000, value in any::<u8>()) {
            for (_, kind) in KINDS {
                let mut bytes = encoded(&smooth(), kind);
                let position = position % bytes.len();
                bytes[position] = value;
                if let Err(error) = read_truth(&bytes) {
                    assert!(error.is_callers_fault(), "{error:?}");
                }
            }
        }
    }
}
