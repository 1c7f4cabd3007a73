//! Writes GIF movies, which presentation programs play without a codec.
//!
//! Grey frames are exact: the palette has all 256 levels. A frame of colours has a palette of 256 colours.

use std::borrow::Cow;
use std::io::Write;

use gif::{DisposalMethod, Encoder, EncodingError, Frame, Repeat};
use ndarray::ArrayView2;

use super::error::Result;
use super::movie::{Clip, FPS};
use super::{Channels, FormatError};

/// Effort of the search for a palette, from 1 (best) to 30 (fastest).
const PALETTE_SPEED: i32 = 10;
/// GIF counts delays in units of 10 ms.
const DELAYS_PER_SECOND: u32 = 100;

/// Writes a GIF frame by frame.
pub struct GifWriter<W: Write> {
    encoder: Encoder<W>,
    /// Height and width in pixels.
    size: (u16, u16),
    channels: Channels,
}

/// Starts a GIF that repeats for ever.
///
/// Errors: I/O; [`FormatError::Internal`] for a side above 65535.
pub fn writer<W: Write>(output: W, clip: &Clip<'_>) -> Result<GifWriter<W>> {
    let side = |side: usize| u16::try_from(side).map_err(|_| wrong_size((side, side)));
    let (_, height, width) = clip.shape;
    let size = (side(height)?, side(width)?);
    let greys: Vec<u8> = match clip.channels {
        Channels::Grey => (0..=u8::MAX).flat_map(|level| [level; 3]).collect(),
        Channels::Rgb => Vec::new(),
    };
    let mut encoder = Encoder::new(output, size.1, size.0, &greys).map_err(unwritten)?;
    encoder.set_repeat(Repeat::Infinite).map_err(unwritten)?;
    Ok(GifWriter { encoder, size, channels: clip.channels })
}

impl<W: Write> GifWriter<W> {
    /// Adds a frame \[row, column\], or \[row, 3 column\] for colours, with levels from 0 to 255.
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a frame of another size.
    pub fn write_frame(&mut self, levels: ArrayView2<'_, u8>) -> Result<()> {
        let (height, width) = self.size;
        if levels.dim() != (usize::from(height), usize::from(width) * self.channels.count()) {
            return Err(wrong_size(levels.dim()));
        }
        let levels: Vec<u8> = levels.iter().copied().collect();
        let frame = match self.channels {
            Channels::Grey => {
                Frame { width, height, buffer: Cow::Owned(levels), ..Frame::default() }
            }
            Channels::Rgb => Frame::from_rgb_speed(width, height, &levels, PALETTE_SPEED),
        };
        let delay = (DELAYS_PER_SECOND / FPS) as u16;
        let frame = Frame { delay, dispose: DisposalMethod::Keep, ..frame };
        self.encoder.write_frame(&frame).map_err(unwritten)
    }

    /// Writes the end of the file, and returns the output.
    ///
    /// Errors: I/O.
    pub fn finish(self) -> Result<W> {
        let mut output = self.encoder.into_inner().map_err(unwritten)?;
        output.flush().map_err(FormatError::io("write the movie"))?;
        Ok(output)
    }
}

fn wrong_size((height, width): (usize, usize)) -> FormatError {
    FormatError::Internal(format!("a frame of {height}x{width} does not fit the movie"))
}

fn unwritten(error: EncodingError) -> FormatError {
    match error {
        EncodingError::Io(error) => FormatError::io("write the movie")(error),
        error => FormatError::Internal(format!("movie: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use gif::{ColorOutput, DecodeOptions};
    use ndarray::Array2;

    use super::writer;
    use crate::movie::Clip;
    use crate::{Channels, FormatError};

    #[test]
    fn grey_levels_are_exact() {
        let clip = Clip { shape: (3, 9, 256), channels: Channels::Grey, title: "" };
        let frames: Vec<_> = (0..3)
            .map(|k| Array2::from_shape_fn((9, 256), |(i, j)| ((i * 3 + j + 5 * k) % 256) as u8))
            .collect();
        let mut writer = writer(Vec::new(), &clip).unwrap();
        for frame in &frames {
            writer.write_frame(frame.view()).unwrap();
        }
        let bytes = writer.finish().unwrap();
        let mut options = DecodeOptions::new();
        options.set_color_output(ColorOutput::RGBA);
        let mut decoder = options.read_info(bytes.as_slice()).unwrap();
        for frame in &frames {
            let decoded = decoder.read_next_frame().unwrap().unwrap();
            assert_eq!(decoded.delay, 10);
            let levels: Vec<u8> = decoded.buffer.iter().step_by(4).copied().collect();
            assert_eq!(levels, frame.iter().copied().collect::<Vec<_>>());
        }
        assert!(decoder.read_next_frame().unwrap().is_none());
    }

    #[test]
    fn frames_of_another_size_are_refused() {
        let clip = Clip { shape: (1, 8, 8), channels: Channels::Rgb, title: "" };
        let mut writer = writer(Vec::new(), &clip).unwrap();
        writer.write_frame(Array2::zeros((8, 24)).view()).unwrap();
        let refused = writer.write_frame(Array2::zeros((8, 8)).view());
        assert!(matches!(refused, Err(FormatError::Internal(_))), "{refused:?}");
    }
}
