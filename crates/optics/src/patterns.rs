//! Aperture patterns \[B, rows, columns\]: the transmission on \[0,1\] of each cell of the LCoS in each frame. The
//! cells divide the LCoS evenly.

use ndarray::{Array3, ArrayView3};
use rand::Rng;
use rand::seq::index;
use serde::{Deserialize, Serialize};

use super::multiplex::rank;
use super::{Geometry, Multiplexing, OpticsError, Result, check_parameter, check_size};

/// Side, in LCoS pixels, of the cells in which circles are drawn. Their shift of the mask is far below a mask pixel.
const CIRCLE_CELL: usize = 8;
/// Number of sample points along the side of such a cell, for the share of it that the circle covers.
const CIRCLE_POINTS: usize = 8;

/// A grid of square sub-apertures. Each one shifts the projected lithography mask by a whole number of mask pixels,
/// one more than its neighbour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ApertureGrid {
    /// Rows of sub-apertures.
    pub rows: usize,
    /// Columns of sub-apertures.
    pub columns: usize,
}

impl ApertureGrid {
    /// The grid for `frames` frames in a snapshot: 3x4 up to 12 frames and 4x5 up to 20, as in the paper and its code.
    /// For more frames it is the smallest grid of r x (r+1) with at least one sub-aperture per frame, because fewer
    /// can't separate the frames.
    pub fn for_frames(frames: usize) -> Self {
        let mut rows = 3;
        while rows * (rows + 1) < frames {
            rows += 1;
        }
        Self { rows, columns: rows + 1 }
    }

    /// Number of sub-apertures.
    pub fn count(self) -> usize {
        self.rows * self.columns
    }
}

impl Multiplexing {
    /// The patterns \[B, rows, columns\] on a grid of sub-apertures, filled row by row.
    pub fn patterns(&self, grid: ApertureGrid) -> Array3<f32> {
        let open = |(frame, row, column)| {
            let rows: &Vec<bool> = &self.rows()[frame];
            let open: bool = rows.get(row * grid.columns + column).copied().unwrap_or(false);
            f32::from(u8::from(open))
        };
        Array3::from_shape_fn((self.rows().len(), grid.rows, grid.columns), open)
    }
}

/// Patterns \[frames, rows, columns\] with one open sub-aperture each, all different: no multiplexing.
///
/// Errors: [`OpticsError::Pattern`] for more frames than sub-apertures.
pub fn single_apertures(
    frames: usize,
    grid: ApertureGrid,
    rng: &mut impl Rng,
) -> Result<Array3<f32>> {
    check_size(frames, grid.rows, grid.columns)?;
    if frames > grid.count() {
        return Err(OpticsError::Pattern(format!(
            "{frames} frames need {frames} sub-apertures, but a grid of {}x{} has {}: use a larger grid or fewer frames",
            grid.rows,
            grid.columns,
            grid.count()
        )));
    }
    let mut patterns = Array3::zeros((frames, grid.rows, grid.columns));
    for (frame, open) in index::sample(rng, grid.count(), frames).into_iter().enumerate() {
        patterns[[frame, open / grid.columns, open % grid.columns]] = 1.0;
    }
    Ok(patterns)
}

/// An open circle that turns about the centre of the LCoS from frame to frame, as in the paper's camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Circle {
    /// Radius in LCoS pixels.
    pub radius_pixels: f64,
    /// Distance of the circle's centre from that of the LCoS, in LCoS pixels.
    pub centre_pixels: f64,
}

impl Default for Circle {
    /// A circle that touches the edge of the LCoS.
    fn default() -> Self {
        Self { radius_pixels: 400.0, centre_pixels: 368.0 }
    }
}

