//! Pictures that people look at: levels of a display window, reduced and encoded by the `image` crate.

use std::io::Cursor;
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::codecs::webp::WebPEncoder;
use image::{DynamicImage, ImageBuffer, ImageError, Luma, Primitive, Rgb};
use ndarray::{Array2, ArrayView2};

use super::{Channels, FormatError};
use crate::error::Result;

/// Quality of a JPEG, from 1 to 100. Errors of single levels are not visible.
const JPEG_QUALITY: u8 = 90;

/// An encoding of pictures. PNG and WebP are lossless.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// PNG.
    Png,
    /// WebP, lossless.
    WebP,
    /// JPEG.
    Jpeg,
}

impl Encoding {
    /// All encodings.
    pub const ALL: [Self; 3] = [Self::Png, Self::WebP, Self::Jpeg];

    /// The media type, such as `image/png`.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Png => "image/png",
            Self::WebP => "image/webp",
            Self::Jpeg => "image/jpeg",
        }
    }
}

/// A picture with 8 or 16 bits per channel.
#[derive(Debug)]
pub struct Picture(DynamicImage);

impl Picture {
    /// A picture with 8 bits per channel. Values are mapped linearly from \[black, white\] to \[0, 255\] and clipped; NaN
    /// becomes 0. `frame` has the axes (row, column), with all channels of a pixel in adjacent columns.
    ///
    /// Errors: [`FormatError::Internal`] unless `black < white`, both finite, and for a frame without pixels.
    pub fn new(
        frame: ArrayView2<'_, f32>,
        channels: Channels,
        (black, white): (f32, f32),
    ) -> Result<Self> {
        let factor = 255.0 / (white - black);
        let levels = frame.iter().map(|value| ((value - black) * factor).round() as u8).collect();
        Self::of(frame.dim(), channels, (black, white), levels)
    }

    /// As [`Self::new`], with 16 bits per channel and levels from 0 to 65535.
    ///
    /// Errors: as [`Self::new`].
    pub fn with_16_bits(
        frame: ArrayView2<'_, f32>,
        channels: Channels,
        (black, white): (f32, f32),
    ) -> Result<Self> {
        let factor = 65535.0 / (white - black);
        let levels = frame.iter().map(|value| ((value - black) * factor).round() as u16).collect();
        Self::of(frame.dim(), channels, (black, white), levels)
    }

    fn of<T: Primitive>(
        (height, samples): (usize, usize),
        channels: Channels,
        (black, white): (f32, f32),
        levels: Vec<T>,
    ) -> Result<Self>
    where
        DynamicImage: From<ImageBuffer<Luma<T>, Vec<T>>> + From<ImageBuffer<Rgb<T>, Vec<T>>>,
        Luma<T>: image::Pixel<Subpixel = T>,
        Rgb<T>: image::Pixel<Subpixel = T>,
    {
        if !(black.is_finite() && white.is_finite() && black < white) {
            return Err(FormatError::Internal(format!(
                "a picture has black {black} and white {white}; black must be below white"
            )));
        }
        let side = |length: usize| u32::try_from(length).ok().filter(|length| *length > 0);
        let picture =
            side(height).zip(side(samples / channels.count())).and_then(|(height, width)| {
                match channels {
                    Channels::Grey => ImageBuffer::<Luma<T>, _>::from_raw(width, height, levels)
                        .map(DynamicImage::from),
                    Channels::Rgb => ImageBuffer::<Rgb<T>, _>::from_raw(width, height, levels)
                        .map(DynamicImage::from),
                }
            });
        let unfit = || FormatError::Internal(format!("a picture has {height}x{samples} samples"));
        picture.map(Self).ok_or_else(unfit)
    }

    /// Reduces the picture so that neither side exceeds `side` pixels. A smaller one is unchanged.
    #[must_use]
    pub fn within(self, side: usize) -> Self {
        let side = u32::try_from(side).unwrap_or(u32::MAX);
        if self.0.width().max(self.0.height()) <= side {
            return self;
        }
        Self(self.0.thumbnail(side, side))
    }

    /// Divides the sides by `step`, rounded up.
    #[must_use]
    pub fn reduced(self, step: usize) -> Self {
        let step = u32::try_from(step).unwrap_or(u32::MAX).max(1);
        let (width, height) = (self.0.width().div_ceil(step), self.0.height().div_ceil(step));
        if step == 1 { self } else { Self(self.0.thumbnail_exact(width, height)) }
    }

