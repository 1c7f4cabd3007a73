//! Temporal shrinkage: an empirical Wiener filter of DCT coefficients along time (Ghael, Sayeed and Baraniuk 1997).
//!
//! A group of patches of fine texture spans all directions. Its filter then passes everything, including
//! frame-to-frame error in static regions. Along time such error can be distinguished from motion, because it is weak
//! in each frequency.

use std::f32::consts::PI;

use multiversion::multiversion;

/// Radius of the square over which energies are averaged, in pixels.
const RADIUS: usize = 2;

/// The DCT along time of frames \[B,H,W\] of one size, without its constant coefficient, and its shrinkage.
#[derive(Debug)]
pub(super) struct TemporalShrinkage {
    frames: usize,
    height: usize,
    width: usize,
    /// The DCT-II without its first row \[B-1,B\].
    cosines: Vec<f32>,
    /// Coefficients, and the means of their squares along the row, of the rows of a square \[rows,B-1,W\].
    rows: Vec<f32>,
    squares: Vec<f32>,
    /// The part of a coefficient that is subtracted, for one row.
    excess: Vec<f32>,
}

impl TemporalShrinkage {
    pub(super) fn new((frames, height, width): (usize, usize, usize)) -> Self {
        let changes = frames.saturating_sub(1);
        let cosine = |m: usize, k: usize| {
            let angle = PI * m as f32 * (k as f32 + 0.5) / frames as f32;
            (2.0 / frames as f32).sqrt() * angle.cos()
        };
        let cosines = (1..=changes).flat_map(|m| (0..frames).map(move |k| cosine(m, k))).collect();
        let ring = vec![0.0; (2 * RADIUS + 1) * changes * width];
        let (squares, excess) = (ring.clone(), vec![0.0; width]);
        Self { frames, height, width, cosines, rows: ring, squares, excess }
    }

    /// The DCT-II without its first row.
    #[cfg(feature = "gpu")]
    pub(super) fn cosines(&self) -> &[f32] {
        &self.cosines
    }

    /// Multiplies each coefficient by `g = e^2 / (e^2 + level^4)`, where `e` is the mean of its square over 5x5
    /// pixels, cut at the edges. `level` is above 0. `clip` has frame after frame, row by row, with at least
    /// `row_length` values in a row.
    pub(super) fn shrink(&mut self, clip: &mut [f32], row_length: usize, level: f32) {
        let Self { frames, height, width, .. } = *self;
        let (plane, changes) = (height * row_length, frames.saturating_sub(1));
        let least = (level * level).max(f32::MIN_POSITIVE);
        let mut analysed = 0;
        for row in 0..height {
            let near = row.saturating_sub(RADIUS)..height.min(row + RADIUS + 1);
            // The rows above are already shrunk; rows that are not yet analysed are unchanged.
            while analysed < near.end {
                let slot = analysed % (2 * RADIUS + 1) * changes * width;
                let (rows, squares) = (&mut self.rows[slot..], &mut self.squares[slot..]);
                for (m, cosine) in self.cosines.chunks_exact(frames).enumerate() {
                    let at = m * width..(m + 1) * width;
                    let frames = clip[analysed * row_length..].chunks(plane);
                    analyse(cosine, frames, &mut rows[at.clone()], &mut squares[at]);
                }
                analysed += 1;
            }
            for (m, cosine) in self.cosines.chunks_exact(frames).enumerate() {
                let of_row = |row: usize| (row % (2 * RADIUS + 1) * changes + m) * width..;
                let squares = near.clone().map(|row| &self.squares[of_row(row)][..width]);
                let scale = 1.0 / (near.len() as f32 * least);
                excess(squares, scale, &self.rows[of_row(row)], &mut self.excess);
                let frames = clip[row * row_length..].chunks_mut(plane);
                for (&cosine, frame) in cosine.iter().zip(frames) {
                    for (value, &excess) in frame.iter_mut().zip(&self.excess) {
                        *value -= cosine * excess;
                    }
                }
            }
        }
    }
}

/// Computes a coefficient of a row, and the means of its squares over `2 RADIUS + 1` columns, cut at the edges.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn analyse<'a>(
    cosine: &[f32],
    frames: impl Iterator<Item = &'a [f32]>,
    row: &mut [f32],
    squares: &mut [f32],
) {
    row.fill(0.0);
    for (&cosine, frame) in cosine.iter().zip(frames) {
        for (sum, &value) in row.iter_mut().zip(frame) {
            *sum += cosine * value;
        }
    }
    let width = row.len();
    for (j, square) in squares.iter_mut().enumerate() {
        let near = &row[j.saturating_sub(RADIUS)..width.min(j + RADIUS + 1)];
        *square = near.iter().map(|value| value * value).sum::<f32>() / near.len() as f32;
    }
}

