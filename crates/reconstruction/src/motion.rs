//! Motion estimation from reconstructed frames (Lucas and Kanade, 1981).
//!
//! Fast motion is reconstructed blurred, and then looks as good as a smooth scene. But coarse structure survives. So
//! frames are averaged over cells, and the motion of a window of cells is the one that explains its temporal change
//! best.

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};

use super::cores::Cores;

/// Side of the cells in pixels. Motion by much more than this from frame to frame is estimated wrongly.
const CELL: usize = 8;
/// Side of the windows in cells.
const WINDOW: usize = 16;
/// Radius, in cells, of the window from which the motion of a cell is estimated.
const REACH: usize = 4;
/// Smallest share of the change that a motion must explain.
const EXPLAINED: f32 = 0.1;
/// Share of the gradient's energy that is treated as along an edge, where motion cannot be observed.
const EDGE: f32 = 0.01;
/// Energies below this are rounding errors.
const FLOOR: f32 = 1e-7;

/// Energies of the spatial differences and of the temporal slope, and their products.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Steps {
    pub down: f32,
    pub right: f32,
    pub both: f32,
    pub slope: f32,
    pub slope_down: f32,
    pub slope_right: f32,
}

impl Steps {
    pub(super) fn add(&mut self, down: f32, right: f32, slope: f32) {
        self.down += down * down;
        self.right += right * right;
        self.both += down * right;
        self.slope += slope * slope;
        self.slope_down += slope * down;
        self.slope_right += slope * right;
    }

    pub(super) fn over(self, count: f32) -> Self {
        Self {
            down: self.down / count,
            right: self.right / count,
            both: self.both / count,
            slope: self.slope / count,
            slope_down: self.slope_down / count,
            slope_right: self.slope_right / count,
        }
    }

    /// The motion that explains the slope best, in differences down and to the right, and the share of the slope that
    /// it leaves unexplained. The energies are means over pixels.
    pub(super) fn motion(&self) -> ((f32, f32), f32) {
        let ridge = EDGE * (self.down + self.right) + FLOOR;
        let (down, right) = (self.down + ridge, self.right + ridge);
        let determinant = down * right - self.both * self.both;
        let rows = (self.both * self.slope_right - right * self.slope_down) / determinant;
        let columns = (self.both * self.slope_down - down * self.slope_right) / determinant;
        let unexplained =
            (self.slope + rows * self.slope_down + columns * self.slope_right).max(0.0);
        ((rows, columns), unexplained / self.slope.max(FLOOR))
    }
}

/// Speed of the fastest window of frames \[K,H,W\] with this white level, in pixels per frame.
pub fn fastest(frames: ArrayView3<'_, f32>, white: f32) -> f32 {
    let coarse = averaged(frames) / white;
    let (count, rows, columns) = coarse.dim();
    if count < 2 || rows < 3 || columns < 3 {
        return 0.0;
    }
    // Windows grow where a side is not a multiple, and shrink only in a smaller picture.
    let parts = |length: usize| (length / WINDOW).max(1);
    let range = |part: usize, length: usize| {
        part * length / parts(length)..(part + 1) * length / parts(length)
    };
    let mut fastest = 0.0f32;
    for row in 0..parts(rows) {
        for column in 0..parts(columns) {
            let window = coarse.slice(s![.., range(row, rows), range(column, columns)]);
            let ((down, right), unexplained) = steps(window).motion();
            if unexplained <= 1.0 - EXPLAINED {
                fastest = fastest.max(down.hypot(right) * CELL as f32);
            }
        }
    }
    fastest
}

/// Motion of each part of a clip, in pixels per frame.
#[derive(Debug)]
pub(super) struct Motion {
    /// Motion down and to the right of each cell. Pixels beyond the last cell take its motion. A clip that is too
    /// small or too short is one static cell.
    of_cells: Array2<(f32, f32)>,
}

impl Motion {
    /// No motion anywhere.
    pub(super) fn none() -> Self {
        Self { of_cells: Array2::default((1, 1)) }
    }

