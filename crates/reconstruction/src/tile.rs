//! Tiles with overlap and smooth blending: pure arithmetic.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, ArrayViewMut2, s};
use serde::{Deserialize, Serialize};

use super::error::{Result, check_parameter, check_shape};

/// A window of a picture: all pixels of some rows and columns, or every second one, as for one colour of a mosaic.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Window {
    /// Rows in the picture.
    pub rows: Range<usize>,
    /// Columns in the picture.
    pub columns: Range<usize>,
    /// Step between pixels: 1, or 2 for a sub-image of a mosaic.
    pub step: usize,
}

impl Window {
    /// A window of all pixels of a picture.
    pub fn whole(height: usize, width: usize) -> Self {
        Self { rows: 0..height, columns: 0..width, step: 1 }
    }

    /// The window of a picture that corresponds to a window of the sub-image with every second pixel from `first` on.
    pub fn of_plane(
        rows: Range<usize>,
        columns: Range<usize>,
        (row, column): (usize, usize),
    ) -> Self {
        let place = |range: Range<usize>, first: usize| {
            2 * range.start + first..(2 * range.end + first).saturating_sub(1)
        };
        Self { rows: place(rows, row), columns: place(columns, column), step: 2 }
    }

    /// The pixels of the window in a frame \[H,W\] of the whole picture.
    pub fn of<'a, T>(&self, frame: ArrayView2<'a, T>) -> ArrayView2<'a, T> {
        let step = self.step.cast_signed();
        frame.slice_move(s![self.rows.clone();step, self.columns.clone();step])
    }
}

/// One tile: a window of a picture of a grey sensor, or of one of the four sub-images of a mosaic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Tile {
    /// Position in the plan.
    pub index: usize,
    /// Row of the first pixel in the picture.
    pub row: usize,
    /// Column of the first pixel in the picture.
    pub column: usize,
    /// Number of rows.
    pub height: usize,
    /// Number of columns.
    pub width: usize,
    /// Step between pixels: 1, or 2 for a sub-image of a mosaic.
    pub step: usize,
}

impl Tile {
    /// The window of the tile in the picture.
    pub fn window(&self) -> Window {
        let span = |first: usize, count: usize| first..first + (count - 1) * self.step + 1;
        let (rows, columns) = (span(self.row, self.height), span(self.column, self.width));
        Window { rows, columns, step: self.step }
    }

    /// The area of the picture to which the tile contributes: row, column, height and width in pixels.
    pub fn place(&self) -> [usize; 4] {
        let step = self.step;
        let cell = |first: usize| first / step * step;
        [cell(self.row), cell(self.column), self.height * step, self.width * step]
    }

    /// Index of its sub-image of a mosaic, from 0 to 3 in the order of a cell of 2x2 pixels, row by row; none for a
    /// grey sensor.
    pub fn plane(&self) -> Option<usize> {
        (self.step == 2).then_some(self.row % 2 * 2 + self.column % 2)
    }
}

/// Divisor of the sides of tiles, where the picture allows it: networks halve them twice.
const MULTIPLE: usize = 8;

/// The tiles of a picture. They depend on its size and the parameters alone, never on the number of workers.
#[derive(Debug, Clone, PartialEq)]
pub struct TilePlan {
    height: usize,
    width: usize,
    size: usize,
    overlap: usize,
    /// 1, or 2 for the sub-images of a mosaic, which have the same tiles.
    step: usize,
    rows: Vec<Span>,
    columns: Vec<Span>,
}

/// A section of one axis with its blending weights, which add up to 1 over all spans.
#[derive(Debug, Clone, PartialEq)]
struct Span {
    start: usize,
    weights: Vec<f32>,
}

impl TilePlan {
    /// Cuts `height` x `width` pixels into as few and as small tiles as possible, of at most `size` x `size` and with
    /// at least `overlap` pixels in common with each neighbour. A side that fits into one tile is not cut.
    ///
    /// # Errors
    /// `size` below 16 or above 8192, or `overlap` above half of `size`.
    pub fn new(height: usize, width: usize, size: usize, overlap: usize) -> Result<Self> {
        let picture = format!("{height}x{width}");
        check_shape(height * width > 0, "a picture to be tiled", picture, "at least one pixel")?;
        let sizes = 16..=8192;
        check_parameter(sizes.contains(&size), "tile size", size, "from 16 to 8192 pixels")?;
        let range = "at most half of the tile size";
        check_parameter(overlap * 2 <= size, "tile overlap", overlap, range)?;
        let (rows, columns) = (spans(height, size, overlap), spans(width, size, overlap));
        Ok(Self { height, width, size, overlap, step: 1, rows, columns })
    }

