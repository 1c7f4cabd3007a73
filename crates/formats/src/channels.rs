//! The channels of frames. Colour frames are arrays \[row, 3 column\] with red, green and blue of each pixel in
//! adjacent columns.

/// The channels of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channels {
    /// One value per pixel.
    Grey,
    /// Red, green and blue of each pixel.
    Rgb,
}

impl Channels {
    /// Number of values per pixel.
    pub const fn count(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::Rgb => 3,
        }
    }
}
