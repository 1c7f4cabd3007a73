//! Detects masks that are not in the order of their patterns, from the correlations between them.

use ndarray::{Array2, ArrayView2, ArrayView3};

/// Gain in agreement from which another order is reported.
const MIN_GAIN: f64 = 0.05;
/// Smallest number of masks for which a turning pattern is recognised. Fewer agree by chance.
const MIN_TURNING_MASKS: usize = 6;

/// An order of the masks that fits their patterns better than the current one.
#[derive(Debug, Clone, PartialEq)]
pub struct Reordering {
    /// The pairs of masks that are interchanged, counted from 0.
    pub swaps: Vec<(usize, usize)>,
    /// Agreement of the current order: the correlation between expected and actual mask correlations.
    pub before: f64,
    /// Agreement after the swaps.
    pub after: f64,
}

/// Normalised overlap \[B,B\] of patterns \[B,rows,columns\]: `<p_k, p_l> / (|p_k| |p_l|)`. Masks correlate as their
/// patterns overlap.
pub fn pattern_overlap(patterns: ArrayView3<'_, f32>) -> Array2<f64> {
    let frames = patterns.dim().0;
    let flat: Vec<Vec<f64>> = patterns
        .outer_iter()
        .map(|pattern| pattern.iter().map(|&value| f64::from(value)).collect())
        .collect();
    let product =
        |k: usize, l: usize| -> f64 { flat[k].iter().zip(&flat[l]).map(|(a, b)| a * b).sum() };
    Array2::from_shape_fn((frames, frames), |(k, l)| {
        let norm = (product(k, k) * product(l, l)).sqrt();
        if norm > 0.0 { product(k, l) / norm } else { 0.0 }
    })
}

/// Prior knowledge about the order of the patterns.
#[derive(Debug, Clone, PartialEq)]
pub enum ExpectedOrder {
    /// The overlap of each pair of patterns \[B,B\]; see [`pattern_overlap`].
    Overlap(Array2<f64>),
    /// The patterns are unknown, but may turn evenly about an axis. The correlation of two masks then depends only on
    /// the angle between them, and decreases with it.
    Turning,
}

impl ExpectedOrder {
    /// Agreement between the masks' correlations \[B,B\] and the expected ones, at most 1, if pattern `order[k]` was
    /// shown in frame k. `None` if all correlations are equal.
    fn agreement(&self, correlation: ArrayView2<'_, f64>, order: &[usize]) -> Option<f64> {
        match self {
            Self::Overlap(expected) => agreement(correlation, expected.view(), order),
            Self::Turning => {
                let TurningModel { expected, decreases } = TurningModel::fit(correlation, order);
                let natural: Vec<usize> = (0..order.len()).collect();
                let agreement = agreement(correlation, expected.view(), &natural)?;
                Some(if decreases { agreement } else { 0.0 })
            }
        }
    }

    /// Agreement from which a new order is accepted.
    fn min_agreement(&self) -> f64 {
        match self {
            Self::Overlap(_) => 0.9,
            // The model is fitted to the same masks, which biases the agreement upwards.
            Self::Turning => 0.95,
        }
    }
}

/// Correlations of masks with a pattern that turns evenly.
struct TurningModel {
    /// Mean correlation of all masks at the same angle, for each pair \[B,B\].
    expected: Array2<f64>,
    /// True if the correlation decreases with the angle, as it does for a turning pattern.
    decreases: bool,
}

impl TurningModel {
    fn fit(correlation: ArrayView2<'_, f64>, order: &[usize]) -> Self {
        let frames = order.len();
        let angle = |k: usize, l: usize| {
            let steps = order[k].abs_diff(order[l]);
            steps.min(frames - steps)
        };
        let (mut sums, mut counts) = (vec![0.0; frames / 2 + 1], vec![0.0; frames / 2 + 1]);
        for ((k, l), value) in correlation.indexed_iter().filter(|((k, l), _)| k != l) {
            sums[angle(k, l)] += value;
            counts[angle(k, l)] += 1.0;
        }
        let means: Vec<f64> =
            sums.iter().zip(&counts).skip(1).map(|(sum, count)| sum / count).collect();
        let monotonic = means.windows(2).all(|pair| pair[1] <= pair[0] + 0.02);
        let drop = means.first().zip(means.last()).is_some_and(|(first, last)| first - last > 0.15);
        let expected = Array2::from_shape_fn((frames, frames), |(k, l)| {
            if k == l { 1.0 } else { means[angle(k, l) - 1] }
        });
        Self { expected, decreases: monotonic && drop }
    }
}

