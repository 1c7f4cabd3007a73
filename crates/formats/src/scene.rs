//! The arrays of a scene, in files that hold several: .mat, HDF5 and npz.

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
    /// The name of the array in the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Masks => "mask",
            Self::Measurements => "meas",
            Self::Truth => "orig",
        }
    }

    /// The names that are looked for in an archive of NumPy's, where `orig` is called `frames`, too.
    pub(super) fn names(self) -> &'static [&'static str] {
        match self {
            Self::Masks => &["mask"],
            Self::Measurements => &["meas"],
            Self::Truth => &["orig", "frames"],
        }
    }

    /// What means 1.0 in this array unless stated, whatever its type.
    pub fn default_full_scale(self) -> FullScale {
        match self {
            Self::Masks => FullScale::ONE,
            Self::Measurements | Self::Truth => FullScale::EIGHT_BIT,
        }
    }
}

/// Names for a message, bounded in number.
pub(super) fn list(names: &[String]) -> String {
    const SHOWN: usize = 20;
    let quoted: Vec<String> = names.iter().take(SHOWN).map(|name| format!("'{name}'")).collect();
    match (quoted.is_empty(), names.len().saturating_sub(SHOWN)) {
        (true, _) => "no arrays".to_owned(),
        (false, 0) => quoted.join(", "),
        (false, more) => format!("{} and {more} more", quoted.join(", ")),
    }
}
