//! How large a file may be. Checked before anything is allocated.

use super::{Format, FormatError, StackInfo};
use crate::error::Result;

/// The largest files and stacks that are read.
///
/// A header is only a claim: each decoder checks the claim against these limits and against the
/// file's real length before it allocates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Length of the file in bytes.
    pub max_file_bytes: u64,
    /// Frames (masks, snapshots) in one file.
    pub max_frames: usize,
    /// Height and width in pixels.
    pub max_side: usize,
    /// Frames x height x width.
    pub max_voxels: u64,
}

impl Default for Limits {
    /// 8 GiB, 4096 frames, 8192 pixels a side, 2^31 voxels: a 3200x3200 camera's day fits, and one
    /// frame in memory stays below 0.8 GiB.
    fn default() -> Self {
        Self { max_file_bytes: 8 << 30, max_frames: 4096, max_side: 8192, max_voxels: 1 << 31 }
    }
}

impl Limits {
    /// Checks the length of a file. Errors: [`FormatError::OverLimit`].
    pub(super) fn check_file(&self, format: Format, bytes: u64) -> Result<()> {
        within(format, "the file's length in bytes", bytes, self.max_file_bytes)
    }

    /// Checks a claimed shape. Errors: [`FormatError::OverLimit`], or [`FormatError::Malformed`]
    /// when an axis is empty.
    pub(super) fn check_shape(
        &self,
        format: Format,
        frames: u64,
        height: u64,
        width: u64,
    ) -> Result<()> {
        if frames == 0 || height == 0 || width == 0 {
            return Err(FormatError::malformed(
                format,
                format!("the stack is empty: {frames} frames of {height}x{width}"),
            ));
        }
        let side = self.max_side as u64;
        within(format, "the number of frames", frames, self.max_frames as u64)?;
        within(format, "the height in pixels", height, side)?;
        within(format, "the width in pixels", width, side)?;
        // Cannot overflow for sane limits, but limits are settings.
        let voxels = frames.saturating_mul(height).saturating_mul(width);
        within(format, "frames x height x width", voxels, self.max_voxels)
    }

    pub(super) fn check_info(&self, info: &StackInfo) -> Result<()> {
        self.check_shape(info.format, info.frames as u64, info.height as u64, info.width as u64)
    }
}

fn within(format: Format, what: &'static str, value: u64, limit: u64) -> Result<()> {
    if value > limit {
        return Err(FormatError::OverLimit { format, what, value, limit });
    }
    Ok(())
}