/// Searches for swaps after which the correlations of the masks \[B,B\] agree with the expected order. `None` if the
/// order is correct, or if it can't be determined.
pub fn reordering(
    correlation: ArrayView2<'_, f64>,
    expected: &ExpectedOrder,
) -> Option<Reordering> {
    let frames = correlation.nrows();
    let min_frames = match expected {
        ExpectedOrder::Overlap(overlap) if overlap.dim() != correlation.dim() => return None,
        ExpectedOrder::Overlap(_) => 3,
        ExpectedOrder::Turning => MIN_TURNING_MASKS,
    };
    if frames < min_frames {
        return None;
    }
    let mut order: Vec<usize> = (0..frames).collect();
    let before = expected.agreement(correlation, &order)?;
    let (mut after, mut swaps) = (before, Vec::new());
    // Greedy search: in practice few masks are misplaced.
    while swaps.len() < frames / 2 {
        let mut best = None;
        for k in 0..frames {
            for l in 0..k {
                order.swap(k, l);
                let agreement = expected.agreement(correlation, &order)?;
                order.swap(k, l);
                if best.is_none_or(|(largest, _, _)| agreement > largest) {
                    best = Some((agreement, l, k));
                }
            }
        }
        match best {
            Some((agreement, k, l)) if agreement > after + MIN_GAIN / 2.0 => {
                order.swap(k, l);
                swaps.push((k, l));
                after = agreement;
            }
            _ => break,
        }
    }
    let convincing =
        !swaps.is_empty() && after > expected.min_agreement() && after > before + MIN_GAIN;
    convincing.then_some(Reordering { swaps, before, after })
}

/// Correlation, over all pairs of masks, between actual and expected mask correlations if pattern `order[k]` was shown
/// in frame k. `None` if either is the same for all pairs.
fn agreement(
    correlation: ArrayView2<'_, f64>,
    expected: ArrayView2<'_, f64>,
    order: &[usize],
) -> Option<f64> {
    let (mut count, mut sums, mut squares, mut product) = (0.0, (0.0, 0.0), (0.0, 0.0), 0.0);
    for k in 0..order.len() {
        for l in 0..k {
            let (a, b) = (correlation[[k, l]], expected[[order[k], order[l]]]);
            count += 1.0;
            sums = (sums.0 + a, sums.1 + b);
            squares = (squares.0 + a * a, squares.1 + b * b);
            product += a * b;
        }
    }
    let spread = |sum: f64, square: f64| square / count - (sum / count).powi(2);
    let (a, b) = (spread(sums.0, squares.0), spread(sums.1, squares.1));
    if a < 1e-12 || b < 1e-12 {
        return None;
    }
    Some((product / count - sums.0 * sums.1 / (count * count)) / (a * b).sqrt())
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis};

    use super::{ExpectedOrder, pattern_overlap, reordering};
    use crate::masks::turning_circle;
    use crate::{ApertureGrid, MaskStudy, random_squares};

    fn correlation_of(masks: &Array3<f32>) -> Array2<f64> {
        let (frames, height, width) = masks.dim();
        let mut study = MaskStudy::new(frames, height, width);
        study.add(masks.view()).unwrap();
        study.finish().unwrap().correlation
    }

    fn with_swap(masks: &Array3<f32>, k: usize, l: usize) -> Array3<f32> {
        let mut order: Vec<usize> = (0..masks.dim().0).collect();
        order.swap(k, l);
        masks.select(Axis(0), &order)
    }

    #[test]
    fn swaps_are_detected_with_known_patterns() {
        for seed in 0..5 {
            let (masks, openings) = random_squares(10, 96, 96, seed).unwrap();
            let patterns = openings.patterns(ApertureGrid::for_frames(10));
            let expected = ExpectedOrder::Overlap(pattern_overlap(patterns.view()));
            let correlation = correlation_of(&masks);
            assert_eq!(reordering(correlation.view(), &expected), None, "seed {seed}");
            assert_eq!(
                reordering(correlation.view(), &ExpectedOrder::Turning),
                None,
                "seed {seed}"
            );
            let correlation = correlation_of(&with_swap(&masks, 2, 7));
            let found = reordering(correlation.view(), &expected).unwrap();
            assert_eq!(found.swaps, [(2, 7)], "seed {seed}: {found:?}");
            // The order of random patterns can be checked only if they are known.
            assert_eq!(
                reordering(correlation.view(), &ExpectedOrder::Turning),
                None,
                "seed {seed}"
            );
        }
    }

    #[test]
    fn swaps_of_turning_patterns_are_detected_without_knowing_them() {
        for frames in [6, 10, 20] {
            let masks = turning_circle(frames, 96, 5);
            let correlation = correlation_of(&masks);
            assert_eq!(reordering(correlation.view(), &ExpectedOrder::Turning), None);
            let correlation = correlation_of(&with_swap(&masks, 1, 4));
            let found = reordering(correlation.view(), &ExpectedOrder::Turning).unwrap();
            assert_eq!(found.swaps, [(1, 4)], "{frames} frames: {found:?}");
        }
    }
}
