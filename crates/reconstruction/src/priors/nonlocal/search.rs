//! The search for similar patches.

use std::ops::Range;

use pulp::{Simd, bytemuck};

#[cfg(feature = "gpu")]
use crate::gpu::nonlocal::{NONE, Windows};
use crate::motion::Motion;

use super::layout::{PATCHES, REACH, SIDE, WINDOW, positions, row_length, shift};

/// Frames, height and width of a clip.
type Size = (usize, usize, usize);

/// Rows of a window that are compared at once: their sums stay in registers.
pub(super) const ROWS: usize = 8;
/// Largest number of candidates that a group keeps between frames; beyond it, only the best [`PATCHES`] stay.
const KEPT: usize = 128;

/// A row of reference patches.
pub(super) struct Line {
    frame: usize,
    row: usize,
    columns: Vec<usize>,
}

impl Line {
    /// Number of references, and so of groups.
    pub(super) fn len(&self) -> usize {
        self.columns.len()
    }
}

/// All rows of reference patches. Their grid depends on the number of earlier searches.
pub(super) fn lines((frames, height, width): Size, searches: usize) -> Vec<Line> {
    let frame_lines = |frame| {
        let (down, right) = shift(frame, searches);
        let columns = positions(width, right);
        let line = move |row| Line { frame, row, columns: columns.clone() };
        positions(height, down).into_iter().map(line)
    };
    (0..frames).flat_map(frame_lines).collect()
}

/// Finds the patches most similar to each reference patch of a line, near it in time and near the place where its motion
/// leads. Among equally similar patches, the first in the clip is taken. `groups` receives [`PATCHES`] for each reference, in
/// the order of the clip.
#[inline(always)]
pub(super) fn search<S: Simd>(
    simd: S,
    clip: (&[f32], Size),
    line: &Line,
    motion: &Motion,
    best: &mut Best,
    groups: &mut [u32],
) {
    match S::F32_LANES {
        16 => search_with::<S, { WINDOW / 16 }>(simd, clip, line, motion, best, groups),
        8 => search_with::<S, { WINDOW / 8 }>(simd, clip, line, motion, best, groups),
        4 => search_with::<S, { WINDOW / 4 }>(simd, clip, line, motion, best, groups),
        _ => search_with::<S, WINDOW>(simd, clip, line, motion, best, groups),
    }
}

/// The search with `V` vectors for a row of a window.
#[inline(always)]
fn search_with<S: Simd, const V: usize>(
    simd: S,
    (guide, (frames, height, width)): (&[f32], Size),
    &Line { frame, row, ref columns }: &Line,
    motion: &Motion,
    best: &mut Best,
    groups: &mut [u32],
) {
    let row_length = row_length(width);
    let plane = height * row_length;
    let reach = frame.saturating_sub(REACH)..(frame + REACH + 1).min(frames);
    // The reference's frame first: it probably has the most similar patches, and the bound falls at once.
    let order = || [frame].into_iter().chain(reach.clone().filter(|&other| other != frame));
    for (&column, group) in columns.iter().zip(groups.chunks_exact_mut(PATCHES)) {
        let motion = motion.at(row + SIDE / 2, column + SIDE / 2);
        let rows_in = |k: usize| window(moved(row, motion.0, frame, k), height);
        let columns_in = |k: usize| window(moved(column, motion.1, frame, k), width);
        let reference = frame * plane + row * row_length + column;
        best.clear();
        for (other, first) in order().flat_map(|k| rows_in(k).step_by(ROWS).map(move |i| (k, i))) {
            if other != frame {
                best.reduce(KEPT);
            }
            let (top, left) = (rows_in(other), columns_in(other));
            let start = other * plane + first * row_length + left.start;
            let distances = distances::<S, V>(simd, guide, reference, start, row_length);
            let starts = (start..).step_by(row_length).take(top.end - first);
            for (row, start) in distances.iter().zip(starts) {
                let bound = simd.splat_f32s(best.bound);
                let below = |&part| simd.first_true_m32s(simd.less_than_f32s(part, bound));
                if row.iter().any(|part| below(part) < S::F32_LANES) {
                    best.add(&bytemuck::cast_slice(row)[..left.len()], start);
                }
            }
            if (first..first + ROWS).contains(&row) && other == frame {
                best.put_first(reference);
            }
        }
        best.reduce(PATCHES);
        // A clip too small for a full group repeats its patches.
        group.iter_mut().zip(best.places().cycle()).for_each(|(slot, place)| *slot = place);
        group.sort_unstable();
    }
}

/// The search windows of all references, in the order of their groups, for clips without margins.
#[cfg(feature = "gpu")]
pub(super) fn windows(size: Size, searches: usize, motion: &Motion) -> Windows {
    let (frames, height, width) = size;
    let mut places = Vec::new();
    for Line { frame, row, columns } in lines(size, searches) {
        for column in columns {
            let place = |frame: usize, row: usize, column: usize| {
                ((frame * height + row) * width + column) as u32
            };
            let by = motion.at(row + SIDE / 2, column + SIDE / 2);
            let searched = frame.saturating_sub(REACH)..frames.min(frame + REACH + 1);
            let mut group = [NONE; 2 * REACH + 2];
            group[0] = place(frame, row, column);
            for (slot, other) in group[1..].iter_mut().zip(searched) {
                let top = window(moved(row, by.0, frame, other), height).start;
                let left = window(moved(column, by.1, frame, other), width).start;
                *slot = place(other, top, left);
            }
            places.push(group);
        }
    }
    Windows { size: (window(0, height).len(), window(0, width).len()), places }
}

