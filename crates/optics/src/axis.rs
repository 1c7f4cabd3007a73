//! One axis of the projection: the weight of each mask pixel in a sensor pixel, seen through one row or column of
//! aperture cells.

use std::collections::BTreeMap;

use ndarray::Array2;

/// Resolution of sub-pixel phases, per mask pixel: a multiple of 2, 3, 4, 5, 6, 8 and 10.
const PHASES: f64 = 240.0;
/// Radius of the blur kernel in standard deviations.
const REACH: f64 = 5.0;
/// Weights below this value are rounding errors.
const MIN_WEIGHT: f64 = 1e-9;

/// The extent of an aperture cell along one axis, as mask shifts in mask pixels. `from == to` for a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    pub(super) from: f64,
    pub(super) to: f64,
}

/// One axis of a projection.
#[derive(Debug)]
pub(super) struct Axis {
    /// First mask pixel that contributes to each sensor pixel, relative to the start of the canvas.
    pub(super) start: Vec<usize>,
    /// Sub-pixel phase of each sensor pixel, as an index into `weights`.
    pub(super) phase: Vec<usize>,
    /// For each phase, the share \[cell, tap\] of the light through a cell that passes mask pixel `start + tap`. The
    /// shares of a cell sum to 1.
    pub(super) weights: Vec<Array2<f64>>,
    /// Length of the canvas in mask pixels.
    pub(super) length: usize,
    /// Mask coordinate of the start of the canvas.
    #[cfg(test)]
    pub(super) origin: i64,
}

impl Axis {
    /// The axis of `pixels` sensor pixels, `ratio` of them per mask pixel. The first one lies at mask coordinate
    /// `offset`. The mask is seen through `cells` and blurred with a standard deviation of `blur` mask pixels.
    pub(super) fn new(cells: &[Cell], pixels: usize, ratio: f64, offset: f64, blur: f64) -> Self {
        // 1. Split the start of each sensor pixel into a whole mask pixel and a phase.
        let mut phases = BTreeMap::new();
        let (mut whole, mut phase) = (Vec::new(), Vec::new());
        for pixel in 0..pixels {
            let place = ((pixel as f64 / ratio + offset) * PHASES).round();
            let part = place.rem_euclid(PHASES);
            let next = phases.len();
            phase.push(*phases.entry(part as u64).or_insert((next, part / PHASES)));
            whole.push(((place - part) / PHASES) as i64);
        }
        let mut values: Vec<(usize, f64)> = phases.into_values().collect();
        values.sort_by_key(|&(index, _)| index);
        // 2. Compute the shares of all taps in reach, and trim those that get no light.
        let lowest = cells.iter().map(|cell| cell.from).fold(f64::INFINITY, f64::min);
        let highest = cells.iter().map(|cell| cell.to).fold(f64::NEG_INFINITY, f64::max);
        let first = (lowest - REACH * blur).floor() as i64 - 1;
        let last = (highest + REACH * blur + 1.0 / ratio).ceil() as i64 + 1;
        let share = |phase: f64, cell: &Cell, tap: i64| {
            let below = |x: i64| share_below(x as f64 - phase, 1.0 / ratio, *cell, blur);
            let share = below(tap + 1) - below(tap);
            if share > MIN_WEIGHT { share } else { 0.0 }
        };
        let used = |tap: i64| {
            values.iter().any(|&(_, phase)| cells.iter().any(|cell| share(phase, cell, tap) > 0.0))
        };
        let first = (first..=last).find(|&tap| used(tap)).unwrap_or(first);
        let last = (first..=last).rev().find(|&tap| used(tap)).unwrap_or(first);
        let taps = (last - first + 1) as usize;
        let weights = values.iter().map(|&(_, phase)| {
            Array2::from_shape_fn((cells.len(), taps), |(cell, tap)| {
                share(phase, &cells[cell], first + tap as i64)
            })
        });
        let weights = weights.collect();
        // 3. The canvas starts at the first mask pixel that contributes to the first sensor pixel.
        let origin = whole.first().map_or(0, |whole| whole + first);
        let start: Vec<usize> =
            whole.iter().map(|whole| (whole + first - origin).max(0) as usize).collect();
        let length = start.last().map_or(0, |last| last + taps);
        let phase = phase.into_iter().map(|(index, _)| index).collect();
        Self {
            start,
            phase,
            weights,
            length,
            #[cfg(test)]
            origin,
        }
    }
}

