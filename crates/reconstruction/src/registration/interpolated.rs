//! Masks between the pixels of their calibration.

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView3, ArrayViewMut1, ArrayViewMut2, Axis, s};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::similarity::{Source, is_covered};

/// Smallest `sum C^2` of interpolated masks at a pixel, relative to the largest of the calibrated pixels around it. At darker
/// pixels the errors of the interpolation outweigh the light, and the projection would divide by it.
pub(super) const MIN_ENERGY: f32 = 0.05;
/// Width in pixels of the border of a defect that is filled from its surroundings.
const FILLED: usize = 3;
/// Largest number of coefficients along each axis that contribute to a place.
const MAX_TAPS: usize = 6;

/// Interpolation of masks by splines. A pixel of a mask is the mean of the light on its area.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Exact for sharp masks with uniform light on each pixel: a moved pixel covers parts of its neighbours.
    Linear,
    /// For masks between these.
    #[default]
    Cubic,
    /// Most accurate for masks that a lens has blurred.
    Quintic,
}

impl Interpolation {
    pub(super) const ALL: [Self; 3] = [Self::Linear, Self::Cubic, Self::Quintic];

    fn degree(self) -> usize {
        2 * self as usize + 1
    }

    /// Poles of the filter from samples to coefficients, and its gain (Unser 1999).
    fn filter(self) -> (Vec<f64>, f64) {
        let (a, b) = (17745f64.sqrt() / 2.0, 105f64.sqrt() / 2.0);
        match self {
            Self::Linear => (vec![], 1.0),
            Self::Cubic => (vec![3f64.sqrt() - 2.0], 6.0),
            Self::Quintic => {
                (vec![(67.5 - a).sqrt() + b - 6.5, (67.5 + a).sqrt() - b - 6.5], 120.0)
            }
        }
    }
}

/// Interpolated masks \[B,h,w\].
pub struct Interpolated {
    degree: usize,
    /// Coefficients of splines through the masks \[B,h,w\].
    coefficients: Array3<f32>,
    /// `sum C^2` of the masks \[h,w\]; NaN where they are unknown.
    energy: Array2<f32>,
}

impl Interpolated {
    /// Continues the masks by reflection. NaN are filled from their surroundings, so that they do not ring.
    pub fn new(masks: ArrayView3<'_, f32>, interpolation: Interpolation) -> Self {
        let energy = masks.map_axis(Axis(0), |pixel| pixel.iter().map(|mask| mask * mask).sum());
        let mut coefficients = masks.to_owned();
        coefficients.outer_iter_mut().for_each(fill);
        let (poles, gain) = interpolation.filter();
        for axis in [Axis(1), Axis(2)] {
            for lane in coefficients.lanes_mut(axis) {
                filter(lane, &poles, gain);
            }
        }
        Self { degree: interpolation.degree(), coefficients, energy }
    }

    /// A window of the masks after they moved, clipped to \[0,1\]. `source` gives the place of each pixel in these masks. A
    /// pixel that no part of the masks has moved onto is NaN. All masks are 0 where an unknown pixel contributes or hardly
    /// any light is left.
    pub fn window(
        &self,
        source: &Source,
        rows: Range<usize>,
        columns: Range<usize>,
    ) -> Array3<f32> {
        let (frames, height, width) = self.coefficients.dim();
        let mut window = Array3::zeros((frames, rows.len(), columns.len()));
        let mut line = Vec::with_capacity(columns.len());
        for (index, row) in rows.enumerate() {
            line.clear();
            line.extend(columns.clone().map(|column| {
                let [row, column] = source.at([row as f64, column as f64]);
                [Taps::at(row, height, self.degree), Taps::at(column, width, self.degree)]
            }));
            let mut out = window.index_axis_mut(Axis(1), index);
            for (mut out, plane) in out.outer_iter_mut().zip(self.coefficients.outer_iter()) {
                for (out, [rows, columns]) in out.iter_mut().zip(&line) {
                    let value: f32 = rows
                        .weighted()
                        .map(|(row, weight)| {
                            let values = plane.row(row);
                            let along =
                                columns.weighted().map(|(column, weight)| weight * values[column]);
                            weight * along.sum::<f32>()
                        })
                        .sum();
                    *out = value.clamp(0.0, 1.0);
                }
            }
            for (mut pixel, [rows, columns]) in out.lanes_mut(Axis(0)).into_iter().zip(&line) {
                let nearest = rows.nearest().iter().flat_map(|&row| {
                    columns.nearest().iter().map(move |&column| self.energy[[row, column]])
                });
                // NaN outweigh all other values.
                let brightest: f32 =
                    nearest.fold(
                        0.0,
                        |most, energy| {
                            if energy > most || energy.is_nan() { energy } else { most }
                        },
                    );
                let energy = pixel.iter().map(|mask| mask * mask).sum::<f32>();
                if brightest.is_nan() && !energy.is_nan() || energy < MIN_ENERGY * brightest {
                    pixel.fill(0.0);
                }
            }
        }
        window
    }
}

