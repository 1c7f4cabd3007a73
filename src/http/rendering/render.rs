//! Reduces regions of a picture by averaging blocks of pixels. The values are also measured, so they are not reduced by
//! the `image` crate: for float32 its filters clip to \[0, 1\], and its thumbnails add a half.

use std::ops::Range;

use ndarray::{Array2, Axis, s};

use formats::{Channels, FormatError};

/// Side of a tile in pixels.
pub(in crate::http) const TILE: usize = 256;
/// Samples that are read at a time: 16 MiB.
const BAND_SAMPLES: usize = 4 << 20;

/// Reads rows and columns of a picture: f32 \[rows, columns\], or \[rows, 3 columns\] for colours.
type Read = dyn Fn(Range<usize>, Range<usize>) -> Result<Array2<f32>, FormatError> + Send + Sync;

/// A picture that is read in regions.
pub(in crate::http) struct Picture {
    pub(in crate::http) height: usize,
    pub(in crate::http) width: usize,
    /// Identifies the values: pictures with the same identity have the same values.
    pub(in crate::http) identity: String,
    pub(in crate::http) channels: Channels,
    /// Samples that are read for each pixel.
    pub(in crate::http) depth: usize,
    /// Default of the value shown as white; black is then 0. `None` if the picture has no white level.
    pub(in crate::http) white: Option<f32>,
    pub(in crate::http) read: Box<Read>,
}

/// A region of a picture in reduced pixels. A reduced pixel covers 2^`level` x 2^`level` pixels.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(in crate::http) struct Region {
    pub(in crate::http) level: u32,
    pub(in crate::http) rows: Range<usize>,
    pub(in crate::http) columns: Range<usize>,
}

/// Range of the values of a picture.
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
    /// The lowest level at which neither side of the picture exceeds `side` pixels.
    pub(in crate::http) fn level_within(&self, side: usize) -> u32 {
        let longest = self.height.max(self.width);
        (0..).find(|level| longest.div_ceil(1 << level) <= side).unwrap_or(0)
    }

    /// The region of the whole picture at a level.
    pub(in crate::http) fn whole(&self, level: u32) -> Region {
        let side = |length: usize| 0..length.div_ceil(1 << level);
        Region { level, rows: side(self.height), columns: side(self.width) }
    }

    /// The region of a tile; `None` if it is outside the picture. Levels go from 0, the full resolution, to the level
    /// at which a single tile covers the picture.
    pub(in crate::http) fn tile(&self, level: u32, row: usize, column: usize) -> Option<Region> {
        if level > self.level_within(TILE) {
            return None;
        }
        let whole = self.whole(level);
        let range = |index: usize, end: usize| {
            let start = index.checked_mul(TILE).filter(|start| *start < end)?;
            Some(start..end.min(start + TILE))
        };
        let (rows, columns) = (range(row, whole.rows.end)?, range(column, whole.columns.end)?);
        Some(Region { level, rows, columns })
    }

    /// The values of a region \[rows, columns\], or \[rows, 3 columns\] for colours. Each value is the mean of the pixels
    /// that it covers. Reads only these pixels, a band of rows at a time.
    pub(in crate::http) fn reduce(&self, region: &Region) -> Result<Array2<f32>, FormatError> {
        let step = 1usize << region.level;
        let channels = self.channels.count();
        let mut reduced = Array2::zeros((region.rows.len(), region.columns.len() * channels));
        let columns = region.columns.start * step..(region.columns.end * step).min(self.width);
        let band = (BAND_SAMPLES / (step * columns.len() * self.depth).max(1)).max(1);
        for start in region.rows.clone().step_by(band) {
            let end = (start + band).min(region.rows.end);
            let rows = start * step..(end * step).min(self.height);
            let window = (self.read)(rows, columns.clone())?;
            for (offset, row) in (start..end).enumerate() {
                let lines = offset * step..((offset + 1) * step).min(window.nrows());
                let mut means = reduced.row_mut(row - region.rows.start);
                for line in lines.clone() {
                    for channel in 0..channels {
                        let channel_samples = s![channel..;channels.cast_signed()];
                        let line = window.row(line);
                        let samples = line.slice(channel_samples);
                        let mut sums = means.slice_mut(channel_samples);
                        // The last block of a line may be narrower than the others.
                        let blocks = samples.axis_chunks_iter(Axis(0), step);
                        for (sum, block) in sums.iter_mut().zip(blocks) {
                            *sum += block.sum() / block.len() as f32;
                        }
                    }
                }
                means /= lines.len() as f32;
            }
        }
        Ok(reduced)
    }
}

