//! Separates static from moving regions, and blends two reconstructions accordingly.
//!
//! Strong temporal shrinkage removes the solver's frame-to-frame error in static regions, but it also removes real motion.
//! A stage may therefore run twice, with weak and with strong shrinkage; moving regions keep the weakly shrunk result.
//!
//! Motion is detected by comparing temporal changes before and after the weak run. Real motion survives the stage, so the
//! changes stay correlated. Solver error is replaced by different error, so they do not.

use ndarray::{Array2, Array3, ArrayView2, ArrayViewMut1, Axis, Zip};

/// Half width, in pixels, of the window in which correlations are measured.
const WINDOW_RADIUS: usize = 8;
/// A region with a correlation up to this value is static.
const STATIC_CORRELATION: f32 = 0.65;
/// A region with a correlation from this value on is moving. In between, results are blended linearly.
const MOVING_CORRELATION: f32 = 0.8;

/// The motion map \[H,W\], from 0 (static) to 1 (moving), of the frames \[B,H,W\] before and after a weakly shrunk stage.
pub(super) fn motion_map(before: &Array3<f32>, after: &Array3<f32>) -> Array2<f32> {
    let range = MOVING_CORRELATION - STATIC_CORRELATION;
    let motion = |c: f32| ((c - STATIC_CORRELATION) / range).clamp(0.0, 1.0);
    local_temporal_correlation(before, after).mapv(motion)
}

/// Blends the weakly shrunk frames into the strongly shrunk ones, with weights from the motion map.
pub(super) fn blend_moving_regions(
    strong: &mut Array3<f32>,
    weak: &Array3<f32>,
    motion: &Array2<f32>,
) {
    for (mut strong, weak) in strong.outer_iter_mut().zip(weak.outer_iter()) {
        Zip::from(&mut strong).and(&weak).and(motion).for_each(|s, &w, &m| *s += m * (w - *s));
    }
}

/// Correlation of the temporal changes of two clips \[B,H,W\] over all pixels; 0 if either clip does not change.
pub(super) fn temporal_correlation(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
    let energy = ChangeEnergy::new(a, b);
    normalized(energy.ab.sum(), energy.aa.sum(), energy.bb.sum())
}

/// The correlation for each pixel \[H,W\], measured in a window around it.
fn local_temporal_correlation(a: &Array3<f32>, b: &Array3<f32>) -> Array2<f32> {
    let energy = ChangeEnergy::new(a, b);
    let [ab, aa, bb] = [energy.ab, energy.aa, energy.bb].map(|map| box_sum(map.view()));
    Zip::from(&ab).and(&aa).and(&bb).map_collect(|&ab, &aa, &bb| normalized(ab, aa, bb))
}

/// `ab / sqrt(aa bb)`, or 0 where the denominator vanishes.
fn normalized(ab: f32, aa: f32, bb: f32) -> f32 {
    let norm = (aa * bb).sqrt();
    if norm > 0.0 { ab / norm } else { 0.0 }
}

/// Products of the deviations of two clips from their temporal means, summed over the frames; each map is \[H,W\].
struct ChangeEnergy {
    ab: Array2<f32>,
    aa: Array2<f32>,
    bb: Array2<f32>,
}

impl ChangeEnergy {
    fn new(a: &Array3<f32>, b: &Array3<f32>) -> Self {
        let (frames, height, width) = a.dim();
        let [a_mean, b_mean] = [a, b].map(|clip| clip.sum_axis(Axis(0)) / frames as f32);
        let zeros = || Array2::zeros((height, width));
        let mut energy = Self { ab: zeros(), aa: zeros(), bb: zeros() };
        for (a, b) in a.outer_iter().zip(b.outer_iter()) {
            let (a, b) = (&a - &a_mean, &b - &b_mean);
            energy.ab += &(&a * &b);
            energy.aa += &(&a * &a);
            energy.bb += &(&b * &b);
        }
        energy
    }
}

/// The sums over the window around each pixel, cut at the edges.
fn box_sum(values: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut sums = values.to_owned();
    sums.lanes_mut(Axis(0)).into_iter().for_each(running_sums);
    sums.lanes_mut(Axis(1)).into_iter().for_each(running_sums);
    sums
}

fn running_sums(mut lane: ArrayViewMut1<'_, f32>) {
    // In 64 bits, so that adding and subtracting a value leaves nothing behind.
    let values: Vec<f64> = lane.iter().map(|value| f64::from(*value)).collect();
    let mut sum: f64 = values.iter().take(WINDOW_RADIUS).sum();
    for at in 0..values.len() {
        sum += values.get(at + WINDOW_RADIUS).copied().unwrap_or(0.0);
        sum -= at.checked_sub(WINDOW_RADIUS + 1).map_or(0.0, |first| values[first]);
        lane[at] = sum as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::{
        WINDOW_RADIUS, blend_moving_regions, box_sum, local_temporal_correlation, motion_map,
        temporal_correlation,
    };
    use ndarray::{Array2, Array3, s};

    /// A value that changes in time and space.
    fn wave(k: usize, i: usize, j: usize) -> f32 {
        (k as f32 * 1.3 + i as f32 * 0.7 + j as f32 * 0.4).sin()
    }

    #[test]
    fn box_sums_are_those_of_the_window() {
        let values = Array2::from_shape_fn((20, 31), |(i, j)| wave(0, i, j));
        let sums = box_sum(values.view());
        for ((i, j), sum) in sums.indexed_iter() {
            let (rows, columns) =
                (i.saturating_sub(WINDOW_RADIUS), j.saturating_sub(WINDOW_RADIUS));
            let square = values.slice(s![
                rows..20.min(i + WINDOW_RADIUS + 1),
                columns..31.min(j + WINDOW_RADIUS + 1)
            ]);
            assert!((square.sum() - sum).abs() < 1e-3, "{i} {j}");
        }
    }

    #[test]
    fn the_correlation_of_changes_ignores_their_size_and_mean() {
        let one = Array3::from_shape_fn((6, 24, 24), |(k, i, j)| wave(k, i, j));
        let assert_correlation = |other: Array3<f32>, wanted: f32| {
            assert!((temporal_correlation(&one, &other) - wanted).abs() < 1e-3, "{wanted}");
            let found = local_temporal_correlation(&one, &other);
            assert!(found.iter().all(|c| (c - wanted).abs() < 1e-3), "{wanted}: {found}");
        };
        assert_correlation(one.mapv(|x| 3.0 + 0.1 * x), 1.0);
        assert_correlation(one.mapv(|x| -x), -1.0);
        assert_correlation(Array3::from_elem((6, 24, 24), 0.5), 0.0);
    }

    /// On the left the stage replaces the changes by others, on the right it keeps them, but larger.
    #[test]
    fn moving_regions_are_blended_and_static_ones_are_not() {
        let moving = Array3::from_shape_fn((6, 24, 64), |(k, i, j)| 0.5 + wave(k, i, j));
        let before = Array3::from_shape_fn((6, 24, 64), |(k, i, j)| match j < 32 {
            true => ((7 * k * k + 13 * i + 29 * j) % 11) as f32,
            false => 0.5 + 0.3 * wave(k, i, j),
        });
        let mut still = Array3::from_elem((6, 24, 64), 0.5);
        blend_moving_regions(&mut still, &moving, &motion_map(&before, &moving));
        assert!(still.slice(s![.., .., ..16]).iter().all(|x| *x == 0.5));
        let (kept, all) = (still.slice(s![.., .., 48..]), moving.slice(s![.., .., 48..]));
        assert!((&kept - &all).iter().all(|d| d.abs() < 1e-6));
    }
}