    /// The levels (row, column), with all channels of a pixel in adjacent columns.
    ///
    /// Errors: [`FormatError::Internal`] if they have 16 bits.
    pub fn into_levels(self) -> Result<Array2<u8>> {
        let rows = self.0.height() as usize;
        let bytes = self.0.into_bytes();
        Array2::from_shape_vec((rows, bytes.len() / rows.max(1)), bytes)
            .map_err(|error| FormatError::Internal(error.to_string()))
    }

    /// The bytes of a file.
    ///
    /// Errors: [`FormatError::Internal`] for 16 bits in another encoding than PNG.
    pub fn encode(&self, encoding: Encoding) -> Result<Vec<u8>> {
        let mut bytes = Cursor::new(Vec::new());
        // Higher levels of compression gain little, because the low bits are noise.
        let (fast, filter) = (CompressionType::Fast, FilterType::Adaptive);
        let written = match encoding {
            Encoding::Png => {
                self.0.write_with_encoder(PngEncoder::new_with_quality(&mut bytes, fast, filter))
            }
            Encoding::WebP => self.0.write_with_encoder(WebPEncoder::new_lossless(&mut bytes)),
            Encoding::Jpeg => {
                self.0.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY))
            }
        };
        let failed = |error: ImageError| FormatError::Internal(format!("{encoding:?}: {error}"));
        written.map_err(failed)?;
        Ok(bytes.into_inner())
    }

    /// Writes a PNG, and replaces an existing file.
    ///
    /// Errors: as [`Self::encode`]; I/O.
    pub fn write_png(&self, path: &Path) -> Result<()> {
        std::fs::write(path, self.encode(Encoding::Png)?).map_err(FormatError::io("write the PNG"))
    }
}

#[cfg(test)]
mod tests {
    use image::DynamicImage;
    use ndarray::{Array2, array};

    use super::{Encoding, Picture};
    use crate::{Channels, FormatError, Limits, read_stack};

    #[test]
    fn levels_are_mapped_and_clipped() {
        let path = tempfile::NamedTempFile::new().unwrap();
        let frame = array![[-1.0, 0.0, 0.25], [0.5, 9.0, f32::NAN]];
        let deep = Picture::with_16_bits(frame.view(), Channels::Grey, (0.0, 0.5)).unwrap();
        deep.write_png(path.path()).unwrap();
        let (_, stack) = read_stack(path.path(), &Limits::default()).unwrap();
        assert_eq!(stack, array![[[0.0, 0.0, 32768.0], [65535.0, 65535.0, 0.0]]]);
        let picture = || Picture::new(frame.view(), Channels::Grey, (0.0, 0.5)).unwrap();
        assert_eq!(picture().into_levels().unwrap(), array![[0, 0, 128], [255, 255, 0]]);
        for encoding in [Encoding::Png, Encoding::WebP] {
            let decoded = image::load_from_memory(&picture().encode(encoding).unwrap()).unwrap();
            assert_eq!(decoded.into_luma8().into_raw(), [0, 0, 128, 255, 255, 0], "{encoding:?}");
        }
        for (black, white) in [(1.0, 1.0), (2.0, 1.0), (0.0, f32::NAN), (f32::NEG_INFINITY, 0.0)] {
            let error = Picture::new(frame.view(), Channels::Grey, (black, white)).unwrap_err();
            assert!(matches!(error, FormatError::Internal(_)), "{error}");
        }
        let empty = Array2::zeros((0, 3));
        assert!(Picture::new(empty.view(), Channels::Grey, (0.0, 1.0)).is_err());
    }

    #[test]
    fn each_channel_is_reduced_to_the_means_of_its_blocks() {
        let colours = Array2::from_shape_fn((8, 36), |(i, at)| (60 * (at % 3) + i + at / 3) as f32);
        let picture = || Picture::new(colours.view(), Channels::Rgb, (0.0, 255.0)).unwrap();
        let means = picture().reduced(4).into_levels().unwrap();
        assert_eq!(means.dim(), (2, 9));
        for ((i, at), &mean) in means.indexed_iter() {
            // Mean of the block's rows and columns, rounded.
            let expected = 60 * (at % 3) + 4 * i + 4 * (at / 3) + 3;
            assert_eq!(usize::from(mean), expected, "{i} {at}");
        }
        let DynamicImage::ImageRgb8(small) = picture().within(6).0 else { panic!("not in colour") };
        assert_eq!((small.width(), small.height()), (6, 4));
        assert_eq!(picture().within(12).into_levels().unwrap().dim(), (8, 36));
        assert_eq!(picture().reduced(5).into_levels().unwrap().dim(), (2, 9));
    }
}
