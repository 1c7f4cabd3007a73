//! The motion with the smallest hold-out error, by a quadratic through the errors on a grid of displacements.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::quadratic::{COUNT, Quadratic, product};
use super::similarity::Similarity;

/// Largest move of a grid that has settled, in distances of its displacements.
const SETTLED: f64 = 0.5;
/// Smallest significant rotation and growth, in standard errors.
pub(super) const SIGNIFICANT: f64 = 3.0;
/// Smallest correction in pixels; a smaller one changes nothing that can be seen.
pub(super) const SMALLEST: f64 = 0.03;

/// Standard errors of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Uncertainty {
    /// Standard error of the shift along rows and columns, in pixels.
    pub shift: [f64; 2],
    /// Standard error of the rotation in degrees; 0 if only the shift was estimated.
    pub rotation: f64,
    /// Standard error of the scale; 0 if only the shift was estimated.
    pub scale: f64,
}

/// The parameters of a motion that are estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Free {
    /// The shift.
    Shift,
    /// Shift, rotation and growth.
    All,
}

/// Errors at the hold-out pixels of a patch for 3x3 displacements, which differ from a motion and the displacement `centre`
/// by up to one step along each axis.
pub struct Grid {
    /// Displacement in pixels along rows and columns.
    pub centre: [f64; 2],
    /// Row and column of each pixel on the sensor.
    pub places: Vec<[f64; 2]>,
    /// Squared errors of all pixels at each displacement, in row order.
    pub errors: Vec<Vec<f64>>,
}

/// The minimum of a quadratic that was fitted to hold-out errors.
pub struct Fit {
    pub minimum: Similarity,
    pub uncertainty: Uncertainty,
    /// True if the quadratic has a minimum close to the centre of the grid. If it has none, true if the centre has the smallest
    /// error: errors behind sharp masks have a kink there.
    pub has_settled: bool,
    /// True if rotation and growth are significant, and large enough to be seen.
    pub has_turned: bool,
}

impl Fit {
    /// Fits errors on grids around a motion `centre`, with displacements `step` pixels apart, on a sensor \[H,W\]. The
    /// minimum lies within the grids.
    pub fn new(
        (centre, sensor): (Similarity, [usize; 2]),
        grids: &[Grid],
        step: f64,
        free: Free,
    ) -> Self {
        let frame = Frame::new(grids);
        let pixels = grids.iter().flat_map(|grid| {
            grid.places.iter().enumerate().map(move |(pixel, place)| (grid, pixel, place))
        });
        let quadratics: Vec<_> = pixels
            .map(|(grid, pixel, place)| {
                Quadratic::fit(
                    |at| grid.errors[at][pixel],
                    frame.derivatives(*place, free),
                    grid.centre.map(|at| at / step),
                )
            })
            .collect();
        let mut sum = Quadratic::default();
        quadratics.iter().for_each(|one| sum.add(one));
        let Some(inverse) = sum.inverse() else {
            let error = |at: usize| grids.iter().flat_map(|grid| &grid.errors[at]).sum::<f64>();
            let smallest = (0..9).min_by(|a, b| error(*a).total_cmp(&error(*b))).unwrap_or(4);
            let [row, column] = [smallest / 3, smallest % 3].map(|place| place as f64 - 1.0);
            let change = frame.change([row, column, 0.0, 0.0], step, sensor);
            let turn = if free == Free::All { step / frame.radius } else { 0.0 };
            let uncertainty =
                Uncertainty { shift: [step; 2], rotation: turn.to_degrees(), scale: turn };
            let minimum = moved(centre, change);
            return Self { minimum, uncertainty, has_settled: smallest == 4, has_turned: false };
        };
        let lowest = product(&inverse, sum.gradient).map(|value| -value);
        let centres = grids.iter().flat_map(|grid| grid.centre);
        let reach = 1.0 + centres.fold(0.0, |most: f64, at| most.max(at.abs())) / step;
        let offset = lowest.map(|value| value.clamp(-reach, reach));
        let mut variance = [0.0; COUNT];
        // Variances of rotation and growth, and their covariance.
        let mut turned = [0.0; 3];
        for one in &quadratics {
            let influence = product(&inverse, one.gradient_at(offset));
            let change = frame.change(influence, step, sensor);
            variance.iter_mut().zip(change).for_each(|(sum, value)| *sum += value * value);
            let [_, _, rotation, growth] = influence;
            let products = [rotation * rotation, growth * growth, rotation * growth];
            turned.iter_mut().zip(products).for_each(|(sum, value)| *sum += value);
        }
        let [rows, columns, rotation, scale] = variance.map(f64::sqrt);
        let [_, _, x, y] = lowest;
        let [xx, yy, xy] = turned;
        let squared = x * x * yy - 2.0 * x * y * xy + y * y * xx;
        Self {
            minimum: moved(centre, frame.change(offset, step, sensor)),
            uncertainty: Uncertainty { shift: [rows, columns], rotation, scale },
            has_settled: lowest.iter().all(|at| at.abs() <= SETTLED),
            has_turned: x.hypot(y) * step >= SMALLEST
                && squared > SIGNIFICANT * SIGNIFICANT * (xx * yy - xy * xy),
        }
    }
}

