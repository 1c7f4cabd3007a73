//! Adds a channel to each part of a stored EXR stack while it is streamed.
//!
//! Each line of a part is an uncompressed chunk. A line with the additional channel is the stored line followed by the
//! values of the channel, so lines can be produced independently. All other attributes stay unchanged.

use std::io::{BufRead, Read};

use super::head::Head;
use crate::error::Result;
use crate::{Channels, FormatError};

/// Name of the channel of the expected error: channel `Y` of the layer `sigma`, in OpenEXR's naming scheme.
pub const SIGMA: &str = "sigma.Y";

/// Start of the attribute with the list of channels. Its size follows, then the channels, then a zero byte.
const CHANNELS: &[u8] = b"channels\0chlist\0";
/// The description after a channel's name: 32-bit float, not perceptually linear, a sample in every column and row.
const SAMPLES: [u8; 16] = [2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];

/// The layout of a stack with an additional channel: a head, followed by all lines of all parts.
#[derive(Debug)]
pub struct Layered {
    /// All bytes before the first line of the new stack.
    pub head: Vec<u8>,
    /// Offset of the first line in the stored stack.
    pub start: u64,
    /// Length of a line in the stored stack, in bytes.
    pub stored_bytes: usize,
    /// Length of a line in the new stack, in bytes.
    pub line_bytes: usize,
    /// Length of the prefix of a line, in bytes. Its last four bytes are the length of the values.
    prefix_bytes: usize,
}

impl Layered {
    /// Reads the head of a stack of this shape (frames, rows, columns) from [`super::write_stack`], and plans the stack
    /// with an additional channel of 32-bit floats. Its name must sort after those of the other channels.
    ///
    /// Errors: I/O; [`FormatError::Internal`] for a file with another layout.
    pub fn read(
        mut stored: impl BufRead,
        (frames, height, width): (usize, usize, usize),
        channels: Channels,
        name: &str,
    ) -> Result<Self> {
        let io = FormatError::io("read the head of the EXR file");
        let mut head = Head::read(&mut stored).map_err(io)?;
        let prefix_bytes = if head.has_several_parts() { 12 } else { 8 };
        let channel_bytes = width * size_of::<f32>();
        let stored_bytes = prefix_bytes + channels.count() * channel_bytes;
        let lines = frames * height;
        let (start, expected) = tables(&head.bytes(), lines, stored_bytes);
        let mut stored_tables = Vec::with_capacity(expected.len());
        let io = FormatError::io("read the tables of the EXR file");
        stored.take(expected.len() as u64).read_to_end(&mut stored_tables).map_err(io)?;
        if head.parts.len() != frames || stored_tables != expected {
            return Err(other_layout());
        }
        for part in &mut head.parts {
            add_channel(part, name)?;
        }
        let line_bytes = stored_bytes + channel_bytes;
        let mut head = head.bytes();
        head.extend(tables(&head, lines, line_bytes).1);
        Ok(Self { head, start, stored_bytes, line_bytes, prefix_bytes })
    }

    /// Appends a line of the new stack to `output`, from the stored line and the bytes of the additional channel.
    pub fn line<'a>(
        &self,
        stored: &[u8],
        layer: impl Iterator<Item = &'a [u8]>,
        output: &mut Vec<u8>,
    ) {
        let (prefix, values) = stored.split_at(self.prefix_bytes);
        output.extend(&prefix[..self.prefix_bytes - 4]);
        output.extend(((self.line_bytes - self.prefix_bytes) as u32).to_le_bytes());
        output.extend(values);
        layer.for_each(|values| output.extend(values));
    }
}

/// Offset of the first line after these headers, and the tables in between, which contain the offset of each line.
fn tables(headers: &[u8], lines: usize, line_bytes: usize) -> (u64, Vec<u8>) {
    let start = headers.len() + lines * size_of::<u64>();
    let offsets = (0..lines).map(|line| (start + line * line_bytes) as u64);
    (start as u64, offsets.flat_map(u64::to_le_bytes).collect())
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
    use std::fs::File;
    use std::io::BufReader;
    use std::path::Path;

    use ::exr::prelude::*;
    use ndarray::{Array2, Array3, Axis};

    use super::{Layered, SIGMA};
    use crate::exr::{Attributes, write_stack};
    use crate::test_support::ramp;
    use crate::{Channels, FormatError};

    /// Each part as the EXR crate reads it: its name, and its channels with their values.
    type Parts = Vec<(String, Vec<(String, Vec<f32>)>)>;

    fn write(path: &Path, frames: &Array3<f32>, channels: Channels) {
        let (count, height, samples) = frames.dim();
        let parts: Vec<_> = (0..count)
            .map(|k| Attributes { frame_time_s: Some(k as f64), ..Attributes::default() })
            .collect();
        let size = (height, samples / channels.count());
        let frame = |k| Ok::<_, FormatError>(frames.index_axis(Axis(0), k).to_owned());
        write_stack(path, size, channels, &parts, frame).unwrap();
    }

    fn open(path: &Path) -> BufReader<File> {
        BufReader::new(File::open(path).unwrap())
    }

    /// The stored stack with an additional channel that encodes the position of each pixel.
    fn layered(path: &Path, shape: (usize, usize, usize), channels: Channels) -> Vec<u8> {
        let layered = Layered::read(open(path), shape, channels, SIGMA).unwrap();
        let stored = std::fs::read(path).unwrap();
        let mut made = layered.head.clone();
        let lines = stored[layered.start as usize..].chunks_exact(layered.stored_bytes);
        assert_eq!(lines.len(), shape.0 * shape.1);
        for (line, stored) in lines.enumerate() {
            let values = (0..shape.2).map(|column| place(line, column).to_le_bytes());
            let values: Vec<_> = values.collect();
            layered.line(stored, values.iter().map(<[u8; 4]>::as_slice), &mut made);
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
        let path = tempfile::NamedTempFile::new().unwrap();
        for (count, channels) in [(3, Channels::Grey), (1, Channels::Grey), (2, Channels::Rgb)] {
            let (height, width) = (5, 7);
            let frames = ramp((count, height, width * channels.count()), 1 << 20);
            write(path.path(), &frames, channels);
            let stored = parts(&std::fs::read(path.path()).unwrap());
            let made = layered(path.path(), (count, height, width), channels);
            let made = parts(&made);
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
        let path = tempfile::NamedTempFile::new().unwrap();
        write(path.path(), &ramp((3, 5, 7), 100), Channels::Grey);
        for shape in [(2, 5, 7), (3, 4, 7), (3, 5, 8)] {
            let refused = Layered::read(open(path.path()), shape, Channels::Grey, SIGMA);
            assert!(matches!(refused, Err(FormatError::Internal(_))), "{shape:?}: {refused:?}");
        }
        let cut = File::options().write(true).open(path.path()).unwrap();
        cut.set_len(600).unwrap();
        assert!(Layered::read(open(path.path()), (3, 5, 7), Channels::Grey, SIGMA).is_err());
    }
}
