//! The part of a file that a request selects, and how its numbers were read.

use serde::{Deserialize, Serialize};

use formats::{Crop, Packing};

/// The reason for a full scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ScaleBasis {
    /// The request states it.
    Stated,
    /// It is the default of the data type or of the file.
    Type,
    /// All values are 0 or 1, so masks are read as closed and open.
    Values,
}

/// The part of a file that was read, and the reason for its full scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Reading {
    pub scale_basis: ScaleBasis,
    /// The window of each picture; `None` for whole pictures.
    pub crop: Option<Crop>,
    /// First and last frame, both included; `None` for all frames.
    pub frames: Option<[usize; 2]>,
    /// How pixels are packed; `None` for one number per pixel.
    pub packing: Option<Packing>,
}

/// True if a window starts at the first pixel of a cell of 2x2 pixels.
pub fn keeps_mosaic(crop: Option<Crop>) -> bool {
    crop.is_none_or(|crop| crop.row.is_multiple_of(2) && crop.column.is_multiple_of(2))
}
