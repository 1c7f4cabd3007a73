//! Bayer mosaics: the colour filters of a sensor, and demosaicking.
//!
//! Colour frames are arrays \[H, 3 W\]; see [`Channels`].

use ndarray::{Array2, ArrayView2, s};
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use formats::Channels;

const COLOURS: usize = Channels::Rgb.count();
const RED: usize = 0;
const GREEN: usize = 1;
const BLUE: usize = 2;
/// Radius, in pixels, of the neighbourhood that demosaicking uses.
pub const MARGIN: usize = 2;

/// A Bayer pattern, named by the colours of its 2x2 cell, row by row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Mosaic {
    /// Red and green, then green and blue.
    Rggb,
    /// Blue and green, then green and red.
    Bggr,
    /// Green and red, then blue and green.
    Grbg,
    /// Green and blue, then red and green.
    Gbrg,
}

impl Mosaic {
    /// Name of the demosaicking method: linear interpolation, corrected by the gradient of the known colour (Malvar, He
    /// and Cutler 2004).
    pub const DEMOSAICKING: &str = "malvar-he-cutler-2004";

    /// Colour of a pixel: 0 is red, 1 green, 2 blue.
    pub fn colour(self, row: usize, column: usize) -> usize {
        let cell = match self {
            Self::Rggb => [RED, GREEN, GREEN, BLUE],
            Self::Bggr => [BLUE, GREEN, GREEN, RED],
            Self::Grbg => [GREEN, RED, BLUE, GREEN],
            Self::Gbrg => [GREEN, BLUE, RED, GREEN],
        };
        cell[row % 2 * 2 + column % 2]
    }

    /// Row and column of the first green pixel of a cell. The sub-image that starts there receives most light, so it
    /// represents the others wherever one decision holds for all colours.
    pub fn green(self) -> (usize, usize) {
        match self {
            Self::Rggb | Self::Bggr => (0, 1),
            Self::Grbg | Self::Gbrg => (0, 0),
        }
    }

    /// Samples a colour frame \[H, 3 W\] through the mosaic, which gives \[H,W\]. `(row, column)` is the position of
    /// the first pixel in the mosaic.
    pub fn sample(
        self,
        colours: ArrayView2<'_, f32>,
        (row, column): (usize, usize),
    ) -> Array2<f32> {
        let (height, width) = (colours.nrows(), colours.ncols() / COLOURS);
        Array2::from_shape_fn((height, width), |(i, j)| {
            colours[[i, COLOURS * j + self.colour(row + i, column + j)]]
        })
    }

    /// Demosaicks a raw frame \[H,W\] into a colour frame \[H, 3 W\]. `(row, column)` is the position of the first
    /// pixel in the mosaic.
    ///
    /// Measured samples are kept. The frame is mirrored at its edges. Frames with fewer than 2 rows or columns become
    /// grey.
    pub fn demosaick(self, raw: ArrayView2<'_, f32>, (row, column): (usize, usize)) -> Array2<f32> {
        let (height, width) = raw.dim();
        let mut colours = Array2::zeros((height, COLOURS * width));
        if height < 2 || width < 2 {
            for ((i, j), &value) in raw.indexed_iter() {
                colours.slice_mut(s![i, COLOURS * j..COLOURS * (j + 1)]).fill(value);
            }
            return colours;
        }
        let padded: Vec<Vec<f32>> = (0..height + 2 * MARGIN)
            .map(|i| {
                let line = raw.row(mirrored(i, height));
                (0..width + 2 * MARGIN).map(|j| line[mirrored(j, width)]).collect()
            })
            .collect();
        for ((i, mut line), rows) in
            colours.rows_mut().into_iter().enumerate().zip(padded.windows(5))
        {
            // Colours of the even and odd columns of this row. Green pixels have red or blue beside them.
            let row_colours = [0, 1].map(|j| self.colour(row + i, column + j));
            let red_beside = row_colours.contains(&RED);
            let Some(line) = line.as_slice_mut() else { continue };
            for (j, pixel) in line.as_chunks_mut::<COLOURS>().0.iter_mut().enumerate() {
                let at = |di: usize, dj: usize| rows[di][j + dj];
                let here = at(2, 2);
                let (beside, above) = (at(2, 1) + at(2, 3), at(1, 2) + at(3, 2));
                let (far_beside, far_above) = (at(2, 0) + at(2, 4), at(0, 2) + at(4, 2));
                let corners = at(1, 1) + at(1, 3) + at(3, 1) + at(3, 3);
                // The colours beside and above a green pixel.
                let beside_green =
                    5.0 * here + 4.0 * beside - far_beside - corners + 0.5 * far_above;
                let above_green = 5.0 * here + 4.0 * above - far_above - corners + 0.5 * far_beside;
                let green = 4.0 * here + 2.0 * (beside + above) - far_beside - far_above;
                let opposite = 6.0 * here + 2.0 * corners - 1.5 * (far_beside + far_above);
                *pixel = match row_colours[j % 2] {
                    RED => [here, green / 8.0, opposite / 8.0],
                    BLUE => [opposite / 8.0, green / 8.0, here],
                    _ if red_beside => [beside_green / 8.0, here, above_green / 8.0],
                    _ => [above_green / 8.0, here, beside_green / 8.0],
                };
            }
        }
        colours
    }
}

