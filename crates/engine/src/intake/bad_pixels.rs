//! Maps of the bad pixels of a sensor.

use std::path::Path;

use ndarray::Array2;

use super::IntakeError;
use crate::intake::error::Result;
use formats::{FormatError, Limits};

const PLACE: &str = "/bad_pixels";

/// Reads a map of bad pixels \[H,W\]: they are those that are not 0.
///
/// Errors: [`IntakeError::Size`] unless there is one map of the size of the masks; [`IntakeError::Format`] for unreadable
/// files.
pub fn bad_pixels(
    path: &Path,
    (height, width): (usize, usize),
    limits: &Limits,
) -> Result<Array2<bool>> {
    let mut reader = formats::open_stack(path, limits).map_err(IntakeError::format(PLACE))?;
    let info = *reader.info();
    if (info.frames, info.height, info.width) != (1, height, width) {
        let detail = format!(
            "the map of bad pixels has {} frames of {}x{} (rows x columns); it must be one of {height}x{width}, the size \
             of the masks, and 0 where a pixel is good",
            info.frames, info.height, info.width
        );
        return Err(IntakeError::Size { place: PLACE.into(), detail });
    }
    let map = reader.next_frame().map_err(IntakeError::format(PLACE))?;
    let map = map.ok_or_else(|| FormatError::Internal("a map without its frame".into()))?;
    let bad = map.mapv(|value| value != 0.0);
    if bad.iter().all(|bad| *bad) {
        let detail = "the map marks every pixel as bad; it must be 0 where a pixel is good, so it may be inverted";
        return Err(IntakeError::content(PLACE, &detail));
    }
    Ok(bad)
}
