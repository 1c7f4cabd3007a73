//! From a window of a picture to what is shown: reduced by averaging.

use std::ops::Range;

use ndarray::{Array2, s};

use formats::{Channels, FormatError};

/// Pixels of a tile's side.
pub(in crate::http) const TILE: usize = 256;
/// Samples that are held at the same time: 16 MiB.
const BAND: usize = 4 << 20;

/// Reads rows and columns of a picture: f32 \[rows, columns\], of colours \[rows, 3 columns\].
type Read = dyn Fn(Range<usize>, Range<usize>) -> Result<Array2<f32>, FormatError> + Send + Sync;

/// A picture of which windows can be read.
pub(in crate::http) struct Picture {
    pub(in crate::http) height: usize,
    pub(in crate::http) width: usize,
    /// Names the content: where this text is the same, so are the values.
    pub(in crate::http) identity: String,
    /// False while the content still grows.
    pub(in crate::http) settled: bool,
    pub(in crate::http) channels: Channels,
    /// Samples that are read for each pixel.
    pub(in crate::http) depth: usize,
    /// The value that is shown as white, with black at 0, unless the request says otherwise.
    pub(in crate::http) white: Option<f32>,
    pub(in crate::http) read: Box<Read>,
}

/// A part of a picture whose sides were divided by 2^`level`, in reduced pixels.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(in crate::http) struct Region {
    pub(in crate::http) level: u32,
    pub(in crate::http) rows: Range<usize>,
    pub(in crate::http) columns: Range<usize>,
}

/// What the values of a picture are like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::http) struct Spread {
    pub(in crate::http) minimum: f32,
    pub(in crate::http) maximum: f32,
    /// Half a percent of the pixels lie below.
    pub(in crate::http) low: f32,
    /// Half a percent of the pixels lie above.
    pub(in crate::http) high: f32,
}

impl Picture {
    /// The first level at which all of the picture fits into `side` pixels.
    pub(in crate::http) fn level_within(&self, side: usize) -> u32 {
        let longest = self.height.max(self.width);
        (0..).find(|level| longest.div_ceil(1 << level) <= side).unwrap_or(0)
    }

    pub(in crate::http) fn whole(&self, level: u32) -> Region {
        let side = |length: usize| 0..length.div_ceil(1 << level);
        Region { level, rows: side(self.height), columns: side(self.width) }
    }

    /// A tile, if there is one of this place: from level 0, the full resolution, to the level at
    /// which one tile holds all.
    pub(in crate::http) fn tile(&self, level: u32, row: usize, column: usize) -> Option<Region> {
        if level > self.level_within(TILE) {
            return None;
        }
        let whole = self.whole(level);
        let cut = |at: usize, end: usize| {
            let start = at.checked_mul(TILE).filter(|start| *start < end)?;
            Some(start..end.min(start + TILE))
        };
        let (rows, columns) = (cut(row, whole.rows.end)?, cut(column, whole.columns.end)?);
        Some(Region { level, rows, columns })
    }

    /// The values of a region \[rows, columns\], of colours \[rows, 3 columns\]: each is the mean of the pixels that
    /// it stands for.
    /// Reads no more than these, a band of rows at a time.
    pub(in crate::http) fn reduce(&self, region: &Region) -> Result<Array2<f32>, FormatError> {
        let step = 1usize << region.level;
        let channels = self.channels.count();
        let mut reduced = Array2::zeros((region.rows.len(), region.columns.len() * channels));
        let columns = region.columns.start * step..(region.columns.end * step).min(self.width);
        let band = (BAND / (step * columns.len() * self.depth).max(1)).max(1);
        for start in region.rows.clone().step_by(band) {
            let end = (start + band).min(region.rows.end);
            let rows = start * step..(end * step).min(self.height);
            let window = (self.read)(rows, columns.clone())?;
            for (offset, row) in (start..end).enumerate() {
                let lines = offset * step..((offset + 1) * step).min(window.nrows());
                let mut target = reduced.row_mut(row - region.rows.start);
                for line in lines.clone() {
                    for channel in 0..channels {
                        let of = s![channel..;channels.cast_signed()];
                        let line = window.row(line);
                        let parts = line.slice(of);
                        let mut sums = target.slice_mut(of);
                        for (sum, part) in sums.iter_mut().zip(parts.exact_or_rest(step)) {
                            *sum += part;
                        }
                    }
                }
                target /= lines.len() as f32;
            }
        }
        Ok(reduced)
    }
}