    /// Estimates the motion of frames \[K,H,W\]. A cell takes the motion of the [`REACH`] cells around it, the global
    /// motion or none: the one with the smallest frame difference near the cell. A wrong estimate
    /// (periodic texture, more than a cell per frame) therefore gives no motion.
    pub(super) fn of(frames: ArrayView3<'_, f32>, cores: &Cores) -> Self {
        let coarse = averaged(frames);
        let (count, rows, columns) = coarse.dim();
        if count < 2 || rows < 3 || columns < 3 {
            return Self::none();
        }
        let estimate = |window: ArrayView3<'_, f32>| {
            let ((down, right), _) = steps(window).motion();
            let cells = down.abs().max(right.abs());
            (cells <= 1.0).then_some((down * CELL as f32, right * CELL as f32))
        };
        let whole = estimate(coarse.view());
        // At least three cells, because fewer have no gradient.
        let around = |at: usize, reach: usize, length: usize| {
            let start = at.saturating_sub(reach).min(length - 3);
            start..(at + reach + 1).clamp(start + 3, length)
        };
        let motion_at = |row: usize, column: usize| {
            let window = s![.., around(row, REACH, rows), around(column, REACH, columns)];
            let pixels = |cells: Range<usize>| cells.start * CELL..cells.end * CELL;
            let area = (pixels(around(row, 1, rows)), pixels(around(column, 1, columns)));
            let mut best = (0.0, 0.0);
            let mut smallest = difference(frames, &area, best);
            for motion in [estimate(coarse.slice(window)), whole].into_iter().flatten() {
                let difference = difference(frames, &area, motion);
                if difference < smallest {
                    (best, smallest) = (motion, difference);
                }
            }
            best
        };
        let mut motions = Array2::default((rows, columns));
        cores.share(motions.outer_iter_mut().enumerate(), |(row, mut cells)| {
            cells.indexed_iter_mut().for_each(|(column, cell)| *cell = motion_at(row, column));
        });
        Self { of_cells: motions }
    }

    /// The motion at this pixel.
    pub(super) fn at(&self, row: usize, column: usize) -> (f32, f32) {
        let (rows, columns) = self.of_cells.dim();
        self.of_cells[[(row / CELL).min(rows - 1), (column / CELL).min(columns - 1)]]
    }
}

/// Mean squared difference between these rows and columns of each frame \[K,H,W\] and those of the next frame
/// displaced by a motion; infinite if the motion leads outside.
fn difference(
    frames: ArrayView3<'_, f32>,
    (rows, columns): &(Range<usize>, Range<usize>),
    (down, right): (f32, f32),
) -> f32 {
    let (count, height, width) = frames.dim();
    // The ranges in this and the next frame, as far as both are inside.
    let ranges = |range: &Range<usize>, by: f32, length: usize| {
        let by = by.round() as isize;
        let start = (range.start as isize).max(-by);
        let end = (range.end as isize).min(length as isize - by).max(start);
        (start as usize..end as usize, (start + by) as usize..(end + by) as usize)
    };
    let (rows, next_rows) = ranges(rows, down, height);
    let (columns, next_columns) = ranges(columns, right, width);
    let pixels = (count - 1) * rows.len() * columns.len();
    if pixels == 0 {
        return f32::INFINITY;
    }
    let mut sum = 0.0;
    for k in 0..count - 1 {
        let here = frames.slice(s![k, rows.clone(), columns.clone()]);
        let next = frames.slice(s![k + 1, next_rows.clone(), next_columns.clone()]);
        sum += here.iter().zip(next).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    }
    sum / pixels as f32
}

/// Means over cells \[K, H / CELL, W / CELL\]. Incomplete cells at the far edges are dropped.
fn averaged(frames: ArrayView3<'_, f32>) -> Array3<f32> {
    let (count, height, width) = frames.dim();
    Array3::from_shape_fn((count, height / CELL, width / CELL), |(k, row, column)| {
        let (i, j) = (row * CELL, column * CELL);
        frames.slice(s![k, i..i + CELL, j..j + CELL]).sum() / (CELL * CELL) as f32
    })
}