/// Index of the pixel at `place` on an axis that is padded by [`MARGIN`] mirrored pixels. Mirroring about the edge
/// pixel keeps the phase of the mosaic.
fn mirrored(place: usize, length: usize) -> usize {
    let period = 2 * (length - 1);
    // The added multiple of the period keeps the value above 0.
    let at = (place + MARGIN.next_multiple_of(period) - MARGIN) % period;
    at.min(period - at)
}

#[cfg(test)]
mod tests {
    use super::Mosaic;
    use ndarray::{Array2, s};

    const ALL: [Mosaic; 4] = [Mosaic::Rggb, Mosaic::Bggr, Mosaic::Grbg, Mosaic::Gbrg];

    /// A colour frame computed from (colour, row, column).
    fn frame(size: (usize, usize), colour: impl Fn(usize, f32, f32) -> f32) -> Array2<f32> {
        Array2::from_shape_fn((size.0, 3 * size.1), |(i, at)| {
            colour(at % 3, i as f32, (at / 3) as f32)
        })
    }

    #[test]
    fn names_list_the_colours_of_a_cell() {
        for mosaic in ALL {
            let name = mosaic.to_string();
            let letter = |at: usize| ["r", "g", "b"][mosaic.colour(at / 2, at % 2)];
            assert_eq!((0..4).map(letter).collect::<String>(), name);
            let (row, column) = mosaic.green();
            assert_eq!(mosaic.colour(row, column), 1);
            assert_eq!(name.parse(), Ok(mosaic));
        }
    }

    #[test]
    fn samples_are_kept_and_linear_slopes_are_recovered() {
        for mosaic in ALL {
            let truth = frame((12, 14), |c, i, j| 0.1 + 0.2 * c as f32 + 0.01 * i - 0.02 * j);
            let raw = mosaic.sample(truth.view(), (0, 0));
            let colours = mosaic.demosaick(raw.view(), (0, 0));
            assert_eq!(mosaic.sample(colours.view(), (0, 0)), raw, "{mosaic}");
            // Mirroring breaks the slope at the edge.
            let inside = s![2..10, 6..36];
            for (colours, truth) in colours.slice(inside).iter().zip(truth.slice(inside)) {
                assert!((colours - truth).abs() < 1e-5, "{mosaic}: {colours} {truth}");
            }
        }
    }

    #[test]
    fn uniform_colours_are_recovered_up_to_the_edge() {
        for (mosaic, size) in ALL.into_iter().zip([(2, 2), (4, 6), (6, 2), (8, 8)]) {
            let truth = frame(size, |c, _, _| [0.2, 0.5, 0.9][c]);
            let colours = mosaic.demosaick(mosaic.sample(truth.view(), (0, 0)).view(), (0, 0));
            assert!(colours.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-6), "{mosaic}");
            let grey = Array2::from_elem(size, 0.4);
            assert!(mosaic.demosaick(grey.view(), (0, 0)).iter().all(|v| (v - 0.4).abs() < 1e-6));
        }
    }

    #[test]
    fn windows_with_a_margin_equal_the_whole_frame() {
        let mosaic = Mosaic::Grbg;
        let truth = frame((20, 24), |c, i, j| ((c as f32 + i * 0.7 + j * 1.3) * 2.1).sin());
        let raw = mosaic.sample(truth.view(), (0, 0));
        let whole = mosaic.demosaick(raw.view(), (0, 0));
        let part = mosaic.demosaick(raw.slice(s![3..14, 5..20]), (3, 5));
        assert_eq!(part.slice(s![2..9, 6..39]), whole.slice(s![5..12, 21..54]));
    }

    #[test]
    fn interpolation_is_corrected_by_the_known_gradient() {
        let raw = Array2::from_shape_fn((8, 8), |(_, j)| f32::from(u8::from(j >= 4)));
        let colours = Mosaic::Rggb.demosaick(raw.view(), (0, 0));
        let green: Vec<f32> = (2..6).map(|j| colours[[4, 3 * j + 1]]).collect();
        assert_eq!(green, [-0.125, 0.0, 0.875, 1.0]);
    }
}
