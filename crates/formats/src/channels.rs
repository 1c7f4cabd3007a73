//! What a pixel of a frame has. Rows of colour frames have red, green and blue of each pixel, one after the other:
//! they are arrays \[row, 3 column\].

/// What a pixel of a frame has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channels {
    /// One value.
    Grey,
    /// Red, green and blue.
    Rgb,
}

impl Channels {
    /// Values of a pixel.
    pub const fn count(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::Rgb => 3,
        }
    }
}