impl Circle {
    /// Patterns \[frames, rows, columns\], each turned by 360/`frames` degrees from the previous one.
    ///
    /// Errors: [`OpticsError::Parameter`] for an impossible circle, [`OpticsError::Pattern`] for one that leaves the
    /// LCoS.
    pub fn patterns(self, frames: usize, geometry: &Geometry) -> Result<Array3<f32>> {
        geometry.check()?;
        check_size(frames, geometry.lcos_rows, geometry.lcos_columns)?;
        self.check(geometry)?;
        let cells =
            [geometry.lcos_rows, geometry.lcos_columns].map(|pixels| pixels.div_ceil(CIRCLE_CELL));
        let turn = |frame| std::f64::consts::TAU * frame as f64 / frames as f64;
        let centres: Vec<(f64, f64)> = (0..frames)
            .map(|frame| turn(frame).sin_cos())
            .map(|(sine, cosine)| (self.centre_pixels * sine, self.centre_pixels * cosine))
            .collect();
        let sides = [
            geometry.lcos_rows as f64 / cells[0] as f64,
            geometry.lcos_columns as f64 / cells[1] as f64,
        ];
        let middle = [geometry.lcos_rows as f64 / 2.0, geometry.lcos_columns as f64 / 2.0];
        Ok(Array3::from_shape_fn((frames, cells[0], cells[1]), |(frame, row, column)| {
            let corner = (row as f64 * sides[0] - middle[0], column as f64 * sides[1] - middle[1]);
            self.share(centres[frame], corner, sides)
        }))
    }

    fn check(self, geometry: &Geometry) -> Result<()> {
        let (radius, centre) = (self.radius_pixels, self.centre_pixels);
        let fits = radius.is_finite() && radius > 0.0;
        check_parameter(fits, "circle radius_pixels", radius, "a number above 0")?;
        let fits = centre.is_finite() && centre >= 0.0;
        check_parameter(fits, "circle centre_pixels", centre, "at least 0")?;
        let edge = geometry.lcos_rows.min(geometry.lcos_columns) as f64 / 2.0;
        let reach = self.radius_pixels + self.centre_pixels;
        if reach > edge {
            return Err(OpticsError::Pattern(format!(
                "the circle reaches {reach} LCoS pixels from the axis (radius {}, centre {}), but the LCoS ends at \
                 {edge}: reduce the radius or the distance of the centre",
                self.radius_pixels, self.centre_pixels
            )));
        }
        Ok(())
    }

    /// Share of a cell that lies inside the circle about `centre`.
    fn share(self, centre: (f64, f64), corner: (f64, f64), sides: [f64; 2]) -> f32 {
        let inside = |&(row, column): &(f64, f64)| {
            (row - centre.0).hypot(column - centre.1) <= self.radius_pixels
        };
        // Only cells near the edge of the circle need sampling.
        let middle = (corner.0 + sides[0] / 2.0, corner.1 + sides[1] / 2.0);
        let distance = (middle.0 - centre.0).hypot(middle.1 - centre.1) - self.radius_pixels;
        if distance.abs() > sides[0].hypot(sides[1]) / 2.0 {
            return f32::from(u8::from(distance < 0.0));
        }
        let at = |step: usize| (step as f64 + 0.5) / CIRCLE_POINTS as f64;
        let points = (0..CIRCLE_POINTS * CIRCLE_POINTS).map(|point| {
            let (row, column) = (at(point / CIRCLE_POINTS), at(point % CIRCLE_POINTS));
            (corner.0 + row * sides[0], corner.1 + column * sides[1])
        });
        points.filter(inside).count() as f32 / (CIRCLE_POINTS * CIRCLE_POINTS) as f32
    }
}

/// Checks patterns \[B, rows, columns\] for `frames` frames.
///
/// Errors: [`OpticsError::Pattern`] for another number of patterns, for values outside \[0,1\], and for a pattern that
/// is closed everywhere.
pub fn check_patterns(patterns: ArrayView3<'_, f32>, frames: usize) -> Result<()> {
    let (count, rows, columns) = patterns.dim();
    check_size(frames, rows, columns)?;
    if count != frames {
        return Err(OpticsError::Pattern(format!(
            "{count} patterns of {rows}x{columns} cells were given for {frames} frames; one pattern per frame is needed"
        )));
    }
    if let Some(((frame, row, column), value)) =
        patterns.indexed_iter().find(|(_, value)| !(0.0..=1.0).contains(*value))
    {
        return Err(OpticsError::Pattern(format!(
            "pattern {frame} transmits {value} at row {row}, column {column} (all counted from 0); \
             transmissions must be from 0 to 1"
        )));
    }
    let dark = patterns.outer_iter().position(|pattern| pattern.iter().all(|&open| open == 0.0));
    match dark {
        Some(frame) => Err(OpticsError::Pattern(format!(
            "pattern {frame} (counted from 0) is closed everywhere and lets no light through"
        ))),
        None => Ok(()),
    }
}

