//! Layout of patches and groups in a clip and in memory.

use pulp::Simd;

/// Height and width of a patch, in pixels.
pub(super) const SIDE: usize = 6;
/// Number of pixels of a patch.
pub(super) const PIXELS: usize = SIDE * SIDE;
/// Number of patches of a group.
pub(super) const PATCHES: usize = 40;
/// Distance of neighbouring reference patches, in pixels.
const STRIDE: usize = 5;
/// Height and width of the search window in each frame, in patch positions.
pub(super) const WINDOW: usize = 16;
/// Number of frames searched before and after the reference.
pub(super) const REACH: usize = 3;
/// Number of groups that are filtered together, as many in each vector register as it has lanes. It is the same on
/// every machine, and so is the order in which patches are accumulated.
pub(super) const BATCH: usize = 16;

/// Index of the first number of a patch in a batch: `S::F32_LANES` groups side by side, pixel by pixel and patch by
/// patch.
#[inline(always)]
pub(super) fn place_of<S: Simd>(group: usize, patch: usize) -> usize {
    let lanes = S::F32_LANES;
    group / lanes * (PIXELS * PATCHES * lanes) + patch * lanes + group % lanes
}

/// Length of a row with its margin.
pub(super) fn row_length(width: usize) -> usize {
    width + WINDOW + SIDE
}

/// Shift of the grid of reference patches down and to the right, by frame and number of earlier searches, so that
/// patch borders vary between frames and searches.
pub(super) fn shift(frame: usize, searches: usize) -> (usize, usize) {
    let down = 2 * frame + 3 * searches;
    (down % STRIDE, (down + frame + searches / 2) % STRIDE)
}

/// Positions of the reference patches along an axis, on a grid shifted by `shift` pixels, with one at each end.
pub(super) fn positions(length: usize, shift: usize) -> Vec<usize> {
    let last = length - SIDE;
    let mut all = vec![0];
    all.extend((shift..last).step_by(STRIDE).filter(|&at| at > 0));
    all.extend((last > 0).then_some(last));
    all
}