/// Share of a sensor pixel's light through a cell that passes the mask below `x`, for a pixel from 0 to `pixel`. It is
/// the cumulative distribution of a uniform position in the pixel, plus a uniform shift within the cell, plus Gaussian
/// blur.
fn share_below(x: f64, pixel: f64, cell: Cell, blur: f64) -> f64 {
    let span = cell.to - cell.from;
    if span > 0.0 {
        let corner = |shift: f64| {
            step_integral_2(x - shift, blur) - step_integral_2(x - shift - pixel, blur)
        };
        (corner(cell.from) - corner(cell.to)) / (pixel * span)
    } else {
        (step_integral(x - cell.from, blur) - step_integral(x - cell.from - pixel, blur)) / pixel
    }
}

/// Integral up to `z` of a unit step at 0 that is blurred by a Gaussian.
fn step_integral(z: f64, blur: f64) -> f64 {
    if blur == 0.0 {
        return z.max(0.0);
    }
    z * normal_cumulative(z / blur) + blur * normal_density(z / blur)
}

/// Integral of [`step_integral`] up to `z`.
fn step_integral_2(z: f64, blur: f64) -> f64 {
    if blur == 0.0 {
        return z.max(0.0).powi(2) / 2.0;
    }
    let t = z / blur;
    ((z * z + blur * blur) * normal_cumulative(t) + z * blur * normal_density(t)) / 2.0
}

/// Density of the standard normal distribution.
fn normal_density(t: f64) -> f64 {
    (-t * t / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

/// Cumulative distribution of the standard normal distribution.
fn normal_cumulative(t: f64) -> f64 {
    (1.0 + libm::erf(t / std::f64::consts::SQRT_2)) / 2.0
}

#[cfg(test)]
mod tests {
    use super::{Axis, Cell};

    #[test]
    fn whole_pixel_shifts_select_one_mask_pixel_each() {
        let cells = [-1.0, 0.0, 1.0].map(|at| Cell { from: at, to: at });
        let axis = Axis::new(&cells, 5, 1.0, 0.0, 0.0);
        assert_eq!(axis.length, 7);
        assert_eq!(axis.start, [0, 1, 2, 3, 4]);
        assert_eq!(axis.weights, [ndarray::Array2::<f64>::eye(3)]);
        assert_eq!(axis.origin, -1);
    }

    #[test]
    fn two_sensor_pixels_share_a_mask_pixel_at_ratio_two() {
        let axis = Axis::new(&[Cell { from: 0.0, to: 0.0 }], 4, 2.0, 0.0, 0.0);
        assert_eq!(axis.start, [0, 0, 1, 1]);
        assert_eq!((axis.phase, axis.length), (vec![0, 1, 0, 1], 2));
        let half = Axis::new(&[Cell { from: 0.25, to: 0.25 }], 2, 2.0, 0.0, 0.0);
        assert_eq!(half.weights[0].row(0).to_vec(), [1.0, 0.0]);
        assert_eq!(half.weights[1].row(0).to_vec(), [0.5, 0.5]);
    }

    #[test]
    fn shares_sum_to_one_for_any_blur() {
        let cells = [Cell { from: -0.7, to: 0.3 }, Cell { from: 0.3, to: 0.3 }];
        for blur in [0.0, 0.4, 2.0] {
            let axis = Axis::new(&cells, 9, 1.5, 0.37, blur);
            for weights in &axis.weights {
                for shares in weights.rows() {
                    assert!((shares.sum() - 1.0).abs() < 1e-5, "blur {blur}: {shares}");
                    assert!(shares.iter().all(|&share| share >= 0.0));
                }
            }
        }
    }
}