/// Replaces NaN of a mask within [`FILLED`] pixels of known ones by means of their neighbours, and others by 0.
fn fill(mut mask: ArrayViewMut2<'_, f32>) {
    let mut unknown: Vec<(usize, usize)> =
        mask.indexed_iter().filter(|(_, value)| value.is_nan()).map(|(at, _)| at).collect();
    let (height, width) = mask.dim();
    for _ in 0..FILLED {
        let means = unknown.iter().map(|&(row, column)| {
            let rows = row.saturating_sub(1)..height.min(row + 2);
            let columns = column.saturating_sub(1)..width.min(column + 2);
            let around = mask.slice(s![rows, columns]);
            let known = || around.iter().filter(|value| !value.is_nan());
            known().sum::<f32>() / known().count() as f32
        });
        let means: Vec<f32> = means.collect();
        unknown.iter().zip(&means).for_each(|(&at, &mean)| mask[at] = mean);
        unknown.retain(|&at| mask[at].is_nan());
    }
    unknown.into_iter().for_each(|at| mask[at] = 0.0);
}

/// The coefficients that contribute to a place, and their weights.
struct Taps {
    places: [usize; MAX_TAPS],
    weights: [f32; MAX_TAPS],
    count: usize,
    is_between: bool,
}

impl Taps {
    fn weighted(&self) -> impl Iterator<Item = (usize, f32)> {
        self.places[..self.count].iter().copied().zip(self.weights[..self.count].iter().copied())
    }

    /// The one or two nearest pixels.
    fn nearest(&self) -> &[usize] {
        let middle = self.count / 2 - 1;
        &self.places[middle..=middle + usize::from(self.is_between)]
    }

    fn at(place: f64, length: usize, degree: usize) -> Self {
        let (first, t) = (place.floor() as i64 - (degree / 2) as i64, place - place.floor());
        // The B-splines of each degree follow from those of the degree below (de Boor).
        let mut weights = [0.0; MAX_TAPS];
        weights[0] = 1.0;
        for degree in 1..=degree {
            for tap in (0..=degree).rev() {
                let rising = if tap > 0 { weights[tap - 1] } else { 0.0 };
                let at = t - tap as f64;
                weights[tap] =
                    ((at + degree as f64) * rising + (1.0 - at) * weights[tap]) / degree as f64;
            }
        }
        let reflected = |tap: usize| {
            let last = length as i64 - 1;
            let index = (first + tap as i64).abs();
            (if index > last { 2 * last - index } else { index }).clamp(0, last) as usize
        };
        let is_known = is_covered(place, length);
        let known = |weight: f64| if is_known { weight as f32 } else { f32::NAN };
        Self {
            places: std::array::from_fn(reflected),
            weights: weights.map(known),
            count: degree + 1,
            is_between: t > 0.0,
        }
    }
}

/// Converts samples into coefficients of a spline, in place (Unser 1999).
fn filter(mut line: ArrayViewMut1<'_, f32>, poles: &[f64], gain: f64) {
    let length = line.len();
    if length < 2 {
        return;
    }
    let mut values: Vec<f64> = line.iter().map(|&value| gain * f64::from(value)).collect();
    for pole in poles {
        // Beyond 30 samples the powers of the pole are below 2e-11.
        let (mut sum, mut power) = (0.0, 1.0);
        for index in 0..30 {
            let period = 2 * (length - 1);
            let place = index % period;
            sum += power * values[if place < length { place } else { period - place }];
            power *= pole;
        }
        values[0] = sum;
        for index in 1..length {
            values[index] += pole * values[index - 1];
        }
        let last = length - 1;
        values[last] = pole / (pole * pole - 1.0) * (values[last] + pole * values[last - 1]);
        for index in (0..last).rev() {
            values[index] = pole * (values[index + 1] - values[index]);
        }
    }
    line.iter_mut().zip(values).for_each(|(out, value)| *out = value as f32);
}