    /// Cuts each of the four sub-images of a mosaic of `height` x `width` pixels, as [`Self::new`] cuts a picture of
    /// their size: `size` and `overlap` are in their pixels. Tiles at the same place are consecutive.
    ///
    /// # Errors
    /// As [`Self::new`]; an odd side.
    pub fn of_mosaic(height: usize, width: usize, size: usize, overlap: usize) -> Result<Self> {
        let (is_even, found) = (height % 2 + width % 2 == 0, format!("{height}x{width}"));
        check_shape(is_even, "a mosaic", found, "an even number of rows and columns")?;
        let plane = Self::new(height / 2, width / 2, size, overlap)?;
        Ok(Self { height, width, step: 2, ..plane })
    }

    /// Rows and columns of the whole picture.
    pub fn dim(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Largest side of a tile.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Smallest overlap of neighbours.
    pub fn overlap(&self) -> usize {
        self.overlap
    }

    /// Number of tiles.
    pub fn len(&self) -> usize {
        self.planes() * self.rows.len() * self.columns.len()
    }

    /// Number of sub-images: 1, or 4 for a mosaic.
    fn planes(&self) -> usize {
        self.step * self.step
    }

    /// Indices of the spans of a tile.
    fn position(&self, index: usize) -> (usize, usize) {
        let place = index / self.planes();
        (place / self.columns.len(), place % self.columns.len())
    }

    /// A plan has at least one tile.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Number of pixels of the largest tile.
    pub fn largest(&self) -> usize {
        self.tiles().map(|tile| tile.height * tile.width).max().unwrap_or(0)
    }

    /// The tile at `index`, row by row; none beyond the last one.
    pub fn tile(&self, index: usize) -> Option<Tile> {
        let (row, column) = self.position(index);
        let (row, column) = (self.rows.get(row)?, self.columns.get(column)?);
        let (step, plane) = (self.step, index % self.planes());
        Some(Tile {
            index,
            row: row.start * step + plane / step,
            column: column.start * step + plane % step,
            height: row.weights.len(),
            width: column.weights.len(),
            step,
        })
    }

    /// All tiles.
    pub fn tiles(&self) -> impl Iterator<Item = Tile> + '_ {
        (0..self.len()).filter_map(|index| self.tile(index))
    }

    /// Blending weights \[height,width\] of a tile; over all tiles they add up to 1 at every
    /// pixel. They rise as a squared sine over the shared pixels and are separable.
    pub fn weights(&self, tile: &Tile) -> Array2<f32> {
        let (row, column) = self.position(tile.index);
        let (rows, columns) = (&self.rows[row].weights, &self.columns[column].weights);
        Array2::from_shape_fn((tile.height, tile.width), |(i, j)| rows[i] * columns[j])
    }

    /// Adds a frame of a tile, with its weights, to the whole frame \[H,W\] (0 at first).
    pub fn blend(&self, tile: &Tile, part: ArrayView2<'_, f32>, mut whole: ArrayViewMut2<'_, f32>) {
        let weights = self.weights(tile);
        let Window { rows, columns, step } = tile.window();
        let step = step.cast_signed();
        let mut window = whole.slice_mut(s![rows;step, columns;step]);
        ndarray::azip!((sum in &mut window, &value in &part, &weight in &weights) {
            *sum += weight * value;
        });
    }
}

/// Cuts an axis into as few and as equal spans as possible, with their weights.
fn spans(length: usize, size: usize, overlap: usize) -> Vec<Span> {
    let size = size.min(length);
    let parts = parts(length, size, overlap.min(size / 2), MULTIPLE);
    let weights = weights(&parts, length);
    let spans = parts.into_iter().zip(weights);
    spans.map(|(part, weights)| Span { start: part.start, weights }).collect()
}

/// Cuts 0 to `length` into as few parts as possible of at most `size`, with at least `overlap` (less than `size`) in
/// common with their neighbours. They are equally spaced and as short as possible, in multiples of `multiple` unless
/// `size` is not one.
pub(super) fn parts(
    length: usize,
    size: usize,
    overlap: usize,
    multiple: usize,
) -> Vec<Range<usize>> {
    let count = 1 + length.saturating_sub(size).div_ceil((size - overlap).max(1));
    // The smallest possible overlap, because shared pixels are computed twice.
    let least = (length + (count - 1) * overlap).div_ceil(count);
    let size = least.next_multiple_of(multiple).min(size);
    let start = |k: usize| if k == 0 { 0 } else { k * (length - size) / (count - 1) };
    (0..count).map(|k| start(k)..start(k) + size).collect()
}

/// Weights of parts that cover 0 to `length`, in order of their starts. They rise as a squared sine over the overlap
/// with a neighbour, and add up to 1 everywhere.
pub(super) fn weights(parts: &[Range<usize>], length: usize) -> Vec<Vec<f32>> {
    let mut weights: Vec<Vec<f32>> = (0..parts.len())
        .map(|k| {
            let part = &parts[k];
            let before = k.checked_sub(1).map_or(0, |k| parts[k].end.saturating_sub(part.start));
            let after = parts.get(k + 1).map_or(0, |next| part.end.saturating_sub(next.start));
            tapered(part.len(), before, after)
        })
        .collect();
    // Even spacing can make three parts meet, so the ramps alone need not add up to 1.
    let mut sums = vec![0.0f32; length];
    for (part, weights) in parts.iter().zip(&weights) {
        sums[part.clone()].iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight);
    }
    for (part, weights) in parts.iter().zip(&mut weights) {
        weights.iter_mut().zip(&sums[part.clone()]).for_each(|(weight, sum)| *weight /= sum);
    }
    weights
}

