//! Limits for the size of files, which are checked before memory is allocated.

use super::{Format, FormatError, StackInfo};
use crate::error::Result;

/// The largest accepted files and stacks.
///
/// A header is only a claim. Each decoder checks it against these limits and the length of the file before it allocates
/// memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Largest length of a file in bytes.
    pub max_file_bytes: u64,
    /// Largest number of frames (masks, snapshots) in a file.
    pub max_frames: usize,
    /// Largest height and width in pixels.
    pub max_side: usize,
    /// Largest number of voxels: frames x height x width.
    pub max_voxels: u64,
}

impl Default for Limits {
    /// 8 GiB, 4096 frames, sides of 8192 pixels, 2^31 voxels. That is enough for 200 snapshots of 3200x3200 pixels, and
    /// one frame takes less than 0.8 GiB of memory.
    fn default() -> Self {
        Self { max_file_bytes: 8 << 30, max_frames: 4096, max_side: 8192, max_voxels: 1 << 31 }
    }
}

impl Limits {
    /// Checks the length of a file in bytes. Errors: [`FormatError::OverLimit`].
    pub(super) fn check_file(&self, format: Format, bytes: u64) -> Result<()> {
        check(format, "the length of the file in bytes", bytes, self.max_file_bytes)
    }

    /// Checks a claimed shape. Errors: [`FormatError::OverLimit`]; [`FormatError::Malformed`] for an empty axis.
    pub fn check_shape(&self, format: Format, frames: u64, height: u64, width: u64) -> Result<()> {
        if frames == 0 || height == 0 || width == 0 {
            return Err(FormatError::malformed(
                format,
                format!("the stack is empty: {frames} frames of {height}x{width}"),
            ));
        }
        let side = self.max_side as u64;
        check(format, "the number of frames", frames, self.max_frames as u64)?;
        check(format, "the height in pixels", height, side)?;
        check(format, "the width in pixels", width, side)?;
        // Saturates, because limits are configurable.
        let voxels = frames.saturating_mul(height).saturating_mul(width);
        check(format, "frames x height x width", voxels, self.max_voxels)
    }

    pub(super) fn check_info(&self, info: &StackInfo) -> Result<()> {
        self.check_shape(info.format, info.frames as u64, info.height as u64, info.width as u64)
    }
}

/// Checks a claimed quantity. Errors: [`FormatError::OverLimit`].
pub(super) fn check(format: Format, what: &'static str, value: u64, limit: u64) -> Result<()> {
    if value > limit {
        return Err(FormatError::OverLimit { format, what, value, limit });
    }
    Ok(())
}
