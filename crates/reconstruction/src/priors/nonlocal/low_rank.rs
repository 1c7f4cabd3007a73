//! The filter of groups of patches.
//!
//! Loops are written as loops, not as closures passed to iterators. A closure is a function without the vector
//! instructions, and calling it is ten times slower unless the compiler inlines it.

#![allow(clippy::needless_range_loop)] // the indices of the algebra

use pulp::Simd;

use super::layout::{BATCH, PATCHES, PIXELS};

/// Rows of a tile of a matrix product. The sums of a tile stay in registers: 4x4 of 32 with AVX-512, 4x2 of 16.
const ROWS: usize = 4;
const _: () = assert!(PIXELS.is_multiple_of(ROWS) && PATCHES.is_multiple_of(4));

/// The patches of a batch of groups and the matrices of their filter. An element of a matrix is a vector with one
/// number for each of several groups; a batch has several such matrices in sequence.
#[derive(Debug)]
pub(super) struct Filter {
    /// `Y`: \[PIXELS, PATCHES\].
    pub(super) patches: Vec<f32>,
    /// `G`: \[PIXELS, PIXELS\].
    gram: Vec<f32>,
    /// Lower triangle of the Cholesky factor, with the reciprocals of its diagonal: \[PIXELS, PIXELS\].
    factor: Vec<f32>,
    /// `Y - mean`, then intermediate results: \[PIXELS, PATCHES\].
    solved: Vec<f32>,
}

impl Default for Filter {
    fn default() -> Self {
        let matrix = |columns: usize| vec![0.0; PIXELS * columns * BATCH];
        let (patches, solved) = (matrix(PATCHES), matrix(PATCHES));
        Self { patches, gram: matrix(PIXELS), factor: matrix(PIXELS), solved }
    }
}

// The filter of a group is `Y <- mean + G^2 (G^2 + tau^2)^-1 (Y - mean)` with `G` of the centred patches, which
// equals `Y - tau^2 (G^2 + tau^2)^-1 (Y - mean)`.

/// Performs a step on each part of a batch, in tiles as wide as the registers of the machine allow.
macro_rules! for_each_part {
    ($simd:ident, $filter:ident, $part:ident => $step:expr) => {
        if S::F32_LANES == 16 {
            for mut $part in parts::<S, 4>($simd, $filter) {
                $step
            }
        } else {
            for mut $part in parts::<S, 2>($simd, $filter) {
                $step
            }
        }
    };
}

/// `G = (Y - mean) (Y - mean)^T`.
#[inline(always)]
pub(super) fn multiply<S: Simd>(simd: S, filter: &mut Filter) {
    for_each_part!(simd, filter, part => part.multiply());
}

/// The Cholesky factor of `G^2 + tau^2`.
#[inline(always)]
pub(super) fn factorize<S: Simd>(simd: S, filter: &mut Filter, tau: f32) {
    for_each_part!(simd, filter, part => part.factorize(tau));
}

/// Computes the filtered patches in place of `Y`.
#[inline(always)]
pub(super) fn solve<S: Simd>(simd: S, filter: &mut Filter, tau: f32) {
    for_each_part!(simd, filter, part => part.solve(tau));
}

#[inline(always)]
fn parts<S: Simd, const C: usize>(
    simd: S,
    filter: &mut Filter,
) -> impl Iterator<Item = Part<'_, S, C>> {
    let Filter { patches, gram, factor, solved } = filter;
    let patches = S::as_mut_simd_f32s(patches).0.chunks_exact_mut(PIXELS * PATCHES);
    let gram = S::as_mut_simd_f32s(gram).0.chunks_exact_mut(PIXELS * PIXELS);
    let factor = S::as_mut_simd_f32s(factor).0.chunks_exact_mut(PIXELS * PIXELS);
    let solved = S::as_mut_simd_f32s(solved).0.chunks_exact_mut(PIXELS * PATCHES);
    patches.zip(gram).zip(factor.zip(solved)).map(move |((patches, gram), (factor, solved))| Part {
        simd,
        patches,
        gram,
        factor,
        solved,
    })
}

/// As many groups as a vector has lanes, in tiles of `ROWS` x `C`.
struct Part<'a, S: Simd, const C: usize> {
    simd: S,
    patches: &'a mut [S::f32s],
    gram: &'a mut [S::f32s],
    factor: &'a mut [S::f32s],
    solved: &'a mut [S::f32s],
}

type Tile<S, const C: usize> = [[<S as Simd>::f32s; C]; ROWS];