/// 1 inside, and a squared sine over the `before` first and `after` last of `length` pixels.
fn tapered(length: usize, before: usize, after: usize) -> Vec<f32> {
    let ramp = |step: usize, shared: usize| {
        let share = ((step as f64 + 0.5) / shared.max(1) as f64).min(1.0);
        (std::f64::consts::FRAC_PI_2 * share).sin().powi(2)
    };
    let edge = |step: usize, shared: usize| if shared == 0 { 1.0 } else { ramp(step, shared) };
    (0..length).map(|i| (edge(i, before) * edge(length - 1 - i, after)) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::{TilePlan, Window};
    use ndarray::Array2;
    use proptest::prelude::proptest;

    proptest! {
        #[test]
        fn weights_add_up_to_one(
            height in 1usize..300,
            width in 1usize..300,
            size in 16usize..128,
            share in 0usize..8,
        ) {
            let plan = TilePlan::new(height, width, size, size * share / 16).unwrap();
            let mut whole = Array2::zeros((height, width));
            for tile in plan.tiles() {
                assert!(tile.height <= size && tile.width <= size);
                let part = Array2::ones((tile.height, tile.width));
                plan.blend(&tile, part.view(), whole.view_mut());
            }
            for sum in &whole {
                assert!((sum - 1.0f32).abs() < 1e-5, "{sum}");
            }
        }
    }

    #[test]
    fn the_sub_images_of_a_mosaic_are_cut_alike_and_cover_it() {
        let plan = TilePlan::of_mosaic(200, 132, 64, 16).unwrap();
        let plane = TilePlan::new(100, 66, 64, 16).unwrap();
        assert_eq!((plan.len(), plan.largest()), (4 * plane.len(), plane.largest()));
        let mut whole = Array2::zeros((200, 132));
        for tile in plan.tiles() {
            let first = plane.tile(tile.index / 4).unwrap();
            assert_eq!(tile.plane(), Some(tile.index % 4));
            let place = [first.row, first.column, first.height, first.width];
            assert_eq!(tile.place(), place.map(|length| 2 * length));
            let rows = first.row..first.row + first.height;
            let columns = first.column..first.column + first.width;
            let phase = (tile.index % 4 / 2, tile.index % 2);
            assert_eq!(tile.window(), Window::of_plane(rows, columns, phase));
            assert_eq!(tile.window().of(whole.view()).dim(), (tile.height, tile.width));
            let part = Array2::from_elem((tile.height, tile.width), (tile.index % 4) as f32 + 1.0);
            plan.blend(&tile, part.view(), whole.view_mut());
        }
        for ((i, j), value) in whole.indexed_iter() {
            let expected = (i % 2 * 2 + j % 2) as f32 + 1.0;
            assert!((value - expected).abs() < 1e-5, "{i} {j}: {value}");
        }
        let error = TilePlan::of_mosaic(201, 132, 64, 16).unwrap_err().to_string();
        assert!(error.contains("201x132") && error.contains("even"), "{error}");
    }

    #[test]
    fn a_picture_that_fits_is_one_tile() {
        let plan = TilePlan::new(256, 200, 256, 32).unwrap();
        assert_eq!(plan.len(), 1);
        assert!(plan.weights(&plan.tile(0).unwrap()).iter().all(|&w| w == 1.0));
        assert_eq!(plan.tile(1), None);
    }

    #[test]
    fn neighbours_share_at_least_the_overlap() {
        let plan = TilePlan::new(3200, 1024, 256, 32).unwrap();
        for axis in [&plan.rows, &plan.columns] {
            for pair in axis.windows(2) {
                let shared = pair[0].start + pair[0].weights.len() - pair[1].start;
                assert!(shared >= 32, "{shared}");
            }
        }
    }

    #[test]
    fn the_overlap_is_not_larger_than_requested() {
        for (length, size, overlap, count, side) in
            [(1024, 256, 32, 5, 232), (3200, 256, 32, 15, 248), (3200, 384, 16, 9, 376)]
        {
            let plan = TilePlan::new(length, 200, size, overlap).unwrap();
            let tile = plan.tile(0).unwrap();
            assert_eq!((plan.len(), tile.height, tile.width), (count, side, 200));
        }
    }

    #[test]
    fn bad_parameters_are_named() {
        for (size, overlap, word) in [(8, 0, "tile size"), (64, 33, "tile overlap")] {
            let error = TilePlan::new(100, 100, size, overlap).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
        assert!(TilePlan::new(0, 5, 64, 8).is_err());
    }
}
