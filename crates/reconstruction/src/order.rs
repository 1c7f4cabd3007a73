//! A permutation test of the order of the masks, on the frames of a snapshot.
//!
//! A prior that works frame by frame commutes with an exchange of masks: the frames are exchanged with them. In a scene that
//! moves steadily, frames differ the more the farther they are apart in time. So the sum of the squared steps from frame to
//! frame is smallest in the right order, and each exchange of two frames is a permutation test. In a static scene no order
//! is better than another.
//!
//! Similar masks leave similar errors in their frames, whatever the scene is. Behind such masks the part of the distances
//! that follows the similarity of the masks is removed first. The rest must follow the time between frames. An order is
//! found on one half of the blocks and confirmed on the other.

use ndarray::{Array2, ArrayView3, Axis, s};
use serde::{Deserialize, Serialize};

/// The outcome of the test of a snapshot's order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Every exchange of two frames makes the steps longer. The reversed order has the same steps.
    Consistent,
    /// The scene hardly moves or too fast, so some exchange makes no difference; or masks resemble one another, and no other
    /// order is much better.
    NotVerifiable,
    /// Another order is much better. The exchange of these two frames, counted from 0, improves the order most.
    Exchanged(usize, usize),
}

/// Side of the blocks over which steps are summed, in pixels. Neighbouring pixels change together.
const BLOCK: usize = 8;
/// An exchange that leaves less than this share of the steps, by this many standard errors, indicates a wrong order. Of 48
/// static and moving scenes in the right order, the one below that share is below it by 1.2 standard errors.
const MUCH_SHORTER: f64 = 0.9;
const SHORTER_T: f64 = 2.5;
/// The order is consistent if each exchange lengthens the steps by this share, by this many standard errors.
const LONGER: f64 = 1.01;
const LONGER_T: f64 = 2.0;

/// Largest correlation between two independent masks. Random squares and the rotating circle have 0.8.
const INDEPENDENT: f64 = 0.1;
/// Another order is found if its times correlate this well with the distances of the frames, and better than those of the
/// given order by this much and by this many standard errors. Of 40 simulated scenes behind up to 12 random squares in the
/// right order, static and moving, the largest gain of orders that correlate as well is 0.16; that of a periodic scene behind
/// grey masks is 0.39. The errors of 20 and more frames behind such masks reach a gain of 0.47.
const MOST_SIMILAR_MASKS: usize = 12;
const FOLLOWS_TIME: f64 = 0.7;
const MIN_GAIN: f64 = 0.5;
const GAIN_T: f64 = 3.5;
/// Masks that change steadily, as a rotating circle does, correlate with time. Their frames show no order apart from that.
const CHANGES_STEADILY: f64 = 0.4;

impl Order {
    /// Tests the order of the frames \\[B,H,W\\] of a snapshot, which a prior without a link along time made, behind `masks`
    /// \\[B,H,W\\]. `None` for fewer than three frames, or pictures of less than four blocks.
    pub fn of(frames: ArrayView3<'_, f32>, masks: ArrayView3<'_, f32>) -> Option<Self> {
        let distances = block_distances(frames);
        let count = frames.len_of(Axis(0));
        if count < 3 || distances.len() < 4 {
            return None;
        }
        let similarity = correlations(masks);
        if similarity.indexed_iter().any(|((k, l), value)| k != l && value.abs() > INDEPENDENT) {
            let blocks_in_row = frames.len_of(Axis(2)) / BLOCK;
            return Some(order_in_time(&distances, &similarity, blocks_in_row));
        }
        let given: Vec<usize> = (0..count).collect();
        let steps = |order: &[usize], block: &Array2<f64>| -> f64 {
            order.windows(2).map(|pair| block[[pair[0], pair[1]]]).sum()
        };
        let before: Vec<f64> = distances.iter().map(|block| steps(&given, block)).collect();
        let total: f64 = before.iter().sum();
        let (mut best, mut is_consistent) = (None, total > 0.0);
        let mut smallest = f64::INFINITY;
        for first in 0..count {
            for second in first + 1..count {
                let mut order = given.clone();
                order.swap(first, second);
                let after = distances.iter().map(|block| steps(&order, block));
                let changes: Vec<f64> = after.zip(&before).map(|(after, b)| after - b).collect();
                let share = 1.0 + changes.iter().sum::<f64>() / total.max(f64::MIN_POSITIVE);
                let t = t_statistic(&changes);
                is_consistent &= share > LONGER && t > LONGER_T;
                if share < smallest {
                    smallest = share;
                    best = (share < MUCH_SHORTER && t < -SHORTER_T).then_some((first, second));
                }
            }
        }
        Some(match best {
            Some((first, second)) => Self::Exchanged(first, second),
            None if is_consistent => Self::Consistent,
            None => Self::NotVerifiable,
        })
    }
}