/// Means of a line's pieces of `step` values, the last of which may be shorter.
trait Pieces {
    fn exact_or_rest(&self, step: usize) -> impl Iterator<Item = f32>;
}

impl Pieces for ndarray::ArrayView1<'_, f32> {
    fn exact_or_rest(&self, step: usize) -> impl Iterator<Item = f32> {
        self.axis_chunks_iter(ndarray::Axis(0), step).map(|piece| piece.sum() / piece.len() as f32)
    }
}

/// How the finite values are spread; from 0 to 1 where there are none.
pub(in crate::http) fn spread(values: &Array2<f32>) -> Spread {
    let mut sorted: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| sorted.get((share * (sorted.len() as f32 - 1.0)).round() as usize);
    match (sorted.first(), at(0.005), at(0.995), sorted.last()) {
        (Some(&minimum), Some(&low), Some(&high), Some(&maximum)) => {
            Spread { minimum, maximum, low, high }
        }
        _ => Spread { minimum: 0.0, maximum: 1.0, low: 0.0, high: 1.0 },
    }
}

#[cfg(test)]
mod tests {
    use super::{Channels, Picture, TILE, spread};
    use ndarray::{Array2, s};

    #[test]
    fn each_colour_is_reduced_by_itself() {
        let colours =
            Array2::from_shape_fn((5, 21), |(i, at)| (100 * (at % 3) + i + at / 3) as f32);
        let grey = |c: usize| picture(colours.slice(s![.., c..;3]).to_owned(), 1);
        let all = colours.clone();
        let read = move |rows: std::ops::Range<usize>, columns: std::ops::Range<usize>| {
            Ok(all.slice(s![rows, 3 * columns.start..3 * columns.end]).to_owned())
        };
        let whole = Picture { channels: Channels::Rgb, read: Box::new(read), ..grey(0) };
        let region = whole.whole(1);
        let found = whole.reduce(&region).unwrap();
        for c in 0..3 {
            assert_eq!(found.slice(s![.., c..;3]), grey(c).reduce(&region).unwrap());
        }
    }

    fn picture(values: Array2<f32>, depth: usize) -> Picture {
        let (height, width) = values.dim();
        Picture {
            channels: Channels::Grey,
            height,
            width,
            identity: "test".into(),
            settled: true,
            depth,
            white: None,
            read: Box::new(move |rows, columns| Ok(values.slice(s![rows, columns]).to_owned())),
        }
    }

    fn ramp(height: usize, width: usize) -> Array2<f32> {
        Array2::from_shape_fn((height, width), |(i, j)| (i * 10 + j) as f32)
    }

    #[test]
    fn tiles_of_all_levels_join_to_the_mean_of_their_pixels() {
        let values = ramp(600, 523);
        // Deep pictures are read in many bands, which must not show.
        for depth in [1, 1 << 14] {
            let picture = picture(values.clone(), depth);
            assert_eq!(picture.level_within(TILE), 2);
            for level in 0..=2 {
                let whole = picture.reduce(&picture.whole(level)).unwrap();
                let step = 1 << level;
                for ((i, j), &found) in whole.indexed_iter() {
                    let (rows, columns) =
                        (i * step..((i + 1) * step).min(600), j * step..((j + 1) * step).min(523));
                    let mean = values.slice(s![rows, columns]).mean().unwrap();
                    assert!((found - mean).abs() < 1e-2, "{level} {i} {j}: {found} {mean}");
                }
                let (mut row, mut pixels) = (0, 0);
                while picture.tile(level, row, 0).is_some() {
                    let mut column = 0;
                    while let Some(region) = picture.tile(level, row, column) {
                        let tile = picture.reduce(&region).unwrap();
                        assert_eq!(tile, whole.slice(s![region.rows, region.columns]));
                        pixels += tile.len();
                        column += 1;
                    }
                    row += 1;
                }
                assert_eq!(pixels, whole.len());
            }
            assert!(picture.tile(3, 0, 0).is_none(), "one tile held all at the level before");
            assert!(picture.tile(0, usize::MAX, 0).is_none());
        }
    }

    #[test]
    fn outliers_do_not_set_the_window() {
        let mut values = Array2::from_shape_fn((100, 100), |(i, _)| i as f32);
        values[[50, 50]] = 1e6;
        values[[51, 51]] = f32::NAN;
        let found = spread(&values);
        assert_eq!((found.minimum, found.maximum), (0.0, 1e6));
        assert_eq!((found.low, found.high), (0.0, 99.0));
        assert_eq!(spread(&Array2::from_elem((2, 2), f32::NAN)).high, 1.0);
    }
}
