//! Frames of two runs of a stage, one that shrinks changes along time much and one that does not, put together:
//! where nothing moves those of the first, where something does those of the second.
//!
//! In a scene at rest what changes from frame to frame is the solver's error, and a stage leaves nothing of it, or
//! other changes. Those of a motion stay what they were before the stage. So the correlation of the changes before
//! and after it, nearby, tells rest from motion; a measurement behind masks that are alike hardly does.

use ndarray::{Array2, Array3, ArrayView2, ArrayViewMut1, Axis, Zip};

/// Pixels to each side of a pixel that are near it.
const NEAR: usize = 8;
/// Up to the first of these correlations something is at rest, from the second on it moves.
const REST: f32 = 0.65;
const MOTION: f32 = 0.8;

/// Where something moves \[H,W\], from 0 for rest to 1, by frames \[B,H,W\] before a stage and after a run of it
/// that shrinks little.
pub(super) fn motion(before: &Array3<f32>, after: &Array3<f32>) -> Array2<f32> {
    correlation_nearby(before, after).mapv(|c| ((c - REST) / (MOTION - REST)).clamp(0.0, 1.0))
}

/// Puts frames \[B,H,W\] of a run that shrinks little into those of one that shrinks much, `still`, by the share
/// `motion` \[H,W\].
pub(super) fn keep_motion(still: &mut Array3<f32>, moving: &Array3<f32>, motion: &Array2<f32>) {
    for (mut still, moving) in still.outer_iter_mut().zip(moving.outer_iter()) {
        Zip::from(&mut still).and(&moving).and(motion).for_each(|still, moving, share| {
            *still += share * (moving - *still);
        });
    }
}

/// The correlation of what differs from the mean over time in frames \[B,H,W\] and in others; 0 where nothing
/// differs.
pub(super) fn correlation(one: &Array3<f32>, other: &Array3<f32>) -> f32 {
    let [product, one, other] = products(one, other).map(|product| product.sum());
    normed(product, one, other)
}

/// The same of the pixels near each \[H,W\].
fn correlation_nearby(one: &Array3<f32>, other: &Array3<f32>) -> Array2<f32> {
    let [product, one, other] = products(one, other).map(|product| nearby(product.view()));
    Zip::from(&product).and(&one).and(&other).map_collect(|&p, &one, &other| normed(p, one, other))
}

fn normed(product: f32, one: f32, other: f32) -> f32 {
    let norm = (one * other).sqrt();
    if norm > 0.0 { product / norm } else { 0.0 }
}

/// Of each pixel, the products of what differs from the mean over time in frames and in others, and the squares of
/// both, added up over time \[H,W\].
fn products(one: &Array3<f32>, other: &Array3<f32>) -> [Array2<f32>; 3] {
    let (_, height, width) = one.dim();
    let frames = one.len_of(Axis(0)) as f32;
    let means = [one, other].map(|frames_of| frames_of.sum_axis(Axis(0)) / frames);
    let [mut products, mut squares, mut others] = [(); 3].map(|()| Array2::zeros((height, width)));
    for (one, other) in one.outer_iter().zip(other.outer_iter()) {
        let (one, other) = (&one - &means[0], &other - &means[1]);
        products += &(&one * &other);
        squares += &(&one * &one);
        others += &(&other * &other);
    }
    [products, squares, others]
}

/// The sums over the pixels near each.
fn nearby(values: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut sums = values.to_owned();
    sums.lanes_mut(Axis(0)).into_iter().for_each(sums_along);
    sums.lanes_mut(Axis(1)).into_iter().for_each(sums_along);
    sums
}

fn sums_along(mut lane: ArrayViewMut1<'_, f32>) {
    // In 64 bits, so that what was added and taken away again leaves nothing behind.
    let values: Vec<f64> = lane.iter().map(|value| f64::from(*value)).collect();
    let mut sum: f64 = values.iter().take(NEAR).sum();
    for at in 0..values.len() {
        sum += values.get(at + NEAR).copied().unwrap_or(0.0);
        sum -= at.checked_sub(NEAR + 1).map_or(0.0, |gone| values[gone]);
        lane[at] = sum as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::{NEAR, correlation, correlation_nearby, keep_motion, motion, nearby};
    use ndarray::{Array2, Array3, s};

    /// Changes of a pixel, one after the other.
    fn wave(k: usize, i: usize, j: usize) -> f32 {
        (k as f32 * 1.3 + i as f32 * 0.7 + j as f32 * 0.4).sin()
    }

    #[test]
    fn sums_are_those_of_the_square_around_each_pixel() {
        let values = Array2::from_shape_fn((20, 31), |(i, j)| wave(0, i, j));
        let sums = nearby(values.view());
        for ((i, j), sum) in sums.indexed_iter() {
            let (rows, columns) = (i.saturating_sub(NEAR), j.saturating_sub(NEAR));
            let square =
                values.slice(s![rows..20.min(i + NEAR + 1), columns..31.min(j + NEAR + 1)]);
            assert!((square.sum() - sum).abs() < 1e-3, "{i} {j}");
        }
    }

    #[test]
    fn changes_correlate_whatever_their_size_and_mean() {
        let one = Array3::from_shape_fn((6, 24, 24), |(k, i, j)| wave(k, i, j));
        let near = |other: Array3<f32>, wanted: f32| {
            assert!((correlation(&one, &other) - wanted).abs() < 1e-3, "{wanted}");
            let found = correlation_nearby(&one, &other);
            assert!(found.iter().all(|c| (c - wanted).abs() < 1e-3), "{wanted}: {found}");
        };
        near(one.mapv(|x| 3.0 + 0.1 * x), 1.0);
        near(one.mapv(|x| -x), -1.0);
        near(Array3::from_elem((6, 24, 24), 0.5), 0.0);
    }

    /// On the left the stage has made other changes than there were, on the right it has kept them, if larger.
    #[test]
    fn what_moves_is_kept_and_what_rests_is_not() {
        let moving = Array3::from_shape_fn((6, 24, 64), |(k, i, j)| 0.5 + wave(k, i, j));
        let before = Array3::from_shape_fn((6, 24, 64), |(k, i, j)| match j < 32 {
            true => ((7 * k * k + 13 * i + 29 * j) % 11) as f32,
            false => 0.5 + 0.3 * wave(k, i, j),
        });
        let mut still = Array3::from_elem((6, 24, 64), 0.5);
        keep_motion(&mut still, &moving, &motion(&before, &moving));
        assert!(still.slice(s![.., .., ..16]).iter().all(|x| *x == 0.5));
        let (kept, all) = (still.slice(s![.., .., 48..]), moving.slice(s![.., .., 48..]));
        assert!((&kept - &all).iter().all(|d| d.abs() < 1e-6));
    }
}
