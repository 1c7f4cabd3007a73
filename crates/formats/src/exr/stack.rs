//! The head of a stack, and the heads of files that are derived from it: one frame, and the stack with an additional
//! channel. All other attributes stay unchanged.

use std::io::{BufRead, Read};

use super::head::Head;
use super::header::header;
use super::{Attributes, Lines};
use crate::error::Result;
use crate::{Channels, FormatError};

/// Name of the channel of the expected error: channel `Y` of the layer `sigma`, in OpenEXR's naming scheme.
pub const SIGMA: &str = "sigma.Y";

/// Start of the attribute with the list of channels. Its size follows, then the channels, then a zero byte.
const CHANNELS: &[u8] = b"channels\0chlist\0";
/// The description after a channel's name: 32-bit float, not perceptually linear, a sample in every column and row.
const SAMPLES: [u8; 16] = [2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];

/// The head of a stack of frames. The lines of all parts follow it.
#[derive(Debug, Clone)]
pub struct Stack {
    head: Head,
    height: usize,
    width: usize,
    channels: Channels,
}

impl Stack {
    /// A stack with one part per element of `parts`, named `frame_0001` and so on, of frames of this size (rows,
    /// columns).
    ///
    /// Errors: [`FormatError::Internal`] for empty frames, and for attributes that can't be written.
    pub fn new(
        (height, width): (usize, usize),
        channels: Channels,
        parts: &[Attributes],
    ) -> Result<Self> {
        let headers = parts.iter().enumerate();
        let headers = headers.map(|(k, part)| header((height, width), channels, k, part));
        let head = Head::new(&headers.collect::<Result<Vec<_>>>()?);
        let head = head.map_err(|error| FormatError::Internal(format!("EXR: {error}")))?;
        Ok(Self { head, height, width, channels })
    }

    /// Reads the head of a stored stack of this shape (frames, rows, columns).
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a file with another layout.
    pub fn read(
        mut stored: impl BufRead,
        (frames, height, width): (usize, usize, usize),
        channels: Channels,
    ) -> Result<Self> {
        let io = FormatError::io("read the head of the EXR file");
        let head = Head::read(&mut stored).map_err(io)?;
        if head.parts.len() != frames {
            return Err(other_layout());
        }
        let stack = Self { head, height, width, channels };
        let expected = tables(&stack.head.bytes(), frames * height, stack.lines().stored_bytes());
        let mut stored_tables = Vec::with_capacity(expected.len());
        let io = FormatError::io("read the tables of the EXR file");
        stored.take(expected.len() as u64).read_to_end(&mut stored_tables).map_err(io)?;
        if stored_tables == expected { Ok(stack) } else { Err(other_layout()) }
    }

    /// The numbers of frames, rows and columns.
    pub fn shape(&self) -> (usize, usize, usize) {
        (self.head.parts.len(), self.height, self.width)
    }

    /// The channels of each frame.
    pub fn channels(&self) -> Channels {
        self.channels
    }

    /// The layout of the lines after the head.
    pub fn lines(&self) -> Lines {
        Lines::new(self.head.parts.len(), self.width, self.channels)
    }

    /// All bytes before the first line.
    pub fn head(&self) -> Vec<u8> {
        self.with_tables(&self.head, self.lines().stored_bytes())
    }

    /// All bytes before the first line of a file that has only frame `k`.
    pub fn frame_head(&self, k: usize) -> Vec<u8> {
        self.with_tables(&self.head.single_part(k), self.lines().frame_bytes())
    }

    /// All bytes before the first line of the stack with an additional channel of 32-bit floats. Its name must sort
    /// after those of the other channels.
    ///
    /// Errors: [`FormatError::Internal`] for a file with another layout.
    pub fn layered_head(&self, name: &str) -> Result<Vec<u8>> {
        let mut head = self.head.clone();
        head.parts.iter_mut().try_for_each(|part| add_channel(part, name))?;
        Ok(self.with_tables(&head, self.lines().layered_bytes()))
    }

    fn with_tables(&self, head: &Head, line_bytes: usize) -> Vec<u8> {
        let mut bytes = head.bytes();
        let tables = tables(&bytes, head.parts.len() * self.height, line_bytes);
        bytes.extend(tables);
        bytes
    }
}

/// The tables between these headers and the first line, which contain the offset of each line.
fn tables(headers: &[u8], lines: usize, line_bytes: usize) -> Vec<u8> {
    let start = headers.len() + lines * size_of::<u64>();
    (0..lines).flat_map(|line| ((start + line * line_bytes) as u64).to_le_bytes()).collect()
}

fn add_channel(part: &mut [Vec<u8>], name: &str) -> Result<()> {
    let attribute = part.iter_mut().find(|attribute| attribute.starts_with(CHANNELS));
    let attribute = attribute.ok_or_else(other_layout)?;
    // After the size, without the final zero byte.
    let channels = attribute.get(CHANNELS.len() + 4..attribute.len().saturating_sub(1));
    let channels =
        [channels.ok_or_else(other_layout)?, name.as_bytes(), b"\0", &SAMPLES, b"\0"].concat();
    *attribute = [CHANNELS, &(channels.len() as u32).to_le_bytes(), &channels].concat();
    Ok(())
}

