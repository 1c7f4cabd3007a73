//! The colour filters of a sensor, in cells of 2x2 pixels that repeat, and the colours that each pixel lacks.
//!
//! A frame of colours is an array \[H, 3 W\]: see [`Channels`].

use ndarray::{Array2, ArrayView2, s};
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use formats::Channels;

const COLOURS: usize = Channels::Rgb.count();
const RED: usize = 0;
const GREEN: usize = 1;
const BLUE: usize = 2;
/// Pixels around one that its colours follow from.
pub const MARGIN: usize = 2;

/// The colours of a cell, row by row: a Bayer pattern.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Hash,
    Serialize,
    Deserialize,
    Display,
    EnumString,
    VariantNames,
)]
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
    /// What the method is called that gives each pixel the colours that it lacks: linear interpolation,
    /// corrected by the gradient of the colour that is known (Malvar, He and Cutler 2004).
    pub const DEMOSAICKING: &str = "malvar-he-cutler-2004";

    /// The colour of a pixel: 0 is red, 1 green, 2 blue.
    pub fn colour(self, row: usize, column: usize) -> usize {
        let cell = match self {
            Self::Rggb => [RED, GREEN, GREEN, BLUE],
            Self::Bggr => [BLUE, GREEN, GREEN, RED],
            Self::Grbg => [GREEN, RED, BLUE, GREEN],
            Self::Gbrg => [GREEN, BLUE, RED, GREEN],
        };
        cell[row % 2 * 2 + column % 2]
    }

    /// Row and column of the first green pixel of a cell. What is decided once for all colours is decided on
    /// the sub-image that begins there: it sees most of the light.
    pub fn green(self) -> (usize, usize) {
        match self {
            Self::Rggb | Self::Bggr => (0, 1),
            Self::Grbg | Self::Gbrg => (0, 0),
        }
    }

    /// What the sensor sees of a frame of colours \[H, 3 W\], whose first pixel stands at this row and column of
    /// the mosaic: \[H,W\].
    pub fn seen(self, colours: ArrayView2<'_, f32>, (row, column): (usize, usize)) -> Array2<f32> {
        let (height, width) = (colours.nrows(), colours.ncols() / COLOURS);
        Array2::from_shape_fn((height, width), |(i, j)| {
            colours[[i, COLOURS * j + self.colour(row + i, column + j)]]
        })
    }

    /// All colours \[H, 3 W\] of each pixel of a sensor's frame \[H,W\], whose first pixel stands at this row
    /// and column of the mosaic. What a pixel has seen stays as it is. Beyond its edges the frame is mirrored.
    /// Frames have at least 2 rows and columns; of smaller ones each pixel is grey.
    pub fn colours(self, seen: ArrayView2<'_, f32>, (row, column): (usize, usize)) -> Array2<f32> {
        let (height, width) = seen.dim();
        let mut colours = Array2::zeros((height, COLOURS * width));
        if height < 2 || width < 2 {
            for ((i, j), &value) in seen.indexed_iter() {
                colours.slice_mut(s![i, COLOURS * j..COLOURS * (j + 1)]).fill(value);
            }
            return colours;
        }
        let padded: Vec<Vec<f32>> = (0..height + 2 * MARGIN)
            .map(|i| {
                let line = seen.row(mirrored(i, height));
                (0..width + 2 * MARGIN).map(|j| line[mirrored(j, width)]).collect()
            })
            .collect();
        for ((i, mut line), rows) in
            colours.rows_mut().into_iter().enumerate().zip(padded.windows(5))
        {
            // The colour of even and odd columns, and whether red stands beside a green pixel of this row.
            let own = [0, 1].map(|j| self.colour(row + i, column + j));
            let red_beside = own.contains(&RED);
            let Some(line) = line.as_slice_mut() else { continue };
            for (j, pixel) in line.as_chunks_mut::<COLOURS>().0.iter_mut().enumerate() {
                let at = |di: usize, dj: usize| rows[di][j + dj];
                let here = at(2, 2);
                let (beside, above) = (at(2, 1) + at(2, 3), at(1, 2) + at(3, 2));
                let (far_beside, far_above) = (at(2, 0) + at(2, 4), at(0, 2) + at(4, 2));
                let corners = at(1, 1) + at(1, 3) + at(3, 1) + at(3, 3);
                // The colour that stands beside a green pixel, and that above it.
                let beside_green =
                    5.0 * here + 4.0 * beside - far_beside - corners + 0.5 * far_above;
                let above_green = 5.0 * here + 4.0 * above - far_above - corners + 0.5 * far_beside;
                let green = 4.0 * here + 2.0 * (beside + above) - far_beside - far_above;
                let opposite = 6.0 * here + 2.0 * corners - 1.5 * (far_beside + far_above);
                *pixel = match own[j % 2] {
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

/// The pixel that stands at a place of an axis with a margin: beyond its ends those before them, so that
/// each has the colour of its place.
fn mirrored(place: usize, length: usize) -> usize {
    let period = 2 * (length - 1);
    // A multiple of the period that keeps it above 0.
    let at = (place + MARGIN.next_multiple_of(period) - MARGIN) % period;
    at.min(period - at)
}

#[cfg(test)]
mod tests {
    use super::Mosaic;
    use ndarray::{Array2, s};

    const ALL: [Mosaic; 4] = [Mosaic::Rggb, Mosaic::Bggr, Mosaic::Grbg, Mosaic::Gbrg];

    /// A frame whose colours are these functions of row and column.
    fn frame(size: (usize, usize), colour: impl Fn(usize, f32, f32) -> f32) -> Array2<f32> {
        Array2::from_shape_fn((size.0, 3 * size.1), |(i, at)| {
            colour(at % 3, i as f32, (at / 3) as f32)
        })
    }

    #[test]
    fn names_say_the_colours_of_a_cell() {
        for mosaic in ALL {
            let name = mosaic.to_string();
            let of = |at: usize| ["r", "g", "b"][mosaic.colour(at / 2, at % 2)];
            assert_eq!((0..4).map(of).collect::<String>(), name);
            let (row, column) = mosaic.green();
            assert_eq!(mosaic.colour(row, column), 1);
            assert_eq!(name.parse(), Ok(mosaic));
        }
    }

    #[test]
    fn what_was_seen_stays_and_slopes_come_back() {
        for mosaic in ALL {
            let truth = frame((12, 14), |c, i, j| 0.1 + 0.2 * c as f32 + 0.01 * i - 0.02 * j);
            let seen = mosaic.seen(truth.view(), (0, 0));
            let found = mosaic.colours(seen.view(), (0, 0));
            assert_eq!(mosaic.seen(found.view(), (0, 0)), seen, "{mosaic}");
            // Mirrored, a slope has a kink at the edge.
            let inside = s![2..10, 6..36];
            for (found, truth) in found.slice(inside).iter().zip(truth.slice(inside)) {
                assert!((found - truth).abs() < 1e-5, "{mosaic}: {found} {truth}");
            }
        }
    }

    #[test]
    fn grey_stays_grey_and_each_colour_even_to_the_edge() {
        for (mosaic, size) in ALL.into_iter().zip([(2, 2), (4, 6), (6, 2), (8, 8)]) {
            let truth = frame(size, |c, _, _| [0.2, 0.5, 0.9][c]);
            let found = mosaic.colours(mosaic.seen(truth.view(), (0, 0)).view(), (0, 0));
            assert!(found.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-6), "{mosaic}");
            let grey = Array2::from_elem(size, 0.4);
            assert!(mosaic.colours(grey.view(), (0, 0)).iter().all(|v| (v - 0.4).abs() < 1e-6));
        }
    }

    #[test]
    fn a_window_with_a_margin_has_the_colours_of_the_whole() {
        let mosaic = Mosaic::Grbg;
        let truth = frame((20, 24), |c, i, j| ((c as f32 + i * 0.7 + j * 1.3) * 2.1).sin());
        let seen = mosaic.seen(truth.view(), (0, 0));
        let whole = mosaic.colours(seen.view(), (0, 0));
        let part = mosaic.colours(seen.slice(s![3..14, 5..20]), (3, 5));
        assert_eq!(part.slice(s![2..9, 6..39]), whole.slice(s![5..12, 21..54]));
    }

    #[test]
    fn an_edge_is_corrected_by_what_is_known_there() {
        let seen = Array2::from_shape_fn((8, 8), |(_, j)| f32::from(u8::from(j >= 4)));
        let found = Mosaic::Rggb.colours(seen.view(), (0, 0));
        let green: Vec<f32> = (2..6).map(|j| found[[4, 3 * j + 1]]).collect();
        assert_eq!(green, [-0.125, 0.0, 0.875, 1.0]);
    }
}
