//! Files that are derived from the stack of frames, line by line. The writer of a result hashes the same bytes that a
//! reader composes later.

use std::ops::Range;

use crate::job::{Mosaic, SceneShape};
use formats::exr::{Lines, Stack};
use formats::{Channels, npy};

/// The file with all frames, from which the others are derived.
pub const STACK: &str = "stack.exr";
/// Folder of the single frames.
pub(super) const FRAMES: &str = "frames";
pub(super) const ARRAY: &str = "frames.npy";
/// The raw frames of a colour sensor.
pub(super) const RAW: &str = "mosaic.npy";

/// A file that is derived from the stack of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Derived {
    /// All frames as one array \[B,H,W\], or \[B,H,W,3\] for colours.
    Array,
    /// The raw frames of a colour sensor as one array \[B,H,W\].
    Raw(Mosaic),
    /// A frame as EXR, counted from 0.
    Frame(usize),
}

impl Derived {
    /// The file of this name in a result with frames of this shape.
    pub fn named(name: &str, shape: SceneShape) -> Option<Self> {
        let number = || {
            let number = name.rsplit_once("frame_")?.1.strip_suffix(".exr")?;
            number.parse::<usize>().ok()?.checked_sub(1)
        };
        let candidates =
            [Some(Self::Array), shape.mosaic.map(Self::Raw), number().map(Self::Frame)];
        candidates.into_iter().flatten().find(|derived| derived.name() == name)
    }

    /// Path of the file below the folder of the snapshot.
    pub fn name(self) -> String {
        match self {
            Self::Array => ARRAY.to_owned(),
            Self::Raw(_) => RAW.to_owned(),
            Self::Frame(k) => format!("{FRAMES}/frame_{:04}.exr", k + 1),
        }
    }

    /// The frames in the file, of `count` in the stack.
    pub fn frames(self, count: usize) -> Range<usize> {
        match self {
            Self::Array | Self::Raw(_) => 0..count,
            Self::Frame(k) => k..k + 1,
        }
    }

    /// All bytes before the first line.
    pub fn head(self, stack: &Stack) -> Vec<u8> {
        match self {
            Self::Array => npy::stack_header(stack.shape(), stack.channels()),
            Self::Raw(_) => npy::stack_header(stack.shape(), Channels::Grey),
            Self::Frame(k) => stack.frame_head(k),
        }
    }

    /// Length of a line in bytes.
    pub fn line_bytes(self, lines: Lines) -> usize {
        match self {
            Self::Array => lines.value_bytes(),
            Self::Raw(_) => lines.value_bytes() / Channels::Rgb.count(),
            Self::Frame(_) => lines.frame_bytes(),
        }
    }

    /// Appends the line of a row, given the line of the stack.
    pub fn line(self, lines: Lines, row: usize, stored: &[u8], output: &mut Vec<u8>) {
        match self {
            Self::Array => lines.values(stored, output),
            // Demosaicking keeps the measured samples.
            Self::Raw(mosaic) => {
                for column in 0..lines.width() {
                    output.extend(lines.value(stored, column, mosaic.colour(row, column)));
                }
            }
            Self::Frame(_) => lines.frame_line(stored, output),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Derived;
    use crate::job::{Mosaic, SceneShape};

    #[test]
    fn files_are_found_by_their_names() {
        let grey = SceneShape { frames: 12, height: 4, width: 4, snapshots: 1, mosaic: None };
        let colour = SceneShape { mosaic: Some(Mosaic::Rggb), ..grey };
        for derived in [Derived::Array, Derived::Frame(0), Derived::Frame(11)] {
            assert_eq!(Derived::named(&derived.name(), grey), Some(derived));
        }
        assert_eq!(Derived::named("mosaic.npy", grey), None);
        assert_eq!(Derived::named("mosaic.npy", colour), Some(Derived::Raw(Mosaic::Rggb)));
        for stored in ["stack.exr", "png/frame_0001.png", "frames/frame_1.exr", "error.npy"] {
            assert_eq!(Derived::named(stored, colour), None, "{stored}");
        }
    }
}