/// Computes `(1 - g) c` for the coefficients `c` of a row. `e / level^2` is the sum of some rows times `scale`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn excess<'a>(
    squares: impl Iterator<Item = &'a [f32]>,
    scale: f32,
    row: &[f32],
    excess: &mut [f32],
) {
    excess.fill(0.0);
    for squares in squares {
        for (sum, &square) in excess.iter_mut().zip(squares) {
            *sum += square;
        }
    }
    for (excess, &value) in excess.iter_mut().zip(row) {
        let ratio = *excess * scale;
        *excess = value / (1.0 + ratio * ratio);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::{RADIUS, TemporalShrinkage};
    use ndarray::{Array3, Axis};
    use rand::{RngExt, SeedableRng};
    use std::f64::consts::PI;

    /// Coefficient by coefficient and pixel by pixel, in 64 bits.
    pub fn shrunk(clip: &Array3<f32>, level: f64) -> Array3<f32> {
        let (frames, height, width) = clip.dim();
        let wide = clip.mapv(f64::from);
        let mut result = wide.clone();
        for m in 1..frames {
            let cosine = |k: usize| {
                (2.0 / frames as f64).sqrt()
                    * (PI * m as f64 * (k as f64 + 0.5) / frames as f64).cos()
            };
            let of =
                |i: usize, j: usize| (0..frames).map(|k| cosine(k) * wide[[k, i, j]]).sum::<f64>();
            let near =
                |at: usize, length: usize| at.saturating_sub(RADIUS)..length.min(at + RADIUS + 1);
            for (i, j) in (0..height).flat_map(|i| (0..width).map(move |j| (i, j))) {
                let (rows, columns) = (near(i, height), near(j, width));
                let count = (rows.len() * columns.len()) as f64;
                let squares = rows.flat_map(|i| columns.clone().map(move |j| of(i, j).powi(2)));
                let ratio = squares.sum::<f64>() / count / level.powi(2);
                let excess = of(i, j) / (1.0 + ratio.powi(2));
                (0..frames).for_each(|k| result[[k, i, j]] -= cosine(k) * excess);
            }
        }
        result.mapv(|value| value as f32)
    }

    #[test]
    fn changes_are_those_of_the_reference() {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(2);
        for (size, margin) in [((7, 9, 13), 0), ((2, 3, 4), 5), ((1, 6, 6), 1), ((5, 1, 2), 3)] {
            // The changes fall from left to right, from far above the level to below it.
            let clip = Array3::from_shape_fn(size, |(_, _, j)| {
                let noise = rng.random::<f32>();
                0.5 + noise / (1 + 3 * j) as f32
            });
            let mut rows = Array3::from_elem((size.0, size.1, size.2 + margin), 7.0f32);
            rows.slice_axis_mut(Axis(2), (..size.2).into()).assign(&clip);
            let mut flat = rows.into_raw_vec_and_offset().0;
            let mut filter = TemporalShrinkage::new(size);
            filter.shrink(&mut flat, size.2 + margin, 0.05);
            let expected = shrunk(&clip, 0.05);
            for (row, expected) in flat.chunks_exact(size.2 + margin).zip(expected.rows()) {
                for (found, expected) in row.iter().zip(expected) {
                    assert!((found - expected).abs() < 1e-6, "{size:?}: {found} {expected}");
                }
                assert!(row[size.2..].iter().all(|&beyond| beyond == 7.0));
            }
        }
    }

    #[test]
    fn coefficients_far_above_the_level_stay_and_those_far_below_vanish() {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(4);
        let clip = Array3::from_shape_simple_fn((6, 12, 12), || rng.random::<f32>());
        for (level, share) in [(1e-3, 1.0), (30.0, 0.0), (f32::MIN_POSITIVE, 1.0)] {
            let mut flat = clip.clone().into_raw_vec_and_offset().0;
            TemporalShrinkage::new(clip.dim()).shrink(&mut flat, 12, level);
            let found = Array3::from_shape_vec(clip.dim(), flat).unwrap();
            let mean = clip.mean_axis(Axis(0)).unwrap();
            for (found, clip) in found.outer_iter().zip(clip.outer_iter()) {
                let expected = &mean + &(share * (&clip - &mean));
                assert!((&found - &expected).iter().all(|d| d.abs() < 1e-4), "{level}");
            }
        }
    }
}
