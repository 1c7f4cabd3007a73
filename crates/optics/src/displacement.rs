//! Displacement of a measurement against its masks, by any number of pixels up to the size of a window.
//!
//! A nearly uniform scene follows the sum of its masks. The cross-correlation of the two is therefore largest at their
//! displacement. It needs no fit of the frames, so thousands of displacements are searched in the time of one fit.

use ndarray::{Array2, ArrayView2, s};

use super::measurement_check::{BLOCK, block_centred};

/// The displacement (rows, columns) that fits best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Displacement {
    /// Rows by which the masks must be moved down.
    pub rows: i32,
    /// Columns by which the masks must be moved to the right.
    pub columns: i32,
    /// Share of the fine structure of the measurement that the sum of the masks explains there.
    pub explained: f64,
}

/// Compares the centre of a measurement \[H,W\] with the sum of its masks \[H,W\] at each displacement by up to `reach`
/// pixels along each axis. `None` if no block of 8x8 pixels is left, or if one of the two has no fine structure.
pub fn displacement(
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    reach: usize,
) -> Option<Displacement> {
    let (height, width) = y.dim();
    let inner = |length: usize| length.saturating_sub(2 * reach) / BLOCK * BLOCK;
    let (rows, columns) = (inner(height), inner(width));
    if light.dim() != (height, width) || rows == 0 || columns == 0 {
        return None;
    }
    let energy = |image: &Array2<f32>| image.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
    let at = |row: usize, column: usize| s![row..row + rows, column..column + columns];
    let y = block_centred(y.slice(at(reach, reach)));
    let norm = energy(&y) * energy(&block_centred(light.slice(at(reach, reach))));
    if norm.is_nan() || norm <= 0.0 {
        return None;
    }
    let all = (0..=2 * reach).flat_map(|row| (0..=2 * reach).map(move |column| (row, column)));
    // The sum of y over a block is 0, so block-centred light would give the same product.
    let product = |(row, column): (usize, usize)| {
        let light = light.slice(at(row, column));
        let rows = light.outer_iter().zip(y.outer_iter());
        let line = |(light, y): (ndarray::ArrayView1<'_, f32>, ndarray::ArrayView1<'_, f32>)| {
            f64::from(light.iter().zip(&y).map(|(light, y)| light * y).sum::<f32>())
        };
        ((row, column), rows.map(line).sum::<f64>())
    };
    let ((row, column), product) = all.map(product).max_by(|a, b| a.1.total_cmp(&b.1))?;
    let pixels = |index: usize| reach as i32 - index as i32;
    let explained = product.max(0.0).powi(2) / norm;
    Some(Displacement { rows: pixels(row), columns: pixels(column), explained })
}

#[cfg(test)]
mod tests {
    use super::displacement;
    use crate::{iid_masks, measure, noisy, random_squares};
    use ndarray::{Array3, Axis, s};

    #[test]
    fn a_wrong_crop_is_found_and_masks_of_another_camera_fit_nowhere() {
        let scene = Array3::from_shape_fn((12, 160, 160), |(k, i, j)| {
            0.5 + 0.2 * ((i + 2 * k) as f32 * 0.2).sin() * (j as f32 * 0.15).cos()
        });
        let kinds = |seed| {
            let squares = random_squares(12, 160, 160, seed).unwrap().0;
            [iid_masks(12, 160, 160, seed).unwrap(), squares]
        };
        for (masks, other) in kinds(1).into_iter().zip(kinds(2)) {
            let y = noisy(measure(masks.view(), scene.view()).unwrap(), 0.02, 1).unwrap();
            let y = y.slice(s![20..148, 5..133]).to_owned();
            let found = |masks: &Array3<f32>| {
                let light = masks.slice(s![.., 12..140, 25..153]).sum_axis(Axis(0));
                displacement(light.view(), y.view(), 32).unwrap()
            };
            let right = found(&masks);
            assert_eq!((right.rows, right.columns), (-8, 20));
            assert!(right.explained > 0.2, "{right:?}");
            assert!(found(&other).explained < 0.05, "{:?}", found(&other));
        }
        let small = Array3::<f32>::ones((2, 40, 40)).sum_axis(Axis(0));
        assert_eq!(displacement(small.view(), small.view(), 32), None);
        assert_eq!(displacement(small.view(), small.view(), 8), None);
    }
}