impl<S: Simd, const C: usize> Part<'_, S, C> {
    /// `tau^2`. Far below the largest eigenvalue its square is lost in rounding, and the filter passes nothing.
    #[inline(always)]
    fn square(&self, tau: f32) -> S::f32s {
        let simd = self.simd;
        let mut trace = simd.splat_f32s(0.0);
        for i in 0..PIXELS {
            trace = simd.add_f32s(trace, self.gram[i * PIXELS + i]);
        }
        let least = simd.mul_f32s(simd.splat_f32s(4e-6), simd.mul_f32s(trace, trace));
        simd.max_f32s(simd.splat_f32s(tau * tau), least)
    }

    /// `solved = Y - mean`.
    #[inline(always)]
    fn centre(&mut self) {
        let simd = self.simd;
        let share = simd.splat_f32s(1.0 / PATCHES as f32);
        let rows = self.patches.chunks_exact(PATCHES).zip(self.solved.chunks_exact_mut(PATCHES));
        for (row, centred) in rows {
            let mut sum = simd.splat_f32s(0.0);
            for &value in row {
                sum = simd.add_f32s(sum, value);
            }
            let mean = simd.mul_f32s(sum, share);
            for (centred, &value) in centred.iter_mut().zip(row) {
                *centred = simd.sub_f32s(value, mean);
            }
        }
    }

    /// `G = solved solved^T`, both triangles.
    #[inline(always)]
    fn multiply(&mut self) {
        self.centre();
        for i in (0..PIXELS).step_by(ROWS) {
            for j in (0..i + ROWS).step_by(C) {
                let mut tile = self.zeros();
                let add = |a, b, sum| self.simd.mul_add_e_f32s(a, b, sum);
                products::<S, C>(&mut tile, self.solved, PATCHES, (i, j), PATCHES, add);
                for (r, row) in tile.iter().enumerate() {
                    for (c, &value) in row.iter().enumerate() {
                        self.gram[(i + r) * PIXELS + j + c] = value;
                        self.gram[(j + c) * PIXELS + i + r] = value;
                    }
                }
            }
        }
    }

    /// `G^2 + square = L L^T`, tile by tile.
    #[inline(always)]
    fn factorize(&mut self, tau: f32) {
        let (simd, square) = (self.simd, self.square(tau));
        for j in (0..PIXELS).step_by(ROWS) {
            for i in (j..PIXELS).step_by(ROWS) {
                for column in (j..j + ROWS).step_by(C) {
                    let mut tile = self.zeros();
                    let add = |a, b, sum| simd.mul_add_e_f32s(a, b, sum);
                    let subtract = |a, b, sum| simd.negate_mul_add_e_f32s(a, b, sum);
                    products::<S, C>(&mut tile, self.gram, PIXELS, (i, column), PIXELS, add);
                    products::<S, C>(&mut tile, self.factor, PIXELS, (i, column), j, subtract);
                    store(&tile, self.factor, PIXELS, (i, column));
                }
                for row in i..i + ROWS {
                    for column in j..(j + ROWS).min(row + 1) {
                        self.finish(row, column, j, square);
                    }
                }
            }
        }
    }

    /// An element of the factor, from which only the products from column `first` on remain to be subtracted.
    #[inline(always)]
    fn finish(&mut self, row: usize, column: usize, first: usize, square: S::f32s) {
        let simd = self.simd;
        let at = |row: usize, column: usize| row * PIXELS + column;
        let mut value = self.factor[at(row, column)];
        for k in first..column {
            let (a, b) = (self.factor[at(row, k)], self.factor[at(column, k)]);
            value = simd.negate_mul_add_e_f32s(a, b, value);
        }
        self.factor[at(row, column)] = if row == column {
            // The pivots of a sum with tau^2 are at least tau^2, up to rounding.
            let least = simd.mul_f32s(simd.splat_f32s(0.1), square);
            let pivot = simd.max_f32s(simd.add_f32s(value, square), least);
            simd.div_f32s(simd.splat_f32s(1.0), simd.sqrt_f32s(pivot))
        } else {
            simd.mul_f32s(value, self.factor[at(column, column)])
        };
    }

    #[inline(always)]
    fn solve(&mut self, tau: f32) {
        let square = self.square(tau);
        for column in (0..PATCHES).step_by(C) {
            for row in (0..PIXELS).step_by(ROWS) {
                self.forward(row, column);
            }
            for row in (0..PIXELS).step_by(ROWS).rev() {
                self.backward(row, column, square);
            }
        }
    }

    /// A tile of `L^-1 solved`, in place of `solved`; the tiles above are done.
    #[inline(always)]
    fn forward(&mut self, i: usize, column: usize) {
        let simd = self.simd;
        let mut tile = self.load(i, column);
        let factor: [&[S::f32s]; ROWS] =
            std::array::from_fn(|r| &self.factor[(i + r) * PIXELS..][..i + ROWS]);
        for k in 0..i {
            let done = &self.solved[k * PATCHES + column..][..C];
            for c in 0..C {
                for r in 0..ROWS {
                    tile[r][c] = simd.negate_mul_add_e_f32s(factor[r][k], done[c], tile[r][c]);
                }
            }
        }
        for c in 0..C {
            for r in 0..ROWS {
                for k in 0..r {
                    let done = tile[k][c];
                    tile[r][c] = simd.negate_mul_add_e_f32s(factor[r][i + k], done, tile[r][c]);
                }
                tile[r][c] = simd.mul_f32s(tile[r][c], factor[r][i + r]);
            }
        }
        store(&tile, self.solved, PATCHES, (i, column));
    }

    /// A tile of `X = L^-T solved`, in place of `solved`, and of `Y - square X`, in place of `Y`; the tiles below are
    /// done.
    #[inline(always)]
    fn backward(&mut self, i: usize, column: usize, square: S::f32s) {
        let simd = self.simd;
        let mut tile = self.load(i, column);
        for k in i + ROWS..PIXELS {
            let done = &self.solved[k * PATCHES + column..][..C];
            let factor = &self.factor[k * PIXELS + i..][..ROWS];
            for c in 0..C {
                for r in 0..ROWS {
                    tile[r][c] = simd.negate_mul_add_e_f32s(factor[r], done[c], tile[r][c]);
                }
            }
        }
        for c in 0..C {
            for r in (0..ROWS).rev() {
                for k in r + 1..ROWS {
                    let factor = self.factor[(i + k) * PIXELS + i + r];
                    tile[r][c] = simd.negate_mul_add_e_f32s(factor, tile[k][c], tile[r][c]);
                }
                tile[r][c] = simd.mul_f32s(tile[r][c], self.factor[(i + r) * PIXELS + i + r]);
            }
        }
        store(&tile, self.solved, PATCHES, (i, column));
        for (r, row) in tile.iter().enumerate() {
            let patches = &mut self.patches[(i + r) * PATCHES + column..][..C];
            for (value, &solved) in patches.iter_mut().zip(row) {
                *value = simd.negate_mul_add_e_f32s(square, solved, *value);
            }
        }
    }

    #[inline(always)]
    fn zeros(&self) -> Tile<S, C> {
        [[self.simd.splat_f32s(0.0); C]; ROWS]
    }

    /// A tile of `solved`.
    #[inline(always)]
    fn load(&self, i: usize, column: usize) -> Tile<S, C> {
        let mut tile = self.zeros();
        for (r, row) in tile.iter_mut().enumerate() {
            row.copy_from_slice(&self.solved[(i + r) * PATCHES + column..][..C]);
        }
        tile
    }
}