/// The range of the finite values; 0 to 1 if there are none.
pub(in crate::http) fn spread(values: &Array2<f32>) -> Spread {
    let mut sorted: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let quantile = |share: f32| sorted.get((share * (sorted.len() as f32 - 1.0)).round() as usize);
    match (sorted.first(), quantile(0.005), quantile(0.995), sorted.last()) {
        (Some(&minimum), Some(&low), Some(&high), Some(&maximum)) => {
            Spread { minimum, maximum, low, high }
        }
        _ => Spread { minimum: 0.0, maximum: 1.0, low: 0.0, high: 1.0 },
    }
}

#[cfg(test)]
mod tests {
    use super::{Channels, Picture, Spread, TILE, spread};
    use ndarray::{Array2, s};

    #[test]
    fn each_colour_is_reduced_separately() {
        let colours =
            Array2::from_shape_fn((5, 21), |(i, at)| (100 * (at % 3) + i + at / 3) as f32);
        let grey = |c: usize| picture(colours.slice(s![.., c..;3]).to_owned(), 1);
        let all = colours.clone();
        let read = move |rows: std::ops::Range<usize>, columns: std::ops::Range<usize>| {
            Ok(all.slice(s![rows, 3 * columns.start..3 * columns.end]).to_owned())
        };
        let whole = Picture { channels: Channels::Rgb, read: Box::new(read), ..grey(0) };
        let region = whole.whole(1);
        let reduced = whole.reduce(&region).unwrap();
        for c in 0..3 {
            assert_eq!(reduced.slice(s![.., c..;3]), grey(c).reduce(&region).unwrap());
        }
    }

    fn picture(values: Array2<f32>, depth: usize) -> Picture {
        let (height, width) = values.dim();
        Picture {
            channels: Channels::Grey,
            height,
            width,
            identity: "test".into(),
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
        // Pictures of great depth are read in many bands. The bands must not change the values.
        for depth in [1, 1 << 14] {
            let picture = picture(values.clone(), depth);
            assert_eq!(picture.level_within(TILE), 2);
            for level in 0..=2 {
                let whole = picture.reduce(&picture.whole(level)).unwrap();
                let step = 1 << level;
                for ((i, j), &value) in whole.indexed_iter() {
                    let (rows, columns) =
                        (i * step..((i + 1) * step).min(600), j * step..((j + 1) * step).min(523));
                    let mean = values.slice(s![rows, columns]).mean().unwrap();
                    assert!((value - mean).abs() < 1e-2, "{level} {i} {j}: {value} {mean}");
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
            assert!(picture.tile(3, 0, 0).is_none(), "a single tile covers the picture at level 2");
            assert!(picture.tile(0, usize::MAX, 0).is_none());
        }
    }

    #[test]
    fn outliers_do_not_set_the_window() {
        let mut values = Array2::from_shape_fn((100, 100), |(i, _)| i as f32);
        values[[50, 50]] = 1e6;
        values[[51, 51]] = f32::NAN;
        let Spread { minimum, maximum, low, high } = spread(&values);
        assert_eq!((minimum, maximum), (0.0, 1e6));
        assert_eq!((low, high), (0.0, 99.0));
        assert_eq!(spread(&Array2::from_elem((2, 2), f32::NAN)).high, 1.0);
    }
}