fn other_layout() -> FormatError {
    FormatError::Internal(
        "the stored EXR stack does not have the layout of this program".to_owned(),
    )
}

#[cfg(test)]
mod tests {
    use ::exr::prelude::*;
    use ndarray::{Array2, Array3};

    use super::{SIGMA, Stack};
    use crate::exr::Attributes;
    use crate::exr::tests::stored;
    use crate::test_support::ramp;
    use crate::{Channels, FormatError};

    /// Each part as the EXR crate reads it: its name, and its channels with their values.
    type Parts = Vec<(String, Vec<(String, Vec<f32>)>)>;

    fn write(frames: &Array3<f32>, channels: Channels) -> Vec<u8> {
        let times = 0..frames.dim().0;
        let parts = times
            .map(|k| Attributes { frame_time_s: Some(k as f64), ..Attributes::default() })
            .collect::<Vec<_>>();
        stored(frames, channels, &parts).unwrap()
    }

    /// The stored stack with an additional channel that encodes the position of each pixel.
    fn layered(bytes: &[u8], shape: (usize, usize, usize), channels: Channels) -> Vec<u8> {
        let stack = Stack::read(bytes, shape, channels).unwrap();
        let mut made = stack.layered_head(SIGMA).unwrap();
        let lines = bytes[stack.head().len()..].chunks_exact(stack.lines().stored_bytes());
        assert_eq!(lines.len(), shape.0 * shape.1);
        for (line, stored) in lines.enumerate() {
            let values = (0..shape.2).map(|column| place(line, column).to_le_bytes());
            let values: Vec<_> = values.collect();
            let values = values.iter().map(<[u8; 4]>::as_slice);
            stack.lines().layered_line(stored, values, &mut made);
        }
        made
    }

    fn place(line: usize, column: usize) -> f32 {
        (line * 100 + column) as f32
    }

    fn parts(bytes: &[u8]) -> Parts {
        let read = read().no_deep_data().largest_resolution_level().all_channels().all_layers();
        let read = read.all_attributes().pedantic().non_parallel();
        let image = read.from_buffered(std::io::Cursor::new(bytes)).unwrap();
        let channel = |one: &AnyChannel<FlatSamples>| {
            (one.name.to_string(), one.sample_data.values_as_f32().collect())
        };
        let parts = image.layer_data.iter().map(|layer| {
            let name = layer.attributes.layer_name.as_ref().map(ToString::to_string);
            (name.unwrap(), layer.channel_data.list.iter().map(channel).collect())
        });
        parts.collect()
    }

    #[test]
    fn all_parts_get_the_channel_and_keep_their_content() {
        for (count, channels) in [(3, Channels::Grey), (1, Channels::Grey), (2, Channels::Rgb)] {
            let (height, width) = (5, 7);
            let frames = ramp((count, height, width * channels.count()), 1 << 20);
            let bytes = write(&frames, channels);
            let stored = parts(&bytes);
            let made = parts(&layered(&bytes, (count, height, width), channels));
            assert_eq!(made.len(), count);
            for (k, ((name, mut channels), expected)) in made.into_iter().zip(stored).enumerate() {
                let (channel, values) = channels.pop().unwrap();
                assert_eq!((name, channels), expected);
                assert_eq!(channel, SIGMA);
                let layer = Array2::from_shape_fn((height, width), |(row, column)| {
                    place(k * height + row, column)
                });
                assert_eq!(values, layer.into_raw_vec_and_offset().0);
            }
        }
    }

    #[test]
    fn stacks_of_another_shape_are_refused() {
        let bytes = write(&ramp((3, 5, 7), 100), Channels::Grey);
        for shape in [(2, 5, 7), (3, 4, 7), (3, 5, 8)] {
            let refused = Stack::read(&*bytes, shape, Channels::Grey);
            assert!(matches!(refused, Err(FormatError::Internal(_))), "{shape:?}: {refused:?}");
        }
        assert!(Stack::read(&bytes[..600], (3, 5, 7), Channels::Grey).is_err());
    }

    #[test]
    fn derived_values_are_in_the_order_of_pixels() {
        for (count, channels) in [(3, Channels::Grey), (1, Channels::Rgb), (2, Channels::Rgb)] {
            let frames = ramp((count, 5, 7 * channels.count()), 1 << 20);
            let bytes = write(&frames, channels);
            let stack = Stack::read(&*bytes, (count, 5, 7), channels).unwrap();
            let mut values = Vec::new();
            let lines = bytes[stack.head().len()..].chunks_exact(stack.lines().stored_bytes());
            lines.for_each(|line| stack.lines().values(line, &mut values));
            let expected: Vec<u8> = frames.iter().flat_map(|value| value.to_le_bytes()).collect();
            assert!(values == expected, "{count} {channels:?}");
        }
    }
}
