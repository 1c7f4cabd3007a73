//! Whether masks stand in the order of their patterns, told by how alike they are.

use ndarray::{Array2, ArrayView2, ArrayView3};

/// How much better than the order as it is another one must agree to be believed.
const BETTER: f64 = 0.05;
/// Masks fewer than this leave too much to chance.
const FEWEST: usize = 6;

/// An order of the masks that fits their patterns better than the one they are in.
#[derive(Debug, Clone, PartialEq)]
pub struct Reordered {
    /// The masks that stand in each other's place, counted from 0.
    pub swaps: Vec<(usize, usize)>,
    /// Agreement (correlation of likenesses) of the order as it is.
    pub before: f64,
    /// Agreement with these swaps undone.
    pub after: f64,
}

/// Likeness \[B,B\] of masks whose patterns \[B,rows,columns\] are known: the share of openings in
/// common.
pub fn pattern_likeness(patterns: ArrayView3<'_, f32>) -> Array2<f64> {
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

/// What is known of the patterns.
#[derive(Debug, Clone, PartialEq)]
pub enum Expected {
    /// How alike any two of them are \[B,B\].
    Likeness(Array2<f64>),
    /// Perhaps they turn evenly about an axis: then their likeness depends on the angle between them
    /// alone, and falls with it.
    Turning,
}

impl Expected {
    /// How well the masks' correlations agree with this if the pattern `order[k]` was shown at place
    /// k, at most 1; none if nothing can be told.
    fn agreement(&self, correlation: ArrayView2<'_, f64>, order: &[usize]) -> Option<f64> {
        match self {
            Self::Likeness(expected) => agreement(correlation, expected.view(), order),
            Self::Turning => {
                let (expected, falls) = by_angle(correlation, order);
                let natural: Vec<usize> = (0..order.len()).collect();
                let seen = agreement(correlation, expected.view(), &natural)?;
                falls.then_some(seen).or(Some(0.0))
            }
        }
    }

    fn convincing(&self) -> f64 {
        match self {
            Self::Likeness(_) => 0.9,
            // The likeness is taken from the masks themselves, which flatters.
            Self::Turning => 0.95,
        }
    }
}

/// The mean correlation of masks as far apart in a turn as any two of them, and whether it falls.
fn by_angle(correlation: ArrayView2<'_, f64>, order: &[usize]) -> (Array2<f64>, bool) {
    let frames = order.len();
    let apart = |k: usize, l: usize| {
        let steps = order[k].abs_diff(order[l]);
        steps.min(frames - steps)
    };
    let (mut sums, mut counts) = (vec![0.0; frames / 2 + 1], vec![0.0; frames / 2 + 1]);
    for ((k, l), value) in correlation.indexed_iter().filter(|((k, l), _)| k != l) {
        sums[apart(k, l)] += value;
        counts[apart(k, l)] += 1.0;
    }
    let means: Vec<f64> =
        sums.iter().zip(&counts).skip(1).map(|(sum, count)| sum / count).collect();
    let falls = means.windows(2).all(|pair| pair[1] <= pair[0] + 0.02);
    let drop = means.first().zip(means.last()).is_some_and(|(first, last)| first - last > 0.15);
    let expected =
        Array2::from_shape_fn(
            (frames, frames),
            |(k, l)| {
                if k == l { 1.0 } else { means[apart(k, l) - 1] }
            },
        );
    (expected, falls && drop)
}

/// Looks for swaps of two masks after which their correlations agree with what is known of their
/// patterns. None if the order is good, or if nothing can be told.
pub fn reordered(correlation: ArrayView2<'_, f64>, expected: &Expected) -> Option<Reordered> {
    let frames = correlation.nrows();
    let fewest = match expected {
        Expected::Likeness(likeness) if likeness.dim() != correlation.dim() => return None,
        Expected::Likeness(_) => 3,
        Expected::Turning => FEWEST,
    };
    if frames < fewest {
        return None;
    }
    let mut order: Vec<usize> = (0..frames).collect();
    let before = expected.agreement(correlation, &order)?;
    let (mut after, mut swaps) = (before, Vec::new());
    // The best swap, then the best one after it: few masks are ever in a wrong place.
    while swaps.len() < frames / 2 {
        let mut best = None;
        for k in 0..frames {
            for l in 0..k {
                order.swap(k, l);
                let seen = expected.agreement(correlation, &order)?;
                order.swap(k, l);
                if best.is_none_or(|(most, _, _)| seen > most) {
                    best = Some((seen, l, k));
                }
            }
        }
        match best {
            Some((seen, k, l)) if seen > after + BETTER / 2.0 => {
                order.swap(k, l);
                swaps.push((k, l));
                after = seen;
            }
            _ => break,
        }
    }
    let found = !swaps.is_empty() && after > expected.convincing() && after > before + BETTER;
    found.then_some(Reordered { swaps, before, after })
}

/// Correlation, over all pairs, of how alike masks are and should be, if the pattern `order[k]`
/// was shown at place k. None if all are equally alike.
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

    use super::{Expected, pattern_likeness, reordered};
    use crate::masks::turning_circle;
    use crate::{ApertureGrid, MaskStudy, random_squares};

    fn correlation(masks: &Array3<f32>) -> Array2<f64> {
        let (frames, height, width) = masks.dim();
        let mut study = MaskStudy::new(frames, height, width);
        study.add(masks.view()).unwrap();
        study.finish().unwrap().correlation
    }

    fn swapped(masks: &Array3<f32>, k: usize, l: usize) -> Array3<f32> {
        let mut order: Vec<usize> = (0..masks.dim().0).collect();
        order.swap(k, l);
        masks.select(Axis(0), &order)
    }

    #[test]
    fn a_swap_against_known_patterns_is_found() {
        for seed in 0..5 {
            let (masks, openings) = random_squares(10, 96, 96, seed).unwrap();
            let patterns = openings.patterns(ApertureGrid::for_frames(10));
            let expected = Expected::Likeness(pattern_likeness(patterns.view()));
            let seen = correlation(&masks);
            assert_eq!(reordered(seen.view(), &expected), None, "seed {seed}");
            assert_eq!(reordered(seen.view(), &Expected::Turning), None, "seed {seed}");
            let seen = correlation(&swapped(&masks, 2, 7));
            let found = reordered(seen.view(), &expected).unwrap();
            assert_eq!(found.swaps, [(2, 7)], "seed {seed}: {found:?}");
            // Without patterns nothing can be told of random ones.
            assert_eq!(reordered(seen.view(), &Expected::Turning), None, "seed {seed}");
        }
    }

    #[test]
    fn a_swap_among_turning_patterns_is_found_without_them() {
        for frames in [6, 10, 20] {
            let masks = turning_circle(frames, 96, 5);
            let seen = correlation(&masks);
            assert_eq!(reordered(seen.view(), &Expected::Turning), None);
            let seen = correlation(&swapped(&masks, 1, 4));
            let found = reordered(seen.view(), &Expected::Turning).unwrap();
            assert_eq!(found.swaps, [(1, 4)], "{frames} frames: {found:?}");
        }
    }
}