/// Number of linearly independent patterns.
pub fn pattern_rank(patterns: ArrayView3<'_, f32>) -> usize {
    let product = |a: usize, b: usize| {
        let (a, b) =
            (patterns.index_axis(ndarray::Axis(0), a), patterns.index_axis(ndarray::Axis(0), b));
        a.iter().zip(b.iter()).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>()
    };
    let frames = patterns.dim().0;
    let gram: Vec<Vec<f64>> =
        (0..frames).map(|a| (0..frames).map(|b| product(a, b)).collect()).collect();
    let largest = (0..frames).map(|k| gram[k][k]).fold(0.0, f64::max);
    rank(gram, largest * 1e-9)
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Axis};

    use super::{Circle, check_patterns, pattern_rank, single_apertures};
    use crate::{ApertureGrid, Geometry, generator};

    #[test]
    fn grids_grow_with_the_number_of_frames() {
        for (frames, rows, columns) in
            [(1, 3, 4), (10, 3, 4), (12, 3, 4), (13, 4, 5), (20, 4, 5), (21, 5, 6), (30, 5, 6)]
        {
            assert_eq!(ApertureGrid::for_frames(frames), ApertureGrid { rows, columns });
        }
        assert!(ApertureGrid::for_frames(31).count() >= 31);
    }

    #[test]
    fn circles_have_the_right_area_and_turn_evenly() {
        let geometry = Geometry::default();
        for frames in [6, 10] {
            let patterns = Circle::default().patterns(frames, &geometry).unwrap();
            assert_eq!(patterns.dim(), (frames, 192, 256));
            let expected = std::f32::consts::PI * 50.0 * 50.0;
            for pattern in patterns.outer_iter() {
                assert!((pattern.sum() / expected - 1.0).abs() < 2e-3, "{}", pattern.sum());
            }
            assert_eq!(pattern_rank(patterns.view()), frames);
            // The first circle is to the right of the axis, the second one is turned by 360/B degrees.
            let centre = |k: usize| {
                let pattern = patterns.index_axis(Axis(0), k);
                let at = |(i, j): (usize, usize)| (i as f32 + 0.5 - 96.0, j as f32 + 0.5 - 128.0);
                let sum = pattern.indexed_iter().fold((0.0, 0.0), |sum, (place, open)| {
                    (sum.0 + open * at(place).0, sum.1 + open * at(place).1)
                });
                (sum.0 / pattern.sum(), sum.1 / pattern.sum())
            };
            let turn = |a: (f32, f32)| a.0.atan2(a.1).to_degrees();
            assert!((centre(0).1 - 46.0).abs() < 0.1 && centre(0).0.abs() < 0.1);
            assert!((turn(centre(1)) - 360.0 / frames as f32).abs() < 0.2);
        }
    }

    #[test]
    fn impossible_circles_are_refused() {
        let geometry = Geometry::default();
        let error = |radius_pixels, centre_pixels| {
            Circle { radius_pixels, centre_pixels }.patterns(6, &geometry).unwrap_err().to_string()
        };
        assert!(error(400.0, 400.0).contains("reaches 800 LCoS pixels"));
        assert!(error(0.0, 0.0).contains("radius_pixels is 0"));
        assert!(error(10.0, -1.0).contains("centre_pixels is -1"));
    }

    #[test]
    fn single_apertures_are_all_different() {
        let grid = ApertureGrid { rows: 3, columns: 4 };
        let patterns = single_apertures(10, grid, &mut generator(1)).unwrap();
        assert_eq!(pattern_rank(patterns.view()), 10);
        assert!(patterns.outer_iter().all(|pattern| pattern.sum() == 1.0));
        let error = single_apertures(13, grid, &mut generator(1)).unwrap_err().to_string();
        assert!(error.contains("13 frames") && error.contains("has 12"), "{error}");
    }

    #[test]
    fn unusable_patterns_are_refused_with_the_place() {
        let good = Array3::from_elem((2, 3, 4), 0.5f32);
        check_patterns(good.view(), 2).unwrap();
        let refused = |patterns: &Array3<f32>, frames| {
            check_patterns(patterns.view(), frames).unwrap_err().to_string()
        };
        assert!(refused(&good, 3).contains("2 patterns of 3x4 cells were given for 3 frames"));
        let mut bad = good.clone();
        bad[[1, 2, 3]] = 1.5;
        assert!(refused(&bad, 2).contains("pattern 1 transmits 1.5 at row 2, column 3"));
        let mut dark = good;
        dark.index_axis_mut(Axis(0), 1).fill(0.0);
        assert!(refused(&dark, 2).contains("pattern 1"));
    }
}