/// Mean energies of a window, by central differences halfway between two frames.
fn steps(window: ArrayView3<'_, f32>) -> Steps {
    let (count, rows, columns) = window.dim();
    let mut sums = Steps::default();
    for k in 0..count - 1 {
        let (frame, next) = (window.index_axis(Axis(0), k), window.index_axis(Axis(0), k + 1));
        for i in 1..rows - 1 {
            for j in 1..columns - 1 {
                let across =
                    |a: [usize; 2], b: [usize; 2]| (frame[b] - frame[a] + next[b] - next[a]) / 4.0;
                let down = across([i - 1, j], [i + 1, j]);
                let right = across([i, j - 1], [i, j + 1]);
                sums.add(down, right, next[[i, j]] - frame[[i, j]]);
            }
        }
    }
    sums.over(((count - 1) * (rows - 2) * (columns - 2)) as f32)
}

#[cfg(test)]
mod tests {
    use super::{Cores, Motion, fastest};
    use ndarray::{Array3, s};

    /// Coarse and fine texture that moves by `rows` and `columns` pixels per frame.
    fn moving(rows: f32, columns: f32) -> Array3<f32> {
        Array3::from_shape_fn((8, 160, 300), |(k, i, j)| {
            let (i, j) = (i as f32 - rows * k as f32, j as f32 - columns * k as f32);
            let coarse = (i / 11.0).sin() * (j / 14.0).cos() + (i / 17.0 + j / 23.0).sin();
            0.5 + 0.15 * coarse + 0.1 * (i * 1.3).sin() * (j * 1.1).sin()
        })
    }

    #[test]
    fn the_speed_of_coarse_structure_is_estimated() {
        for (rows, columns) in [(0.0, 0.0), (0.0, 3.0), (-2.0, 2.0), (6.0, 8.0), (10.0, 0.0)] {
            let (expected, speed) =
                (f32::hypot(rows, columns), fastest(moving(rows, columns).view(), 1.0));
            assert!((speed - expected).abs() < 0.25 * expected + 0.1, "{rows}, {columns}: {speed}");
        }
    }

    #[test]
    fn a_moving_part_is_detected_and_changing_light_is_no_motion() {
        let mut frames = moving(0.0, 0.0);
        frames.slice_mut(s![.., .., 150..]).assign(&moving(0.0, 9.0).slice(s![.., .., 150..]));
        assert!(fastest(frames.view(), 1.0) > 6.0, "{}", fastest(frames.view(), 1.0));
        let mut lit = moving(0.0, 0.0);
        lit.outer_iter_mut().enumerate().for_each(|(k, mut frame)| frame *= 1.0 - 0.1 * k as f32);
        assert!(fastest(lit.view(), 1.0) < 2.0, "{}", fastest(lit.view(), 1.0));
        // Too small for cells.
        assert_eq!(fastest(moving(0.0, 9.0).slice(s![.., ..20, ..]), 1.0), 0.0);
    }

    #[test]
    fn each_part_has_its_motion() {
        let mut frames = moving(0.0, 0.0);
        frames.slice_mut(s![.., .., 150..]).assign(&moving(-2.0, 4.0).slice(s![.., .., 150..]));
        let motion = Motion::of(frames.view(), &Cores::default());
        assert_eq!((motion.at(80, 60), motion.at(0, 0)), ((0.0, 0.0), (0.0, 0.0)));
        for at in [(80, 230), (159, 299)] {
            let (down, right) = motion.at(at.0, at.1);
            assert!(
                (down + 2.0).abs() < 1.0 && (right - 4.0).abs() < 1.0,
                "{at:?}: {down}, {right}"
            );
        }
        // A single frame, and frames too small for cells, have no estimate.
        for frames in [frames.slice(s![..1, .., ..]), frames.slice(s![.., ..20, ..])] {
            assert_eq!(Motion::of(frames, &Cores::default()).at(10, 200), (0.0, 0.0));
        }
    }

    #[test]
    fn a_shadow_that_moves_over_still_texture_is_no_motion() {
        let frames = Array3::from_shape_fn((8, 96, 128), |(k, i, j)| {
            let (fine, coarse) = (i as f32 * 1.3, (j as f32 - 5.0 * k as f32) / 11.0);
            0.5 + 0.2 * fine.sin() * (j as f32 * 1.1).sin() + 0.05 * coarse.sin()
        });
        assert!((fastest(frames.view(), 1.0) - 5.0).abs() < 1.0);
        assert_eq!(Motion::of(frames.view(), &Cores::default()).at(48, 64), (0.0, 0.0));
    }
}
