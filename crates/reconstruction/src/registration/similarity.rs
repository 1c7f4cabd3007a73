//! The motion of masks since their calibration: a shift, a rotation and a magnification.

use std::ops::Range;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest displacement of the centre along each axis, in pixels.
pub const REACH: usize = 4;
/// Largest rotation in degrees.
pub const MAX_ROTATION: f64 = 0.3;
/// Largest change of the magnification.
pub const MAX_GROWTH: f64 = 0.003;
/// Pixels around a place on which its interpolation depends: a spline's filter falls below 2e-6 within them.
const FILTER: usize = 16;

/// A motion of masks on their sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Similarity {
    /// Pixels by which the masks have moved down and to the right, at most 4 along each axis.
    pub shift: [f64; 2],
    /// Degrees by which they have turned clockwise about the centre of the sensor, from -0.3 to 0.3.
    pub rotation: f64,
    /// Factor by which they have grown about the centre of the sensor, from 0.997 to 1.003.
    pub scale: f64,
}

impl Default for Similarity {
    fn default() -> Self {
        Self { shift: [0.0; 2], rotation: 0.0, scale: 1.0 }
    }
}

/// Where pixels of moved masks lie in the calibrated ones: an affine map of rows and columns.
#[derive(Debug, Clone, Copy)]
pub struct Source {
    /// The place of pixel (0, 0).
    offset: [f64; 2],
    /// The step of this place from row to row, and from column to column.
    steps: [[f64; 2]; 2],
}

impl Source {
    /// The place of a pixel.
    pub fn at(&self, [row, column]: [f64; 2]) -> [f64; 2] {
        let [down, right] = self.steps;
        [0, 1].map(|axis| self.offset[axis] + down[axis] * row + right[axis] * column)
    }
}

impl Similarity {
    /// A motion by whole or partial pixels alone.
    pub fn shifted(shift: [f64; 2]) -> Self {
        Self { shift, ..Self::default() }
    }

    /// True if all pixels move by the same displacement.
    pub fn is_shift(&self) -> bool {
        self.rotation == 0.0 && self.scale == 1.0
    }

    /// True if all pixels move by the same whole number of rows and columns.
    pub fn is_whole(&self) -> bool {
        self.is_shift() && self.shift.iter().all(|shift| shift.fract() == 0.0)
    }

    /// The map from the pixels of an array with its first pixel at `origin` of a sensor \[H,W\] to places in the same array.
    pub fn source(&self, sensor: [usize; 2], origin: [usize; 2]) -> Source {
        let (sine, cosine) = self.rotation.to_radians().sin_cos();
        let down = [cosine / self.scale, sine / self.scale];
        let right = [-sine / self.scale, cosine / self.scale];
        let centre = [0, 1].map(|axis| (sensor[axis] as f64 - 1.0) / 2.0 - origin[axis] as f64);
        let [row, column] = [0, 1].map(|axis| -centre[axis] - self.shift[axis]);
        let offset = [0, 1].map(|axis| centre[axis] + down[axis] * row + right[axis] * column);
        Source { offset, steps: [down, right] }
    }

    /// True if part of the masks of a sensor \[H,W\] lies on a pixel after the motion.
    pub fn covers(&self, sensor: [usize; 2], [row, column]: [usize; 2]) -> bool {
        let place = self.source(sensor, [0; 2]).at([row as f64, column as f64]);
        (0..2).all(|axis| is_covered(place[axis], sensor[axis]))
    }

    /// Displacement in pixels of the light at a pixel of a sensor \[H,W\].
    pub fn displacement(&self, sensor: [usize; 2], pixel: [f64; 2]) -> [f64; 2] {
        let place = self.source(sensor, [0; 2]).at(pixel);
        [pixel[0] - place[0], pixel[1] - place[1]]
    }

    /// Root of the mean squared displacement over a sensor \[H,W\], in pixels.
    pub fn length(&self, sensor: [usize; 2]) -> f64 {
        let radius = sensor.iter().map(|side| (*side as f64).powi(2) / 12.0).sum::<f64>();
        let turned = self.rotation.to_radians().powi(2) + (self.scale - 1.0).powi(2);
        (self.shift[0].powi(2) + self.shift[1].powi(2) + radius * turned).sqrt()
    }

    /// Pixels around a window of a sensor \[H,W\] on which its moved masks depend.
    pub fn margin(&self, sensor: [usize; 2], rows: &Range<usize>, columns: &Range<usize>) -> usize {
        // The displacement is an affine function, so it is largest in a corner.
        let corners = [rows.start, rows.end]
            .map(|row| [columns.start, columns.end].map(|column| [row as f64, column as f64]));
        let lengths = corners
            .into_iter()
            .flatten()
            .flat_map(|corner| self.displacement(sensor, corner).map(f64::abs));
        FILTER + 1 + lengths.fold(0.0, f64::max).ceil() as usize
    }
}

/// True if a place lies on one of `length` pixels. Half a pixel beyond the last centre a pixel still has light on it.
pub fn is_covered(place: f64, length: usize) -> bool {
    (-0.5..=length as f64 - 0.5).contains(&place)
}

#[cfg(test)]
mod tests {
    use super::Similarity;

    #[test]
    fn masks_turn_clockwise_and_grow_about_the_centre() {
        let sensor = [101, 201];
        let turned = Similarity { rotation: 0.3, ..Similarity::default() };
        let [down, right] = turned.displacement(sensor, [50.0, 200.0]);
        assert!((down - 100.0 * 0.3f64.to_radians()).abs() < 1e-3 && right.abs() < 2e-3);
        let grown = Similarity { scale: 1.003, ..Similarity::default() };
        let [down, right] = grown.displacement(sensor, [0.0, 100.0]);
        assert!((down + 0.15).abs() < 1e-3 && right.abs() < 1e-9, "{down} {right}");
        let shifted = Similarity::shifted([1.5, -2.0]);
        assert_eq!(shifted.displacement(sensor, [3.0, 4.0]), [1.5, -2.0]);
        assert!(shifted.covers(sensor, [2, 0]) && !shifted.covers(sensor, [0, 0]));
        // A window anywhere on the sensor gives the same places.
        let all = Similarity { rotation: -0.2, scale: 0.998, ..shifted };
        let (whole, part) = (all.source(sensor, [0, 0]), all.source(sensor, [20, 90]));
        let (one, other) = (whole.at([30.0, 100.0]), part.at([10.0, 10.0]));
        assert!((one[0] - 20.0 - other[0]).abs() + (one[1] - 90.0 - other[1]).abs() < 1e-9);
        assert_eq!(shifted.margin(sensor, &(0..10), &(0..10)), 19);
    }
}
