//! The lines of a stack. A line is an uncompressed chunk with a row of pixels: the number of its part in files with
//! several parts, its row, the length of its values, and the values of one channel after another.

use ndarray::{ArrayView2, s};

use super::names;
use crate::Channels;

/// Length of the number of a part, in bytes.
const PART_BYTES: usize = 4;
/// Length of the row and of the length of the values, in bytes.
const PREFIX_BYTES: usize = 8;
const SAMPLE_BYTES: usize = size_of::<f32>();

/// The layout of the lines of a stack.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lines {
    has_several_parts: bool,
    width: usize,
    channels: Channels,
}

impl Lines {
    /// The lines of a stack with this number of frames, and of columns.
    pub fn new(frames: usize, width: usize, channels: Channels) -> Self {
        Self { has_several_parts: frames > 1, width, channels }
    }

    /// Number of columns of pixels.
    pub fn width(self) -> usize {
        self.width
    }

    /// Length of a line in the stack, in bytes.
    pub fn stored_bytes(self) -> usize {
        self.prefix_bytes() + self.value_bytes()
    }

    /// Length of a line in a file of one frame, in bytes.
    pub fn frame_bytes(self) -> usize {
        PREFIX_BYTES + self.value_bytes()
    }

    /// Length of a line in a stack with an additional channel of 32-bit floats, in bytes.
    pub fn layered_bytes(self) -> usize {
        self.stored_bytes() + self.channel_bytes()
    }

    /// Length of the values of a line, in bytes.
    pub fn value_bytes(self) -> usize {
        self.channels.count() * self.channel_bytes()
    }

    /// Offset of the values in a line.
    pub(super) fn prefix_bytes(self) -> usize {
        if self.has_several_parts { PART_BYTES + PREFIX_BYTES } else { PREFIX_BYTES }
    }

    fn channel_bytes(self) -> usize {
        self.width * SAMPLE_BYTES
    }

    /// Appends the lines of consecutive rows of frame `part`, from number `row` on. All channels of a pixel are in
    /// adjacent columns.
    pub fn encode(
        self,
        (part, row): (usize, usize),
        rows: ArrayView2<'_, f32>,
        output: &mut Vec<u8>,
    ) {
        for (index, values) in rows.rows().into_iter().enumerate() {
            if self.has_several_parts {
                output.extend((part as u32).to_le_bytes());
            }
            output.extend(((row + index) as u32).to_le_bytes());
            output.extend((self.value_bytes() as u32).to_le_bytes());
            for &(_, place) in names(self.channels) {
                let channel = values.slice(s![place..;self.channels.count().cast_signed()]);
                output.extend(channel.iter().flat_map(|value| value.to_le_bytes()));
            }
        }
    }

    /// Appends the values of a stored line. All channels of a pixel follow each other: red, green and blue.
    pub fn values(self, stored: &[u8], output: &mut Vec<u8>) {
        match self.channels {
            Channels::Grey => output.extend(&stored[self.prefix_bytes()..]),
            Channels::Rgb => {
                let count = self.channels.count();
                let samples = 0..self.width * count;
                let value = |at: usize| self.value(stored, at / count, at % count);
                samples.for_each(|at| output.extend(value(at)));
            }
        }
    }

    /// The value of a channel in a column of a stored line. Channels count from red.
    pub fn value(self, stored: &[u8], column: usize, channel: usize) -> &[u8] {
        let order = names(self.channels);
        let channel = order.iter().position(|(_, place)| *place == channel).unwrap_or(0);
        let start = self.prefix_bytes() + (channel * self.width + column) * SAMPLE_BYTES;
        &stored[start..start + SAMPLE_BYTES]
    }

    /// Appends a stored line in the form that a file of one frame has.
    pub fn frame_line(self, stored: &[u8], output: &mut Vec<u8>) {
        output.extend(&stored[self.stored_bytes() - self.frame_bytes()..]);
    }

    /// Appends a stored line with the bytes of an additional channel.
    pub fn layered_line<'a>(
        self,
        stored: &[u8],
        layer: impl Iterator<Item = &'a [u8]>,
        output: &mut Vec<u8>,
    ) {
        let (prefix, values) = stored.split_at(self.prefix_bytes());
        let value_bytes = self.value_bytes() + self.channel_bytes();
        output.extend(&prefix[..prefix.len() - 4]);
        output.extend((value_bytes as u32).to_le_bytes());
        output.extend(values);
        layer.for_each(|values| output.extend(values));
    }
}