/// Position in another frame of an object at `at` that moves by `by` pixels per frame.
fn moved(at: usize, by: f32, frame: usize, other: usize) -> usize {
    (at as f32 + by * (other as f32 - frame as f32)).round().max(0.0) as usize
}

/// Positions of the search window around `at`.
pub(super) fn window(at: usize, length: usize) -> Range<usize> {
    let count = length - SIDE + 1;
    let start = at.saturating_sub(WINDOW / 2).min(count.saturating_sub(WINDOW));
    start..(start + WINDOW).min(count)
}

/// The candidates of a group.
pub(super) struct Best {
    /// Distance (the bits of a positive float sort like the float), then position: the order is total.
    keys: Vec<u64>,
    count: usize,
    /// Distance from which on a patch is no candidate.
    bound: f32,
}

impl Default for Best {
    /// An empty list with room for a window, or for the kept candidates and one more block.
    fn default() -> Self {
        let most = (WINDOW * WINDOW).max(KEPT + ROWS * WINDOW);
        Self { keys: vec![0; most], count: 0, bound: f32::INFINITY }
    }
}

impl Best {
    fn clear(&mut self) {
        (self.count, self.bound) = (0, f32::INFINITY);
    }

    /// Adds the patches at consecutive positions that are below the bound. The code has no branch, because the
    /// outcome cannot be predicted.
    #[inline(always)]
    fn add(&mut self, distances: &[f32], first: usize) {
        let room = &mut self.keys[self.count..][..distances.len()];
        let mut taken = 0;
        for (&distance, place) in distances.iter().zip(first as u64..) {
            room[taken] = (u64::from(distance.to_bits()) + 1) << 32 | place;
            taken += usize::from(distance < self.bound);
        }
        self.count += taken;
    }

    /// Adds the reference before its equals, so that every pixel is covered.
    fn put_first(&mut self, reference: usize) {
        let known = self.keys[..self.count].iter_mut().find(|key| place(**key) == reference as u32);
        match known {
            Some(key) => *key = reference as u64,
            // NaN, so never below a bound.
            None => {
                self.keys[self.count] = reference as u64;
                self.count += 1;
            }
        }
    }

    /// Drops all but the best `PATCHES` if there are more than `most`.
    fn reduce(&mut self, most: usize) {
        if self.count > most {
            let (_, &mut last, _) = self.keys[..self.count].select_nth_unstable(PATCHES - 1);
            self.count = PATCHES;
            self.bound = f32::from_bits((last >> 32).saturating_sub(1) as u32);
        }
    }

    fn places(&self) -> impl Iterator<Item = u32> + Clone {
        self.keys[..self.count].iter().map(|&key| place(key))
    }
}

fn place(key: u64) -> u32 {
    key as u32
}

/// Squared distances between the patch at `reference` and those at consecutive positions from `start` on, and in the
/// rows below.
#[inline(always)]
fn distances<S: Simd, const V: usize>(
    simd: S,
    clip: &[f32],
    reference: usize,
    start: usize,
    row_length: usize,
) -> [[S::f32s; V]; ROWS] {
    let mut sums = [[simd.splat_f32s(0.0); V]; ROWS];
    for i in 0..SIDE {
        let patch = &clip[reference + i * row_length..][..SIDE];
        let rows: [&[f32]; ROWS] =
            std::array::from_fn(|row| &clip[start + (row + i) * row_length..][..SIDE + WINDOW]);
        for j in 0..SIDE {
            let value = simd.splat_f32s(patch[j]);
            for (row, sums) in rows.iter().zip(&mut sums) {
                let others = S::as_simd_f32s(&row[j..j + WINDOW]).0;
                for (sum, &other) in sums.iter_mut().zip(others) {
                    let difference = simd.sub_f32s(other, value);
                    *sum = simd.mul_add_e_f32s(difference, difference, *sum);
                }
            }
        }
    }
    sums
}

/// Counts how many patches cover each pixel: box sums, over squares of `SIDE`, of the patches that begin at a pixel.
pub(super) fn count_cover(groups: &[u32], cover: &mut [f32], row_length: usize) {
    cover.fill(0.0);
    for &place in groups.iter() {
        cover[place as usize] += 1.0;
    }
    for step in [1, row_length] {
        for at in (0..cover.len()).rev() {
            let before = (0..SIDE).map_while(|back| at.checked_sub(back * step));
            cover[at] = before.map(|place| cover[place]).sum();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::window;

    #[test]
    fn windows_stay_inside() {
        assert_eq!((window(0, 40), window(20, 40), window(34, 40)), (0..16, 12..28, 19..35));
        assert_eq!(window(1, 8), 0..3);
    }
}
