//! The residual of a tile: the part of the measurement that its frames do not explain.

use std::ops::Range;

use ndarray::{Array2, ArrayView3};

/// Relative residual `||y - H v|| / ||y||` over the measured pixels (others are NaN) of a run of snapshots: the largest of its pieces, at most
/// [`f32::MAX`]. It is 0 behind masks that let no light through.
///
/// Takes masks \[B,h,w\], the measurement \[S,h,w\], and ranges of snapshots as pieces. `frame` returns one of the
/// `S B` frames \[h,w\] on the scale of the measurement. The sums are in f64 and in a fixed order, so equal arrays
/// give an equal result on every machine.
///
/// # Errors
/// Those of `frame`.
pub fn residual<E>(
    masks: ArrayView3<'_, f32>,
    y: ArrayView3<'_, f32>,
    pieces: &[Range<usize>],
    mut frame: impl FnMut(usize) -> Result<Array2<f32>, E>,
) -> Result<f32, E> {
    if masks.iter().all(|&c| c == 0.0) {
        return Ok(0.0);
    }
    let frames = masks.dim().0;
    let mut worst = 0.0f32;
    for piece in pieces {
        let (mut rest_squares, mut y_squares) = (0.0f64, 0.0f64);
        for (snapshot, y) in y.outer_iter().enumerate().filter(|(s, _)| piece.contains(s)) {
            let is_measured = y.mapv(|y| !y.is_nan());
            let mut rest = y.mapv(|y| if y.is_nan() { 0.0 } else { f64::from(y) });
            y_squares += squares(&rest);
            for (k, mask) in masks.outer_iter().enumerate() {
                let frame = frame(snapshot * frames + k)?;
                ndarray::azip!((rest in &mut rest, &c in &mask, &x in &frame, &measured in &is_measured) {
                    if measured {
                        *rest -= f64::from(c) * f64::from(x);
                    }
                });
            }
            rest_squares += squares(&rest);
        }
        let relative = rest_squares.sqrt() / y_squares.sqrt().max(f64::MIN_POSITIVE);
        worst = worst.max((relative as f32).min(f32::MAX));
    }
    Ok(worst)
}

fn squares(values: &Array2<f64>) -> f64 {
    values.iter().map(|value| value * value).sum()
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)] // lists of ranges, some of one
mod tests {
    use std::convert::Infallible;

    use ndarray::{Array2, Array3};

    use super::residual;

    #[test]
    fn the_worst_piece_counts_and_no_light_leaves_nothing() {
        let masks = Array3::ones((2, 4, 4));
        let y = Array3::from_shape_fn((3, 4, 4), |(s, ..)| s as f32);
        // Frames that explain half of every snapshot, and more than nothing of the first.
        let half = |k: usize| Ok::<_, Infallible>(Array2::from_elem((4, 4), (k / 2) as f32 / 4.0));
        let residual_of =
            |pieces: &[std::ops::Range<usize>]| residual(masks.view(), y.view(), pieces, half);
        assert_eq!(residual_of(&[1..3]), Ok(0.5));
        assert_eq!(residual_of(&[0..1, 1..2]), Ok(0.5));
        let bright = |_| Ok::<_, Infallible>(Array2::ones((4, 4)));
        let value = residual(masks.view(), y.view(), &[0..1], bright);
        assert_eq!(value, Ok(f32::MAX), "something where nothing was measured");
        let dark = Array3::zeros((2, 4, 4));
        assert_eq!(residual(dark.view(), y.view(), &[0..3], bright), Ok(0.0));
    }
}