/// A motion after a change of the shift, of the rotation in degrees, and of the scale.
fn moved(motion: Similarity, [rows, columns, rotation, scale]: [f64; COUNT]) -> Similarity {
    Similarity {
        shift: [motion.shift[0] + rows, motion.shift[1] + columns],
        rotation: motion.rotation + rotation,
        scale: motion.scale + scale,
    }
}

/// The coordinates in which a motion is estimated: shifts of the middle of all pixels, and displacements by rotation and
/// growth at their mean distance from it.
struct Frame {
    middle: [f64; 2],
    /// Root of the mean squared distance in pixels.
    radius: f64,
}

impl Frame {
    fn new(grids: &[Grid]) -> Self {
        let places: Vec<_> = grids.iter().flat_map(|grid| grid.places.clone()).collect();
        let middle = middle(&places);
        let squares =
            |place: &[f64; 2]| (place[0] - middle[0]).powi(2) + (place[1] - middle[1]).powi(2);
        let mean = places.iter().map(squares).sum::<f64>() / places.len().max(1) as f64;
        Self { middle, radius: mean.sqrt().max(1.0) }
    }

    /// Derivatives of the displacement at a place by each parameter.
    fn derivatives(&self, place: [f64; 2], free: Free) -> [[f64; COUNT]; 2] {
        let [row, column] = match free {
            Free::Shift => [0.0; 2],
            Free::All => [0, 1].map(|axis| (place[axis] - self.middle[axis]) / self.radius),
        };
        [[1.0, 0.0, column, row], [0.0, 1.0, -row, column]]
    }

    /// The change of the shift at the centre of the sensor, of the rotation in degrees, and of the scale by parameters in
    /// units of `step` pixels.
    fn change(&self, point: [f64; COUNT], step: f64, sensor: [usize; 2]) -> [f64; COUNT] {
        let [rows, columns, rotation, growth] = point.map(|value| value * step);
        let (rotation, growth) = (rotation / self.radius, growth / self.radius);
        let [row, column] =
            [0, 1].map(|axis| (sensor[axis] as f64 - 1.0) / 2.0 - self.middle[axis]);
        [
            rows + rotation * column + growth * row,
            columns - rotation * row + growth * column,
            rotation.to_degrees(),
            growth,
        ]
    }
}

/// The mean of places.
pub fn middle(places: &[[f64; 2]]) -> [f64; 2] {
    let count = places.len().max(1) as f64;
    [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / count)
}

#[cfg(test)]
mod tests {
    use super::{Fit, Free, Grid};
    use crate::registration::similarity::Similarity;

    /// Errors that are smallest at a true motion, with noise that depends on the pixel.
    fn grid(from: [f64; 2], centre: Similarity, truth: Similarity, step: f64) -> Grid {
        let places: Vec<_> = (0..400)
            .map(|at| [from[0] + f64::from(at / 20) * 4.0, from[1] + f64::from(at % 20) * 4.0])
            .collect();
        let errors = |place: usize| {
            let at = [place / 3, place % 3].map(|place| step * (place as f64 - 1.0));
            let error = |(index, pixel): (usize, &[f64; 2])| {
                let (is, should) =
                    (centre.displacement([256; 2], *pixel), truth.displacement([256; 2], *pixel));
                let off = [0, 1].map(|axis| is[axis] + at[axis] - should[axis]);
                let noise = 0.02
                    * ((index as f64 * 1.7).sin() * off[0] + (index as f64 * 2.3).cos() * off[1]);
                1.0 + off[0] * off[0] + 2.0 * off[1] * off[1] + noise
            };
            places.iter().enumerate().map(error).collect()
        };
        Grid { centre: [0.0; 2], errors: (0..9).map(errors).collect(), places }
    }

    #[test]
    fn a_motion_about_the_centre_is_found_from_pieces_beside_it() {
        let centre = Similarity::shifted([0.3, -0.3]);
        let truth = Similarity { shift: [0.4, -0.25], rotation: 0.05, scale: 0.9995 };
        let grids = [[20.0, 30.0], [20.0, 140.0], [150.0, 30.0]]
            .map(|from| grid(from, centre, truth, 0.25));
        let fit = Fit::new((centre, [256; 2]), &grids, 0.25, Free::All);
        assert!(fit.has_settled && fit.has_turned);
        let found = fit.minimum;
        assert!(
            (found.rotation - 0.05).abs() < 2e-3 && (found.scale - 0.9995).abs() < 3e-5,
            "{found:?}"
        );
        assert!((found.shift[0] - 0.4).abs() + (found.shift[1] + 0.25).abs() < 5e-3, "{found:?}");
        assert!(fit.uncertainty.shift.iter().all(|error| *error > 0.0 && *error < 0.01));
        let shift = Fit::new((centre, [256; 2]), &grids, 0.25, Free::Shift);
        assert!(shift.minimum.is_shift() && !shift.has_turned && shift.uncertainty.rotation == 0.0);
        // A pure shift has no significant rotation.
        let truth = Similarity::shifted([0.4, -0.25]);
        let grids = [[20.0, 30.0], [150.0, 140.0]].map(|from| grid(from, centre, truth, 0.25));
        assert!(!Fit::new((centre, [256; 2]), &grids, 0.25, Free::All).has_turned);
    }
}