/// Accumulates `f(a_ik, a_jk, sum)` over the first `count` columns, for the rows of a tile from `i` and `j` on of a
/// matrix with `columns` columns.
#[inline(always)]
fn products<S: Simd, const C: usize>(
    tile: &mut Tile<S, C>,
    matrix: &[S::f32s],
    columns: usize,
    (i, j): (usize, usize),
    count: usize,
    f: impl Fn(S::f32s, S::f32s, S::f32s) -> S::f32s,
) {
    let row = |row: usize| &matrix[row * columns..][..count];
    let left: [&[S::f32s]; ROWS] = std::array::from_fn(|r| row(i + r));
    let right: [&[S::f32s]; C] = std::array::from_fn(|c| row(j + c));
    let mut sums = *tile;
    for k in 0..count {
        for c in 0..C {
            let b = right[c][k];
            for r in 0..ROWS {
                sums[r][c] = f(left[r][k], b, sums[r][c]);
            }
        }
    }
    *tile = sums;
}

/// Writes a tile to its place in a matrix with `columns` columns.
#[inline(always)]
fn store<V: Copy, const C: usize>(
    tile: &[[V; C]; ROWS],
    matrix: &mut [V],
    columns: usize,
    (i, j): (usize, usize),
) {
    for (r, row) in tile.iter().enumerate() {
        matrix[(i + r) * columns + j..][..C].copy_from_slice(row);
    }
}

#[cfg(test)]
mod tests {
    use super::super::layout::place_of;
    use super::{BATCH, Filter, PATCHES, PIXELS, factorize, multiply, solve};
    use pulp::{Arch, Simd, WithSimd};
    use rand::{Rng, SeedableRng};