/// Correlations \[B,B\] between masks.
fn correlations(masks: ArrayView3<'_, f32>) -> Array2<f64> {
    let centred: Vec<Vec<f64>> = masks
        .outer_iter()
        .map(|mask| {
            let mean = mask.iter().map(|value| f64::from(*value)).sum::<f64>() / mask.len() as f64;
            mask.iter().map(|value| f64::from(*value) - mean).collect()
        })
        .collect();
    let product =
        |one: &[f64], other: &[f64]| -> f64 { one.iter().zip(other).map(|(a, b)| a * b).sum() };
    Array2::from_shape_fn((centred.len(), centred.len()), |(k, l)| {
        let (one, other) = (&centred[k], &centred[l]);
        let scale = (product(one, one) * product(other, other)).sqrt();
        if scale > 0.0 { product(one, other) / scale } else { 0.0 }
    })
}

/// Pairs (first, second) of `count` frames.
fn pairs(count: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..count).flat_map(move |first| (first + 1..count).map(move |second| (first, second)))
}

/// Values without their mean and the part that follows `other`, which has mean 0.
fn without(values: &mut [f64], other: &[f64]) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter_mut().for_each(|value| *value -= mean);
    let norm = other.iter().map(|value| value * value).sum::<f64>();
    let product = values.iter().zip(other).map(|(a, b)| a * b).sum::<f64>();
    if norm > 0.0 {
        values.iter_mut().zip(other).for_each(|(value, other)| *value -= product / norm * other);
    }
}

/// Times between the frames of each pair, where frame k was recorded at `times[k]`: mean 0, norm 1.
fn time_differences(times: &[usize]) -> Vec<f64> {
    let mut steps: Vec<f64> =
        pairs(times.len()).map(|(k, l)| times[k].abs_diff(times[l]) as f64).collect();
    without(&mut steps, &[]);
    let norm = steps.iter().map(|step| step * step).sum::<f64>().sqrt();
    steps.iter_mut().for_each(|step| *step /= norm);
    steps
}

fn product(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}

/// The times of the frames with which these values of pairs agree best, by exchanges from `times` on.
fn best_times(values: &[f64], mut times: Vec<usize>) -> Vec<usize> {
    let agreement = |times: &[usize]| product(values, &time_differences(times));
    let mut best = agreement(&times);
    loop {
        let mut better = None;
        let mut compare = |candidate: Vec<usize>| {
            let value = agreement(&candidate);
            if value > best + 1e-9 * best.abs() {
                (best, better) = (value, Some(candidate));
            }
        };
        for (first, second) in pairs(times.len()) {
            let mut exchanged = times.clone();
            exchanged.swap(first, second);
            compare(exchanged);
        }
        for frame in 0..times.len() {
            for time in (0..times.len()).filter(|time| *time != times[frame]) {
                // The frame moves to that time, and those between make room.
                let old = times[frame];
                let moved = |(k, &at): (usize, &usize)| match at {
                    _ if k == frame => time,
                    at if old < at && at <= time => at - 1,
                    at if time <= at && at < old => at + 1,
                    at => at,
                };
                compare(times.iter().enumerate().map(moved).collect());
            }
        }
        match better {
            Some(candidate) => times = candidate,
            None => return times,
        }
    }
}

