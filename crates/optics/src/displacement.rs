//! Displacement of a measurement against its masks, by any number of pixels up to the size of a window.
//!
//! A nearly uniform scene follows the sum of its masks. The cross-correlation of the two is therefore largest at their
//! displacement. It needs no fit of the frames, so thousands of displacements are searched in the time of one fit.

use ndarray::{Array2, ArrayView2, s};

use super::measurement_fit::{BLOCK, block_centred};

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

impl Displacement {
    /// True if the masks stay where they are.
    pub fn is_none(&self) -> bool {
        (self.rows, self.columns) == (0, 0)
    }
}

/// Compares the centre of a measurement \[H,W\] with the sum of its masks \[H,W\] at each displacement by up to `reach`
/// pixels along each axis. NaN in either were not measured and are left out. `None` if no block of 8x8 pixels is left, or
/// if one of the two has no fine structure.
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
    let y = y.slice(at(reach, reach));
    let known = y.mapv(|value| !value.is_nan());
    let lit = light.iter().copied().filter(|light| !light.is_nan());
    let (sum, count) = lit.fold((0.0, 0usize), |(sum, count), v| (sum + f64::from(v), count + 1));
    // Masks that are not known have no fine structure, so they match nothing.
    let mean = (sum / count.max(1) as f64) as f32;
    let light = light.mapv(|light| if light.is_nan() { mean } else { light });
    let fine = |image: ArrayView2<'_, f32>| block_centred(image, known.view()).1;
    let y = fine(y);
    let norm = energy(&y) * energy(&fine(light.slice(at(reach, reach))));
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

/// The image \[H,W\] enlarged by a factor about its middle, by linear interpolation. A reduced image has a
/// smaller size of the same parity. `None` if nothing is left.
pub fn magnified(image: ArrayView2<'_, f32>, factor: f64) -> Option<Array2<f32>> {
    let (height, width) = image.dim();
    let kept = |length: usize| {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // at most the length
        let known = (length as f64 * factor.min(1.0)) as usize;
        length - (length - known.min(length)).div_ceil(2) * 2
    };
    let (rows, columns) = (kept(height), kept(width));
    if rows < BLOCK || columns < BLOCK {
        return None;
    }
    let source = |at: usize, length: usize, kept: usize| {
        let from_middle = at as f64 - (kept as f64 - 1.0) / 2.0;
        let place =
            (from_middle / factor + (length as f64 - 1.0) / 2.0).clamp(0.0, length as f64 - 1.0);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // below the length
        let first = (place as usize).min(length.saturating_sub(2));
        (first, (place - first as f64) as f32)
    };
    Some(Array2::from_shape_fn((rows, columns), |(row, column)| {
        let (i, down) = source(row, height, rows);
        let (j, right) = source(column, width, columns);
        let (below, beside) = ((i + 1).min(height - 1), (j + 1).min(width - 1));
        let line = |row: usize| image[[row, j]] * (1.0 - right) + image[[row, beside]] * right;
        line(i) * (1.0 - down) + line(below) * down
    }))
}

/// The central part of an image with this size, which has the same parity.
pub fn central(image: ArrayView2<'_, f32>, (height, width): (usize, usize)) -> ArrayView2<'_, f32> {
    let (row, column) = ((image.nrows() - height) / 2, (image.ncols() - width) / 2);
    image.slice_move(s![row..row + height, column..column + width])
}

/// The factor by which masks must be enlarged about the middle of the picture, with the displacement that remains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Magnified {
    /// The factor.
    pub factor: f64,
    /// The displacement after the magnification.
    pub displacement: Displacement,
}

/// Largest and smallest factor that is searched, and the step between factors.
const LARGEST_FACTOR: f64 = 2.1;
const FACTOR_STEP: f64 = 1.015;
/// Side of the compared centre. Half a step of the factor displaces its border by a third of a pixel.
const COMPARED: usize = 96;
/// Smallest side.
const MIN_COMPARED: usize = 40;
/// Largest displacement that is searched with each factor, in pixels.
const MAGNIFIED_REACH: usize = 6;

/// Searches the factor that fits the sum of the masks \[H,W\] to a measurement \[H,W\] best. `None` if the picture is too
/// small.
pub fn magnification(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> Option<Magnified> {
    let steps = (LARGEST_FACTOR.ln() / FACTOR_STEP.ln()).ceil() as i32;
    let found = (-steps..=steps).filter_map(|step| {
        let factor = FACTOR_STEP.powi(step);
        let light = magnified(light, factor)?;
        let side = light.nrows().min(light.ncols()).min(COMPARED + 2 * MAGNIFIED_REACH);
        if side < MIN_COMPARED + 2 * MAGNIFIED_REACH {
            return None;
        }
        let same_parity = |length: usize| side - (length - side) % 2;
        let size = (same_parity(light.nrows()), same_parity(light.ncols()));
        let (light, y) = (central(light.view(), size).to_owned(), central(y, size));
        let displacement = displacement(light.view(), y, MAGNIFIED_REACH)?;
        Some(Magnified { factor, displacement })
    });
    found.max_by(|a, b| a.displacement.explained.total_cmp(&b.displacement.explained))
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
