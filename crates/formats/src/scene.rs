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

/// Lists names for a message, up to a limit.
pub(super) fn list(names: &[String]) -> String {
    const MAX_NAMES: usize = 20;
    let quoted: Vec<String> =
        names.iter().take(MAX_NAMES).map(|name| format!("'{name}'")).collect();
    match (quoted.is_empty(), names.len().saturating_sub(MAX_NAMES)) {
        (true, _) => "no arrays".to_owned(),
        (false, 0) => quoted.join(", "),
        (false, more) => format!("{} and {more} more", quoted.join(", ")),
    }
}