/// Tests the order behind masks with these correlations \[B,B\].
fn order_in_time(distances: &[Array2<f64>], similarity: &Array2<f64>, in_row: usize) -> Order {
    let count = similarity.nrows();
    if count > MOST_SIMILAR_MASKS {
        return Order::NotVerifiable;
    }
    let given: Vec<usize> = (0..count).collect();
    let given_differences = time_differences(&given);
    let mut similar: Vec<f64> = pairs(count).map(|pair| similarity[[pair.0, pair.1]]).collect();
    without(&mut similar, &[]);
    let norm = product(&similar, &similar).sqrt();
    if norm > 0.0 && product(&similar, &given_differences).abs() > CHANGES_STEADILY * norm {
        return Order::NotVerifiable;
    }
    let residuals: Vec<Vec<f64>> = distances
        .iter()
        .map(|block| {
            let mut values: Vec<f64> = pairs(count).map(|pair| block[[pair.0, pair.1]]).collect();
            without(&mut values, &similar);
            values
        })
        .collect();
    // Cells of 2x2 blocks alternate between the halves.
    let half = |block: usize| (block / in_row / 2 + block % in_row / 2) % 2;
    let sum_of = |which: usize| {
        let mut sum = vec![0.0; given_differences.len()];
        for (_, values) in residuals.iter().enumerate().filter(|(block, _)| half(*block) == which) {
            sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
        sum
    };
    let correlation = |values: &[f64], differences: &[f64]| {
        product(values, differences) / product(values, values).sqrt().max(f64::MIN_POSITIVE)
    };
    let (mut before, mut after, mut gains) = (0.0, 0.0, Vec::new());
    for (search, test) in [(0, 1), (1, 0)] {
        let values = sum_of(search);
        let starts = [given.clone(), by_distance(&values, count)];
        let found = starts.map(|start| time_differences(&best_times(&values, start)));
        let [one, other] = found.each_ref().map(|differences| product(&values, differences));
        let found = &found[usize::from(other > one)];
        let confirmed = sum_of(test);
        before += 0.5 * correlation(&confirmed, &given_differences);
        after += 0.5 * correlation(&confirmed, found);
        for (_, values) in residuals.iter().enumerate().filter(|(block, _)| half(*block) == test) {
            gains.push(product(values, found) - product(values, &given_differences));
        }
    }
    if after < FOLLOWS_TIME || after - before < MIN_GAIN || t_statistic(&gains) < GAIN_T {
        return Order::NotVerifiable;
    }
    // The exchange that improves the order most.
    let all: Vec<f64> = sum_of(0).iter().zip(sum_of(1)).map(|(one, other)| one + other).collect();
    let gain = |pair: &(usize, usize)| {
        let mut times = given.clone();
        times.swap(pair.0, pair.1);
        product(&all, &time_differences(&times))
    };
    let best = pairs(count).max_by(|one, other| gain(one).total_cmp(&gain(other)));
    best.map_or(Order::NotVerifiable, |(first, second)| Order::Exchanged(first, second))
}

/// Times by the distance from the frame that is farthest from all others, given the values of pairs.
fn by_distance(values: &[f64], count: usize) -> Vec<usize> {
    let mut matrix = Array2::zeros((count, count));
    for ((k, l), value) in pairs(count).zip(values) {
        matrix[[k, l]] = *value;
        matrix[[l, k]] = *value;
    }
    let total = |k: &usize| matrix.row(*k).sum();
    let first = (0..count).max_by(|k, l| total(k).total_cmp(&total(l))).unwrap_or_default();
    let mut frames: Vec<usize> = (0..count).filter(|k| *k != first).collect();
    frames.sort_by(|k, l| matrix[[first, *k]].total_cmp(&matrix[[first, *l]]));
    let mut times = vec![0; count];
    for (time, frame) in std::iter::once(first).chain(frames).enumerate() {
        times[frame] = time;
    }
    times
}

/// Squared distances \\[B,B\\] between the frames in each block.
fn block_distances(frames: ArrayView3<'_, f32>) -> Vec<Array2<f64>> {
    let (count, height, width) = frames.dim();
    let mut all = Vec::new();
    for row in (0..height / BLOCK * BLOCK).step_by(BLOCK) {
        for column in (0..width / BLOCK * BLOCK).step_by(BLOCK) {
            let block = frames.slice(s![.., row..row + BLOCK, column..column + BLOCK]);
            let mut distances = Array2::zeros((count, count));
            for first in 0..count {
                for second in first + 1..count {
                    let one = block.index_axis(Axis(0), first);
                    let other = block.index_axis(Axis(0), second);
                    let squares = one.iter().zip(&other).map(|(a, b)| f64::from(a - b).powi(2));
                    let sum: f64 = squares.sum();
                    distances[[first, second]] = sum;
                    distances[[second, first]] = sum;
                }
            }
            all.push(distances);
        }
    }
    all
}

/// t-statistic of the mean of values; 0 if they do not vary.
fn t_statistic(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    if variance > 0.0 { mean / (variance / count).sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::Order;
    use crate::operator::SensingOperator;
    use crate::schedule::Schedule;
    use crate::solver::reconstruct;
    use ndarray::{Array3, Axis};
    use optics::{iid_masks, random_squares};

    /// The order of frames of total variation, after masks `a` and `b` were exchanged.
    fn test(speed: f32, (a, b): (usize, usize)) -> Option<Order> {
        let masks = iid_masks(8, 96, 96, 3).unwrap();
        let truth = Array3::from_shape_fn((8, 96, 96), |(k, i, j)| {
            let moved = j as f32 + speed * k as f32;
            0.5 + 0.2 * (moved * 0.2).sin() * (i as f32 * 0.15).cos()
                + if (40.0..56.0).contains(&moved) { 0.25 } else { 0.0 }
        });
        let y = SensingOperator::new(masks.clone()).unwrap().forward(truth.view()).unwrap();
        let mut order: Vec<usize> = (0..8).collect();
        order.swap(a, b);
        let op = SensingOperator::new(masks.select(Axis(0), &order)).unwrap();
        let schedule = Schedule::gap_tv();
        let frames = reconstruct(&op, y.view(), &schedule, &mut (), &mut ()).unwrap().frames;
        Order::of(frames.view(), op.masks())
    }

    #[test]
    fn exchanged_masks_are_found_where_the_scene_moves() {
        assert_eq!(test(1.5, (0, 0)), Some(Order::Consistent));
        assert_eq!(test(1.5, (2, 6)), Some(Order::Exchanged(2, 6)));
        assert_eq!(test(1.5, (1, 4)), Some(Order::Exchanged(1, 4)));
        assert_eq!(test(0.0, (2, 6)), Some(Order::NotVerifiable));
        let two = Array3::zeros((2, 96, 96));
        assert_eq!(Order::of(two.view(), two.view()), None);
    }

    /// The frames of a scene that moves, behind masks that resemble one another, with noise that follows their similarity.
    #[test]
    fn shuffled_masks_that_resemble_one_another_are_found_by_the_motion() {
        let (masks, _) = random_squares(8, 96, 96, 1).unwrap();
        let frames = Array3::from_shape_fn((8, 96, 96), |(k, i, j)| {
            let moved = j as f32 + 1.5 * k as f32;
            0.5 + 0.2 * (moved * 0.2).sin() * (i as f32 * 0.15).cos() + 0.05 * masks[[k, i, j]]
        });
        let after = |order: &[usize]| {
            let (frames, masks) = (frames.select(Axis(0), order), masks.select(Axis(0), order));
            Order::of(frames.view(), masks.view())
        };
        assert_eq!(after(&[0, 1, 2, 3, 4, 5, 6, 7]), Some(Order::NotVerifiable));
        for order in [[3, 1, 6, 0, 7, 2, 5, 4], [0, 1, 5, 3, 4, 2, 6, 7]] {
            assert!(matches!(after(&order), Some(Order::Exchanged(..))), "{order:?}");
        }
    }

    /// Their frames resemble one another as their masks do, in the right order too.
    #[test]
    fn masks_that_resemble_one_another_show_no_order() {
        let (masks, _) = random_squares(8, 96, 96, 1).unwrap();
        let frames = masks.mapv(|mask| 0.5 + 0.1 * mask);
        assert_eq!(Order::of(frames.view(), masks.view()), Some(Order::NotVerifiable));
    }
}