    type Patches = Vec<[f32; PATCHES]>;

    /// The filter on a batch of groups.
    struct Apply<'a> {
        groups: &'a [Patches],
        tau: f32,
    }

    impl WithSimd for Apply<'_> {
        type Output = Vec<Patches>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<Patches> {
            let mut filter = Filter::default();
            let place =
                |group, i: usize, patch| place_of::<S>(group, patch) + i * PATCHES * S::F32_LANES;
            for (index, group) in self.groups.iter().enumerate() {
                for (i, row) in group.iter().enumerate() {
                    for (patch, &value) in row.iter().enumerate() {
                        filter.patches[place(index, i, patch)] = value;
                    }
                }
            }
            multiply(simd, &mut filter);
            factorize(simd, &mut filter, self.tau);
            solve(simd, &mut filter, self.tau);
            let row =
                |group, i| std::array::from_fn(|patch| filter.patches[place(group, i, patch)]);
            let group = |group| (0..PIXELS).map(|i| row(group, i)).collect();
            (0..self.groups.len()).map(group).collect()
        }
    }

    /// Eigenvalues and eigenvectors (rows) of a symmetric matrix, by Jacobi's rotations.
    #[allow(clippy::needless_range_loop)] // the indices of the algebra
    fn eigen(mut a: Vec<Vec<f64>>) -> (Vec<f64>, Vec<Vec<f64>>) {
        let n = a.len();
        let mut vectors: Vec<Vec<f64>> =
            (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect();
        for (p, q) in (0..12).flat_map(|_| (0..n).flat_map(|q| (0..q).map(move |p| (p, q)))) {
            let angle = 0.5 * (2.0 * a[p][q]).atan2(a[q][q] - a[p][p]);
            let (s, c) = angle.sin_cos();
            for k in 0..n {
                (a[k][p], a[k][q]) = (c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]);
            }
            for rows in [&mut a, &mut vectors] {
                for k in 0..n {
                    let (x, y) = (rows[p][k], rows[q][k]);
                    (rows[p][k], rows[q][k]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
        ((0..n).map(|i| a[i][i]).collect(), vectors)
    }

    /// Each eigenvector `e` of `G = Y Y^T` with the eigenvalue `l` keeps the share `l^2 / (l^2 + tau^2)`.
    #[test]
    fn the_filter_is_that_of_the_eigenvalues() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let tau = 0.9;
        let mut groups = vec![vec![[0.0; PATCHES]; PIXELS]; BATCH];
        for group in &mut groups {
            // Few directions and noise, as in a group of similar patches.
            let directions: Vec<f32> = (0..3 * PIXELS).map(|_| rng.random::<f32>() - 0.5).collect();
            for patch in 0..PATCHES {
                let shares: [f32; 3] = rng.random();
                for i in 0..PIXELS {
                    let signal: f32 = (0..3).map(|d| shares[d] * directions[d * PIXELS + i]).sum();
                    let noise = 0.3 * (rng.random::<f32>() - 0.5);
                    group[i][patch] = 0.5 + signal + noise;
                }
            }
        }
        let after = Arch::new().dispatch(Apply { groups: &groups, tau });
        for index in [0, 5, BATCH - 1] {
            let before = &groups[index];
            let mean = |i: usize| {
                (0..PATCHES).map(|k| f64::from(before[i][k])).sum::<f64>() / PATCHES as f64
            };
            let centred: Vec<Vec<f64>> = (0..PIXELS)
                .map(|i| (0..PATCHES).map(|k| f64::from(before[i][k]) - mean(i)).collect())
                .collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let gram = centred.iter().map(|a| centred.iter().map(|b| dot(a, b)).collect());
            let (values, vectors) = eigen(gram.collect());
            assert!(values.iter().any(|l| *l > 2.0) && values.iter().any(|l| *l < 0.5));
            for k in 0..PATCHES {
                let patch: Vec<f64> = centred.iter().map(|row| row[k]).collect();
                for i in 0..PIXELS {
                    let kept = values.iter().zip(&vectors).map(|(value, vector)| {
                        let square = value * value;
                        square / (square + f64::from(tau * tau)) * dot(vector, &patch) * vector[i]
                    });
                    let expected = mean(i) + kept.sum::<f64>();
                    let found = f64::from(after[index][i][k]);
                    assert!((found - expected).abs() < 1e-4, "{index} {k} {i}: {found} {expected}");
                }
            }
        }
    }
}
