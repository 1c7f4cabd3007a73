//! How patches and groups lie in a clip and in memory.

use pulp::Simd;

/// Height and width of a patch, pixels.
pub(super) const SIDE: usize = 6;
/// Pixels of a patch.
pub(super) const PIXELS: usize = SIDE * SIDE;
/// Patches of a group.
pub(super) const PATCHES: usize = 40;
/// Distance of neighbouring reference patches, pixels.
const STRIDE: usize = 5;
/// Height and width of the window that is searched in each frame, in positions of patches.
pub(super) const WINDOW: usize = 16;
/// Frames before and after the reference that are searched.
pub(super) const REACH: usize = 3;
/// Groups that are filtered together, so many in each vector register as it has lanes. The number is the
/// same for every machine: so is the order in which patches are added up.
pub(super) const BATCH: usize = 16;

/// Where a number of a patch lies among those of a batch: `S::F32_LANES` groups beside each other, pixel by
/// pixel and patch by patch.
#[inline(always)]
pub(super) fn place_of<S: Simd>(group: usize, patch: usize) -> usize {
    let lanes = S::F32_LANES;
    group / lanes * (PIXELS * PATCHES * lanes) + patch * lanes + group % lanes
}

/// Length of a row with its margin.
pub(super) fn row_length(width: usize) -> usize {
    width + WINDOW + SIDE
}

/// How far the grid of reference patches is shifted down and to the right, for a frame and the searches before: not
/// the same pixels lie between the patches in every frame and after every search.
pub(super) fn shift(frame: usize, searches: usize) -> (usize, usize) {
    let down = 2 * frame + 3 * searches;
    (down % STRIDE, (down + frame + searches / 2) % STRIDE)
}

/// Positions of the reference patches along an axis, on a grid that is shifted by so many pixels; one at each
/// end.
pub(super) fn positions(length: usize, shift: usize) -> Vec<usize> {
    let last = length - SIDE;
    let mut all = vec![0];
    all.extend((shift..last).step_by(STRIDE).filter(|&at| at > 0));
    all.extend((last > 0).then_some(last));
    all
}
