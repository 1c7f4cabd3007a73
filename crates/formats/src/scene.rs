//! The arrays of a scene in files with several arrays: .mat, HDF5 and npz.

use super::FullScale;

/// An array of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SceneArray {
    /// `mask`, (row, column, mask), on `[0,1]`.
    Masks,
    /// `meas`, (row, column, snapshot), raw: 255 means 1.
    Measurements,
    /// `orig`, (row, column, frame), raw: 255 means 1.
    Truth,
}

impl SceneArray {
    /// The usual name of the array in a file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Masks => "mask",
            Self::Measurements => "meas",
            Self::Truth => "orig",
        }
    }

    /// The accepted names in an npz archive, where `orig` may be called `frames`.
    pub(super) fn names(self) -> &'static [&'static str] {
        match self {
            Self::Masks => &["mask"],
            Self::Measurements => &["meas"],
            Self::Truth => &["orig", "frames"],
        }
    }

    /// The full scale of this array in a MATLAB file if none is stated, for all data types.
    pub fn default_full_scale(self) -> FullScale {
        match self {
            Self::Masks => FullScale::ONE,
            Self::Measurements | Self::Truth => FullScale::EIGHT_BIT,
        }
    }
}

/// Largest number of arrays in a message.
pub(super) const MAX_NAMES: usize = 20;

/// Lists arrays for a message, up to a limit: the name, and the size unless it is empty.
pub(super) fn list(arrays: &[(String, Vec<u64>)]) -> String {
    let size = |shape: &[u64]| shape.iter().map(u64::to_string).collect::<Vec<_>>().join("x");
    let quoted = arrays.iter().take(MAX_NAMES).map(|(name, shape)| match shape.is_empty() {
        true => format!("'{name}'"),
        false => format!("'{name}' ({})", size(shape)),
    });
    let quoted: Vec<String> = quoted.collect();
    match (quoted.is_empty(), arrays.len().saturating_sub(MAX_NAMES)) {
        (true, _) => "no arrays".to_owned(),
        (false, 0) => quoted.join(", "),
        (false, more) => format!("{} and {more} more", quoted.join(", ")),
    }
}
